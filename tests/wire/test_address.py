"""Endpoint strings."""

from __future__ import annotations

import ipaddress
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.link.address import Address, AddressError, Kind, parse_address

label = st.from_regex(r"[a-z0-9]([a-z0-9-]{0,8}[a-z0-9])?", fullmatch=True)
name = st.lists(label, min_size=1, max_size=3).map(".".join).filter(lambda host: not host.replace(".", "").isdigit())
host = name | st.ip_addresses(v=4).map(str) | st.ip_addresses(v=6).map(str)


kinds: st.SearchStrategy[Kind] = st.sampled_from(get_args(Kind))


@given(kinds, host, st.integers(1, 65535))
def test_every_address_survives_its_string(kind: Kind, host: str, port: int) -> None:
    address = Address(kind, host, port)
    text = str(address)
    assert parse_address(text) == address
    assert parse_address(text.replace(":", "://", 1)) == address


@given(st.text() | st.text("udpinotc:/[]0123456789.abcf", max_size=30))
def test_any_text_is_an_address_or_an_address_error(text: str) -> None:
    try:
        address = parse_address(text)
    except AddressError as error:
        reason = str(error)
    else:
        reason = repr(text)
        assert parse_address(str(address)) == address
    assert repr(text) in reason


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("udpin:127.0.0.1:14550", Address("udpin", "127.0.0.1", 14550)),
        ("udp:0.0.0.0:14550", Address("udpin", "0.0.0.0", 14550)),
        ("udp://localhost:14540", Address("udpin", "localhost", 14540)),
        ("udpout:ground.example:14550", Address("udpout", "ground.example", 14550)),
        ("udpin://[::1]:0", Address("udpin", "::1", 0)),
        ("UDPOUT:[0:0::1]:1", Address("udpout", "::1", 1)),
        ("tcpin:127.0.0.1:0", Address("tcpin", "127.0.0.1", 0)),
        ("tcp:127.0.0.1:5760", Address("tcp", "127.0.0.1", 5760)),
        ("tcpout://[::1]:5760", Address("tcp", "::1", 5760)),
    ],
)
def test_the_forms_of_the_tools(text: str, expected: Address) -> None:
    assert parse_address(text) == expected


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not an endpoint; allowed: udpin:HOST:PORT"),
        ("127.0.0.1", "not an endpoint"),
        ("serial:127.0.0.1:5760", "no links of type 'serial' here; allowed: udpin:HOST:PORT.*udpout:HOST:PORT.*tcp"),
        ("udpbcast://127.0.0.1:5760", "'udpbcast'"),
        ("tcp:127.0.0.1:0", "allowed: 1 to 65535"),
        ("tcp:5760", "one host and one port"),
        ("udpin:14550", "one host and one port"),
        ("udpin:::1:14550", "one host and one port"),
        ("udpin::14550", "names no host; 127.0.0.1 is this machine alone"),
        ("udpin:127.0.0.1:", "'' is not a port; allowed: 0 to 65535"),
        ("udpin:127.0.0.1:65536", "allowed: 0 to 65535"),
        ("udpout:127.0.0.1:0", "allowed: 1 to 65535"),
        ("udpin:127.0.0.1:+1", "is not a port"),
        ("udpin:127.0.0.1:١٢", "is not a port"),
        ("udpin:127.0.0.1:14550\n", "is not a port"),
        ("udpin:127.0.0.300:14550", "not an IPv4 address"),
        ("udpin:[::g]:14550", "not an IPv6 address"),
        ("udpin:a b:14550", "not a host name or address"),
        ("udp://127.0.0.1:14540@127.0.0.1:14550", "one host and one port"),
    ],
)
def test_what_is_refused_and_why(text: str, reason: str) -> None:
    with pytest.raises(AddressError, match=reason):
        parse_address(text)


@given(st.ip_addresses(v=6))
def test_ipv6_is_written_in_its_short_form(address: ipaddress.IPv6Address) -> None:
    assert parse_address(f"udpin:[{address.exploded}]:1").host == str(address)
