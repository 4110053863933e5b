"""SET_ATTITUDE_TARGET and SET_ACTUATOR_CONTROL_TARGET: what is taken, what is refused, and in whose axes."""

from __future__ import annotations

from math import cos, inf, isnan, nan, radians, sin, sqrt
from typing import Any

import pytest
from mavsitl_vehicle.autopilot.setpoints import (
    AttitudeSetpoint,
    RateSetpoint,
    Refusal,
    TorqueSetpoint,
    from_actuator_control_target,
)

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import Client, attitude_target, taken_of

# The rule, from MAVLink's bit list as PX4 reads it. Columns: bit 7 (attitude ignored), bit 1 (pitch rate ignored) and
# bit 0 (roll rate ignored); then what the message is. Bits 3 and 4 say nothing; bit 5 asks for a field that the message
# has not.
RULE = {
    "000": "attitude",
    "001": "attitude",
    "010": "attitude",
    "011": "attitude",
    "100": "rates",
    "101": "nothing",
    "110": "nothing",
    "111": "nothing",
}

EXACT = (0.5, 0.5, 0.5, 0.5)
RATES = (0.25, -0.5, 0.75)


def expected_kind(type_mask: int) -> str:
    bits = f"{type_mask:08b}"  # bits[0] is bit 7
    return "refused" if bits[2] == "1" else RULE[bits[0] + bits[6] + bits[7]]


@pytest.mark.parametrize("type_mask", range(256))
def test_every_type_mask(type_mask: int) -> None:
    taken = taken_of(attitude_target(type_mask, q=EXACT, rates=RATES, thrust=0.625))
    bits = f"{type_mask:08b}"
    thrust = 0.0 if bits[1] == "1" else 0.625
    yaw_ignored = bits[5] == "1"
    match expected_kind(type_mask):
        case "attitude":
            assert isinstance(taken, AttitudeSetpoint)
            assert taken.attitude == (0.5, 0.5, -0.5, -0.5)
            assert isnan(taken.yaw_rate_rad_s) if yaw_ignored else taken.yaw_rate_rad_s == -0.75
            assert taken.thrust == thrust
        case "rates":
            assert isinstance(taken, RateSetpoint)
            p, q, r = taken.omega_flu_rad_s
            assert (p, q) == (0.25, 0.5)
            assert isnan(r) if yaw_ignored else r == -0.75
            assert taken.thrust == thrust
        case _:
            assert isinstance(taken, Refusal)
            assert taken.text


def test_the_rule_has_all_three_outcomes() -> None:
    kinds = [expected_kind(type_mask) for type_mask in range(256)]
    assert {kind: kinds.count(kind) for kind in set(kinds)} == {
        "refused": 128,
        "attitude": 64,
        "rates": 16,
        "nothing": 48,
    }


FIELDS = ("q0", "q1", "q2", "q3", "roll", "pitch", "yaw", "thrust")
# What each mask uses of FIELDS.
USED = {
    7: {"q0", "q1", "q2", "q3", "thrust"},
    3: {"q0", "q1", "q2", "q3", "yaw", "thrust"},
    0: {"q0", "q1", "q2", "q3", "yaw", "thrust"},
    7 | 64: {"q0", "q1", "q2", "q3"},
    128: {"roll", "pitch", "yaw", "thrust"},
    128 | 4: {"roll", "pitch", "thrust"},
    128 | 64: {"roll", "pitch", "yaw"},
    128 | 64 | 4: {"roll", "pitch"},
}


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("type_mask", USED)
def test_a_field_that_is_not_finite_refuses_where_it_is_used(type_mask: int, field: str, bad: float) -> None:
    values = dict(zip(FIELDS, (*EXACT, *RATES, 0.625), strict=True)) | {field: bad}
    q = (values["q0"], values["q1"], values["q2"], values["q3"])
    rates = (values["roll"], values["pitch"], values["yaw"])
    taken = taken_of(attitude_target(type_mask, q=q, rates=rates, thrust=values["thrust"]))
    assert isinstance(taken, Refusal) == (field in USED[type_mask])


@pytest.mark.parametrize(("norm", "good"), [(0.0, False), (0.98, False), (0.995, True), (1.005, True), (1.02, False)])
def test_quaternion_norm(norm: float, good: bool) -> None:
    q = (0.6 * norm, 0.0, 0.8 * norm, 0.0)
    taken = taken_of(attitude_target(7, q=q))
    assert isinstance(taken, AttitudeSetpoint) == good
    if isinstance(taken, AttitudeSetpoint):
        assert taken.attitude == pytest.approx((0.6, 0.0, -0.8, 0.0), abs=1e-12)
    unused = taken_of(attitude_target(128, q=q))
    assert isinstance(unused, RateSetpoint)


@pytest.mark.parametrize(("sent", "flown"), [(-3.0e7, 0.0), (-0.1, 0.0), (0.3, 0.3), (1.0, 1.0), (1.5, 1.0)])
@pytest.mark.parametrize("type_mask", [7, 128])
def test_thrust_is_clipped(type_mask: int, sent: float, flown: float) -> None:
    taken = taken_of(attitude_target(type_mask, thrust=sent))
    assert not isinstance(taken, Refusal)
    assert taken.thrust == flown


HALF = radians(15.0)


@pytest.mark.parametrize(
    ("name", "frd", "flu"),
    [
        # FRD to NED on the left; by hand on the right. Rolled to the right is the same turn about the common x axis.
        ("right wing down", (cos(HALF), sin(HALF), 0, 0), (cos(HALF), sin(HALF), 0, 0)),
        # Nose up turns about FRD's y, to the right; FLU's y points left, so the angle is negative.
        ("nose up", (cos(HALF), 0, sin(HALF), 0), (cos(HALF), 0, -sin(HALF), 0)),
        # Nose to the east turns about z down; about z up it is negative.
        ("facing east", (sqrt(0.5), 0, 0, sqrt(0.5)), (sqrt(0.5), 0, 0, -sqrt(0.5))),
    ],
)
def test_attitude_signs(name: str, frd: tuple[float, float, float, float], flu: tuple[float, ...]) -> None:
    taken = taken_of(attitude_target(7, q=frd))
    assert isinstance(taken, AttitudeSetpoint)
    assert taken.attitude == pytest.approx(flu, abs=1e-12)


def actuators(controls: tuple[float, ...], group: int = 0) -> Any:
    filled = [*controls, *([0.0] * (8 - len(controls)))]
    return mavlink.MAVLink_set_actuator_control_target_message(4000, group, 1, 1, filled)


def test_actuator_control_target() -> None:
    taken = from_actuator_control_target(actuators((0.1, 0.2, 0.3, 0.4)))
    assert taken == TorqueSetpoint((0.1, -0.2, -0.3), 0.4)
    taken = from_actuator_control_target(actuators((-2.0, 2.0, -2.0, -1.0)))
    assert taken == TorqueSetpoint((-1.0, -1.0, 1.0), 0.0)
    assert from_actuator_control_target(actuators((0, 0, 0, 7.0))) == TorqueSetpoint((0.0, 0.0, 0.0), 1.0)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("index", range(8))
def test_actuator_controls_that_are_not_finite(index: int, bad: float) -> None:
    controls = [0.5] * 8
    controls[index] = bad
    taken = from_actuator_control_target(actuators(tuple(controls)))
    assert isinstance(taken, Refusal) == (index < 4)  # 4 to 7 are flaps and the like: not looked at


@pytest.mark.parametrize("group", [1, 2, 3, 255])
def test_other_actuator_groups_are_refused(group: int) -> None:
    assert isinstance(from_actuator_control_target(actuators((0, 0, 0, 0.5), group)), Refusal)


# --- over the wire: does it count as a stream?


def counts_as_stream(client: Client, message: Any) -> bool:
    """Arming in OFFBOARD is what a stream is for."""
    client.send(message)
    assert client.offboard() == mavlink.MAV_RESULT_ACCEPTED
    return bool(client.arm() == mavlink.MAV_RESULT_ACCEPTED)


@pytest.mark.parametrize("target", [(1, 1), (0, 0), (1, 0), (0, 1)])
def test_own_and_broadcast_setpoints_are_a_stream(client: Client, target: tuple[int, int]) -> None:
    assert counts_as_stream(client, attitude_target(7, target=target))


@pytest.mark.parametrize(
    "message",
    [
        attitude_target(7, target=(2, 1)),
        attitude_target(7, target=(1, 2)),
        attitude_target(7, target=(0, 190)),
        attitude_target(7, q=(nan, 0, 0, 0)),
        attitude_target(131),
        attitude_target(39),
        actuators((0, 0, 0, nan)),
        actuators((0, 0, 0, 0.5), 1),
        mavlink.MAVLink_set_actuator_control_target_message(4000, 0, 2, 1, [0.0] * 8),
        mavlink.MAVLink_set_actuator_control_target_message(4000, 0, 1, 9, [0.0] * 8),
    ],
    ids=lambda message: message.get_type(),
)
def test_foreign_and_refused_setpoints_are_no_stream(client: Client, message: Any) -> None:
    assert not counts_as_stream(client, message)


def test_foreign_setpoints_are_silent_and_refused_ones_say_why(client: Client) -> None:
    client.send(attitude_target(7, target=(2, 1)))
    client.tick()
    assert client.texts() == []
    client.send(attitude_target(7, q=(2.0, 0, 0, 0)))
    client.tick()
    assert client.texts() == ["SET_ATTITUDE_TARGET refused: |q| is 2, need 1"]


def test_the_whole_reason_arrives(client: Client) -> None:
    """STATUSTEXT holds 50 characters; a longer text comes in chunks."""
    client.send(attitude_target(39))
    client.tick()
    text = "SET_ATTITUDE_TARGET refused: THRUST_BODY_SET needs thrust_body, not in this dialect"
    assert client.texts() == [text]
    chunks = client.all("STATUSTEXT", 0)
    assert [chunk.chunk_seq for chunk in chunks] == [0, 1]
    assert chunks[0].id == chunks[1].id != 0
    assert len(chunks[0].text) == 50


def test_a_bad_stream_does_not_flood_its_link(client: Client) -> None:
    client.run(2.9, lambda: client.send(attitude_target(7, thrust=nan)))
    reason = "SET_ATTITUDE_TARGET refused: thrust is nan"
    assert client.texts() == [reason, reason, f"{reason} (498 more held back)"]
    assert client.vehicle.autopilot.refused_setpoints == 725


def test_actuator_control_target_turns_as_it_says(client: Client) -> None:
    """A little more torque to the right, nose up, to the right: FRD rates positive on each axis."""
    client.climb(3.0)
    client.send(actuators((0.05, 0.05, 0.2, 0.5)))
    client.run(0.1)
    state = client.last("ATTITUDE", 0)
    assert state.rollspeed > 0.1
    assert state.pitchspeed > 0.1
    assert state.yawspeed > 0.005
