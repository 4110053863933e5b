"""Every field of every handled message at its extremes, one after the other, at a vehicle that hovers off-board.

`python -m tests.hostile.fields`. What is no number a vehicle could use, infinite or beyond all measure, is refused
with the code that its protocol has for it and moves nothing; NaN and denormals are refused or mean what MAVLink says.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from math import dist, inf, isfinite, nan
from typing import Any, NamedTuple

import numpy as np
from mavsitl_vehicle.autopilot import commands, plan
from mavsitl_vehicle.autopilot.parameters import TABLE

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, Client
from tests.autopilot.copter import ACCEPTED, flying
from tests.hostile.attacks import HANDLED, RANGES, message_class
from tests.hostile.report import Report, bar

HEIGHT_M = 3.0
USELESS = (inf, -inf, 3e38, -3e38)
TINY = (nan, 1e-45, -1e-45, -0.0)
HOVER_M = 0.3
FIGHTER = (66, 1)

ACKED = ("COMMAND_LONG", "COMMAND_INT")
MOVING = ("SET_MODE",)
"""Whole numbers of these choose another mode, as they should."""
SETPOINTS = (
    "SET_ATTITUDE_TARGET", "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT",
    "SET_ACTUATOR_CONTROL_TARGET",
)  # fmt: skip
RATES_ONLY = 128
"""`type_mask` of SET_ATTITUDE_TARGET, in place of a command: the attitude is ignored."""
ITEMS = ("MISSION_ITEM_INT", "MISSION_ITEM")


UNUSED: dict[int, frozenset[tuple[str, str]]] = {
    0: frozenset(
        {
            ("SET_ATTITUDE_TARGET", "body_roll_rate"),
            ("SET_ATTITUDE_TARGET", "body_pitch_rate"),
            ("SET_ATTITUDE_TARGET", "thrust_body"),
            ("SET_ACTUATOR_CONTROL_TARGET", "controls"),
        }
    ),
    RATES_ONLY: frozenset({("SET_ATTITUDE_TARGET", "q"), ("SET_ATTITUDE_TARGET", "thrust_body")}),
}
"""What the masks leave out: never looked at, and so never refused. Of `controls` the last four outputs."""


class Case(NamedTuple):
    message: Any
    useless: bool
    """Holds a float that nobody can use."""
    what: str


def base(name: str, command: int = 0) -> dict[str, Any]:
    """A message that asks for what is flown already, or for nothing that matters."""
    kind = message_class(name)
    values: dict[str, Any] = {}
    for field, code, length in zip(kind.ordered_fieldnames, kind.native_format.decode()[1:], kind.lengths, strict=True):
        values[field] = b"" if code == "c" else [0] * length if length > 1 else 0
    values.update({field: 1 for field in ("target_system", "target_component") if field in values})
    if name == "SET_ATTITUDE_TARGET":
        values |= {"q": [1.0, 0.0, 0.0, 0.0], "thrust": 0.5, "type_mask": command or 3}
    elif name == "SET_POSITION_TARGET_LOCAL_NED":
        values |= {"coordinate_frame": 1, "z": -HEIGHT_M, "type_mask": 0}
    elif name == "SET_POSITION_TARGET_GLOBAL_INT":
        values |= {"coordinate_frame": 6, "alt": HEIGHT_M, "lat_int": 473977418, "lon_int": 85455939}
    elif name == "SET_ACTUATOR_CONTROL_TARGET":
        values["controls"] = [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0]
    elif name in ACKED:
        values["command"] = command
        values |= {f"param{number}": nan for number in range(1, 8) if f"param{number}" in values}
        if name == "COMMAND_INT":
            values |= {"x": 2**31 - 1, "y": 2**31 - 1, "z": nan, "frame": 6}
    elif name in ITEMS:
        values |= {"frame": 6, "command": command, "x": 0, "y": 0, "z": 10.0, "autocontinue": 1}
    return values


def floats(name: str, command: int = 0) -> Iterator[Case]:
    """Each float field in turn at each value."""
    kind = message_class(name)
    for field, code, length in zip(kind.ordered_fieldnames, kind.native_format.decode()[1:], kind.lengths, strict=True):
        if code not in "fd":
            continue
        for index in range(length):
            for value in (*USELESS, *TINY):
                values = base(name, command)
                if length > 1:
                    values[field] = [value if k == index else old for k, old in enumerate(values[field])]
                else:
                    values[field] = value
                if (name, field) in UNUSED.get(command, UNUSED[0]) and (field != "controls" or index >= 4):
                    continue
                message = kind(**{each: values[each] for each in kind.fieldnames})
                yield Case(message, value in USELESS, f"{name} {command or ''} {field} {value:g}")


def wholes(name: str, command: int = 0) -> Iterator[Case]:
    """Each whole field in turn at its ends; the addresses stay."""
    kind = message_class(name)
    for field, code, length in zip(kind.ordered_fieldnames, kind.native_format.decode()[1:], kind.lengths, strict=True):
        if code not in RANGES or length > 1 or field.startswith("target_") or (field == "command" and command):
            continue
        low, high = RANGES[code]
        for value in {low, high, low + 1, high - 1, high // 2}:
            values = base(name, command) | {field: value}
            yield Case(kind(**{each: values[each] for each in kind.fieldnames}), False, f"{name} {field} {value}")


class Bench:
    """A vehicle that hovers off-board by an honest controller's stream, and one who fights it on the same link."""

    def __init__(self) -> None:
        self.client: Client = flying(HEIGHT_M)
        self.escaped = 0
        self.client.run(0.5, self.stream)
        assert self.client.offboard() == ACCEPTED
        self.client.run(1.0, self.stream)
        self.here = self.client.truth[:3]
        self.worst_m = 0.0

    def stream(self) -> None:
        self.client.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, 1, 0x9F8, 0.0, 0.0, -HEIGHT_M, 0, 0, 0, 0, 0, 0, 0, 0
            )
        )

    def off_m(self) -> float:
        return dist(self.client.truth[:3], self.here)

    def tell(self, case: Case) -> list[Any]:
        """Send it; what the vehicle answered within two periods."""
        seen = len(self.client.inbox)
        try:
            self.client.send(case.message, port=GCS, sender=FIGHTER)
            self.client.run(0.008, self.stream)
        except Exception as error:
            self.escaped += 1
            print(f"{case.what}: {error!r}", file=sys.stderr)
        answers = [message for _, _, message in self.client.inbox[seen:]]
        if len(self.client.inbox) > 20_000:
            del self.client.inbox[:10_000]
            for wire in self.client.wire:
                wire.clear()
        return answers

    @property
    def errors(self) -> int:
        return int(self.client.vehicle.counters.errors)

    @property
    def finite(self) -> bool:
        simulation = self.client.vehicle.simulation
        return bool(np.isfinite(simulation.x).all() and np.isfinite(simulation.estimate).all()) and all(
            isfinite(value) for value in self.client.vehicle.parameters.as_dict().values()
        )

    @property
    def flies(self) -> bool:
        commander = self.client.vehicle.autopilot.commander
        return bool(commander.armed and not self.client.vehicle.autopilot.on_ground)


def useless_floats(report: Report, *, show: bool = True) -> None:
    """What nobody can use: refused by its code, and the hover goes on."""
    cases = [case for name in HANDLED if name not in (*ACKED, *ITEMS) for case in floats(name)]
    cases += floats("SET_ATTITUDE_TARGET", RATES_ONLY)
    for name in ACKED:
        cases += [case for command in commands.TABLE for case in floats(name, command)]
    bench = Bench()
    taken: list[str] = []
    results: Counter[str] = Counter()
    with bar(len(cases), show=show) as progress:
        for case in cases:
            progress.move(1, "floats")
            if not case.useless:
                continue
            refused = bench.client.vehicle.autopilot.refused_setpoints
            answers = bench.tell(case)
            kind = case.message.get_type()
            if kind in ACKED:
                acks = [a for a in answers if a.get_type() == "COMMAND_ACK" and a.command == case.message.command]
                result = mavlink.enums["MAV_RESULT"][acks[0].result].name if acks else "no answer"
                results[result] += 1
                if not acks or acks[0].result in (0, 4, 5):
                    taken.append(f"{case.what}: {result}")
            elif kind in SETPOINTS:
                if bench.client.vehicle.autopilot.refused_setpoints == refused:
                    taken.append(case.what)
            elif kind == "PARAM_SET" and not any(a.get_type() == "PARAM_ERROR" for a in answers):
                taken.append(case.what)
            bench.worst_m = max(bench.worst_m, bench.off_m())
    for text in taken[:40]:
        print(text, file=sys.stderr)
    count = sum(case.useless for case in cases)
    report.demand(f"of {count} messages with an infinite or huge float, taken", "0", len(taken), not taken)
    report.demand("  exceptions", "0", bench.errors + bench.escaped, bench.errors + bench.escaped == 0)
    report.demand("  state finite, still off-board", "yes", bench.finite and bench.flies, bench.finite and bench.flies)
    report.demand("  hover, m off", f"<= {HOVER_M}", bench.worst_m, bench.worst_m <= HOVER_M)


def other_extremes(report: Report, *, show: bool = True) -> None:
    """NaN, denormals and whole numbers at their ends: the hover may become another mode's, but it stays a flight."""
    cases = [case for name in HANDLED if name not in (*ACKED, *ITEMS) for case in (*floats(name), *wholes(name))]
    grounding = {
        mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, mavlink.MAV_CMD_DO_FLIGHTTERMINATION,
        mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    }  # fmt: skip
    for name in ACKED:
        for command in commands.TABLE:
            if command not in grounding:
                cases += [*floats(name, command), *wholes(name, command)]
    bench = Bench()
    fell: list[str] = []
    with bar(len(cases), show=show) as progress:
        for case in cases:
            progress.move(1, "extremes")
            if case.useless:
                continue
            bench.tell(case)
            if not bench.flies:
                fell.append(case.what)
                break
            if bench.client.vehicle.autopilot.commander.mode.name != "OFFBOARD":
                bench.client.run(0.02, bench.stream)
                bench.client.offboard()
                bench.client.run(0.2, bench.stream)
    bench.client.run(4.0, bench.stream)
    off_m = bench.off_m()
    count = sum(not case.useless for case in cases)
    report.demand(f"of {count} messages at other extremes, ended the flight", "0", "; ".join(fell) or "0", not fell)
    report.demand("  exceptions", "0", bench.errors + bench.escaped, bench.errors + bench.escaped == 0)
    report.demand("  state and parameters finite", "yes", bench.finite, bench.finite)
    report.demand("  back at its place afterwards, m off", f"<= {HOVER_M}", off_m, off_m <= HOVER_M)


def parameters(report: Report) -> None:
    """Every parameter at the values that no parameter may have."""
    bench = Bench()
    before = bench.client.vehicle.parameters.as_dict()
    wrong: list[str] = []
    count = 0
    for name, row in TABLE.items():
        if row.is_integer:
            continue
        for value in (*USELESS, nan):
            message = mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)
            answers = bench.tell(Case(message, True, f"PARAM_SET {name} {value:g}"))
            count += 1
            kinds = {answer.get_type() for answer in answers}
            if bench.client.vehicle.parameters[name] != before[name] or "PARAM_VALUE" not in kinds:
                wrong.append(f"{name} {value:g}")
    report.demand(f"of {count} PARAM_SET, taken or not answered with the old value", "0", len(wrong), not wrong)
    unchanged = bench.client.vehicle.parameters.as_dict() == before
    report.demand("  parameters unchanged, no exception", "yes", unchanged, unchanged and not bench.errors)


def items(report: Report, *, show: bool = True) -> None:
    """Every float of every mission item, uploaded by the protocol."""
    bench = Bench()
    taken: list[str] = []
    results: Counter[str] = Counter()
    cases = [case for name in ITEMS for command in plan.COMMANDS for case in floats(name, command) if case.useless]
    with bar(len(cases), show=show) as progress:
        for case in cases:
            progress.move(1, "mission items")
            bench.client.send(mavlink.MAVLink_mission_count_message(1, 1, 1, 0), port=GCS, sender=FIGHTER)
            answers = [a for a in bench.tell(case) if a.get_type() == "MISSION_ACK"]
            result = answers[0].type if answers else -1
            name = mavlink.enums["MAV_MISSION_RESULT"][result].name if answers else "no answer"
            results[name] += 1
            if result in (-1, mavlink.MAV_MISSION_ACCEPTED):
                taken.append(f"{case.what}: {name}")
    for text in taken[:40]:
        print(text, file=sys.stderr)
    report.demand(f"of {len(cases)} mission items with a useless float, taken", "0", len(taken), not taken)
    exact = all(name.startswith("MAV_MISSION_INVALID_PARAM") for name in results)
    report.demand("  refused by the parameter's own code", "all", ", ".join(sorted(results)), exact)
    report.demand("  exceptions", "0", bench.errors + bench.escaped, bench.errors + bench.escaped == 0)


CHECKS: tuple[Callable[..., None], ...] = (useless_floats, other_extremes, items)


def main() -> int:
    report = Report("every field at its extremes")
    for check in CHECKS:
        check(report)
    parameters(report)
    return report.print()


if __name__ == "__main__":
    sys.exit(main())
