"""Setpoints out: the bytes parsed back. What the demand is in the wire's terms: `test_cycle`."""

from __future__ import annotations

from typing import Any

import pytest
from mavsitl_ground import demand

from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.node import Node
from mavsitl.quaternion import IDENTITY

TARGET = (3, 1)


def sent(node: Node) -> Any:
    """The one frame that was sent."""
    [datagram] = node.datagrams()
    [frame] = parse(datagram)
    assert (frame.system_id, frame.component_id) == (250, 191)
    assert (frame.message.target_system, frame.message.target_component) == TARGET
    return frame.message


@pytest.fixture
def node() -> Node:
    return Node(250, 191)


def test_attitude(node: Node) -> None:
    demand.send_attitude(node, TARGET, 1_236_000, ((0.5, -0.5, 0.5, -0.5), 0.0, 0.0, 0.0, 0.625))
    message = sent(node)
    assert type(message).id == mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET == 82
    assert message.time_boot_ms == 1236
    assert message.type_mask == 0b0000_0111  # the three body rates ignored; attitude and throttle used
    assert message.q == [0.5, -0.5, 0.5, -0.5]
    assert message.thrust == 0.625


def test_body_rates(node: Node) -> None:
    demand.send_rates(node, TARGET, 4000, (IDENTITY, 0.5, -0.25, 1.5, 0.75))
    message = sent(node)
    assert type(message).id == 82
    assert message.time_boot_ms == 4
    assert message.type_mask == 0b1000_0000  # the attitude ignored
    assert (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate) == (0.5, -0.25, 1.5)
    assert message.thrust == 0.75


def test_torque(node: Node) -> None:
    demand.send_torque(node, TARGET, 123_456_000, (IDENTITY, 0.125, 0.25, -0.5, 0.5))
    message = sent(node)
    assert type(message).id == mavlink.MAVLINK_MSG_ID_SET_ACTUATOR_CONTROL_TARGET == 139
    assert message.time_usec == 123_456_000
    assert message.group_mlx == 0
    assert list(message.controls) == [0.125, 0.25, -0.5, 0.5, 0.0, 0.0, 0.0, 0.0]


def test_the_stamp_comes_back_from_the_wire_for_every_control_period(node: Node) -> None:
    """The token of lock-step is in ms: a whole number of them for every rate that a scenario may have."""
    for period_us in (1000, 4000, 5000, 8000, 100_000):
        for tick in (0, 1, 249, 899_999):
            stamp_us = tick * period_us
            demand.send_rates(node, TARGET, stamp_us, (IDENTITY, 0.0, 0.0, 0.0, 0.0))
            assert sent(node).time_boot_ms * 1000 == stamp_us
