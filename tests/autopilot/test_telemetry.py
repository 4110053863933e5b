"""Telemetry: identity, rates on each port, values against the truth, the interval commands."""

from __future__ import annotations

from math import nan, pi, radians, sqrt
from typing import Any

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, OFFBOARD, Client, flight

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
SET = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
GET = mavlink.MAV_CMD_GET_MESSAGE_INTERVAL
REQUEST = mavlink.MAV_CMD_REQUEST_MESSAGE

RATES_HZ = {
    "HEARTBEAT": (1, 1),
    "SYS_STATUS": (5, 1),
    "EXTENDED_SYS_STATE": (5, 1),
    "ATTITUDE": (50, 10),
    "ATTITUDE_QUATERNION": (50, 10),
    "LOCAL_POSITION_NED": (30, 10),
    "ODOMETRY": (30, 0),
}
"""Messages per second on the off-board port and on the ground station's."""


def test_default_rates_on_each_port(client: Client) -> None:
    client.run(0.5)
    since_us = client.now_us
    client.run(10.0)
    for port in (OFFBOARD, GCS):
        for name, rates in RATES_HZ.items():
            assert len(client.all(name, port, since_us)) == pytest.approx(10 * rates[port], abs=1), (name, port)
        others = {message.get_type() for _, at, message in client.inbox if at == port} - set(RATES_HZ)
        assert others == set()


# --- identity


def test_heartbeat_is_px4s(client: Client) -> None:
    first = client.heartbeat
    assert (first.type, first.autopilot, first.mavlink_version) == (
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_PX4,
        3,
    )
    custom_enabled, auto, guided, stabilize, armed = 1, 4, 8, 16, 128
    disarmed_bits = custom_enabled | auto | guided | stabilize
    assert (first.base_mode, first.custom_mode) == (disarmed_bits, 50593792)  # AUTO.LOITER
    assert first.system_status == mavlink.MAV_STATE_STANDBY
    client.attitude()
    client.offboard()
    client.tick()
    assert (client.heartbeat.base_mode, client.heartbeat.custom_mode) == (disarmed_bits, 393216)  # OFFBOARD
    client.arm()
    client.tick()
    assert (client.heartbeat.base_mode, client.heartbeat.custom_mode) == (disarmed_bits | armed, 393216)
    assert client.heartbeat.system_status == mavlink.MAV_STATE_ACTIVE
    client.land()
    client.tick()
    assert client.heartbeat.custom_mode == 100925440  # AUTO.LAND


@pytest.mark.parametrize("command", [(REQUEST, 148), (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1)])
def test_autopilot_version(client: Client, command: tuple[int, float]) -> None:
    assert client.result(*command, port=GCS) == ACCEPTED
    (version,) = client.all("AUTOPILOT_VERSION")
    assert client.all("AUTOPILOT_VERSION", GCS) == [version]
    assert version.flight_sw_version.to_bytes(4, "big") == bytes((1, 17, 0, 255))
    command_int, attitude_target_bit, mavlink2 = 8, 64, 8192
    assert version.capabilities == command_int | attitude_target_bit | mavlink2
    assert version.uid != 0


# --- values


def pose(client: Client, q: tuple[float, float, float, float]) -> None:
    """Put vehicle and estimate at a state by hand: FLU -> NWU attitude `q`, the rest a list of distinct numbers."""
    state = [1.0, 2.0, 3.0, 0.25, 0.5, 0.75, *q, 0.125, 0.375, 0.625]
    client.vehicle.autopilot.estimate = state


def requested(client: Client, message_id: int) -> Any:
    assert client.result(REQUEST, message_id) == ACCEPTED
    return client.inbox[-2][2] if client.inbox[-1][2].get_type() == "COMMAND_ACK" else client.inbox[-1][2]


R = sqrt(0.5)
HAND = [
    # name, FLU -> NWU, FRD -> NED, (roll, pitch, yaw) on the wire
    ("level, north", (1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ("facing west: +90 deg about z up", (R, 0.0, 0.0, R), (R, 0.0, 0.0, -R), (0.0, 0.0, -pi / 2)),
    ("right wing down 90 deg", (R, R, 0.0, 0.0), (R, R, 0.0, 0.0), (pi / 2, 0.0, 0.0)),
    # 60 deg about y, which points left: the nose goes down
    ("nose down 60 deg", (sqrt(0.75), 0.0, 0.5, 0.0), (sqrt(0.75), 0.0, -0.5, 0.0), (0.0, -pi / 3, 0.0)),
]


@pytest.mark.parametrize(("name", "flu", "frd", "euler"), HAND)
def test_values_by_hand(
    client: Client,
    name: str,
    flu: tuple[float, float, float, float],
    frd: tuple[float, ...],
    euler: tuple[float, ...],
) -> None:
    pose(client, flu)
    position, velocity, rates = (1.0, -2.0, -3.0), (0.25, -0.5, -0.75), (0.125, -0.375, -0.625)
    m = requested(client, mavlink.MAVLINK_MSG_ID_ATTITUDE)
    assert (m.roll, m.pitch, m.yaw) == pytest.approx(euler, abs=1e-6)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == rates
    m = requested(client, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION)
    assert (m.q1, m.q2, m.q3, m.q4) == pytest.approx(frd, abs=1e-7)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == rates
    m = requested(client, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    assert (m.x, m.y, m.z) == position
    assert (m.vx, m.vy, m.vz) == velocity
    m = requested(client, mavlink.MAVLINK_MSG_ID_ODOMETRY)
    assert (m.frame_id, m.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_NED)
    assert (m.x, m.y, m.z, m.vx, m.vy, m.vz) == position + velocity
    assert m.q == pytest.approx(frd, abs=1e-7)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == rates


def test_telemetry_is_the_truth_without_noise(client: Client) -> None:
    client.climb(2.0)
    client.run(0.4, lambda: client.rates((0.3, 0.2, 0.1)))
    x = client.truth
    m = requested(client, mavlink.MAVLINK_MSG_ID_ODOMETRY)
    assert m.time_usec == client.vehicle._now_us
    assert (m.x, m.y, m.z) == pytest.approx((x[0], -x[1], -x[2]), rel=1e-6)
    assert (m.vx, m.vy, m.vz) == pytest.approx((x[3], -x[4], -x[5]), rel=1e-6)
    assert m.q == pytest.approx((x[6], x[7], -x[8], -x[9]), rel=1e-6)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == pytest.approx((x[10], -x[11], -x[12]), rel=1e-6)
    assert min(map(abs, (m.x, m.y, m.z, m.rollspeed, m.pitchspeed, m.yawspeed))) > 1e-6


def test_start_pose_and_true_wind() -> None:
    wind = [{"model": "steady", "velocity_nwu_m_s": [1.0, 2.0, 0.5]}]
    client = Client(flight(start__position_nwu_m=[3.0, 4.0, 5.0], start__yaw_deg=30.0, start__clamp=True, wind=wind))
    client.run(0.1)
    m = client.last("LOCAL_POSITION_NED")
    assert (m.x, m.y, m.z) == (3.0, -4.0, -5.0)
    assert client.last("ATTITUDE").yaw == pytest.approx(radians(-30.0), abs=1e-6)
    m = requested(client, mavlink.MAVLINK_MSG_ID_DEBUG_VECT)
    assert (m.name, m.x, m.y, m.z) == ("WIND_TRUE", 1.0, -2.0, -0.5)


# --- intervals


@pytest.mark.parametrize(("hz", "message_id"), [(100, 30), (25, 331), (4, 1), (250, 31), (7, 254), (50, 250)])
def test_interval_is_delivered_on_its_port_alone(client: Client, hz: int, message_id: int) -> None:
    if message_id == 254:  # not streamed: must be refused
        assert client.result(SET, message_id, 1e6 / hz, port=GCS) == DENIED
        return
    name = mavlink.mavlink_map[message_id].msgname
    client.run(0.5)
    other = RATES_HZ.get(name, (0, 0))[OFFBOARD]
    assert client.result(SET, message_id, 1e6 // hz, port=GCS) == ACCEPTED
    since_us = client.now_us
    client.run(4.0)
    assert len(client.all(name, GCS, since_us)) == pytest.approx(4 * hz, rel=0.02, abs=1)
    assert len(client.all(name, OFFBOARD, since_us)) == pytest.approx(4 * other, abs=1)


def test_stop_and_default(client: Client) -> None:
    assert client.result(SET, 30, -1) == ACCEPTED
    since_us = client.now_us
    client.run(1.0)
    assert client.all("ATTITUDE", OFFBOARD, since_us) == []
    assert client.result(GET, 30) == ACCEPTED
    assert client.last("MESSAGE_INTERVAL").interval_us == -1
    assert client.result(SET, 30, 0) == ACCEPTED
    assert client.result(GET, 30) == ACCEPTED
    assert client.last("MESSAGE_INTERVAL").interval_us == 20000
    since_us = client.now_us
    client.run(2.0)
    assert len(client.all("ATTITUDE", OFFBOARD, since_us)) == pytest.approx(100, abs=1)


def test_interval_longer_than_the_flight(client: Client) -> None:
    assert client.result(SET, 30, 2.0e9) == ACCEPTED
    assert client.result(GET, 30) == ACCEPTED
    assert client.last("MESSAGE_INTERVAL").interval_us == 2_000_000_000


def test_get_interval_answers_on_the_port_that_asked(client: Client) -> None:
    for port, interval_us in ((OFFBOARD, 20_000), (GCS, 100_000)):
        client.result(GET, 30, port=port)
        (m,) = client.all("MESSAGE_INTERVAL", port)
        assert (m.message_id, m.interval_us) == (30, interval_us)
    client.result(GET, 331, port=GCS)
    assert client.last("MESSAGE_INTERVAL", GCS).interval_us == -1  # there, but off on this port
    client.result(GET, 24, port=GCS)
    assert client.last("MESSAGE_INTERVAL", GCS).interval_us == 0  # not available


@pytest.mark.parametrize("interval", [-1.0, 1.0, 1e6, 3e38, nan])
def test_heartbeat_cannot_be_stopped(client: Client, interval: float) -> None:
    assert client.result(SET, 0, interval) == DENIED
    client.run(0.5)
    since_us = client.now_us
    client.run(5.0)
    assert len(client.all("HEARTBEAT", OFFBOARD, since_us)) == 5


WILD = [nan, 3e38, -3e38, 0.5, float("inf"), -2.0, 2.0**31, 2.0**63, 65536.0]


@pytest.mark.parametrize("wild", WILD)
def test_wild_ids_and_intervals_are_refused(client: Client, wild: float) -> None:
    for command, params in ((SET, (wild, 1e5)), (SET, (30, wild)), (GET, (wild,)), (REQUEST, (wild,))):
        if params == (30, 65536.0):
            continue  # a good interval
        assert client.result(command, *params) == DENIED, (command, params)
    since_us = client.now_us
    client.run(3.0)
    assert len(client.all("HEARTBEAT", GCS, since_us)) == 3
    assert len(client.all("ATTITUDE", GCS, since_us)) == pytest.approx(30, abs=1)


def test_request_message(client: Client) -> None:
    client.run(0.3)
    for message_id in (0, 1, 245, 30, 31, 32, 331, 250, 148):
        name = mavlink.mavlink_map[message_id].msgname
        before = [len(client.all(name, port)) for port in (OFFBOARD, GCS)]
        assert client.result(REQUEST, message_id, port=GCS) == ACCEPTED
        assert [len(client.all(name, port)) for port in (OFFBOARD, GCS)] == [before[0], before[1] + 1]
    assert client.result(REQUEST, 24) == DENIED
    client.tick()
    assert client.texts() == ["Request refused: message 24 is not served"]
