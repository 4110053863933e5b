"""Every stick mode flown by MANUAL_CONTROL, and every switch between modes that fly: no step in what is demanded."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from math import acos, degrees, hypot
from typing import NamedTuple

import numpy as np
import pytest
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.autopilot import Autopilot
from mavsitl_vehicle.autopilot.modes import TABLE, Control, Mode
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    HOLD,
    REJECTED,
    flying,
    item,
    sticks,
    track,
    upload,
    waypoint,
)

STICK_MODES = [mode for mode, info in TABLE.items() if info.control is Control.STICKS]
SELECTABLE = [mode for mode, info in TABLE.items() if info.selectable]
HEIGHT_M = 5.0


def numbers(mode: Mode) -> tuple[int, int]:
    return TABLE[mode].main_mode, TABLE[mode].sub_mode


def piloted(mode: Mode) -> tuple[Client, Callable[[], int]]:
    """In the air in a stick mode, sticks centred."""
    client = flying(HEIGHT_M)
    centred = sticks(client)
    client.run(0.1, centred)
    assert client.mode(*numbers(mode)) == ACCEPTED
    client.run(0.2, centred)
    assert client.flight_mode == numbers(mode)
    return client, centred


# --- the table


@pytest.mark.parametrize("mode", SELECTABLE)
def test_a_mode_is_shown_as_the_table_says(mode: Mode, client: Client) -> None:
    info = TABLE[mode]
    client.run(2.1)
    assert client.mode(*numbers(mode)) == ACCEPTED
    client.tick()
    beat = client.heartbeat
    assert beat.custom_mode == modes.custom_mode(mode) == info.main_mode << 16 | info.sub_mode << 24
    assert beat.base_mode & 1
    assert bool(beat.base_mode & mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED) == (info.control is Control.STICKS)
    assert bool(beat.base_mode & mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED) == info.stabilized
    auto = info.control in (Control.NAVIGATOR, Control.STREAM)
    assert bool(beat.base_mode & mavlink.MAV_MODE_FLAG_GUIDED_ENABLED) == auto
    assert client.last("CURRENT_MODE", GCS).custom_mode == beat.custom_mode


@pytest.mark.parametrize("mode", SELECTABLE)
def test_what_arms(mode: Mode, client: Client) -> None:
    """Without stream, mission and sticks: PX4 arms in all that need none of them, and in the stick modes."""
    client.run(0.1)
    client.mode(*numbers(mode))
    arms = TABLE[mode].can_arm and mode not in (Mode.OFFBOARD, Mode.MISSION)
    assert client.arm() == (ACCEPTED if arms else REJECTED)
    client.tick()
    assert client.armed == arms
    if not arms:
        assert client.texts()[-1].startswith("Arming denied: ")


def test_the_numbers_name_one_mode_each() -> None:
    named = {numbers(mode) for mode in modes.LISTED}
    assert len(named) == len(modes.LISTED)
    assert numbers(Mode.DESCEND) == numbers(Mode.LAND)  # as on PX4
    assert len({info.nav_state for info in TABLE.values()}) == len(TABLE)
    for mode in SELECTABLE:
        assert modes.find(*numbers(mode)) is mode
    for mode in set(modes.LISTED) - set(SELECTABLE):  # as on PX4 only their own commands lead there
        assert modes.find(*numbers(mode)) is None
    assert modes.find(4, 0) is Mode.MISSION


def test_standard_modes_by_command() -> None:
    for mode in SELECTABLE:
        info = TABLE[mode]
        if not info.standard_mode:
            continue
        client = Client(flight())
        assert client.result(mavlink.MAV_CMD_DO_SET_STANDARD_MODE, info.standard_mode) == ACCEPTED
        client.tick()
        assert client.flight_mode == numbers(mode)
    assert Client(flight()).result(mavlink.MAV_CMD_DO_SET_STANDARD_MODE, 2) == mavlink.MAV_RESULT_DENIED


# --- flown by sticks


@pytest.mark.parametrize("mode", [Mode.ALTCTL, Mode.POSCTL])
def test_take_off_by_the_throttle_and_hold(mode: Mode) -> None:
    client = Client(flight())
    client.mode(*numbers(mode))
    client.run(0.2, sticks(client, throttle=0.0))
    assert client.arm() == ACCEPTED
    client.run(2.0, sticks(client, throttle=0.5))
    assert client.landed
    client.run_until(lambda: client.truth[2] > 2.0, 8.0, sticks(client, throttle=0.9))
    client.run(3.0, sticks(client))
    path = track(client, 3.0, sticks(client))
    assert path[:, 2].max() - path[:, 2].min() < 0.05
    assert 2.0 < client.truth[2] < 4.0


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.STABILIZED, Mode.ACRO])
def test_take_off_by_the_collective(mode: Mode) -> None:
    client = Client(flight())
    client.mode(*numbers(mode))
    client.run(0.2, sticks(client, throttle=0.0))
    assert client.arm() == ACCEPTED
    client.run(2.0, sticks(client, throttle=0.0))
    assert client.landed
    client.run(1.0, sticks(client, throttle=0.7))
    assert client.truth[2] > 0.5
    assert hypot(*client.truth[:2]) < 0.1


@pytest.mark.parametrize("mode", [Mode.ALTCTL, Mode.POSCTL])
def test_climb_and_sink_by_the_throttle(mode: Mode) -> None:
    client, centred = piloted(mode)
    client.run(2.5, sticks(client, throttle=1.0))
    assert client.truth[5] == pytest.approx(client.vehicle.parameters["MPC_Z_VEL_MAX_UP"], abs=0.1)
    client.run(2.0, centred)
    assert abs(client.truth[5]) < 0.05
    client.run(2.5, sticks(client, throttle=0.0))
    assert client.truth[5] == pytest.approx(-client.vehicle.parameters["MPC_Z_VEL_MAX_DN"], abs=0.1)


@pytest.mark.parametrize("mode", STICK_MODES)
@pytest.mark.parametrize(("pitch", "roll"), [(0.4, 0.0), (0.0, 0.4), (-0.4, 0.0), (0.0, -0.4)])
def test_sticks_point_where_it_goes(mode: Mode, pitch: float, roll: float) -> None:
    """Forward stick: nose down, to the north; right stick: right wing down, to the east."""
    client, _ = piloted(mode)
    client.run(0.7, sticks(client, pitch=pitch, roll=roll))
    _, _, _, vx, vy = client.truth[:5]
    along = vx if pitch else -vy
    assert along * (pitch or roll) > 0.0
    assert abs(along) > 0.3
    assert abs(-vy if pitch else vx) < 0.1


@pytest.mark.parametrize("mode", STICK_MODES)
@pytest.mark.parametrize("yaw", [0.5, -0.5])
def test_the_yaw_stick_turns_and_stops(mode: Mode, yaw: float) -> None:
    client, centred = piloted(mode)
    client.run(1.2, sticks(client, yaw=yaw))
    rate = client.last("ATTITUDE", 0).yawspeed
    assert rate * yaw > 0.0
    assert abs(rate) > 0.3
    client.run(1.5, centred)
    assert abs(client.last("ATTITUDE", 0).yawspeed) < 0.05


def test_posctl_stops_and_stays() -> None:
    client, centred = piloted(Mode.POSCTL)
    client.run(3.0, sticks(client, pitch=1.0))
    assert client.truth[3] > 3.0
    client.run(6.0, centred)
    path = track(client, 3.0, centred)
    assert np.ptp(path[:, :3], axis=0).max() < 0.05


def test_posctl_lands_by_the_throttle_and_disarms() -> None:
    client, _ = piloted(Mode.POSCTL)
    down = sticks(client, throttle=0.0)
    client.run_until(lambda: client.landed, 15.0, down)
    client.run_until(lambda: not client.armed, 4.0, down)
    assert client.texts()[-1] == "Disarmed by landing"


@pytest.mark.parametrize("mode", [Mode.STABILIZED, Mode.MANUAL])
def test_released_sticks_level_the_vehicle(mode: Mode) -> None:
    client, centred = piloted(mode)
    client.run(0.4, sticks(client, roll=0.6))
    assert client.last("ATTITUDE", 0).roll > 0.2
    client.run(1.0, centred)
    assert abs(client.last("ATTITUDE", 0).roll) < 0.02


def test_acro_keeps_the_attitude_that_it_was_turned_to() -> None:
    client, centred = piloted(Mode.ACRO)
    client.run(0.3, sticks(client, roll=0.5))
    rolled = client.last("ATTITUDE", 0).roll
    assert rolled > 0.1
    client.run(0.3, centred)
    assert client.last("ATTITUDE", 0).roll > rolled


def test_axes_that_are_not_there_keep_their_value() -> None:
    client, _ = piloted(Mode.POSCTL)
    client.run(1.0, sticks(client, pitch=0.5))
    missing = 2**15 - 1
    message = mavlink.MAVLink_manual_control_message(1, missing, 0, 500, missing, 0)
    client.run(1.5, lambda: client.send(message, port=GCS))
    assert client.truth[3] > 1.0
    nothing = mavlink.MAVLink_manual_control_message(1, missing, missing, missing, missing, 0)
    client.run(1.0, lambda: client.send(nothing, port=GCS))
    assert client.flight_mode != numbers(Mode.POSCTL)  # it counts as silence
    assert client.critical


def test_sticks_for_another_vehicle_are_not_ours(client: Client) -> None:
    client.send(mavlink.MAVLink_manual_control_message(2, 0, 0, 500, 0, 0))
    assert client.vehicle.autopilot.pilot.received_us is None
    client.send(mavlink.MAVLink_manual_control_message(0, 0, 0, 500, 0, 0))
    assert client.vehicle.autopilot.pilot.received_us is not None


# --- refusals in the air


@pytest.mark.parametrize("mode", STICK_MODES)
def test_stick_modes_without_sticks_are_refused_in_the_air(mode: Mode) -> None:
    client = flying(2.0)
    assert client.mode(*numbers(mode)) == REJECTED
    client.tick()
    assert client.flight_mode == HOLD
    assert client.texts()[-1] == f"{TABLE[mode].name} refused: no MANUAL_CONTROL received yet"
    client.run(0.1, sticks(client))
    client.run(0.6)
    assert client.mode(*numbers(mode)) == REJECTED
    client.tick()
    assert "last MANUAL_CONTROL 0.60 s ago, need < 0.50 s" in client.texts()[-1]


# --- switches


class Demand(NamedTuple):
    tilt: tuple[float, float, float]
    """The body's z axis in the world."""
    thrust: float


def demand(autopilot: Autopilot) -> Demand | None:
    setpoint = autopilot.attitude_setpoint
    if not isinstance(setpoint, AttitudeSetpoint):
        return None
    w, x, y, z = setpoint.attitude
    return Demand((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), setpoint.thrust)


PAIRS = list(permutations(SELECTABLE, 2))
SMOOTH = {Mode.ALTCTL, Mode.POSCTL, Mode.MISSION, Mode.LOITER, Mode.RTL, Mode.OFFBOARD, Mode.TAKEOFF, Mode.LAND}
"""Modes that fly by the position cascade: the switch to them must not be felt."""


@pytest.mark.parametrize("before", SELECTABLE)
def test_switches_in_flight_make_no_step(before: Mode) -> None:
    """From `before`, flying to the north at some metres a second, to every other mode and back."""
    client = flying(8.0)
    upload(client, [item(client, 22, height_m=8.0), waypoint(client, 300, 0, 8)])
    stick = sticks(client, pitch=0.3)
    stream = mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0xDC7, 0, 0, 0, 2.0, 0, 0, 0, 0, 0, 0, 0
    )  # fmt: skip

    def both() -> None:
        stick()
        client.send(stream)

    client.run(0.3, both)
    autopilot = client.vehicle.autopilot
    for after in SELECTABLE:
        if after is before:
            continue
        client.hold()
        client.run(0.7, both)
        assert client.mode(*numbers(before)) == ACCEPTED, before
        client.run(0.6, both)
        old = demand(autopilot)
        assert client.mode(*numbers(after)) == ACCEPTED, (before, after)
        both()
        client.tick()
        client.tick()
        new = demand(autopilot)
        assert client.flight_mode in (numbers(after), HOLD), (before, after)  # a take-off is over at once
        if after in SMOOTH and old is not None:
            assert new is not None
            turn = degrees(acos(min(sum(a * b for a, b in zip(old.tilt, new.tilt, strict=True)), 1.0)))
            assert turn < 2.0, (before, after, turn)
            assert abs(new.thrust - old.thrust) < 0.03, (before, after, old.thrust, new.thrust)
        client.run(0.3, both)
        assert 2.0 < client.truth[2] < 14.0
        if before in (Mode.ACRO,) or after in (Mode.ACRO,):
            client.hold()
            client.run(3.0, both)
