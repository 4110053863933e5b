"""A vehicle on sockets beside the test: found by its addresses, watched while it runs, in lock-step with a program."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mavsitl import ends
from mavsitl.ask import ListTask
from mavsitl.link.address import Address
from mavsitl.link.udp import LOOPBACK
from mavsitl.testing import FaultError, Flight, FlightAssertionError, assert_flight, vehicle
from tests.interop.conftest import PATIENCE_S, await_end

pytestmark = pytest.mark.sockets


def parameters(url: str) -> int:
    """What a client gets that speaks first."""
    port = int(url.rpartition(":")[2])
    reply = ends.ask(ListTask(), Address("udpout", LOOPBACK, port), system_id=None, patience_s=PATIENCE_S)
    return len(reply.parameters)


def test_a_client_needs_the_address_alone() -> None:
    with vehicle(speed=4.0) as running:
        assert running.gcs_url == f"udpout://127.0.0.1:{running.gcs_own}"
        assert running.offboard_device == f"udpout:127.0.0.1:{running.offboard_own}"
        assert parameters(running.gcs_url) == parameters(running.offboard_url) > 100


def test_its_state_and_its_past_can_be_looked_at_while_it_flies(tmp_path: Path) -> None:
    with vehicle("takeoff-hover", speed=10.0, record=tmp_path / "logs") as running:
        state = running.wait_until(lambda state: state.time_s > 2.0, within_s=PATIENCE_S)
        assert state.mode == "AUTO.LOITER"
        assert len(running.truth) > 400
        assert_flight(running).stays_within(0.1, of=(0.0, 0.0, 0.0)).never_failsafe()
        with pytest.raises(FlightAssertionError, match="says 'hello'"):
            assert_flight(running).says("hello")
        with pytest.raises(FlightAssertionError, match="it did not"):
            running.wait_until(lambda state: state.armed, within_s=0.01)
    assert len(running.truth) > 400
    assert (tmp_path / "logs" / "link.tlog").stat().st_size > 0


def test_faults_reach_the_vehicle_and_its_links() -> None:
    with vehicle(speed=10.0) as running:
        fault = running.faults.inject("battery", "off", for_s=1.0)
        running.wait_until(lambda state: fault.ended_s is not None, within_s=PATIENCE_S)
        assert [text.text for text in running.texts if "battery" in text.text][:1] == ["Failure injected: battery off"]
        running.faults.link(port="gcs", down=True)
        answer = ends.ask(
            ListTask(), Address("udpout", LOOPBACK, running.gcs_own), system_id=None, patience_s=0.3
        )  # fmt: skip
        assert "no vehicle is heard" in answer.problem
        assert parameters(running.offboard_url) > 100
        running.faults.clear()
        assert parameters(running.gcs_url) > 100


def test_a_program_in_lock_step_flies_the_flight_that_mavsitl_flies() -> None:
    """The shipped ground as the program: time goes on with its answers, and the vehicle ends with its flight."""
    keys = {"duration_s": 1.0}
    with vehicle("hover-wind", lockstep=True, overrides=keys) as running:
        command = [
            sys.executable, "-m", "mavsitl", "ground", "hover-wind", "--lockstep", "--set", "duration_s=1.0",
            "--link", running.offboard_device, "--vehicle", f"{LOOPBACK}:{running.offboard_own}",
        ]  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as ground:
            running.wait_end(within_s=PATIENCE_S)
            assert await_end(ground) == 0, ground.stdout.read() if ground.stdout else ""
        assert_flight(running).entered("OFFBOARD").stays_within(0.2, of=(0.0, 0.0, -1.0))
        with pytest.raises(FaultError, match="port: 'offboard' is not allowed"):
            running.faults.link(loss=0.1)
    flight = Flight("hover-wind", overrides=keys).run()
    rows = np.searchsorted(running.truth.time_s, (flight._zero_us() / 1e6, flight._zero_us() / 1e6 + 1.0))
    np.testing.assert_array_equal(
        running.truth.position_ned_m[rows[0] : rows[1] + 1], flight.truth.between(0.0, 1.0).position_ned_m
    )


def test_a_lock_step_vehicle_that_nobody_answers_ends_with_its_test() -> None:
    with vehicle(lockstep=True) as running, pytest.raises(FlightAssertionError, match="the flight ends within"):
        running.wait_end(within_s=0.01)


@pytest.mark.parametrize(
    ("keys", "told"), [({"speed": 0.0}, "speed is 0"), ({"speed": 2.0, "lockstep": True}, "no speed")]
)
def test_wrong_set_ups_are_told(keys: dict[str, float], told: str) -> None:
    with pytest.raises(ValueError, match=told), vehicle(**keys):  # type: ignore[arg-type]
        pass
