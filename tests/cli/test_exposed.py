"""Another address than loopback: not by accident, and never in silence."""

from __future__ import annotations

from pathlib import Path

import pytest
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import ends
from mavsitl.cli import main
from mavsitl.codec import encode
from mavsitl.ends import ExposedError, NullRecorder, VehicleLinks
from mavsitl.keep import carry_out
from mavsitl.scenario import load
from mavsitl.signing import EPOCH_UNIX_US, Key, setup_signing

KEY = Key(bytes(range(32)))
EVERYWHERE = VehicleLinks(bind="0.0.0.0", offboard_port=14580, gcs_port=18570, tcp_port=5760)
SOCKETS = "UDP 0.0.0.0:14580 (off-board), UDP 0.0.0.0:18570 (ground stations), TCP 0.0.0.0:5760 (ground stations)"


def check(links: VehicleLinks, *, signed: bool, lockstep: bool = False) -> list[str]:
    said: list[str] = []
    ends._check_exposed(links, said.append, signed=signed, lockstep=lockstep)
    return said


def test_loopback_has_nothing_to_say() -> None:
    for host in ("127.0.0.1", "localhost", "::1", "127.3.2.1"):
        assert check(VehicleLinks(bind=host), signed=False) == []


def test_a_network_without_a_key_is_refused_and_both_ways_out_are_named() -> None:
    with pytest.raises(ExposedError) as caught:
        check(EVERYWHERE, signed=False)
    text = str(caught.value)
    assert SOCKETS in text
    for word in ("MAV_SIGN_CFG", "SETUP_SIGNING", "--insecure"):
        assert word in text


def test_what_is_exposed_is_said() -> None:
    insecure = VehicleLinks(bind="0.0.0.0", offboard_port=14580, gcs_port=18570, tcp_port=5760, insecure=True)
    (text,) = check(insecure, signed=False)
    assert SOCKETS in text
    assert "WITHOUT AUTHENTICATION" in text
    (text,) = check(EVERYWHERE, signed=True)
    assert SOCKETS in text
    assert "signed with the vehicle's key" in text
    with pytest.raises(ExposedError, match=r"UDP 0\.0\.0\.0:14580 \(off-board\) to a network.* say --insecure"):
        check(EVERYWHERE, signed=False, lockstep=True)


@pytest.mark.sockets
@pytest.mark.parametrize("more", [["--no-state"], ["--lockstep"]])
def test_the_command_refuses(more: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    ports = [] if "--lockstep" in more else ["--gcs-port", "0"]
    assert main(["vehicle", "--bind", "0.0.0.0", "--offboard-port", "0", *ports, *more]) == 2
    assert "--insecure" in capsys.readouterr().err


def test_the_option_alone_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["vehicle", "--insecure"]) == 2
    assert "only with --bind" in capsys.readouterr().err


def test_a_vehicle_with_a_key_and_the_demand_is_signed_only(tmp_path: Path) -> None:
    """The steps of the documentation: the key on loopback, the demand, and then the network."""
    unix_us = EPOCH_UNIX_US + 400_000_000_000_000

    def vehicle(*, trusted: bool) -> Vehicle:
        return Vehicle(
            load("takeoff-hover"), NullRecorder(), seed=1, state=tmp_path, unix_us=lambda: unix_us, trusted=trusted
        )

    at_home = vehicle(trusted=True)
    assert not at_home.signed_only
    at_home.step(0)
    at_home.receive(0, encode(setup_signing((1, 1), KEY, 1), 0, 255, 190))
    assert at_home.parameters.set("MAV_SIGN_CFG", 1) is None
    assert not at_home.signed_only  # 1 leaves out the links on loopback
    at_home.close()
    carry_out(at_home)
    abroad = vehicle(trusted=False)
    assert abroad.signed_only
    abroad.close()
