"""From an endpoint to the link that it means."""

from __future__ import annotations

import socket

from mavsitl.link.address import Address
from mavsitl.link.base import LinkError
from mavsitl.link.sockets import resolve, show
from mavsitl.link.tcp import TcpClientLink, TcpServerLink
from mavsitl.link.udp import UdpLink

__all__ = ["open_link"]


def open_link(
    address: Address, *, port_option: str = "--port ...", host_option: str = "--bind ..."
) -> UdpLink | TcpServerLink | TcpClientLink:
    """Open an endpoint: ``udpin`` and ``tcpin`` bind it, ``udpout`` and ``tcp`` send there from a free port.

    For ``udpout`` the free port is on the one local address from which the remote is reached, not on all of them. A
    ``tcp`` server need not be there yet. The two options are what an error tells the user to change.

    Raises:
        LinkError: the address cannot be bound, found or, for ``udpout``, reached.
    """
    there = address.host, address.port
    if address.kind == "udpin":
        return UdpLink(there, port_option=port_option, host_option=host_option)
    if address.kind == "tcpin":
        return TcpServerLink(there, port_option=port_option, host_option=host_option)
    if address.kind == "tcp":
        return TcpClientLink(there)
    family, remote = resolve(*there)
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(remote)  # sends nothing: it only asks the routing table
        except OSError as error:
            raise LinkError(f"no way to {show(remote)}: {error.strerror or error}") from error
        local_host = str(probe.getsockname()[0])
    return UdpLink((local_host, 0), remote[:2], port_option=port_option, host_option=host_option)
