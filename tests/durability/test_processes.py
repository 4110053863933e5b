"""Real processes killed, stopped, and asked to end: the programs of this folder in their short form."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic, sleep

import pytest
from pyulog import ULog

from tests.durability import clocks, kills, restarts, soak
from tests.durability.station import PATIENCE_S, Ports, Process, Station

pytestmark = [
    pytest.mark.sockets,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals, and /proc"),
]


def test_nothing_acknowledged_is_lost_by_a_kill(tmp_path: Path) -> None:
    tally = kills.run(len(kills.KINDS), 1, tmp_path, show=False)
    assert tally.faults == []
    assert set(tally.acknowledged) == {"parameters", "missions", "files"}
    assert tally.logs == len(kills.KINDS) - 1
    assert kills.passed(tally)


def test_a_ledger_of_what_may_be_there() -> None:
    """The judge of the campaign: what it would call lost."""
    entry = kills.Entry("old", [("a", 1.0), ("b", 2.0), ("c", 2.4), ("d", None)])
    assert entry.allowed(2.6) == ["b", "c", "d"]
    assert entry.allowed(3.0) == ["c", "d"]
    assert entry.allowed(1.4) == ["old", "a", "b", "c", "d"]


@pytest.mark.parametrize("event", [restarts.vehicle_killed, restarts.ground_killed])
def test_a_flight_goes_on_when_one_end_comes_back(event: Callable[..., None]) -> None:
    flight, figures = restarts.Flight(), restarts.Figures()
    try:
        flight.flying()
        event(flight, random.Random(3), figures)
    finally:
        flight.close()
    assert len(figures.seconds) >= 1  # the limits are for a machine that does nothing else


def test_a_soak_of_seconds(tmp_path: Path) -> None:
    found = soak.realtime(6.0, 2.0, tmp_path)
    assert found.failures == []
    assert found.exit_code == 0
    assert min(found.done[name] for name in ("parameters", "missions", "files", "logs")) > 3
    assert len(found.samples) >= 5


def test_a_slope_is_of_what_comes_after_the_warm_up() -> None:
    steep = [(k / 60, 1000.0 + 50 * min(k, 25)) for k in range(100)]
    assert soak.slope(steep) == pytest.approx(0.0, abs=1.0)
    assert soak.slope([(k / 60, 2.0 * k) for k in range(100)]) == pytest.approx(120.0)
    found = soak.Soak(samples=[(k / 60, 1, 7 + k // 50, 3) for k in range(100)])
    assert not found.constant(2)
    assert found.constant(3)


def test_the_time_base_is_measured() -> None:
    found = clocks.measure(2.0)
    assert found.answers > 30
    assert found.round_trip_p99_ms < 1000.0
    assert abs(found.drift) < 0.5


def test_a_suspended_vehicle_neither_jumps_nor_rushes_and_says_so() -> None:
    """Its own clock goes on where it stood; the lost time is told on the link and on the console."""
    ports = Ports()
    station, process = Station(ports), Process(*ports.vehicle("--no-state"))
    try:
        station.wait_booted()
        station.run(0.5)
        before_ms = station.clock_ms()
        process.send(signal.SIGSTOP)
        sleep(2.0)
        process.send(signal.SIGCONT)
        went_on_s = monotonic()
        station.until(lambda: any("given up" in text for text in station.texts), what="the lost time")
        assert station.clock_ms() - before_ms < 1000.0 * (monotonic() - went_on_s) + 1000.0
        assert process.end() == 0  # only then is all of what it printed certain to have been read
        assert "of real time given up" in process.printed
        assert "schedule moved" in process.printed
    finally:
        process.close()
        station.close()


# --- asked to end


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def gone(pid: int) -> bool:
    """Not there, or a zombie that its parent's end left for somebody else to collect."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def wait_gone(pids: list[int]) -> None:
    until_s = monotonic() + PATIENCE_S
    while not all(gone(pid) for pid in pids):
        assert monotonic() < until_s, f"still there: {[pid for pid in pids if not gone(pid)]}"
        sleep(0.05)


@pytest.fixture(autouse=True)
def terminal() -> Iterator[None]:
    """Processes do not begin under nohup, whatever runs the tests."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def flying(folder: Path) -> subprocess.Popen[bytes]:
    """`mavsitl fly`, a while after its two processes began to fly."""
    process = subprocess.Popen(
        [sys.executable, "-m", "mavsitl", "fly", "hover-calm", "--duration", "100000", "--run-dir", str(folder)],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    log = folder / "hover-calm" / "link.tlog"
    until_s = monotonic() + PATIENCE_S
    while not log.exists() or log.stat().st_size < 1_000_000:
        assert monotonic() < until_s
        assert process.poll() is None
        sleep(0.02)
    return process


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGKILL, -9)])
def test_fly_takes_its_two_processes_with_it(tmp_path: Path, number: int, code: int) -> None:
    """However it ends; their logs are readable, and complete where somebody could see to that."""
    process = flying(tmp_path)
    ends = children(process.pid)
    assert len(ends) == 2
    process.send_signal(number)
    said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code
    wait_gone(ends)
    if number != signal.SIGKILL:
        assert "mavsitl fly: interrupted" in said.decode()
    for name in ("vehicle.ulg", "ground.ulg"):
        log = ULog(str(tmp_path / "hover-calm" / name), disable_str_exceptions=False)
        assert not log.file_corruption
        assert log.last_timestamp > 1_000_000


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_vehicle_that_is_asked_to_end_has_complete_logs_and_state(tmp_path: Path, number: int) -> None:
    """A parameter set in its last moment is in its file, and its log reaches to the end that it states."""
    ports = Ports()
    station = Station(ports)
    process = Process(*ports.vehicle("--state-dir", str(tmp_path), "--run-dir", str(tmp_path / "logs")))
    try:
        station.wait_booted()
        request = station.parameters.set("MIS_TAKEOFF_ALT", 7.0)
        station.until(lambda: request.outcome != "open", what="an answer")
        assert process.end(number) == 0
        assert '"MIS_TAKEOFF_ALT": 7.0' in (tmp_path / "parameters.json").read_text()
        simulated_s = float(process.printed.rpartition(" s in ")[0].rpartition("\n")[2])
        log = ULog(str(tmp_path / "logs" / "vehicle.ulg"), disable_str_exceptions=False)
        assert log.last_timestamp == pytest.approx(simulated_s * 1e6, abs=60_000)
    finally:
        process.close()
        station.close()


def test_a_terminal_s_end_is_ignored_where_that_was_asked_for(tmp_path: Path) -> None:
    """As under nohup."""
    ports = Ports()
    station = Station(ports)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        process = Process(*ports.vehicle("--no-state"))
    finally:
        signal.signal(signal.SIGHUP, before)
    try:
        station.wait_booted()
        process.send(signal.SIGHUP)
        station.heard.clear()
        station.until(lambda: "HEARTBEAT" in station.heard, what="a HEARTBEAT")
        assert process.running
        assert process.end() == 0
    finally:
        process.close()
        station.close()
