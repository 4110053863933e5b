"""What MAVSDK gets through a link that loses a quarter of all messages each way: ``python -m tests.interop.loss``.

A client gives up after a few tries of its own; its user then asks again. Counted is how often that was needed.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mavsitl.clock import monotonic_us
from mavsitl.dialect import mavlink
from tests.hostile.report import Report, bar
from tests.interop.conftest import Sitl, sitl
from tests.interop.mavsdk_client import Pilot, connected
from tests.interop.test_mavsdk import _raw, _same, finished

LOSS = 0.25
ASKED = 6
"""Times that a user asks before it counts as not done."""
CALL_S = 40.0
"""Longest time of one call."""


def done(call: Callable[[], Any]) -> bool:
    """Whether a call of MAVSDK's ended well; one that does not end is left behind."""
    results: list[Any] = []

    def run() -> None:
        try:
            results.append(call())
        except Exception:
            results.append(False)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(CALL_S)
    return bool(results) and results[0] is not False


def measure(report: Report, what: str, calls: Sequence[Callable[[], Any]]) -> None:
    """Each call until it is done, and how often it was asked for."""
    begun_us, asked = monotonic_us(), []
    for call in calls:
        asked.append(next((k for k in range(1, ASKED + 1) if done(call)), ASKED + 1))
    seconds = (monotonic_us() - begun_us) / 1e6
    again = sum(min(k, ASKED) - 1 for k in asked)
    failed = sum(k > ASKED for k in asked)
    found = f"{len(asked) - failed} of {len(asked)}, asked again {again} x, {seconds:.1f} s"
    report.demand(what, f"done within {ASKED} tries", found, failed == 0)


def steps(pilot: Pilot, folder: Path, scale: int) -> list[tuple[str, list[Callable[[], Any]]]]:
    here = pilot.telemetry.position()
    items = _raw(here, *((mavlink.MAV_CMD_NAV_WAYPOINT, 0.1 * k, 3.0) for k in range(5 * scale)))
    back = folder / "back"
    back.mkdir()
    (folder / "sent.bin").write_bytes(bytes(range(250)) * 10 * scale)

    def set_and_read(value: float) -> Callable[[], bool]:
        def call() -> bool:
            pilot.param.set_param_float("MIS_TAKEOFF_ALT", value)
            return bool(pilot.param.get_param_float("MIS_TAKEOFF_ALT") == value)

        return call

    def download() -> bool:
        found = pilot.mission_raw.download_mission()
        return len(found) == len(items) and all(map(_same, items, found))

    def files() -> bool:
        sent = finished(pilot.ftp.upload_async, str(folder / "sent.bin"), "/fs/microsd") == "SUCCESS"
        got = finished(pilot.ftp.download_async, "/fs/microsd/sent.bin", str(back), False) == "SUCCESS"
        return sent and got and (back / "sent.bin").read_bytes() == (folder / "sent.bin").read_bytes()

    return [
        ("a parameter set and read back", [set_and_read(2.0 + k) for k in range(2 * scale)]),
        (f"a mission of {len(items)} items up", [lambda: pilot.mission_raw.upload_mission(items)]),
        ("the same down, equal", [download]),
        (f"a file of {2.5 * scale:g} kB up and down, equal", [files]),
        ("a command", [lambda: pilot.telemetry.set_rate_position(2.0)] * (2 * scale)),
    ]


def run(report: Report, *, scale: int, show: bool = True) -> None:
    loss = [f"link.{way}.loss={LOSS}" for way in ("to_ground", "to_vehicle")]
    settings = [word for setting in loss for word in ("--set", setting)]
    with TemporaryDirectory() as name, bar(5, show=show) as progress:
        folder = Path(name)
        vehicle: Sitl
        with sitl("takeoff-hover", *settings, state_dir=folder / "state") as vehicle, connected(vehicle) as pilot:
            pilot.wait("health_all_ok", bool)
            for what, calls in steps(pilot, folder, scale):
                progress.move(said=what)
                measure(report, what, calls)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    report = Report(f"MAVSDK, {LOSS:.0%} of all messages lost each way")
    run(report, scale=4)
    return report.print()


if __name__ == "__main__":
    raise SystemExit(main())
