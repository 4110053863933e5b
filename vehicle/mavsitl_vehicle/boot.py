"""The vehicle's HEARTBEAT before there is a vehicle. Loads the dialect and the table of modes, and nothing else."""

from __future__ import annotations

from mavsitl.codec import packer
from mavsitl.dialect import mavlink
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.modes import Mode

_HEARTBEAT = packer(mavlink.MAVLink_heartbeat_message)
_MAVLINK_VERSION = 3


def heartbeat(sequence: int, system_id: int) -> bytes:
    """The entry point `mavsitl.boot`: a frame that says what will be here, disarmed, and that it boots."""
    mode = Mode.LOITER
    frame = _HEARTBEAT(
        sequence, system_id, mavlink.MAV_COMP_ID_AUTOPILOT1,
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4,
        mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | modes.TABLE[mode].base_mode, modes.custom_mode(mode),
        mavlink.MAV_STATE_BOOT, _MAVLINK_VERSION,
    )  # fmt: skip
    return bytes(frame)
