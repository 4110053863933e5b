"""What `mavsitl vehicle` and `mavsitl ground` share: options of a process, and what it tells while it runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.cli.common import Interrupted, UsageError, above_zero, logs_in, on_signals, whole

if TYPE_CHECKING:
    from mavsitl.ends import Outcome
    from mavsitl.fleet import FleetOutcome
    from mavsitl.realtime import Wish


MAX_VEHICLES = 250
"""In one process: system ids end at 255, and ground stations take the highest."""

COUNT = whole(1, MAX_VEHICLES)

DEADLINE_S = 10.0


def add_end_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("run")
    group.add_argument(
        "--lockstep", action="store_true", help="simulated time, with a partner that also runs --lockstep"
    )
    group.add_argument(
        "--deadline",
        type=above_zero,
        metavar="S",
        help="lock-step: a partner silent for so long is an error (default: 10)",
    )
    group.add_argument(
        "--cpu",
        type=whole(0, 4095),
        metavar="N",
        help="lock-step: run on this CPU from the first exchange on; the same for both is fastest",
    )
    group.add_argument(
        "--realtime", action="store_true", default=None,
        help="keep the time on a busy machine: a real-time priority and locked memory (Linux, where it is allowed)",
    )  # fmt: skip
    group.add_argument(
        "--best-effort", action="store_true", default=None,
        help="with --realtime: go on without what is not allowed, and say what that is",
    )  # fmt: skip
    group.add_argument("--run-dir", type=Path, metavar="DIR", help="write logs there (default: none)")
    group.add_argument("--wing", metavar="NAME", help="another installed vehicle or controller, by its entry point")
    group.add_argument(
        "--json", action="store_const", dest="status", const="json", help="print one JSON object a line, for programs"
    )
    group.add_argument("--status", choices=("text", "json"), default="text", help="json: as --json")


class Status:
    """What an end tells while it runs: lines for a person, or JSON objects for a program. Also its stop flag."""

    def __init__(self, as_json: bool, logs: Path | None = None) -> None:
        """`logs`: the folder that they go to; None: none are written."""
        self._as_json = as_json
        self._logs = logs
        self._signal = 0
        on_signals(self._stop)

    @property
    def stopped(self) -> bool:
        return self._signal != 0

    def _stop(self, number: int, frame: Any) -> None:
        if self._signal:
            raise Interrupted(number)
        self._signal = number

    def stop(self) -> bool:
        return self.stopped

    def progress(self, flight_time_s: float) -> None:
        if self._signal:
            raise Interrupted(self._signal)
        if self._as_json:
            self._print({"event": "progress", "flight_time_s": flight_time_s})

    def say(self, text: str) -> None:
        if self._as_json:
            self._print({"event": "report", "text": text})
        else:
            print(text, flush=True)

    def start(self, text: str) -> None:
        """`text` is who and where; told with it is where the logs go."""
        self.say(text)
        if self._logs is not None:
            self.say(f"logs: {self._logs}")

    def end(self, outcome: Outcome) -> None:
        if self._as_json:
            self._print({
                "event": "end", "simulated_s": outcome.simulated_s, "wall_s": outcome.wall_s, "speed": outcome.speed,
                "wire_hash": outcome.wire_hash, "finished": outcome.finished,
                "frames": outcome.frames, "rejected": outcome.rejected,
                **({} if outcome.lateness_us is None else {
                    "lateness_us": outcome.lateness_us, "rebased": outcome.rebased, "lost_s": outcome.lost_s,
                }),
                **({"lost": outcome.lost} if outcome.lost else {}),
                "dropped": outcome.dropped, **outcome.links, **self._where(),
            })  # fmt: skip
            return
        self._tell_end(_end_lines(outcome), lost=bool(outcome.lost))

    def end_fleet(self, outcome: FleetOutcome) -> None:
        if self._as_json:
            self._print(outcome.as_event() | self._where())
            return
        self._tell_end(fleet_table(outcome), lost=bool(outcome.lost))

    def _where(self) -> dict[str, str]:
        return {} if self._logs is None else {"logs": f"{self._logs}"}

    def _tell_end(self, lines: Sequence[str], *, lost: bool) -> None:
        where = "" if self._logs is None else f"logs: {self._logs}"
        if lost and not where:
            where = "logs: none; --run-dir DIR keeps them"
        for line in (*lines, where):
            if line:
                print(line)

    def _print(self, event: dict[str, Any]) -> None:
        import msgspec

        sys.stdout.write(msgspec.json.encode(event).decode() + "\n")
        sys.stdout.flush()


def _end_lines(outcome: Outcome) -> list[str]:
    lines = [_pace(outcome)]
    if outcome.lost:
        lines.append(f"lost: {outcome.lost}")
    return [*lines, *_dropped(outcome), *_links("", outcome.links), *_lateness(outcome)]


def tells_logs(run: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """Of a command with --run-dir: however it ends, the user is told what was written there."""

    @wraps(run)
    def command(options: argparse.Namespace) -> int:
        with logs_in(options.run_dir):
            return run(options)

    return command


def fleet_table(outcome: FleetOutcome) -> list[str]:
    """For a person: each vehicle in a line, and what is of all."""
    lines = [f"{_pace(outcome)}, {len(outcome.vehicles)} vehicles"]
    if any(each.rms_m is not None for each in outcome.vehicles):
        lines.append(f"{'vehicle':>7} {'flown s':>8} {'rms m':>7} {'worst m':>8}  end")
        for each in outcome.vehicles:
            error = f"{'-':>7} {'-':>8}" if each.rms_m is None else f"{each.rms_m:7.3f} {each.worst_m:8.3f}"
            end = f"lost: {each.lost}" if each.lost else "as planned" if each.finished else "not flown to its end"
            lines.append(f"{each.system_id:7d} {each.flight_time_s:8.1f} {error}  {end}")
    for collision in outcome.collisions:
        lines.append(
            f"collision of vehicles {collision.vehicle} and {collision.other} at t = {collision.time_s:.2f} s: "
            f"{collision.distance_m:.2f} m"
        )
    lines += _dropped(outcome)
    for each in outcome.vehicles:
        lines += _links(f"vehicle {each.system_id}, ", each.link)
    return lines + _lateness(outcome)


def _pace(outcome: Outcome | FleetOutcome) -> str:
    flown = f"{outcome.simulated_s:.1f} s in {outcome.wall_s:.1f} s, {outcome.speed:.2f} x real time"
    return f"{flown}; {outcome.frames} frames in"


def _dropped(outcome: Outcome | FleetOutcome) -> list[str]:
    counts = ", ".join(f"{name} {count}" for name, count in outcome.dropped.items())
    return [f"dropped: {counts}"] if counts else []


def _links(whose: str, links: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[str]:
    """A line for each direction of each bad link on which anything was sent: its counts that are not 0."""
    return [
        f"{whose}{place} {direction}: " + ", ".join(f"{name} {value:g}" for name, value in counts.items() if value)
        for place, directions in links.items()
        for direction, counts in directions.items()
        if any(counts.values())
    ]


def _lateness(outcome: Outcome | FleetOutcome) -> list[str]:
    if outcome.lateness_us is None:  # nobody is late in lock-step
        return []
    p50, p99 = outcome.lateness_us
    given_up = f"schedule moved {outcome.rebased} times, {outcome.lost_s:.1f} s given up"
    return [f"tick lateness p50 {p50:.0f} us, p99 {p99:.0f} us; {given_up}"]


def check_effect(options: argparse.Namespace, end: str, names: Sequence[str]) -> None:
    """Scenario options that this end does not look at. In lock-step both ends are given all of them."""
    for name in names:
        if getattr(options, name[2:].replace("-", "_")) is not None and not options.lockstep:
            raise UsageError(f"{name}: has no effect on the {end}, give it to the other end")


def check_lockstep(options: argparse.Namespace, *, real_time_only: Sequence[str], lockstep_only: Sequence[str]) -> None:
    """An option that would have no effect is refused, not ignored."""
    names, needed = (real_time_only, "not with") if options.lockstep else (lockstep_only, "only with")
    for name in names:
        if getattr(options, name[2:].replace("-", "_")) is not None:
            raise UsageError(f"{name}: {needed} --lockstep")


def check_fleet(options: argparse.Namespace, system_id: int) -> int:
    """The number of vehicles of a fleet; 0: it is no fleet."""
    if options.count is None:
        if options.one_link:
            raise UsageError("--one-link: only with --count")
        return 0
    if options.lockstep:
        raise UsageError("--count: not with --lockstep; mavsitl fly --count flies a formation in lock-step")
    count: int = options.count
    if system_id + count - 1 > MAX_VEHICLES:
        last = system_id + count - 1
        raise UsageError(f"--count {count}: system ids {system_id} to {last}; allowed: up to {MAX_VEHICLES}")
    return count


def wish_for_real_time(options: argparse.Namespace) -> Wish:
    from mavsitl.realtime import Wish

    if options.best_effort and not options.realtime:
        raise UsageError("--best-effort: only with --realtime")
    if not options.realtime:
        return Wish.ORDINARY
    speed = getattr(options, "speed", None) or 1.0
    if speed > 1.0:
        raise UsageError(
            f"--realtime: not with --speed {speed:g}: a vehicle faster than the machine would hold its core "
            "from everything else; allowed: 1 or less"
        )
    return Wish.BEST_EFFORT if options.best_effort else Wish.DEMANDED
