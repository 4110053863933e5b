"""What the links over sockets share: addresses found, shown and bound, with errors that say what to change."""

from __future__ import annotations

import errno
import os
import select
import socket
from collections.abc import Sequence
from typing import Any

from mavsitl.link.base import Link, LinkError

__all__ = ["LOOPBACK", "bind_socket", "resolve", "resolve_all", "show", "wait_any"]

LOOPBACK = "127.0.0.1"


def resolve_all(
    host: str, port: int, family: int = socket.AF_UNSPEC, kind: int = socket.SOCK_DGRAM
) -> list[tuple[int, Any]]:
    """Address families and numeric socket addresses of a host, at least one. Raises `LinkError`."""
    try:
        found = socket.getaddrinfo(host, port, family, kind)
    except OSError as error:
        raise LinkError(f"cannot find the host {host!r}: {error.strerror or error}") from error
    return [(int(entry[0]), entry[4]) for entry in found]


def resolve(host: str, port: int, family: int = socket.AF_UNSPEC, kind: int = socket.SOCK_DGRAM) -> tuple[int, Any]:
    """The first of `resolve_all`. Raises `LinkError`."""
    return resolve_all(host, port, family, kind)[0]


def show(address: Any) -> str:
    """A numeric socket address as text."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def wait_any(links: Sequence[Link], timeout_s: float) -> bool:
    """Wait until something may have come on one of the links, at most `timeout_s` seconds; whether it has.

    It returns False at once where there is no socket to wait for.
    """
    readers = [reader for link in links for reader in link.readers()]
    return bool(readers) and bool(select.select(readers, (), (), timeout_s)[0])


def bind_socket(bind: tuple[str, int], family: int, kind: int, port_option: str, host_option: str) -> socket.socket:
    """A socket bound to an address that nobody else has.

    Raises:
        LinkError: the port is taken or not allowed, or the host cannot be found or bound.
    """
    host, port = bind
    family, address = resolve(host, port, family, kind)
    opened = socket.socket(family, kind)
    try:
        if kind == socket.SOCK_STREAM and os.name == "posix":
            # Else a port rests for minutes after its connections have ended. Two listeners still exclude one another.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind(address)
        if kind == socket.SOCK_STREAM:
            opened.listen()  # two listeners at one port may find out only here
    except OSError as error:
        opened.close()
        if error.errno == errno.EADDRINUSE:
            text = f"port {port} is in use (bind {host}): choose another with {port_option}"
        elif error.errno == errno.EACCES:
            text = f"port {port} is not allowed for this user (bind {host}): choose one above 1023 with {port_option}"
        elif error.errno == errno.EADDRNOTAVAIL:
            text = f"{host} is not an address of this machine (port {port}): choose another with {host_option}"
        else:
            text = f"cannot bind {host} port {port}: {error.strerror or error}; see {port_option} and {host_option}"
        raise LinkError(text) from error
    return opened
