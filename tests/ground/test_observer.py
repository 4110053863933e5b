"""Telemetry to state: three ways to send one state, what is not taken, age and validity."""

from __future__ import annotations

from math import inf, nan, radians
from typing import Any

import numpy as np
import pytest
from mavsitl_ground.observer import Observer

from mavsitl.codec import Frame
from mavsitl.dialect import mavlink
from mavsitl.frames import flip_quaternion, flip_vector
from mavsitl.quaternion import conjugate, from_euler, rotate
from tests.ground.exercise import framed

ANGLES = (radians(20.0), radians(-10.0), radians(120.0))
QUATERNION = from_euler(*ANGLES)
POSITION = (1.0, -2.0, 3.5)
VELOCITY = (0.5, 0.25, -0.75)
OMEGA = (0.1, -0.2, 0.3)


def odometry(stamp_us: int, *, child: int = mavlink.MAV_FRAME_LOCAL_NED, **other: Any) -> Frame:
    """The state above as PX4 sends it, or with fields of its own."""
    attitude_ned = flip_quaternion(*QUATERNION)
    velocity = flip_vector(*VELOCITY)
    if child == mavlink.MAV_FRAME_BODY_FRD:
        velocity = rotate(conjugate(attitude_ned), velocity)
    fields: dict[str, Any] = {
        **dict(zip("xyz", flip_vector(*POSITION), strict=True)),
        "q": list(attitude_ned),
        **dict(zip(("vx", "vy", "vz"), velocity, strict=True)),
        **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), flip_vector(*OMEGA), strict=True)),
        "frame_id": mavlink.MAV_FRAME_LOCAL_NED,
    } | other
    unknown = [nan] * 21
    return framed(
        mavlink.MAVLink_odometry_message(
            time_usec=stamp_us, child_frame_id=child, pose_covariance=unknown, velocity_covariance=unknown, **fields
        )
    )


def attitude(stamp_us: int) -> Frame:
    values = (*flip_quaternion(*QUATERNION), *flip_vector(*OMEGA))
    return framed(mavlink.MAVLink_attitude_quaternion_message(stamp_us // 1000, *values))


def position(stamp_us: int) -> Frame:
    values = (*flip_vector(*POSITION), *flip_vector(*VELOCITY))
    return framed(mavlink.MAVLink_local_position_ned_message(stamp_us // 1000, *values))


def state(observer: Observer) -> list[float]:
    parts = (
        observer.position_nwu_m,
        observer.velocity_nwu_m_s,
        observer.quaternion,
        observer.angles_rad,
        observer.omega_flu_rad_s,
    )
    return [float(value) for part in parts for value in part[:, 0]]


WIRE = 2e-7
"""Rounding of a float32, of angles from such a quaternion, and of a turned velocity."""
EXPECTED = [*POSITION, *VELOCITY, *QUATERNION, *ANGLES, *OMEGA]


@pytest.mark.parametrize("child", [mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD])
def test_odometry_in_either_child_frame(child: int) -> None:
    observer = Observer()
    observer.receive(odometry(8000, child=child))
    assert state(observer) == pytest.approx(EXPECTED, abs=WIRE)
    assert observer.stamp_us == 8000
    assert observer.fresh


@pytest.mark.parametrize("attitude_first", [True, False])
def test_split_telemetry_is_the_same_state(attitude_first: bool) -> None:
    observer = Observer()
    first, second = (attitude, position) if attitude_first else (position, attitude)
    observer.receive(first(8000))
    assert not observer.fresh
    observer.receive(second(8000))
    assert observer.fresh
    assert observer.stamp_us == 8000
    assert state(observer) == pytest.approx(EXPECTED, abs=WIRE)


def test_odometry_in_other_frames_is_ignored() -> None:
    observer = Observer()
    observer.receive(odometry(8000, child=mavlink.MAV_FRAME_GLOBAL))
    observer.receive(odometry(8000, frame_id=mavlink.MAV_FRAME_LOCAL_FLU))
    assert observer.stamp_us == -1
    assert not observer.fresh


BAD: dict[str, dict[str, Any]] = {
    "NaN quaternion": {"q": [nan, 0.0, 0.0, 0.0]},
    "zero quaternion": {"q": [0.0, 0.0, 0.0, 0.0]},
    "infinite quaternion": {"q": [inf, 0.0, 0.0, 0.0]},
    "quaternion of norm 1.1": {"q": [1.1, 0.0, 0.0, 0.0]},
    "quaternion of norm 0.9": {"q": [0.9, 0.0, 0.0, 0.0]},
    "NaN rate": {"pitchspeed": nan},
    "NaN position": {"z": nan},
    "infinite position": {"x": inf},
    "opposite infinities": {"x": inf, "y": -inf},
    "NaN velocity": {"vy": nan},
}


@pytest.mark.parametrize("child", [mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD])
@pytest.mark.parametrize("bad", BAD.values(), ids=BAD.keys())
def test_nothing_of_a_bad_message_is_taken(bad: dict[str, Any], child: int) -> None:
    observer = Observer()
    observer.receive(odometry(4000))
    observer.take(observer.stamp_us)
    before = state(observer)
    observer.receive(odometry(8000, child=child, **({"x": 9.0, "vx": 9.0, "rollspeed": 9.0} | bad)))
    assert state(observer) == before
    assert observer.stamp_us == 4000
    assert not observer.fresh


@pytest.mark.parametrize("field", range(1, 8))
def test_split_messages_that_are_not_finite_are_ignored(field: int) -> None:
    observer = Observer()
    observer.receive(attitude(4000))
    observer.receive(position(4000))
    before = state(observer)
    values: list[Any] = [8, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    values[field] = nan
    observer.receive(framed(mavlink.MAVLink_attitude_quaternion_message(*values)))
    if field < 7:
        observer.receive(framed(mavlink.MAVLink_local_position_ned_message(*values[:7])))
    assert state(observer) == before
    assert observer.stamp_us == 4000


def test_a_late_message_does_not_overwrite_a_newer_one() -> None:
    observer = Observer()
    observer.receive(odometry(900_000))
    observer.take(observer.stamp_us)
    before = state(observer)
    observer.receive(odometry(896_000, x=50.0, vx=50.0, rollspeed=1.0))
    assert state(observer) == before
    assert (observer.stamp_us, observer.fresh, observer.restarted) == (900_000, False, False)


def test_the_same_stamp_again_is_not_fresh() -> None:
    observer = Observer()
    observer.receive(odometry(4000))
    observer.take(observer.stamp_us)
    observer.receive(odometry(4000))
    assert not observer.fresh


@pytest.mark.parametrize("send", [odometry, attitude])
def test_a_clock_that_goes_back_by_more_than_a_second_is_a_restart(send: Any) -> None:
    observer = Observer()
    observer.receive(odometry(5_000_000))
    observer.receive(position(5_000_000))
    observer.receive(send(4_000_000))
    assert not observer.restarted
    observer.receive(send(3_999_000))
    assert observer.restarted
    observer.reset()
    assert not observer.restarted
    observer.receive(odometry(0))
    assert observer.stamp_us == 0
    assert observer.fresh


def test_an_attitude_without_a_position_near_it_is_not_fresh() -> None:
    observer = Observer(max_age_us=500_000)
    observer.receive(position(100_000))
    observer.receive(attitude(600_000))
    assert observer.fresh
    observer.take(observer.stamp_us)
    observer.receive(attitude(601_000))
    assert not observer.fresh


def test_an_attitude_waits_for_its_position_where_every_one_had_one() -> None:
    observer = Observer("split")
    for stamp_us in (4000, 8000, 12_000):
        observer.receive(attitude(stamp_us))
        observer.receive(position(stamp_us))
        assert observer.fresh
        observer.take(observer.stamp_us)
    observer.receive(attitude(16_000))
    assert not observer.fresh
    observer.receive(position(16_000))
    assert observer.fresh


def test_a_lost_position_delays_the_attitude_by_one_at_most() -> None:
    observer = Observer("split")
    for stamp_us in (4000, 8000, 12_000):
        observer.receive(attitude(stamp_us))
        observer.receive(position(stamp_us))
    observer.take(observer.stamp_us)
    observer.receive(attitude(16_000))
    observer.receive(attitude(20_000))
    assert observer.fresh


def test_positions_that_come_more_rarely_are_not_waited_for() -> None:
    observer = Observer("split")
    for stamp_us in range(20_000, 400_000, 20_000):
        observer.receive(attitude(stamp_us))
        assert observer.fresh or stamp_us < 40_000
        observer.take(observer.stamp_us)
        if stamp_us % 40_000 == 20_000:
            observer.receive(position(stamp_us))


def test_age_and_validity_are_by_the_ground_s_clock() -> None:
    observer = Observer(max_age_us=500_000)
    assert observer.age_us(7_000_000) is None
    assert observer.take(7_000_000) is None
    observer.receive(odometry(4000))
    assert observer.age_us(7_000_000) == 0  # the fastest way seen so far
    assert observer.take(7_000_000) == 0
    assert observer.take(7_000_000) is None  # once
    assert observer.age_us(7_400_000) == 400_000
    observer.receive(odometry(8000))
    assert observer.take(7_504_000) == 500_000
    observer.receive(odometry(508_000))
    assert observer.take(7_504_300) == 300
    observer.reset()
    assert observer.age_us(7_500_000) is None


def test_a_state_that_comes_too_late_is_not_flown_by_however_long_it_is_the_newest() -> None:
    observer = Observer(max_age_us=500_000)
    observer.receive(odometry(4000))
    assert observer.take(7_000_000) == 0
    observer.receive(odometry(8000))
    for now_us in range(7_600_000, 12_000_000, 4000):
        assert observer.take(now_us) is None
        assert observer.age_us(now_us) == now_us - 7_004_000


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_a_vehicle_whose_clock_falls_behind_is_flown_all_the_same(speed: float) -> None:
    """In real time a vehicle without its processor gives up time: its clock is that much later for ever."""
    observer = Observer(max_age_us=500_000)
    late_us, taken = 0, []
    for number in range(2500):
        if number == 1000:
            late_us = 3_000_000  # it was suspended
        now_us = 1_000_000 + number * 4000 + late_us
        observer.receive(odometry(4000 + round(number * 4000 * speed)))
        taken.append(observer.take(now_us) is not None)
    assert all(taken[:1000])
    assert all(taken[1000 + 250 :])  # a second after


def test_true_wind_is_turned_and_forgotten() -> None:
    def vector(name: bytes, *values: float) -> Frame:
        return framed(mavlink.MAVLink_debug_vect_message(name, 0, *values))

    observer = Observer()
    observer.receive(vector(b"OTHER", 9.0, 9.0, 9.0))
    assert np.isnan(observer.true_wind_nwu_m_s).all()
    observer.receive(vector(b"WIND_TRUE", 1.0, 2.0, 3.0))
    observer.receive(vector(b"WIND_TRUE", 4.0, nan, inf))
    np.testing.assert_array_equal(observer.true_wind_nwu_m_s, [[1.0], [-2.0], [-3.0]])
    observer.reset()
    assert np.isnan(observer.true_wind_nwu_m_s).all()


def test_messages_that_are_no_state_are_left_alone() -> None:
    observer = Observer("odometry")
    before = state(observer)
    observer.receive(framed(mavlink.MAVLink_heartbeat_message(2, 12, 209, 0x60000, 4, 3)))
    observer.receive(attitude(4000))
    observer.receive(position(4000))
    assert state(observer) == before
    assert observer.stamp_us == -1
