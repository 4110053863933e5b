"""Endpoint strings opened as links."""

from __future__ import annotations

from contextlib import closing

import pytest

from mavsitl.link.address import parse_address
from mavsitl.link.endpoint import open_link
from mavsitl.link.sockets import LOOPBACK
from mavsitl.link.tcp import TcpClientLink, TcpServerLink
from mavsitl.link.udp import UdpLink

pytestmark = pytest.mark.sockets

LIMIT_S = 5.0


def test_udp() -> None:
    with closing(open_link(parse_address("udpin:127.0.0.1:0"))) as listener:
        assert isinstance(listener, UdpLink)
        port = listener.address[1]
        with closing(open_link(parse_address(f"udpout:127.0.0.1:{port}"))) as sender:
            assert isinstance(sender, UdpLink)
            assert listener.remote is None
            assert sender.remote == listener.address
            assert sender.address[0] == LOOPBACK
            sender.send(b"hello")
            assert listener.wait(LIMIT_S)
            assert listener.receive(0) == [(b"hello", sender.address)]


@pytest.mark.parametrize("scheme", ["tcp", "tcpout"])
def test_tcp(scheme: str) -> None:
    with closing(open_link(parse_address("tcpin:127.0.0.1:0"))) as server:
        assert isinstance(server, TcpServerLink)
        with closing(open_link(parse_address(f"{scheme}:127.0.0.1:{server.address[1]}"))) as client:
            assert isinstance(client, TcpClientLink)
            for _ in range(int(LIMIT_S / 0.01)):
                client.wait(0.01)
                server.wait(0.0)
                if client.connected and server.peers:
                    break
            assert client.remote == server.address
            assert len(server.peers) == 1
