"""A user's controller by two processes in lock-step, and in real time."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavsitl import controllers, ends, pair, testing
from mavsitl.link.address import parse_address
from mavsitl.link.udp import LOOPBACK
from mavsitl.scenario import load

MINE = """\
from mavsitl.controllers import AttitudeDemand


class Mine:
    def __init__(self, airframe):
        self.mass, self.gravity = airframe.mass_kg, (0.0, 0.0, airframe.gravity_m_s2)

    def update(self, time_s, state, reference):
        wanted = 4.0 * (reference.position - state.position) - 3.0 * state.velocity
        return AttitudeDemand.along(self.mass * (wanted + self.gravity), reference.yaw)
"""


@pytest.fixture
def mine(tmp_path: Path) -> str:
    (tmp_path / "mine.py").write_text(MINE)
    return f"{tmp_path / 'mine.py'}:Mine"


@pytest.mark.sockets
def test_two_processes_fly_the_bytes_of_one(mine: str, tmp_path: Path) -> None:
    flight = load("hover-wind", {"duration_s": 1.0, **controllers.settings(mine)})
    once = ends.in_memory(flight, None, report=lambda text: None, progress=None)
    settings = ["duration_s=1.0", f"controller.own='{mine}'"]
    twice = pair.fly("hover-wind", settings, tmp_path / "run", lambda end, event: None)
    assert twice.vehicle["wire_hash"] == once.wire_hash
    assert twice.ground["finished"]


@pytest.mark.sockets
def test_in_real_time(mine: str) -> None:
    flight = load("hover-calm", {"duration_s": 1.0, **controllers.settings(mine)})
    said: list[str] = []
    with testing.vehicle("hover-calm") as vehicle:
        outcome = ends.ground_realtime(
            flight, parse_address(f"udpin:{LOOPBACK}:{vehicle.offboard_port}"), None, vehicle_system_id=None, wing=None,
            report=said.append, stop=lambda: False, progress=None,
        )  # fmt: skip
    assert outcome.finished, said
    assert "flying" in said
