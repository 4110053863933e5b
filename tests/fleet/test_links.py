"""Impaired links of a fleet: each vehicle has its own, drawn by its number, and is what it would be alone over it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from mavsitl import ends, seeds
from mavsitl.cli import main
from mavsitl.fleet import FleetOutcome, Flown
from mavsitl.link.udp import LOOPBACK
from mavsitl.log.content import load
from mavsitl.report.run import load_run
from mavsitl.scenario import Flight
from tests.bench.bench_fleet import free_block
from tests.drivers.exercise import hash_in_memory, shortened
from tests.fleet.test_processes import fly as fly_over_udp

BAD = {"loss": 0.1, "latency_ms": 20.0, "jitter_ms": 5.0}


def impaired(duration_s: float = 2.0, **changes: Any) -> Flight:
    both = {
        f"link__{direction}__{key}": value for direction in ("to_ground", "to_vehicle") for key, value in BAD.items()
    }
    return shortened("formation-spiral", duration_s, **{**both, **changes})


def fly(flight: Flight, count: int, folder: Path | None = None) -> FleetOutcome:
    return ends.fleet_in_memory(flight, folder, count=count, report=lambda text: None, progress=None)


def share_lost(flown: Flown, direction: str = "to_vehicle") -> float:
    counts: Mapping[str, float] = flown.link["link"][direction]
    return counts["lost"] / counts["sent"]


@pytest.fixture(scope="module")
def three() -> FleetOutcome:
    return fly(impaired(), 3)


def test_over_bad_links_the_same_seed_gives_the_same_bytes(three: FleetOutcome) -> None:
    again = fly(impaired(), 3)
    hashes = [[each.wire_hash for each in outcome.vehicles] for outcome in (three, again)]
    assert hashes[0] == hashes[1]
    assert len(set(hashes[0])) == 3
    assert again.vehicles == three.vehicles
    assert three.finished


def test_the_first_is_the_vehicle_alone_over_its_link(three: FleetOutcome) -> None:
    assert three.vehicles[0].wire_hash == hash_in_memory(impaired())
    (alone,) = fly(impaired(), 1).vehicles
    assert alone == three.vehicles[0]


def test_a_vehicle_s_link_does_not_depend_on_how_many_fly(three: FleetOutcome) -> None:
    assert fly(impaired(), 2).vehicles == three.vehicles[:2]


def test_each_link_has_random_numbers_of_its_own(three: FleetOutcome) -> None:
    assert [ends.lockstep_channels(impaired(), j) is not None for j in range(2)] == [True, True]
    assert len({seeds.of_vehicle(1, j) for j in range(100)}) == 100
    for direction in ("to_ground", "to_vehicle"):
        lost = [share_lost(each, direction) for each in three.vehicles]
        assert len(set(lost)) == 3
        assert all(0.03 < each < 0.2 for each in lost)
        assert all(
            each.link["link"][direction]["delay_p50_ms"] == pytest.approx(20.0, abs=3.0) for each in three.vehicles
        )


def test_one_that_may_become_worse_loses_nothing() -> None:
    outcome = fly(shortened("formation-spiral", 1.0, link__live=True), 2)
    assert outcome.finished
    for each in outcome.vehicles:
        counts = each.link["link"]["to_ground"]
        assert counts["sent"] == counts["delivered"] > 0.0
    assert fly(shortened("formation-spiral", 1.0), 2).vehicles[0].link == {}


def test_a_perfect_link_is_what_it_was_without_one() -> None:
    scenario = shortened("formation-spiral", 1.0)
    assert fly(scenario, 2).vehicles[0].wire_hash == hash_in_memory(scenario)


def test_a_vehicle_without_its_ground_is_one_that_has_not_flown_to_its_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not an error that takes the others' flights with it; here nobody ever meets."""
    monkeypatch.setattr(ends, "IMPAIRED_GRACE_S", 5.0)
    silent = ["--set", "link.to_vehicle.down=true", "--set", "link.to_ground.down=true"]
    arguments = ["fly", "formation-spiral", "--count", "2", "--duration", "1", "--json", "--run-dir", str(tmp_path)]
    assert main([*arguments, *silent]) == 1
    told = json.loads(capsys.readouterr().out)
    assert [each["finished"] for each in told["vehicles"]] == [False, False]
    assert told["simulated_s"] == pytest.approx(6.0, abs=0.1)
    assert not told["finished"]
    vehicles = told["flights"][0]["flight"]["fleet"]["vehicles"]
    assert [(each["flight_time_s"], each["rms_m"]) for each in vehicles] == [(0.0, None)] * 2
    page = (tmp_path / "report.html").read_text("utf-8")
    assert page.count("not flown to its end") == 2
    assert "0 of 2 flown as planned" in page


def test_chaos_acts_on_every_vehicle() -> None:
    scenario = shortened("formation-spiral", 1.0, chaos=[{"mode": "ack-first-lost"}])
    outcome = fly(scenario, 2)
    assert outcome.finished
    alone = ends.in_memory(scenario, None, report=lambda text: None, progress=None)
    assert (
        outcome.vehicles[0].wire_hash
        == alone.wire_hash
        != fly(shortened("formation-spiral", 1.0), 1).vehicles[0].wire_hash
    )


def test_logs_run_json_and_page_have_each_link(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [
        part for direction in ("to_ground", "to_vehicle") for key, value in BAD.items()
        for part in ("--set", f"link.{direction}.{key}={value}")
    ]  # fmt: skip
    arguments = ["fly", "formation-spiral", "--count", "2", "--duration", "2", "--run-dir", str(tmp_path)]
    assert main([*arguments, *settings, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    fleet = load_run(tmp_path).flights[0].fleet
    assert fleet is not None
    for said, vehicle in zip(told["vehicles"], fleet.vehicles, strict=True):
        assert said["link"] == vehicle.links
        counts = vehicle.links["link"]["to_vehicle"]
        assert counts["lost"] > 0.0
        tables = load(tmp_path / vehicle.folder / "vehicle.ulg").tables
        rows = [table["lost"][-1] for table in tables.values() if "queue_drops" in table and "delay_p99_ms" in table]
        assert counts["lost"] in rows  # the last row is of the whole run
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "Impaired links" in page
    assert page.count('<td class="text">off-board, to vehicle') == 2
    assert page.count("<figure") == 5


@pytest.mark.sockets
def test_in_real_time_each_vehicle_has_both_its_links(tmp_path: Path) -> None:
    ports = free_block(6)
    bad = ["--set", "link.to_vehicle.loss=0.1", "--set", "link.to_ground.latency_ms=10"]
    gcs = ["--set", "gcs_link.to_ground.loss=0.3"]
    vehicle, ground = fly_over_udp(
        2,
        (*bad, *gcs, "--no-state", "--run-dir", str(tmp_path), "--offboard-port", f"{ports}",
         "--offboard-remote", f"{LOOPBACK}:{ports + 2}", "--gcs-port", f"{ports + 4}"),
        ("--link", f"udpin:{LOOPBACK}:{ports + 2}"),
    )  # fmt: skip
    assert vehicle["finished"] is ground["finished"] is True
    for j, each in enumerate(vehicle["vehicles"]):
        assert each["link"].keys() == {"link", "gcs_link"}
        assert each["link"]["link"]["to_vehicle"]["lost"] > 0
        assert each["link"]["link"]["to_ground"]["delay_p50_ms"] == pytest.approx(10.0, abs=0.5)
        assert each["link"]["gcs_link"]["to_ground"]["lost"] > 0
        tables = load(tmp_path / f"vehicle-{j}" / "vehicle.ulg").tables
        sent = [int(table["sent"][-1]) for table in tables.values() if "queue_drops" in table]
        assert int(each["link"]["link"]["to_vehicle"]["sent"]) in sent
