"""A short run of both ends in lock-step, its logs on the disk: what people open."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavsitl import ends, scenario


def fly(folder: Path, seed: int = 1, level: str = "body_rate") -> Path:
    """`vehicle.ulg`, `ground.ulg` and `link.tlog` of 2 s of hover in wind, in `folder`."""
    flight = scenario.load("hover-wind", {"duration_s": 2.0, "seed": seed, "controller.level": level})
    ends.in_memory(flight, folder, report=lambda text: None, progress=None)
    return folder


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("runs") / "hover-wind")
