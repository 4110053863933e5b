"""SET_POSITION_TARGET_LOCAL_NED and _GLOBAL_INT: every mask and frame against the rule, stated once more."""

from __future__ import annotations

from math import cos, inf, isnan, nan, pi, sin
from types import SimpleNamespace
from typing import Any

import pytest
from mavsitl_vehicle.autopilot.setpoints import (
    AttitudeSetpoint,
    PositionSetpoint,
    RateSetpoint,
    Refusal,
    State,
    from_position_target_global_int,
    from_position_target_local_ned,
)

from mavsitl.dialect import mavlink
from mavsitl.quaternion import from_euler
from tests.autopilot.conftest import taken_of

FIELDS = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz")
VALUES = dict(zip(FIELDS, (1.0, 2.0, 3.0, 0.5, 0.25, 0.125, 4.0, 8.0, 16.0), strict=True))
YAW, YAW_RATE = 0.75, 0.375
HEADING_NWU = 0.5
STATE = State((100.0, 200.0, 50.0), (7.0, 7.0, 7.0), from_euler(0.3, -0.2, HEADING_NWU))
SIGNS = (1.0, -1.0, -1.0)
"""NED to NWU."""


def local(mask: int, frame: int = 1, yaw: float = YAW, yaw_rate: float = YAW_RATE, **fields: float) -> Any:
    values = {**VALUES, **fields}
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, mask, *(values[name] for name in FIELDS), yaw, yaw_rate
    )


def bit(mask: int, index: int) -> bool:
    """Whether the mask leaves out field `index` of FIELDS; 9 is force, 10 yaw, 11 yaw rate."""
    return f"{mask:012b}"[11 - index] == "1"


def expected(mask: int, frame: int) -> list[list[float]] | None:
    """Position, velocity and acceleration (NWU, NaN: not controlled), by looking at each field; None: refused."""
    numbers = list(VALUES.values())
    groups = []
    for first in (0, 3, 6):
        raw = [nan if bit(mask, first + i) else numbers[first + i] for i in range(3)]
        if frame == 8 and first == 0:
            raw = [nan] * 3
        if frame == 8 and first == 6 and any(isnan(value) for value in raw):
            raw = [nan] * 3
        groups.append(raw)
    if all(isnan(value) for raw in groups for value in raw):
        return None
    if bit(mask, 9) and not all(isnan(value) for value in groups[2]):
        return None
    answer = []
    for index, raw in enumerate(groups):
        nwu = [sign * value for sign, value in zip(SIGNS, raw, strict=True)]
        if frame == 9 or (frame == 8 and index == 1):
            if not (isnan(nwu[0]) and isnan(nwu[1])):
                ahead, left = (0.0 if isnan(value) else value for value in nwu[:2])
                c, s = cos(HEADING_NWU), sin(HEADING_NWU)
                nwu[:2] = [ahead * c - left * s, ahead * s + left * c]
        elif frame == 8 and index == 2 and not isnan(nwu[0]):
            w, x, y, z = STATE.attitude  # the rotation matrix, row by row
            rows = (
                (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
                (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
                (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
            )
            nwu = [sum(a * b for a, b in zip(row, nwu, strict=True)) for row in rows]
        if index == 0 and frame in (7, 9):
            nwu = [a + b for a, b in zip(nwu, STATE.position_nwu_m, strict=True)]
        answer.append(nwu)
    return answer


@pytest.mark.parametrize("yaw_bits", [0, 1024, 2048, 3072])
@pytest.mark.parametrize("frame", [1, 7, 8, 9])
def test_every_mask(frame: int, yaw_bits: int) -> None:
    """All 512 combinations of the nine fields, with and without the force bit."""
    outcomes = []
    for low in range(1024):
        mask = low | yaw_bits
        taken = from_position_target_local_ned(local(mask, frame), STATE)
        wanted = expected(mask, frame)
        outcomes.append(wanted is None)
        if wanted is None:
            assert isinstance(taken, Refusal), hex(mask)
            continue
        assert isinstance(taken, PositionSetpoint), hex(mask)
        for got, want in zip(taken[:3], wanted, strict=True):
            assert got == pytest.approx(want, abs=1e-12, nan_ok=True), hex(mask)
        if yaw_bits & 1024:
            assert isnan(taken.yaw_rad)
        else:
            assert taken.yaw_rad == pytest.approx(-YAW + (HEADING_NWU if frame == 9 else 0.0))
        if yaw_bits & 2048:
            assert isnan(taken.yaw_rate_rad_s)
        else:
            assert taken.yaw_rate_rad_s == -YAW_RATE
    # Of 512 masks one leaves nothing, and 448 have an acceleration for the force bit to refuse. In frame 8 the position
    # counts for nothing and the acceleration only whole: 8 x 7 leave nothing, 8 x 8 have an acceleration.
    assert outcomes.count(True) == (2 * 8 * 7 + 8 * 8 if frame == 8 else 2 * 1 + 448)


@pytest.mark.parametrize(
    ("client", "mask", "used"),
    [
        ("MAVSDK position", 0x9F8, "xyz yaw"),
        ("MAVSDK position, both yaws left out", 0xDF8, "xyz"),
        ("MAVSDK velocity", 0x9C7, "v yaw"),
        ("MAVSDK position and velocity", 0x9C0, "xyz v yaw"),
        ("MAVSDK all", 0x800, "xyz v a yaw"),
        ("MAVSDK acceleration", 0xC3F, "a"),
        ("mavros velocity", 0x5C7, "v rate"),
        ("ArduPilot's examples, force bit set with no acceleration", 0xFC7, "v"),
    ],
)
def test_what_clients_send(client: str, mask: int, used: str) -> None:
    taken = from_position_target_local_ned(local(mask), STATE)
    assert isinstance(taken, PositionSetpoint)
    words = used.split()
    assert taken.position_nwu_m == (pytest.approx((1.0, -2.0, -3.0)) if "xyz" in words else taken.position_nwu_m)
    for word, values in (("xyz", taken[0]), ("v", taken[1]), ("a", taken[2]), ("yaw", taken[3:4]), ("rate", taken[4:])):
        assert all(isnan(value) != (word in words) for value in values), word


def test_signs() -> None:
    """2 m east, 3 m up, facing east, turning right."""
    taken = from_position_target_local_ned(local(0b000111000000, x=0.0, y=2.0, z=-3.0, yaw=pi / 2, yaw_rate=0.1), STATE)
    assert isinstance(taken, PositionSetpoint)
    assert taken.position_nwu_m == (0.0, -2.0, 3.0)
    assert taken.yaw_rad == pytest.approx(-pi / 2)
    assert taken.yaw_rate_rad_s == -0.1


def test_forward_is_where_the_nose_points() -> None:
    """Facing west, tilted: one metre a second ahead is to the west, level, and 1 m to the right is to the north."""
    west = State((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), from_euler(0.2, 0.3, pi / 2))
    taken = from_position_target_local_ned(local(0xFC7, 8, vx=1.0, vy=0.0, vz=0.0), west)
    assert isinstance(taken, PositionSetpoint)
    assert taken.velocity_nwu_m_s == pytest.approx((0.0, 1.0, 0.0), abs=1e-12)
    taken = from_position_target_local_ned(local(0xFF8, 9, x=0.0, y=1.0, z=-1.0), west)
    assert isinstance(taken, PositionSetpoint)
    assert taken.position_nwu_m == pytest.approx((1.0, 0.0, 6.0), abs=1e-12)


def test_yaw_comes_out_within_a_turn() -> None:
    taken = from_position_target_local_ned(local(0xBF8, yaw=7.0), STATE)
    assert isinstance(taken, PositionSetpoint)
    assert taken.yaw_rad == pytest.approx(-7.0 + 2.0 * pi)


@pytest.mark.parametrize("frame", [0, 2, 3, 4, 5, 6, 10, 11, 12, 13, 20, 21, 255])
def test_other_local_frames_are_refused(frame: int) -> None:
    taken = from_position_target_local_ned(local(0xFF8 & ~512, frame), STATE)
    assert isinstance(taken, Refusal)
    assert f"frame {frame}" in taken.text


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("frame", [1, 7, 8, 9])
def test_a_used_field_that_is_not_finite_refuses(frame: int, bad: float) -> None:
    for index, name in enumerate(FIELDS):
        fields = {name: bad}
        used = not (frame == 8 and index < 3)
        assert isinstance(from_position_target_local_ned(local(0, frame, **fields), STATE), Refusal) == used, name
        ignored = from_position_target_local_ned(local(1 << index, frame, **fields), STATE)
        assert isinstance(ignored, PositionSetpoint), name
    assert isinstance(from_position_target_local_ned(local(0, frame, yaw=bad), STATE), Refusal)
    assert isinstance(from_position_target_local_ned(local(0, frame, yaw_rate=bad), STATE), Refusal)
    assert isinstance(from_position_target_local_ned(local(3072, frame, bad, bad), STATE), PositionSetpoint)


LOST = State((nan, 1.0, 1.0), (0.0, 0.0, 0.0), STATE.attitude)
BLIND = State((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (nan, nan, nan, nan))


@pytest.mark.parametrize(
    ("frame", "mask", "state", "good"),
    [
        (1, 0, LOST, True),
        (1, 0, BLIND, True),
        (7, 0, LOST, False),
        (7, 1, LOST, True),
        (7, 0, BLIND, True),
        (8, 0, LOST, True),
        (8, 0, BLIND, False),
        (9, 0, LOST, False),
        (9, 0, BLIND, False),
        (9, 7, LOST, True),
    ],
)
def test_a_frame_that_turns_on_an_unknown_state_is_refused(frame: int, mask: int, state: State, good: bool) -> None:
    assert isinstance(from_position_target_local_ned(local(mask, frame), state), PositionSetpoint) == good


# --- global


class FlatOrigin:
    """A metre is a hundred-thousandth of a degree, as far as this test goes."""

    altitude_amsl_m = 488.0

    def to_local(self, latitude_deg: float, longitude_deg: float, /) -> tuple[float, float]:
        return (latitude_deg - 47.0) * 1e5, (8.0 - longitude_deg) * 1e5


HOME_AMSL = 490.0
GLOBAL_VALUES = {"alt": 520.0} | {name: VALUES[name] for name in FIELDS[3:]}


def global_int(mask: int, frame: int = 5, lat: int = 470010000, lon: int = 80020000, **fields: float) -> Any:
    values = {**GLOBAL_VALUES, "yaw": YAW, "yaw_rate": YAW_RATE, **fields}
    return mavlink.MAVLink_set_position_target_global_int_message(0, 1, 1, frame, mask, lat, lon, *values.values())


@pytest.mark.parametrize(
    ("frame", "altitude", "up"),
    [
        (0, 520.0, 32.0),
        (5, 520.0, 32.0),
        (3, 30.0, 32.0),  # 490 + 30 - 488
        (6, 30.0, 32.0),
        (6, -1.0, 1.0),
        (10, 32.0, 32.0),
        (11, 32.0, 32.0),
    ],
)
def test_altitudes(frame: int, altitude: float, up: float) -> None:
    taken = from_position_target_global_int(global_int(0xDF8, frame, alt=altitude), FlatOrigin(), HOME_AMSL)
    assert isinstance(taken, PositionSetpoint)
    assert taken.position_nwu_m == pytest.approx((100.0, -200.0, up))


@pytest.mark.parametrize("frame", [0, 3, 5, 6, 10, 11])
def test_every_global_mask(frame: int) -> None:
    """Velocity, acceleration and altitude are per axis, latitude and longitude go together."""
    refused = 0
    for mask in range(4096):
        taken = from_position_target_global_int(global_int(mask, frame), FlatOrigin(), HOME_AMSL)
        nothing = all(bit(mask, index) for index in range(9))
        forced = bit(mask, 9) and not all(bit(mask, index) for index in (6, 7, 8))
        if nothing or forced or bit(mask, 0) != bit(mask, 1):
            refused += 1
            assert isinstance(taken, Refusal), hex(mask)
            continue
        assert isinstance(taken, PositionSetpoint), hex(mask)
        got = [*taken.position_nwu_m, *taken.velocity_nwu_m_s, *taken.acceleration_nwu_m_s2, *taken[3:]]
        left_out = [bit(mask, index) for index in (*range(9), 10, 11)]
        assert [isnan(value) for value in got] == left_out, hex(mask)
        for index in range(3, 9):
            if not left_out[index]:
                assert got[index] == SIGNS[index % 3] * VALUES[FIELDS[index]]
    assert 0 < refused < 4096


@pytest.mark.parametrize("frame", [1, 2, 4, 7, 8, 9, 12, 21, 255])
def test_other_global_frames_are_refused(frame: int) -> None:
    assert isinstance(from_position_target_global_int(global_int(0xDF8, frame), FlatOrigin(), HOME_AMSL), Refusal)


@pytest.mark.parametrize("frame", [3, 6])
def test_above_home_needs_a_home(frame: int) -> None:
    taken = from_position_target_global_int(global_int(0xDF8, frame), FlatOrigin(), nan)
    assert isinstance(taken, Refusal)
    assert "home" in taken.text
    velocity = from_position_target_global_int(global_int(0xDC7, frame), FlatOrigin(), nan)
    assert isinstance(velocity, PositionSetpoint)


@pytest.mark.parametrize(
    ("lat", "lon"), [(2**31 - 1, 0), (900000001, 0), (-900000001, 0), (0, 1800000001), (0, -(2**31))]
)
def test_no_such_place(lat: int, lon: int) -> None:
    assert isinstance(from_position_target_global_int(global_int(0, 5, lat, lon), FlatOrigin(), HOME_AMSL), Refusal)
    taken = from_position_target_global_int(global_int(3, 5, lat, lon), FlatOrigin(), HOME_AMSL)
    assert isinstance(taken, PositionSetpoint)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("name", ["alt", *FIELDS[3:], "yaw", "yaw_rate"])
def test_a_used_global_field_that_is_not_finite_refuses(name: str, bad: float) -> None:
    index = {"alt": 2, "yaw": 10, "yaw_rate": 11}.get(name) or FIELDS.index(name)
    used = from_position_target_global_int(
        global_int(0, 5, 470010000, 80020000, **{name: bad}), FlatOrigin(), HOME_AMSL
    )
    assert isinstance(used, Refusal)
    ignored = from_position_target_global_int(
        global_int(1 << index, 5, 470010000, 80020000, **{name: bad}), FlatOrigin(), HOME_AMSL
    )
    assert isinstance(ignored, PositionSetpoint)


# --- THRUST_BODY_SET of SET_ATTITUDE_TARGET, where the message has the field


def attitude(mask: int, thrust_body: tuple[float, float, float], thrust: float = 0.9) -> Any:
    return SimpleNamespace(
        type_mask=mask,
        q=[1.0, 0.0, 0.0, 0.0],
        body_roll_rate=0.0,
        body_pitch_rate=0.0,
        body_yaw_rate=0.0,
        thrust=thrust,
        thrust_body=thrust_body,
    )


@pytest.mark.parametrize(("z", "flown"), [(-0.3, 0.3), (0.2, 0.0), (-1.5, 1.0)])
def test_thrust_body_gives_the_collective(z: float, flown: float) -> None:
    taken = taken_of(attitude(32 | 7, (0.1, 0.1, z), thrust=nan))
    assert isinstance(taken, AttitudeSetpoint)
    assert taken.thrust == flown
    taken = taken_of(attitude(32 | 128, (0.0, 0.0, z)))
    assert isinstance(taken, RateSetpoint)
    assert taken.thrust == flown


def test_thrust_body_only_where_the_mask_says_so() -> None:
    taken = taken_of(attitude(7, (0.0, 0.0, -0.3)))
    assert isinstance(taken, AttitudeSetpoint)
    assert taken.thrust == 0.9
    taken = taken_of(attitude(32 | 64 | 7, (0.0, 0.0, -0.3)))
    assert isinstance(taken, AttitudeSetpoint)
    assert taken.thrust == 0.0
    assert isinstance(taken_of(attitude(32 | 7, (0.0, 0.0, nan))), Refusal)
