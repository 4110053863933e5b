"""Real flights through messages: take-off, hold, landing, the attitude and the rate loop."""

from __future__ import annotations

from math import cos, degrees, radians, sin

import numpy as np
import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import MAIN_AUTO, SUB_LAND, SUB_LOITER, Client, attitude_target, flight

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED


def rolled(angle_deg: float) -> tuple[float, float, float, float]:
    half = radians(angle_deg) / 2.0
    return cos(half), sin(half), 0.0, 0.0


@pytest.mark.parametrize("noisy", [False, True])
def test_take_off_and_land(noisy: bool) -> None:
    noise = {"noise__position_m": 0.005, "noise__velocity_m_s": 0.005, "noise__rate_deg_s": 0.1} if noisy else {}
    client = Client(flight(**noise))
    client.climb(2.0)
    assert not client.landed
    assert client.land() == ACCEPTED
    client.tick()
    assert client.flight_mode == (MAIN_AUTO, SUB_LAND)
    descent_s = client.run_until(lambda: client.landed, 10.0)
    assert descent_s == pytest.approx(2.0 / 0.7, abs=1.5)
    assert abs(client.truth[2]) < 0.05
    assert abs(client.truth[5]) < 0.15
    assert client.armed
    assert client.run_until(lambda: not client.armed, 5.0) == pytest.approx(2.0, abs=0.03)
    assert client.texts()[-1] == "Disarmed by landing"
    assert client.flight_mode == (MAIN_AUTO, SUB_LOITER)
    assert client.vehicle.finished
    client.run(0.5)
    assert np.hypot(client.truth[0], client.truth[1]) < 0.3
    assert client.truth[13:] == [0.0] * 4


def test_it_flies_again_after_landing(client: Client) -> None:
    client.climb(1.0)
    client.land()
    client.run_until(lambda: not client.armed, 15.0)
    assert client.arm() == ACCEPTED  # in Hold, on the ground: the rotors must stand
    client.run(2.0)
    assert client.landed
    assert client.truth[2] < 0.02
    assert client.truth[13:] == [0.0] * 4
    assert client.disarm() == ACCEPTED
    client.climb(1.0)
    assert not client.landed


def test_take_off_by_body_rates(client: Client) -> None:
    client.rates(thrust=0.0)
    client.offboard()
    client.arm()
    client.run(2.0, lambda: client.rates(thrust=0.6))
    x, y, z = client.truth[:3]
    # 1 s after the spool-up: half of a fifth of gravity, little drag
    assert z == pytest.approx(0.5 * 0.2 * 9.81, rel=0.1)
    assert np.hypot(x, y) < 0.05


def test_hold_stays(client: Client) -> None:
    client.climb(3.0)
    assert client.hold() == ACCEPTED
    start = np.array(client.truth[:3])
    worst = 0.0
    for _ in range(200):
        client.run(0.1)
        worst = max(worst, float(np.linalg.norm(np.array(client.truth[:3]) - start)))
    assert worst < 0.3
    assert np.linalg.norm(client.truth[3:6]) < 0.05


def test_hold_out_of_a_landing_stays_where_it_was_asked_for(client: Client) -> None:
    client.climb(4.0)
    client.land()
    client.run(3.0)
    height_m = client.truth[2]
    assert height_m < 2.8
    client.hold()
    client.run(8.0)
    # It brakes: 0.7 to 1.5 m/s within the jerk and acceleration of automatic flight.
    assert height_m - 0.5 < client.truth[2] <= height_m
    assert abs(client.truth[5]) < 0.01


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_roll_step(client: Client, side: float) -> None:
    client.climb(3.0)
    client.run(0.5, client.attitude)
    rolls: list[float] = []

    def step() -> None:
        client.attitude(rolled(20.0 * side), 0.5 / cos(radians(20.0)))
        rolls.append(degrees(client.last("ATTITUDE", 0).roll) * side)

    before = client.truth[4]
    client.run(1.5, step)
    assert rolls[0] == pytest.approx(0.0, abs=3.0)
    settled = np.array(rolls[125:])  # after 0.5 s
    assert np.abs(settled - 20.0).max() < 3.0
    assert max(rolls) < 24.0
    state = client.last("ATTITUDE", 0)
    assert abs(degrees(state.pitch)) < 1.0
    assert abs(degrees(state.yaw)) < 1.0
    assert (client.truth[4] - before) * side < -1.0  # right wing down flies to the east: NWU y falls


def test_yaw_rate_feeds_forward(client: Client) -> None:
    """Attitude with a body yaw rate that is not ignored: the nose goes right, ahead of the attitude asked for."""
    client.climb(3.0)
    client.run(0.1, lambda: client.send(attitude_target(3, rates=(9.0, 9.0, 0.3))))
    state = client.last("ATTITUDE", 0)
    assert state.yawspeed > 0.1
    assert abs(state.rollspeed) < 0.02
    assert abs(state.pitchspeed) < 0.02


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("rate", [0.5, -0.5])
def test_rate_loop(client: Client, axis: int, rate: float) -> None:
    client.climb(4.0)
    wanted = [0.0, 0.0, 0.0]
    wanted[axis] = rate
    rates = (wanted[0], wanted[1], wanted[2])
    client.run(0.6, lambda: client.rates(rates))
    state = client.last("ATTITUDE_QUATERNION", 0)
    assert (state.rollspeed, state.pitchspeed, state.yawspeed) == pytest.approx(rates, abs=0.05)
    assert client.truth[10:13] == pytest.approx((rates[0], -rates[1], -rates[2]), abs=0.05)


def test_an_ignored_yaw_rate_stays_as_it_is(client: Client) -> None:
    client.climb(4.0)
    client.run(0.6, lambda: client.rates((0.0, 0.0, 0.5)))
    spin = client.truth[12]
    client.run(0.3, lambda: client.send(attitude_target(128 | 4, rates=(0.0, 0.0, 9.0))))
    assert client.truth[12] == pytest.approx(spin, abs=0.05)
