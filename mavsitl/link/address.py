"""The endpoint strings of the MAVLink tools: ``udpin:host:port``, ``udpout:host:port``, ``tcpin:...``, ``tcp:...``.

``udpin`` and ``tcpin`` listen at the address, ``udpout`` sends to it, ``tcp`` connects to it. ``udp`` is ``udpin``, as
in pymavlink, and ``tcpout`` is ``tcp``. ``udpin://host:port`` is the same as ``udpin:host:port``. An IPv6 host stands
in brackets.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from typing import Literal, TypeAlias

from mavsitl.errors import UsageError

__all__ = ["Address", "AddressError", "Kind", "parse_address"]

_ALLOWED = (
    "udpin:HOST:PORT (listen there; also udp:HOST:PORT), udpout:HOST:PORT (send there), "
    "tcpin:HOST:PORT (listen there), tcp:HOST:PORT (connect there; also tcpout:HOST:PORT), "
    "each also as udpin://HOST:PORT; an IPv6 HOST in brackets"
)
_PATTERN = re.compile(r"(?P<scheme>[A-Za-z0-9]+):(?P<slashes>//)?(?P<rest>.*)", re.DOTALL)
_HOST_AND_PORT = re.compile(r"(?:\[(?P<ipv6>[^\[\]]*)\]|(?P<host>[^:\[\]]*)):(?P<port>[^:]*)", re.DOTALL)
_HOST_NAME = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?(\.[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?)*\.?")


class AddressError(UsageError):
    """An endpoint string that is not one; the text quotes it and says what is allowed."""


Kind: TypeAlias = Literal["udpin", "udpout", "tcpin", "tcp"]

_KINDS: dict[str, Kind] = {
    "udp": "udpin",
    "udpin": "udpin",
    "udpout": "udpout",
    "tcp": "tcp",
    "tcpin": "tcpin",
    "tcpout": "tcp",
}


@dataclass(frozen=True, slots=True)
class Address:
    """One endpoint. ``str(address)`` is its canonical string, which parses to an equal address."""

    kind: Kind
    host: str
    """name or numeric address, IPv6 without brackets"""
    port: int
    """0 to 65535; 0, "any free port", only for udpin and tcpin"""

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind}:{host}:{self.port}"


def parse_address(text: str) -> Address:
    """Read an endpoint string. Raises `AddressError`."""
    match = _PATTERN.fullmatch(text)
    if match is None:
        raise AddressError(f"{text!r} is not an endpoint; allowed: {_ALLOWED}")
    scheme = match["scheme"].lower()
    kind = _KINDS.get(scheme)
    if kind is None:
        raise AddressError(f"{text!r}: no links of type {scheme!r} here; allowed: {_ALLOWED}")
    parts = _HOST_AND_PORT.fullmatch(match["rest"])
    if parts is None:
        raise AddressError(f"{text!r} needs one host and one port after {scheme!r}; allowed: {_ALLOWED}")
    host = _ipv6(text, parts["ipv6"]) if parts["ipv6"] is not None else _host(text, parts["host"])
    return Address(kind, host, _port(text, parts["port"], least=0 if kind in ("udpin", "tcpin") else 1))


def _ipv6(text: str, host: str) -> str:
    try:
        address = ipaddress.IPv6Address(host)
    except ValueError as error:
        raise AddressError(f"{text!r}: {host!r} in brackets is not an IPv6 address") from error
    return str(address)


def _host(text: str, host: str) -> str:
    if not host:
        raise AddressError(f"{text!r} names no host; 127.0.0.1 is this machine alone, 0.0.0.0 every network it is on")
    if re.fullmatch(r"[0-9.]+", host):
        try:
            return str(ipaddress.IPv4Address(host))
        except ValueError as error:
            raise AddressError(f"{text!r}: {host!r} is not an IPv4 address") from error
    if len(host) > 253 or _HOST_NAME.fullmatch(host) is None:
        raise AddressError(f"{text!r}: {host!r} is not a host name or address")
    return host


def _port(text: str, port: str, least: int) -> int:
    if re.fullmatch(r"[0-9]{1,5}", port) is None or not least <= int(port) <= 65535:
        raise AddressError(f"{text!r}: {port!r} is not a port; allowed: {least} to 65535")
    return int(port)
