"""The programs of this folder in their short form: the same demands, fixed seeds, no clock of the wall."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import Client
from tests.hostile import fields, floods, fuzz, ground, guided, loss, rivals
from tests.hostile.attacks import HANDLED
from tests.hostile.report import Report
from tests.hostile.targets import TARGETS


def failures(report: Report) -> list[str]:
    assert report.rows, "nothing was measured"
    return report.failures


def test_the_list_of_handled_messages_is_the_vehicle_s() -> None:
    autopilot = Client().vehicle.autopilot
    ids = {*autopilot._handlers, *autopilot.ports[0].message_ids, mavlink.MAVLINK_MSG_ID_SETUP_SIGNING}
    assert {mavlink.mavlink_map[number].msgname for number in ids} == set(HANDLED)


@pytest.mark.parametrize("seed", range(1, 6))
def test_fuzz(seed: int, tmp_path: Path) -> None:
    assert failures(fuzz.fuzz(20_000, seed, tmp_path, show=False)) == []


def test_the_controller_s_end() -> None:
    report = Report("")
    ground.ground(report, ticks=1000, show=False)
    assert failures(report) == []


def test_useless_floats() -> None:
    report = Report("")
    fields.useless_floats(report, show=False)
    assert failures(report) == []


def test_other_extremes() -> None:
    report = Report("")
    fields.other_extremes(report, show=False)
    assert failures(report) == []


def test_mission_items() -> None:
    report = Report("")
    fields.items(report, show=False)
    assert failures(report) == []


def test_parameters() -> None:
    report = Report("")
    fields.parameters(report)
    assert failures(report) == []


@pytest.mark.sockets
def test_amplification() -> None:
    report = Report("")
    rivals.amplification(report)
    assert failures(report) == []


@pytest.mark.sockets
def test_spoofed_sources() -> None:
    report = Report("")
    rivals.spoofed(report)
    assert failures(report) == []


@pytest.mark.sockets
def test_floods() -> None:
    report = Report("")
    floods.simulated(report)
    assert failures(report) == []


def test_two_ground_stations() -> None:
    report = Report("")
    rivals.fighting(report)
    assert failures(report) == []


def test_files_and_secrets(tmp_path: Path) -> None:
    report = Report("")
    rivals.traversal(report, tmp_path)
    assert failures(report) == []


@pytest.mark.parametrize("seed", [1, 2])
def test_a_quarter_of_the_frames_is_lost(seed: int) -> None:
    report = Report("")
    loss.measure(report, seed)
    assert failures(report) == []


@pytest.mark.parametrize("name", TARGETS)
def test_guided(name: str) -> None:
    assert failures(guided.guided([name], 150, 1, show=False)) == []


def test_the_guide_knows_new_ground() -> None:
    """New ground is told from old, and what a target raises is not swallowed."""
    from mavsitl.services import statustext

    def target(data: bytes) -> None:
        text = data.decode("latin-1")
        for message in statustext.chunks(1, text, 1 + len(data)):
            assert message.chunk_seq < 2, "three chunks"

    coverage = guided.Coverage()
    assert coverage.run(target, b"a")
    assert not coverage.run(target, b"b")
    assert coverage.run(target, b"c" * 60)
    with pytest.raises(AssertionError, match="three chunks"):
        coverage.run(target, b"c" * 120)
