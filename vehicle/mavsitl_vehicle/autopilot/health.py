"""Health: the sensor bits of SYS_STATUS and the pre-arm summary, as pure functions of one small struct."""

from __future__ import annotations

from typing import NamedTuple

from mavsitl.dialect import mavlink

GYRO: int = mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
ACCELEROMETER: int = mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
MAGNETOMETER: int = mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
BAROMETER: int = mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
GPS: int = mavlink.MAV_SYS_STATUS_SENSOR_GPS
MOTORS: int = mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
STICKS: int = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
FENCE: int = mavlink.MAV_SYS_STATUS_GEOFENCE
LOGGING: int = mavlink.MAV_SYS_STATUS_LOGGING
BATTERY: int = mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
PREARM: int = mavlink.MAV_SYS_STATUS_PREARM_CHECK

_RATES: int = mavlink.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
_ATTITUDE: int = (
    mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mavlink.MAV_SYS_STATUS_SENSOR_YAW_POSITION
)
_HEIGHT: int = mavlink.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
_POSITION: int = mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL

_ALWAYS = (
    GYRO | ACCELEROMETER | MAGNETOMETER | BAROMETER | GPS | MOTORS | BATTERY
    | _RATES | _ATTITUDE | _HEIGHT | _POSITION | PREARM
)  # fmt: skip
"""What every vehicle of this kind has."""


class Validity(NamedTuple):
    """Which parts of the estimate are good for flying."""

    attitude: bool = True
    height: bool = True
    """Height and climb."""
    velocity: bool = True
    """Horizontal."""
    position: bool = True
    """Horizontal."""


class Health(NamedTuple):
    """What is well. Defaults are a vehicle without faults, sticks, fence or log."""

    gyro: bool = True
    accelerometer: bool = True
    magnetometer: bool = True
    barometer: bool = True
    gps: bool = True
    motors: bool = True
    battery: bool = True
    """No warning of BAT_CRIT_THR or worse."""
    attitude: bool = True
    """The attitude estimate is valid."""
    upright: bool = True
    """Not fallen over: what lies on its side cannot take off."""
    height: bool = True
    position: bool = True
    """The horizontal position estimate is valid."""
    home: bool = True
    """Home has been set."""
    sticks: bool = False
    """Stick input is coming."""
    sticks_needed: bool = False
    """The mode flies by the sticks."""
    fence: bool = False
    """A fence is loaded and its action is not "none"."""
    fence_breached: bool = False
    logging: bool = False
    """A log is being written."""
    position_needed: bool = True
    """The mode needs a position, and with it home; with COM_ARM_WO_GPS it may be False in modes without one."""
    mode_refusal: str | None = None
    """Why the mode itself would not arm now; None: it would."""


class Bits(NamedTuple):
    """Of SYS_STATUS: onboard_control_sensors_present, _enabled and _health."""

    present: int
    enabled: int
    health: int


def refusals(health: Health) -> tuple[str, ...]:
    """Every reason why arming is refused, the gravest first; empty: ready."""
    checks = (
        (health.gyro, "gyro fault"),
        (health.accelerometer, "accelerometer fault"),
        (health.magnetometer, "magnetometer fault"),
        (health.barometer, "barometer fault"),
        (health.motors, "motor fault"),
        (health.attitude, "attitude estimate invalid"),
        (health.upright, "fallen over, a reboot sets it upright"),
        (health.height, "height estimate invalid"),
        (health.position or not health.position_needed, "no valid position estimate"),
        (health.gps or not health.position_needed, "no GPS fix"),
        (health.home or not health.position_needed, "home position not set"),
        (health.battery, "low battery"),
        (health.sticks or not health.sticks_needed, "no manual control input"),
        (not health.fence_breached, "geofence violation"),
    )
    found = tuple(reason for well, reason in checks if not well)
    return found if health.mode_refusal is None else (*found, health.mode_refusal)


def summary(health: Health) -> str | None:
    """`refusals` in one line, for a STATUSTEXT; None when ready."""
    return ", ".join(refusals(health)) or None


def bits(health: Health) -> Bits:
    """The bits of SYS_STATUS.

    Ready to arm, `enabled` is a subset of `health`: ground stations list what is enabled and not healthy as an error.
    So what the mode does not need (sticks, position) is enabled only while it works. GEOFENCE is healthy unless
    breached, fence or none.
    """
    present, well = _ALWAYS, FENCE | LOGGING | _RATES
    if health.sticks:
        present |= STICKS
    if health.fence:
        present |= FENCE
    if health.logging:
        present |= LOGGING
    enabled = present | STICKS if health.sticks_needed else present
    for good, bit in (
        (health.gyro, GYRO),
        (health.accelerometer, ACCELEROMETER),
        (health.magnetometer, MAGNETOMETER),
        (health.barometer, BAROMETER),
        (health.gps, GPS),
        (health.motors, MOTORS),
        (health.battery, BATTERY),
        (health.attitude, _ATTITUDE),
        (health.height, _HEIGHT),
        (health.position, _POSITION),
        (health.sticks, STICKS),
    ):
        if good:
            well |= bit
    if health.fence_breached:
        well &= ~FENCE
    if not health.position_needed:
        enabled &= well | ~(GPS | _POSITION)
    if not refusals(health):
        well |= PREARM
    return Bits(present, enabled, well)
