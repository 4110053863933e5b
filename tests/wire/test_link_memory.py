"""The link without sockets."""

from __future__ import annotations

import pytest

from mavsitl.link.base import Link, LinkError
from mavsitl.link.memory import memory_pair


def test_datagrams_arrive_whole_and_in_order() -> None:
    first, second = memory_pair()
    assert not second.wait(0.0)
    for octets in (b"one", b"", b"three"):
        first.send(octets)
    assert second.wait(0.0)
    assert second.receive(0) == [(octets, first.address) for octets in (b"one", b"", b"three")]
    assert second.receive(0) == []
    assert first.receive(0) == []


def test_it_is_a_link_and_feeds_its_other_end() -> None:
    link: Link = memory_pair()[0]
    first, second = memory_pair()
    assert first.admit(second.address, 0)
    assert not first.admit(first.address, 0)
    assert link.receive(0) == []


def test_a_full_or_closed_end_loses_datagrams_and_counts_them() -> None:
    first, second = memory_pair(capacity=2)
    for _ in range(5):
        first.send(b"x")
    assert second.dropped == 3
    assert len(second.receive(0)) == 2
    second.close()
    second.close()
    first.send(b"x")
    assert second.dropped == 4
    for use in (lambda: second.receive(0), lambda: second.send(b"x"), lambda: second.wait(0.0)):
        with pytest.raises(LinkError, match="closed"):
            use()


def test_capacity_is_checked() -> None:
    with pytest.raises(ValueError, match="capacity is 0"):
        memory_pair(0)
