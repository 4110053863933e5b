"""Whatever comes over the wire: `receive` does not raise, nothing that is not finite gets into the simulation."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mavsitl_vehicle import tick

from mavsitl.codec import encode
from mavsitl.dialect import mavlink
from tests.autopilot.conftest import Client

LARGEST = float(np.finfo(np.float32).max)
floats = st.one_of(
    st.floats(width=32),
    st.sampled_from([nan, inf, -inf, LARGEST, -LARGEST, 0.0, 1.0, -1.0, 2.0**31, 2.0**63, -(2.0**63)]),
    st.floats(-1.0, 1.0, width=32),
    st.integers(-2, 600).map(float),
)
ours = st.sampled_from([0, 1])
ints = st.one_of(st.sampled_from([0, -(2**31), 2**31 - 1]), st.integers(-(2**31), 2**31 - 1))
commands = st.one_of(
    st.sampled_from([400, 176, 21, 511, 510, 512, 520]),
    st.integers(0, 65535),
)
quaternions = st.one_of(
    st.lists(floats, min_size=4, max_size=4),
    st.sampled_from([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.5, -0.5, 0.5, -0.5]]),
)
uint8 = st.integers(0, 255)
uint32 = st.integers(0, 2**32 - 1)

messages: st.SearchStrategy[Any] = st.one_of(
    st.builds(mavlink.MAVLink_command_long_message, ours, ours, commands, uint8, *[floats] * 7),
    st.builds(
        mavlink.MAVLink_command_int_message,
        ours,
        ours,
        uint8,
        commands,
        uint8,
        uint8,
        *[floats] * 4,
        ints,
        ints,
        floats,
    ),
    st.builds(
        mavlink.MAVLink_set_attitude_target_message,
        uint32,
        ours,
        ours,
        st.one_of(st.sampled_from([0, 3, 7, 128, 132]), uint8),
        quaternions,
        *[floats] * 4,
    ),
    st.builds(
        mavlink.MAVLink_set_actuator_control_target_message,
        st.integers(0, 2**64 - 1),
        st.sampled_from([0, 0, 0, 1]),
        ours,
        ours,
        st.lists(floats, min_size=8, max_size=8),
    ),
    st.builds(
        mavlink.MAVLink_set_mode_message,
        ours,
        uint8,
        st.one_of(st.sampled_from([6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24]), uint32),
    ),
)

LONG = mavlink.MAVLink_command_long_message


def check(client: Client) -> None:
    simulation = client.vehicle.simulation
    for name in ("x", "estimate", "inner", "wind"):
        array = getattr(simulation, name)
        if name == "inner":  # the rate setpoint may say "as it is" by NaN: rows 6 to 8
            array = np.delete(array, slice(tick.RATE_SETPOINT, tick.RATE_SETPOINT + 3), axis=0)
        assert np.isfinite(array).all(), name
    demand = simulation.demand
    finite = [tick.KIND, tick.THRUST, *range(tick.ATTITUDE, tick.ATTITUDE + 4), *range(tick.TORQUE, tick.TORQUE + 3)]
    assert np.isfinite(demand[finite]).all()
    assert 0.0 <= demand[tick.THRUST, 0] <= 1.0
    assert np.isfinite(demand[tick.RATE : tick.RATE + 2]).all()  # roll and pitch; yaw may be "as it is"


@settings(max_examples=250)
@example([LONG(1, 1, 511, 0, 30, 1e38, 0, 0, 0, 0, 0), LONG(1, 1, 510, 0, 30, 0, 0, 0, 0, 0, 0)])
@example([mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 128, [nan] * 4, LARGEST, -LARGEST, LARGEST, 1.0)])
@example([mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 0, [1, 0, 0, 0], nan, nan, LARGEST, 1.0)])
@given(st.lists(messages, min_size=1, max_size=12))
def test_any_fields(batch: list[Any]) -> None:
    client = Client()
    client.attitude()
    client.offboard()
    client.arm()
    for message in batch:
        assert client.send(message) == 1
        client.run(0.02)
        check(client)
    client.run(0.3)
    check(client)


@settings(max_examples=60)
@given(st.lists(messages, min_size=1, max_size=8))
def test_any_fields_in_flight(batch: list[Any]) -> None:
    """The same at speed: off the ground, with the rotors turning, so that setpoints act."""
    client = Client()
    client.start()
    client.run(0.3, lambda: client.attitude(thrust=0.8))
    for message in batch:
        assert client.send(message, port=1) == 1
        client.run(0.1)
        check(client)


@settings(max_examples=200)
@given(st.lists(st.binary(max_size=300), max_size=10), st.sampled_from([0, 1]))
def test_any_bytes(datagrams: list[bytes], port: int) -> None:
    client = Client()
    for datagram in datagrams:
        client.vehicle.receive(port, datagram)
    client.run(0.02)
    check(client)


@settings(max_examples=100)
@given(messages, st.integers(0, 10**6), st.integers(1, 255))
def test_damaged_frames_change_nothing(message: Any, where: int, flip: int) -> None:
    client = Client()
    frame = bytearray(encode(message, 0, 245, 190))
    frame[where % len(frame)] ^= flip
    assert client.vehicle.receive(0, bytes(frame)) == 0
    client.run(0.1)
    assert client.all("COMMAND_ACK") == []
    assert client.texts() == []
    assert not client.armed
