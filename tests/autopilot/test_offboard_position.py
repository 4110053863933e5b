"""Off-board by position, velocity and acceleration: masks, frames, take-off and landing by the stream alone."""

from __future__ import annotations

from collections.abc import Callable
from math import dist, hypot, pi, radians
from typing import Any

import numpy as np
import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    HOLD,
    OFFBOARD_MODE,
    RETURN,
    degrees_e7,
    distance,
    flying,
    origin,
    set_parameter,
    track,
)

LOCAL, LOCAL_OFFSET, BODY, BODY_OFFSET = 1, 7, 8, 9
POSITION_YAW, VELOCITY_YAW, POSITION_VELOCITY, ALL, ACCELERATION = 0xDF8 & ~0x400, 0x9C7, 0x9C0, 0x800, 0xC3F
BODY_RATE = 0x5C7


def local(
    client: Client, mask: int, p: tuple[float, float, float] = (0, 0, 0), v: tuple[float, float, float] = (0, 0, 0),
    a: tuple[float, float, float] = (0, 0, 0), *, yaw: float = 0.0, yaw_rate: float = 0.0, frame: int = LOCAL,
) -> Callable[[], int]:  # fmt: skip
    """Sends SET_POSITION_TARGET_LOCAL_NED (NED) when called."""
    message = mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, *p, *v, *a, yaw, yaw_rate)
    return lambda: client.send(message)


def globally(
    client: Client, mask: int, north: float, east: float, altitude: float, frame: int, yaw: float = 0.0
) -> Callable[[], int]:
    x, y = degrees_e7(client, north, -east)
    message: Any = mavlink.MAVLink_set_position_target_global_int_message(
        0, 1, 1, frame, mask, x, y, altitude, 0, 0, 0, 0, 0, 0, yaw, 0
    )
    return lambda: client.send(message)


def offboard(height_m: float, send: Callable[[Client], Callable[[], int]], **changes: Any) -> tuple[Client, Any]:
    """In the air, in OFFBOARD, with that stream."""
    client = flying(height_m, **changes)
    stream = send(client)
    client.run(0.1, stream)
    assert client.offboard() == ACCEPTED
    client.run(0.05, stream)
    assert client.flight_mode == OFFBOARD_MODE
    return client, stream


def ned(client: Client) -> tuple[float, float, float]:
    x, y, z = client.truth[:3]
    return x, -y, -z


def velocity_ned(client: Client) -> tuple[float, float, float]:
    x, y, z = client.truth[3:6]
    return x, -y, -z


def test_take_off_by_a_position_and_hold_there() -> None:
    client = Client(flight())
    stream = local(client, POSITION_YAW, (0.0, 0.0, -3.0), yaw=radians(60.0))
    client.run(0.2, stream)
    assert client.offboard() == ACCEPTED
    assert client.arm() == ACCEPTED
    path = track(client, 9.0, stream)
    assert distance(client, 0.0, 0.0, 3.0) < 0.05
    assert path[:, 2].max() < 3.3
    assert client.last("ATTITUDE", 0).yaw == pytest.approx(radians(60.0), abs=0.02)
    assert not client.landed


@pytest.mark.parametrize("climb", [0.05, 0.0])
def test_a_position_on_the_ground_does_not_lift(climb: float) -> None:
    client = Client(flight())
    stream = local(client, POSITION_YAW, (3.0, 0.0, -climb))
    client.run(0.2, stream)
    client.offboard()
    client.arm()
    client.run(3.0, stream)
    assert client.landed
    assert client.truth[13:] == [0.0] * 4


@pytest.mark.parametrize("target", [(8.0, 0.0, -4.0), (-4.0, 4.0, -6.0), (0.0, -6.0, -2.5)])
def test_positions_are_flown_to(target: tuple[float, float, float]) -> None:
    client, stream = offboard(4.0, lambda c: local(c, POSITION_YAW, target, yaw=1.0))
    took_s = client.run_until(lambda: dist(ned(client), target) < 0.3, 10.0, stream)
    assert took_s < 10.0
    client.run(3.0, stream)
    assert ned(client) == pytest.approx(target, abs=0.05)
    sent = client.last("POSITION_TARGET_LOCAL_NED", 0)
    assert (sent.x, sent.y, sent.z) == pytest.approx(target, abs=1e-5)


@pytest.mark.parametrize("velocity", [(3.0, 0.0, 0.0), (0.0, -2.0, 0.0), (1.0, 1.0, -1.0), (0.0, 0.0, 0.8)])
def test_velocities(velocity: tuple[float, float, float]) -> None:
    client, stream = offboard(5.0, lambda c: local(c, VELOCITY_YAW, v=velocity, yaw=0.5))
    client.run(3.5, stream)
    assert velocity_ned(client) == pytest.approx(velocity, abs=0.08)
    assert client.last("ATTITUDE", 0).yaw == pytest.approx(0.5, abs=0.02)


def test_position_with_velocity_fed_forward_follows_a_circle() -> None:
    client = flying(4.0)
    t0 = client.now_us / 1e6

    def target() -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
        w, t = 0.8, client.now_us / 1e6 - t0
        c, s = np.cos(w * t), np.sin(w * t)
        return (
            (2.0 * float(s), 2.0 - 2.0 * float(c), -4.0),
            (2.0 * w * float(c), 2.0 * w * float(s), 0.0),
            (-2.0 * w * w * float(s), 2.0 * w * w * float(c), 0.0),
        )

    def error(mask: int) -> float:
        errors: list[float] = []

        def stream() -> None:
            p, v, a = target()
            local(client, mask, p, v, a)()
            errors.append(float(np.linalg.norm(np.subtract(ned(client), p))))

        stream()
        assert client.offboard() == ACCEPTED
        client.run(8.0, stream)
        return max(errors[-1500:])

    alone, fed, full = error(POSITION_YAW), error(POSITION_VELOCITY), error(ALL)
    assert full < 0.1
    assert full < fed < alone


def test_acceleration_alone() -> None:
    client, stream = offboard(6.0, lambda c: local(c, ACCELERATION, a=(1.0, 0.0, 0.0)))
    before = velocity_ned(client)[0]
    client.run(2.0, stream)
    assert velocity_ned(client)[0] - before == pytest.approx(2.0, abs=0.35)
    assert client.truth[2] == pytest.approx(6.0, abs=0.3)


def test_velocity_with_height() -> None:
    """x and y by velocity, z by position: what keeps a survey level."""
    mask = 0xFFF & ~(4 | 8 | 16 | 0x400)
    client, stream = offboard(4.0, lambda c: local(c, mask, (0, 0, -5.5), (2.0, 0.0, 0.0)))
    client.run(5.0, stream)
    assert velocity_ned(client)[:2] == pytest.approx((2.0, 0.0), abs=0.08)
    assert client.truth[2] == pytest.approx(5.5, abs=0.05)


def test_a_yaw_rate_turns() -> None:
    client, stream = offboard(4.0, lambda c: local(c, BODY_RATE, yaw_rate=0.4))
    client.run(3.0, stream)
    assert client.last("ATTITUDE", 0).yawspeed == pytest.approx(0.4, abs=0.03)
    assert hypot(*client.truth[3:6]) < 0.1


@pytest.mark.parametrize("frame", [BODY, BODY_OFFSET])
def test_body_velocity_goes_where_the_nose_points(frame: int) -> None:
    client, turn = offboard(4.0, lambda c: local(c, POSITION_YAW, (0.0, 0.0, -4.0), yaw=pi / 2))
    client.run(3.0, turn)
    stream = local(client, BODY_RATE, v=(2.0, 0.5, 0.0), frame=frame)
    client.run(3.0, stream)
    assert velocity_ned(client) == pytest.approx((-0.5, 2.0, 0.0), abs=0.1)


def test_offsets_count_from_where_the_vehicle_is() -> None:
    client, turn = offboard(4.0, lambda c: local(c, POSITION_YAW, (3.0, 0.0, -4.0), yaw=pi / 2))
    client.run(7.0, turn)
    local(client, POSITION_YAW, (2.0, 0.0, -1.0), yaw=pi / 2, frame=LOCAL_OFFSET)()
    client.run(0.9)
    keep = local(client, VELOCITY_YAW, (0, 0, 0), yaw=pi / 2)
    asked = client.last("POSITION_TARGET_LOCAL_NED", 0)
    assert (asked.x, asked.y, asked.z) == pytest.approx((5.0, 0.0, -5.0), abs=0.05)
    client.run(3.0, keep)
    x, y, z = ned(client)
    local(client, POSITION_YAW, (2.0, 0.0, 0.0), yaw=pi / 2, frame=BODY_OFFSET)()
    client.run(0.2)
    asked = client.last("POSITION_TARGET_LOCAL_NED", 0)
    assert (asked.x, asked.y, asked.z) == pytest.approx((x, y + 2.0, z), abs=0.05)


GLOBAL_FRAMES = [(0, "sea"), (5, "sea"), (3, "home"), (6, "home"), (10, "ground"), (11, "ground")]


@pytest.mark.parametrize(("frame", "datum"), GLOBAL_FRAMES)
def test_global_positions(frame: int, datum: str) -> None:
    height = 5.0

    def send(client: Client) -> Callable[[], int]:
        altitude = height + (origin(client).altitude_amsl_m if datum == "sea" else 0.0)
        return globally(client, POSITION_YAW, 6.0, -3.0, altitude, frame, yaw=0.7)

    client, stream = offboard(4.0, send)
    client.run(8.0, stream)
    assert ned(client) == pytest.approx((6.0, -3.0, -height), abs=0.1)


def test_altitude_over_a_home_that_is_not_the_origin() -> None:
    """Frame 6 counts from home (PX4 1.17 gets its sign wrong where home is not at the local origin's height)."""
    client = flying(4.0)
    base = origin(client).altitude_amsl_m
    x, y = origin(client).to_global(0.0, 0.0)
    assert client.result(mavlink.MAV_CMD_DO_SET_HOME, 0.0, 0, 0, 0, x, y, base + 2.0) == ACCEPTED
    stream = globally(client, POSITION_YAW, 0.0, 0.0, 4.0, 6)
    client.run(0.1, stream)
    client.offboard()
    client.run(6.0, stream)
    assert client.truth[2] == pytest.approx(6.0, abs=0.1)


def test_landing_by_velocity_disarms() -> None:
    client, down = offboard(3.0, lambda c: local(c, VELOCITY_YAW, v=(0.0, 0.0, 1.0)))
    client.run_until(lambda: client.landed, 10.0, down)
    assert abs(client.truth[2]) < 0.05
    disarmed_s = client.run_until(lambda: not client.armed, 5.0, down)
    assert disarmed_s == pytest.approx(2.0, abs=0.1)
    assert hypot(*client.truth[:2]) < 0.1
    assert client.texts()[-1] == "Disarmed by landing"


def test_take_off_and_landing_by_velocity_alone() -> None:
    client = Client(flight())
    up, down = local(client, VELOCITY_YAW, v=(0, 0, -1.0)), local(client, VELOCITY_YAW, v=(0, 0, 1.0))
    client.run(0.2, up)
    client.offboard()
    client.arm()
    client.run_until(lambda: client.truth[2] > 2.0, 10.0, up)
    client.run_until(lambda: not client.armed, 15.0, down)
    assert client.landed


def test_touching_the_ground_and_leaving_it_again_without_disarming() -> None:
    client, down = offboard(2.0, lambda c: local(c, VELOCITY_YAW, v=(0.0, 0.0, 1.0)))
    client.run_until(lambda: client.landed, 10.0, down)
    client.run(0.5, down)
    up = local(client, POSITION_YAW, (0.0, 0.0, -2.0))
    client.run(6.0, up)
    assert client.armed
    assert client.truth[2] == pytest.approx(2.0, abs=0.05)


def test_the_speed_limits_hold() -> None:
    client, stream = offboard(6.0, lambda c: local(c, VELOCITY_YAW, v=(30.0, 0.0, 0.0)))
    set_parameter(client, "MPC_XY_VEL_MAX", 4.0)
    client.run(5.0, stream)
    assert velocity_ned(client)[0] == pytest.approx(4.0, abs=0.1)


def test_from_position_to_attitude_and_back() -> None:
    client, stream = offboard(5.0, lambda c: local(c, POSITION_YAW, (0.0, 0.0, -5.0)))
    client.run(1.0, stream)
    client.run(1.0, client.attitude)
    assert client.flight_mode == OFFBOARD_MODE
    client.run(4.0, stream)
    assert distance(client, 0.0, 0.0, 5.0) < 0.1


def test_silence_returns_and_the_stream_resumes() -> None:
    client, stream = offboard(5.0, lambda c: local(c, POSITION_YAW, (3.0, 0.0, -5.0)))
    client.run(4.0, stream)
    assert client.run_until(lambda: client.flight_mode == RETURN, 2.0) == pytest.approx(1.0, abs=0.05)
    client.run(1.0)
    client.run(5.0, stream)
    assert client.flight_mode == OFFBOARD_MODE
    assert distance(client, 3.0, 0.0, 5.0) < 0.1
    assert client.hold() == ACCEPTED
    client.run(0.1, stream)
    assert client.flight_mode == HOLD


@pytest.mark.parametrize("frame", [2, 4, 12, 20])
def test_frames_that_are_refused_do_not_count_as_a_stream(frame: int) -> None:
    client = Client(flight())
    client.run(0.2, local(client, POSITION_YAW, (0, 0, -2.0), frame=frame))
    client.offboard()
    assert client.arm() == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert f"frame {frame} unsupported" in client.texts()[0]
