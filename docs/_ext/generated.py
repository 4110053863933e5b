"""Directives that write reference pages from the program itself, so that a page cannot say what the program does not.

``{struct-tables} mavsitl.scenario.Scenario``
    A section for each struct below that one: key, type and allowed values, unit, default, meaning.
``{shipped-scenarios}``
    Name, title and description of each shipped scenario.
``{shipped-airframes}``
    Each shipped airframe's numbers side by side.
``{streams}``
    The vehicle's telemetry: each message with its default rates on both links, PX4's beside, and their sums.
``{commands}``, ``{mission-commands}``, ``{messages-taken}``
    What the vehicle does by COMMAND_LONG and COMMAND_INT, what a mission may hold, which other messages it takes.
``{modes}``, ``{mode-changes}``, ``{failsafes}``
    The flight modes with PX4's numbers; a drawing of the changes that nobody asked for, found by running the commander;
    what trips each fail-safe and what it does by the value of its parameter.
``{failures}``
    `failures.TABLE`: what each failure that can be injected does, its size, and the parameters that show and set it.
``{parameter-tables}``
    A section for each group of the vehicle's parameters: name, type, default, allowed values, meaning.
``{chaos-modes}``
    What a vehicle does wrong on command: a table for each group of modes.
``{testing-class} NAME``, ``{testing-fixtures}``, ``{testing-options}``
    Of `mavsitl.testing`: a class out of its docstrings; the plugin's fixtures; its options and its marker.
``{log-topics} END``
    The ULog topics that the vehicle, or the ground, writes: fields, when there is a row, what it says.
``{suite}``
    The cases of the score board: group, scenario and settings.
``{cli-help} SUBCOMMAND``
    What ``mavsitl SUBCOMMAND --help`` prints.
"""

from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib import import_module, resources
from typing import Any, ClassVar, NamedTuple

import msgspec
from docutils import nodes
from mavsitl_vehicle import failures
from mavsitl_vehicle.autopilot import commands, modes, plan, telemetry
from mavsitl_vehicle.autopilot.commander import FAILSAFES, Action, By, Commander, Failsafe, Situation
from mavsitl_vehicle.autopilot.modes import Control, Mode, Need
from mavsitl_vehicle.autopilot.parameters import TABLE, Parameter
from mavsitl_vehicle.vehicle import Vehicle
from msgspec.structs import replace
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from mavsitl import chaos, scenario, testing
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.log.topics import GROUND_TOPICS, VEHICLE_TOPICS, Topic
from mavsitl.score import suite
from mavsitl.testing import plugin

UNITS = {
    "hz": "Hz",
    "s": "s",
    "m": "m",
    "deg": "°",
    "kg": "kg",
    "m_s": "m/s",
    "m_s2": "m/s²",
    "deg_s": "°/s",
    "rad_s": "rad/s",
    "per_s": "1/s",
    "per_s2": "1/s²",
    "per_s3": "1/s³",
    "kg_m2": "kg m²",
    "kg_m3": "kg/m³",
    "n_s2": "N s²",
    "n_m_s2": "N m s²",
    "ah": "A h",
    "ohm": "Ω",
    "w": "W",
    "ms": "ms",
    "gauss": "G",
    "deg_s_rt_hz": "°/s/√Hz",
    "deg_s_rt_s": "°/s/√s",
    "m_s2_rt_hz": "m/s²/√Hz",
    "m_s2_rt_s": "m/s²/√s",
    "m_rt_s": "m/√s",
}
"""What ends a key, and the unit it stands for."""


AS_BELOW = "as below"
"""The default of a table whose keys all have their own."""


def unit(key: str) -> str:
    """The unit that ends `key`; empty where it has none."""
    parts = key.split("_")
    for start in range(1, len(parts)):
        if "_".join(parts[start:]) in UNITS:
            return UNITS["_".join(parts[start:])]
    return ""


def field_docs(kind: type[Any]) -> dict[str, str]:
    """The string below each field of `kind`, as in its source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, below in zip(body.body, body.body[1:], strict=False):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                found[name] = inspect.cleandoc(text)
    return found


def toml(value: Any) -> str:
    """A default as the user would write it."""
    match value:
        case bool():
            return str(value).lower()
        case str():
            return f'"{value}"'
        case list() | tuple():
            return f"[{', '.join(toml(item) for item in value)}]"
        case dict():
            return f"{{ {', '.join(f'{key} = {toml(item)}' for key, item in value.items())} }}" if value else "{}"
        case msgspec.Struct():
            given = {name: item for name, item in msgspec.structs.asdict(value).items() if not _is_default(value, name)}
            tag = value.__struct_config__.tag
            field = value.__struct_config__.tag_field
            return toml({**({field: tag} if field else {}), **given})
        case _:
            return repr(value)


def _is_default(value: msgspec.Struct, name: str) -> bool:
    field = next(field for field in msgspec.structs.fields(value) if field.name == name)
    return bool(getattr(value, name) == field.default)


def default(field: msgspec.inspect.Field) -> str:
    if field.required:
        return "required"
    value = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
    text = "none" if value is None else toml(value)
    return AS_BELOW if isinstance(value, msgspec.Struct) and text == "{}" else text


def structs_below(info: msgspec.inspect.Type, path: str) -> Iterator[tuple[str, msgspec.inspect.StructType]]:
    """Each struct that a key below `info` may hold, with where it stands in the file."""
    match info:
        case msgspec.inspect.Metadata():
            yield from structs_below(info.type, path)
        case msgspec.inspect.StructType():
            yield path, info
            for field in info.fields:
                yield from structs_below(field.type, f"{path}.{field.encode_name}".lstrip("."))
        case msgspec.inspect.UnionType():
            for option in info.types:
                yield from structs_below(option, path)
        case msgspec.inspect.VarTupleType():
            yield from structs_below(info.item_type, f"{path}[]")


def heading(path: str, info: msgspec.inspect.StructType) -> str:
    """The TOML that opens this table: ``[rates]``, ``[[wind]] model = "gust"``."""
    if not path:
        return "Top level"
    header = f"[[{path.removesuffix('[]')}]]" if path.endswith("[]") else f"[{path}]"
    return header.replace("[].", ".") + (f' {info.tag_field} = "{info.tag}"' if info.tag_field else "")


class GeneratedDirective(SphinxDirective):
    has_content = False

    def text(self, markdown: str) -> list[nodes.Node]:
        """Inline text of a docstring: what stands in backticks becomes code."""
        holder = nodes.paragraph()
        for index, piece in enumerate(markdown.replace("``", "`").split("`")):
            holder += nodes.literal(piece, piece) if index % 2 else nodes.Text(piece)
        return list(holder.children)

    def code(self, text: str) -> list[nodes.Node]:
        return [nodes.literal(text, text)] if text else []

    def table(self, header: Sequence[str], rows: Sequence[Sequence[list[nodes.Node]]]) -> nodes.table:
        table = nodes.table(classes=["colwidths-auto"])
        group = nodes.tgroup(cols=len(header))
        group += [nodes.colspec(colwidth=1) for _ in header]
        head, body = nodes.thead(), nodes.tbody()
        for part, lines in ((head, [[[nodes.Text(name)] for name in header]]), (body, rows)):
            for line in lines:
                row = nodes.row()
                for cell in line:
                    row += nodes.entry("", nodes.paragraph("", "", *cell))
                part += row
        group += [head, body]
        table += group
        return table

    def section(self, title: str, *content: nodes.Node) -> nodes.section:
        section = nodes.section(ids=[nodes.make_id(f"{self.env.docname}-{title}")], names=[])
        section += nodes.title("", "", nodes.literal(title, title) if title.startswith("[") else nodes.Text(title))
        section += list(content)
        return section


class StructTables(GeneratedDirective):
    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        module, _, name = self.arguments[0].rpartition(".")
        root = msgspec.inspect.type_info(getattr(import_module(module), name))
        tables: dict[type[Any], tuple[list[str], msgspec.inspect.StructType]] = {}
        for path, info in structs_below(root, ""):
            tables.setdefault(info.cls, ([], info))[0].append(heading(path, info))
        return [self.struct(headings, info) for headings, info in tables.values()]

    def struct(self, headings: Sequence[str], info: msgspec.inspect.StructType) -> nodes.Node:
        docs = field_docs(info.cls)
        rows = [
            [
                self.code(field.encode_name),
                self.text(scenario.describe(field.type)),
                self.text(unit(field.encode_name)),
                self.text(AS_BELOW) if default(field) == AS_BELOW else self.code(default(field)),
                self.text(docs.get(field.name, "")),
            ]
            for field in info.fields
        ]
        header = ("key", "allowed", "unit", "default", "meaning")
        # Its own words only: inspect.getdoc would fall back on the base class.
        paragraphs = inspect.cleandoc(vars(info.cls).get("__doc__") or "").split("\n\n")
        also = [f"Also `{other}`." for other in headings[1:]]
        content: list[nodes.Node] = [nodes.paragraph("", "", *self.text(text)) for text in (*paragraphs, *also) if text]
        return self.section(headings[0], *content, self.table(header, rows))


class ShippedScenarios(GeneratedDirective):
    def run(self) -> list[nodes.Node]:
        rows = []
        for name in scenario.names():
            shipped = scenario.load(name).scenario
            rows.append([self.code(name), self.text(shipped.title), self.text(shipped.description)])
        return [self.table(("name", "title", "what it is"), rows)]


class ShippedAirframes(GeneratedDirective):
    def run(self) -> list[nodes.Node]:
        folder = resources.files("mavsitl") / "airframes"
        names = sorted(file.name.removesuffix(".toml") for file in folder.iterdir() if file.name.endswith(".toml"))
        airframes = [scenario.load_airframe(name) for name in names]
        rows = [
            [
                self.code(field.name),
                self.text(unit(field.name)),
                *(self.text(toml(getattr(airframe, field.name)).strip('"')) for airframe in airframes),
            ]
            for field in msgspec.structs.fields(airframes[0])
        ]
        return [self.table(("key", "unit", *names), rows)]


class Streams(GeneratedDirective):
    """The one table of `mavsitl_vehicle.autopilot.telemetry`."""

    def run(self) -> list[nodes.Node]:
        streams = telemetry.STREAMS
        rows = [
            [self.code(row.name), *(self.text(rate(hz)) for hz in self.rates(row)), self.text(row.note)]
            for row in streams
        ]
        sums = [sum(column) for column in zip(*(self.rates(row) for row in streams), strict=True)]
        rows.append([self.text("sum"), *(self.text(rate(hz)) for hz in sums), self.text("with everything being sent")])
        header = ("message", "ground station, Hz", "PX4", "off-board, Hz", "PX4", "note")
        return [self.table(header, rows)]

    def rates(self, row: telemetry.Stream) -> tuple[float, float, float, float]:
        return row.gcs_hz, row.px4_gcs_hz, row.offboard_hz, row.px4_offboard_hz


def rate(hz: float) -> str:
    return f"{hz:g}" if hz else "–"


def enum_name(enum: str, value: int) -> str:
    """The entry without its enumeration's name before it."""
    return str(mavlink.enums[enum][value].name).removeprefix(f"{enum}_")


class Commands(GeneratedDirective):
    """`commands.TABLE`."""

    def run(self) -> list[nodes.Node]:
        rows = [
            [self.code(enum_name("MAV_CMD", command)), self.text(f"{command}"), self.text(row.text)]
            for command, row in sorted(commands.TABLE.items())
        ]
        return [self.table(("command", "id", "what it does here"), rows)]


class MissionCommands(GeneratedDirective):
    """`plan.COMMANDS`."""

    def run(self) -> list[nodes.Node]:
        rows = []
        skipped: list[nodes.Node] = [nodes.Text("Accepted and skipped: ")]
        for command, info in sorted(plan.COMMANDS.items()):
            name = self.code(enum_name("MAV_CMD", command))
            if info.effect is plan.Effect.SKIP:
                skipped += [*name, nodes.Text(f" ({command}), ")]
                continue
            cells = (f"{command}", info.effect.value, info.place.value, info.params)
            rows.append([name, *(self.text(cell) for cell in cells)])
        skipped[-1] = nodes.Text(str(skipped[-1]).removesuffix(", ") + ".")
        header = ("command", "id", "is", "position", "parameters looked at")
        return [self.table(header, rows), nodes.paragraph("", "", *skipped)]


class MessagesTaken(GeneratedDirective):
    """What the autopilot and the services of a port take, asked of a vehicle."""

    HOW: ClassVar[dict[str, str]] = {
        "HEARTBEAT": "of a ground station: the link is not lost (`NAV_DLL_ACT`)",
        "PING": "one for everybody is sent back, up to 200 a second",
        "TIMESYNC": "a request is answered with the vehicle's clock, up to 200 a second",
        "COMMAND_LONG": "by the table of commands",
        "COMMAND_INT": "by the table of commands",
        "SET_MODE": "as `DO_SET_MODE`, without an acknowledgement",
        "SET_GPS_GLOBAL_ORIGIN": "refused with a text: the origin is the simulator's",
        "SET_ATTITUDE_TARGET": "off-board: attitude or body rates, and thrust",
        "SET_POSITION_TARGET_LOCAL_NED": "off-board, all masks, in frames 1, 7, 8 (velocity, acceleration) and 9",
        "SET_POSITION_TARGET_GLOBAL_INT": "off-board, all masks, in frames 0, 3, 5, 6, 10 and 11",
        "SET_ACTUATOR_CONTROL_TARGET": "off-board: torques and thrust of group 0; PX4 1.17 does not take it",
        "MANUAL_CONTROL": "sticks; an axis that is not there (INT16_MAX) is left out",
        "PARAM_REQUEST_READ": "by name or index; `_HASH_CHECK` by name",
        "PARAM_REQUEST_LIST": "all, paced; a second one begins again",
        "PARAM_SET": "answered by `PARAM_VALUE` on every link; a refused one also by `PARAM_ERROR`",
        "MISSION_COUNT": "begins an upload; 0 clears",
        "MISSION_ITEM_INT": "an item of an upload",
        "MISSION_ITEM": "the same with float coordinates, for old clients",
        "MISSION_REQUEST_LIST": "begins a download",
        "MISSION_REQUEST_INT": "an item of a download",
        "MISSION_REQUEST": "the same with float coordinates",
        "MISSION_ACK": "ends a download",
        "MISSION_CLEAR_ALL": "one plan or all three",
        "MISSION_SET_CURRENT": "jumps to an item; answered by `MISSION_CURRENT`",
        "MISSION_REQUEST_PARTIAL_LIST": "refused: `MAV_MISSION_UNSUPPORTED`",
        "MISSION_WRITE_PARTIAL_LIST": "refused: `MAV_MISSION_UNSUPPORTED`",
        "FILE_TRANSFER_PROTOCOL": "MAVLink FTP, all operations",
        "LOG_REQUEST_LIST": "answered by `LOG_ENTRY`",
        "LOG_REQUEST_DATA": "answered by `LOG_DATA`, paced",
        "LOG_REQUEST_END": "ends the transfer",
        "LOG_ERASE": "refused with a text",
    }
    """What becomes of each; to be as long as the vehicle's own list."""

    def run(self) -> list[nodes.Node]:
        flight = scenario.load("takeoff-hover")
        vehicle = Vehicle(flight, NullRecorder(), seed=1, ports=("offboard", "gcs"), unix_us=lambda: 0)
        taken = {*vehicle.autopilot.ports[0].message_ids, *vehicle.autopilot._handlers}
        vehicle.close()
        names = {message_id: str(mavlink.mavlink_map[message_id].msgname) for message_id in taken}
        if set(names.values()) != set(self.HOW):
            raise self.error(f"MessagesTaken.HOW and the vehicle differ: {set(names.values()) ^ set(self.HOW)}")
        rows = [[self.code(names[key]), self.text(f"{key}"), self.text(self.HOW[names[key]])] for key in sorted(taken)]
        return [self.table(("message", "id", "what becomes of it"), rows)]


CONTROLS = {
    Control.STICKS: "sticks",
    Control.NAVIGATOR: "vehicle",
    Control.STREAM: "program",
    Control.NOBODY: "nobody",
}


NEEDS = {
    Need.ATTITUDE: "attitude",
    Need.HEIGHT: "height",
    Need.VELOCITY: "velocity",
    Need.POSITION: "position",
    Need.HOME: "home",
    Need.MISSION: "mission",
    Need.STREAM: "setpoints",
    Need.STICKS: "sticks",
    Need.LIMITS: "limits",
}


def values(**changes: float) -> dict[str, float]:
    """Parameters at their defaults but for some."""
    return {name: row.default for name, row in TABLE.items()} | changes


WELL = Situation(landed=False, setpoint_age_us=0, sticks_age_us=0, gcs_age_us=0, mission_refusal=None)
"""In the air, and everything there."""
CAUSES: Mapping[str, tuple[Mapping[str, Any], Mapping[str, float]]] = {
    "off-board signal lost": ({"setpoint_age_us": None, "sticks_age_us": None}, {}),
    "manual control lost": ({"sticks_age_us": None}, {}),
    "connection to ground station lost": ({"gcs_age_us": None}, {}),
    "low battery": ({"battery_level": 1}, {}),
    "critical battery": ({"battery_level": 2}, {}),
    "emergency battery level": ({"battery_level": 3}, {}),
    "geofence breached": ({"fence_breach": "too far"}, {}),
    "both links lost after the mission": ({"gcs_age_us": None, "mission_finished": True}, {"COM_RC_IN_MODE": 4}),
    "battery unhealthy": ({"battery_age_us": 10_000_000}, {}),
    "remaining flight time low": ({"return_margin_s": -1.0}, {}),
    "flight time nearly over": ({"airborne_s": 95.0}, {"COM_FLT_TIME_MAX": 100}),
    "maximum flight time exceeded": ({"airborne_s": 101.0}, {"COM_FLT_TIME_MAX": 100}),
    "strong wind": ({"wind_m_s": 11.0}, {"COM_WIND_WARN": 10}),
    "wind limit exceeded": ({"wind_m_s": 11.0}, {"COM_WIND_MAX": 10}),
    "mission failure": ({"mission_failure": "no mission"}, {}),
    "position accuracy low": ({"position_error_m": 11.0}, {"COM_POS_LOW_EPH": 10}),
    "attitude estimate lost": ({"attitude_valid": False}, {}),
    "height estimate lost": ({"height_valid": False}, {}),
    "velocity estimate lost": ({"velocity_valid": False}, {}),
    "position estimate lost": ({"position_valid": False}, {}),
    "attitude failure (roll)": ({"roll_rad": 2.0}, {"CBRK_FLIGHTTERM": 0}),
    "attitude failure (pitch)": ({"pitch_rad": 1.5}, {"CBRK_FLIGHTTERM": 0}),
    "altitude loss": ({"altitude_loss_m": 11.0}, {"FD_ALT_LOSS": 10, "CBRK_FLIGHTTERM": 0}),
    "motor failure": ({"motor_failure": 1}, {"FD_ACT_EN": 1}),
    "kill switch engaged": ({}, {}),
}
"""What makes each fail-safe trip, of `Situation` and of the parameters; who flies off-board has no sticks."""
LONG_US = 60_000_000
"""Beyond COM_FAIL_ACT_T."""


def flying(mode: Mode, parameters: Mapping[str, float]) -> Commander:
    """A commander, armed and in the air, to which nothing has happened yet."""
    commander = Commander(parameters, lambda severity, text: None)
    commander.home_set = True
    commander.step(0, replace(WELL, landed=True))
    commander.request_arm(True, False, 0)
    commander.step(0, WELL)
    commander.request_mode(mode, "")
    commander.step(0, WELL)
    if commander.mode is not mode or not commander.armed:
        raise AssertionError(f"the commander does not fly {mode}")
    return commander


class Modes(GeneratedDirective):
    """`modes.TABLE`."""

    def run(self) -> list[nodes.Node]:
        rows = []
        for info in modes.TABLE.values():
            standard = enum_name("MAV_STANDARD_MODE", info.standard_mode) if info.standard_mode else ""
            cells = (
                info.title,
                f"{info.main_mode}, {info.sub_mode}",
                standard,
                CONTROLS[info.control],
                ", ".join(NEEDS[need] for need in Need if need in info.needs),
                "yes" if info.can_arm else "no",
                "yes" if info.selectable else "no",
            )
            rows.append([self.code(info.name), *(self.text(cell) for cell in cells)])
        header = (
            "mode",
            "shown as",
            "main, sub",
            "standard mode",
            "flown by",
            "needs",
            "can arm",
            "can be chosen",
        )
        return [self.table(header, rows)]


class Change(NamedTuple):
    """Some modes become another without being asked."""

    why: str
    target: Mode
    sources: tuple[Mode, ...]


def changes() -> Iterator[Change]:
    """What the commander does by itself, tried with each mode; a fail-safe with a value of its parameter that acts."""
    yield Change("take-off height reached", Mode.LOITER, (Mode.TAKEOFF,))  # Autopilot.decide: commander.complete
    ends: dict[Mode, list[Mode]] = {}
    for mode in Mode:
        commander = flying(mode, values())
        commander.request_arm(False, True, 0)
        if commander.mode is not mode:
            ends.setdefault(commander.mode, []).append(mode)
    for target, sources in ends.items():
        yield Change("disarmed", target, tuple(sources))
    for row in FAILSAFES:
        yield from failsafe_changes(row)


def failsafe_changes(row: Failsafe) -> Iterator[Change]:
    situation, parameters = CAUSES[row.name]
    why = row.name
    if isinstance(row.action, By):
        name, actions = row.action.parameter, row.action.actions
        acting = [value for value in sorted(actions) if actions[value] > Action.WARN]
        if not acting:
            return
        default = int(TABLE[name].default)
        value = default if default in acting else acting[0]
        parameters = {**parameters, name: value}
        why = f"{row.name} ({name} {value})"
    found: dict[Mode, list[Mode]] = {}
    for mode in Mode:
        commander = flying(mode, values(**parameters))
        tripped = replace(WELL, **situation)
        for now_us in (LONG_US, 2 * LONG_US, 3 * LONG_US):
            commander.step(now_us, tripped)
        if commander.armed and commander.mode is not mode:
            found.setdefault(commander.mode, []).append(mode)
    for target, sources in found.items():
        yield Change(why, target, tuple(sources))


class ModeChanges(GeneratedDirective):
    """A line for each change: dots at the modes it leaves, an arrow at the one it leads to."""

    LABEL, COLUMN, HEAD, ROW, DOT = 400, 46, 120, 30, 5

    def run(self) -> list[nodes.Node]:
        columns = {mode: self.LABEL + self.COLUMN * (0.5 + index) for index, mode in enumerate(modes.TABLE)}
        found = list(changes())
        height = self.HEAD + self.ROW * len(found) + 8
        width = self.LABEL + self.COLUMN * len(columns) + 45
        style = 'style="width: 100%; height: auto; font: 16px sans-serif" fill="currentColor" stroke="none"'
        label = 'role="img" aria-label="Mode changes that nobody asked for"'
        parts = [f'<svg viewBox="0 0 {width} {height}" {label} {style}>']
        for mode, x in columns.items():
            name = escape(modes.TABLE[mode].name)
            parts.append(f'<text transform="translate({x - 3:g} {self.HEAD - 12}) rotate(-45)">{name}</text>')
            parts.append(
                f'<line x1="{x:g}" x2="{x:g}" y1="{self.HEAD - 6}" y2="{height - 8}" '
                'stroke="currentColor" stroke-opacity="0.2"/>'
            )
        for index, change in enumerate(found):
            parts.append(self.line(change, columns, self.HEAD + self.ROW * (index + 0.5)))
        return [nodes.raw("", "\n".join([*parts, "</svg>"]), format="html")]

    def line(self, change: Change, columns: Mapping[Mode, float], y: float) -> str:
        target = columns[change.target]
        sources = [columns[mode] for mode in change.sources]
        span = [*sources, target]
        parts = [
            f'<text x="0" y="{y + 5:g}">{escape(change.why)}</text>',
            f'<line x1="{min(span):g}" x2="{max(span):g}" y1="{y:g}" y2="{y:g}" stroke="currentColor"/>',
            *(f'<circle cx="{x:g}" cy="{y:g}" r="{self.DOT}"/>' for x in sources),
        ]
        for side in {1 if x < target else -1 for x in sources}:
            points = f"{target:g},{y:g} {target - 11 * side:g},{y - 5.5:g} {target - 11 * side:g},{y + 5.5:g}"
            parts.append(f'<polygon points="{points}" fill="#c2410c"/>')
        return "".join(parts)


class Failsafes(GeneratedDirective):
    """`commander.FAILSAFES`."""

    def run(self) -> list[nodes.Node]:
        if {row.name for row in FAILSAFES} != set(CAUSES):
            raise self.error("CAUSES and commander.FAILSAFES name different fail-safes")
        rows = []
        for row in FAILSAFES:
            names = (*row.looks_at, row.after) if row.after else row.looks_at
            watched = ", ".join(f"`{name}`" for name in names)
            if isinstance(row.action, By):
                name, actions = row.action.parameter, row.action.actions
                does = ", ".join(f"{value}: {action.name.lower()}" for value, action in sorted(actions.items()))
                does = f"`{name}` (default {TABLE[name].default:g}): {does}"
            else:
                does = " ".join((row.action.__doc__ or "").split())
            before = "`COM_FAIL_ACT_T` of holding before it leaves" if row.deferred else "at once"
            ends = "with its cause" if row.ends_with_cause else "by a mode change or disarming"
            rows.append([self.text(cell) for cell in (row.name, watched, does, before, ends)])
        return [self.table(("fail-safe", "looks at", "does", "when", "ends"), rows)]


class ParameterTables(GeneratedDirective):
    EFFECT: ClassVar[dict[str, str]] = {
        "now": "",
        "arming": "Takes effect at the next arming. ",
        "boot": "Takes effect at the next start. ",
    }

    def run(self) -> list[nodes.Node]:
        groups: dict[str, list[Parameter]] = {}
        for row in TABLE.values():
            groups.setdefault(row.group, []).append(row)
        header = ("name", "type", "default", "allowed", "meaning", "beside PX4 1.17")
        return [
            self.section(group, self.table(header, [self.row(row) for row in rows])) for group, rows in groups.items()
        ]

    def row(self, row: Parameter) -> list[list[nodes.Node]]:
        default = f"{row.default:d}" if isinstance(row.default, int) else f"{row.default:g}"
        named = row.values or row.bits
        allowed = "; ".join(f"{key}: {text}" for key, text in sorted(named.items()))
        if row.bits:
            allowed = f"bits {allowed}"
        meaning = f"{row.text}. {row.long} {self.EFFECT[row.live]}"
        if row.read_only:
            meaning += "Read-only. "
        if row.used_by == "client":
            meaning += "For ground stations; the vehicle does not act on it."
        return [
            self.code(row.name),
            self.text(row.type),
            self.code(default),
            self.text(allowed or row.allowed),
            self.text(" ".join(meaning.split())),
            self.text(row.note),
        ]


class ChaosModes(GeneratedDirective):
    """`chaos.TABLE`."""

    def run(self) -> list[nodes.Node]:
        return [self.group(group) for group in dict.fromkeys(row.group for row in chaos.TABLE.values())]

    def group(self, group: str) -> nodes.Node:
        rows = []
        for name, row in chaos.TABLE.items():
            if row.group == group:
                defaults = ", ".join(f"{each.name} {each.default or 'all'}" for each in row.arguments)
                mocklink = " ".join(f"`{each}`" for each in row.mocklink.split(", ") if each)
                cells = (row.text, defaults, mocklink)
                rows.append([self.code(row.usage(name)), *(self.text(cell) for cell in cells)])
        return self.section(group, self.table(("mode", "what goes wrong", "defaults", "MockLink's name"), rows))


class FailureTable(GeneratedDirective):
    """`failures.TABLE`."""

    def run(self) -> list[nodes.Node]:
        rows = []
        for (unit, kind), meaning in sorted(failures.TABLE.items()):
            size = failures.SIZES.get((unit, kind))
            names = [name for name, (other, _) in failures.PARAMETERS.items() if other is unit]
            shown = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
            rows.append(
                [
                    self.text(f"`{failures.named(unit)}` ({unit.value})"),
                    self.text(f"`{failures.named(kind)}` ({kind.value})"),
                    self.text(meaning),
                    self.text(size_text(size) if size else ""),
                    self.code(shown),
                ]
            )
        return [self.table(("unit", "type", "what it does", "value", "parameters"), rows)]


def size_text(size: failures.Size) -> str:
    return f"{size.minimum:g} to {size.maximum:g}; without one {size.default:g}: {size.text(size.default)}"


class LogTopics(GeneratedDirective):
    """`log.topics`; topics that differ by their number, or by their link, are one row."""

    ENDS: ClassVar[dict[str, tuple[Topic, ...]]] = {"vehicle": VEHICLE_TOPICS, "ground": GROUND_TOPICS}
    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        groups: dict[tuple[object, ...], list[Topic]] = {}
        for topic in self.ENDS[self.arguments[0]]:
            groups.setdefault((topic.fields, topic.text, topic.rate), []).append(topic)
        rows = []
        for alike in groups.values():
            first = alike[0]
            names = ", ".join(f"`{name}`" for name in dict.fromkeys(topic.name for topic in alike))
            fields = ", ".join(f"`{name}[{count}]`" if count else f"`{name}`" for name, _, count in first.columns[1:])
            what = f"{first.text} {fields}" if first.text else fields
            rows.append([self.text(names), self.text(first.rate), self.text(what)])
        return [self.table(("topic", "rows", "what, and fields"), rows)]


class SuiteTable(GeneratedDirective):
    """`mavsitl/score/suite-N.toml`."""

    def run(self) -> list[nodes.Node]:
        rows = []
        for case in suite.read().cases:
            settings = [f"{key} = {toml(value)}" for key, value in case.settings.items()]
            cell: list[nodes.Node] = []
            for setting in settings:
                cell += [nodes.Text(", ")] * bool(cell) + self.code(setting)
            name = self.code(case.name) + self.text(" (quick)" if case.quick else "")
            rows.append([self.text(case.group), name, self.code(case.scenario), cell])
        return [self.table(("group", "case", "scenario", "settings"), rows)]


class CliHelp(GeneratedDirective):
    optional_arguments = 2

    def run(self) -> list[nodes.Node]:
        command = ["mavsitl", *self.arguments, "--help"]
        result = subprocess.run(
            [sys.executable, "-m", *command],
            env={**os.environ, "COLUMNS": "90", "NO_COLOR": "1"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            check=False,
        )
        if result.returncode:
            raise self.error(f"`{' '.join(command)}` failed: {result.stderr}")
        return [nodes.literal_block(result.stdout, result.stdout, language="text")]


_ATTRIBUTE = re.compile(r"^    (\w[\w, ]*): (.*)")


def members(kind: type[Any]) -> Iterator[tuple[str, Any]]:
    """What is public of a class, with what it has from ours, in the order of their sources."""
    seen = set()
    for owner in kind.__mro__:
        if not owner.__module__.startswith("mavsitl.testing"):
            continue
        for name, member in vars(owner).items():
            wanted = inspect.isfunction(member) or isinstance(member, property)
            if wanted and member.__doc__ and not name.startswith("_") and name not in seen:
                seen.add(name)
                yield name, member


def signature(name: str, function: Any) -> str:
    """As it is called: names with defaults, without types where the text says them."""
    parts: list[str] = []
    parameters = [each for each in inspect.signature(function).parameters.values() if each.name not in ("self", "cls")]
    starred = False
    for each in parameters:
        if each.kind is each.KEYWORD_ONLY and not starred:
            starred = True
            parts.append("*")
        starred = starred or each.kind is each.VAR_POSITIONAL
        mark = "*" if each.kind is each.VAR_POSITIONAL else "**" if each.kind is each.VAR_KEYWORD else ""
        default = "" if each.default is each.empty else f"={each.default!r}"
        parts.append(f"{mark}{each.name}{default}")
    return f"{name}({', '.join(parts)})"


class Documented(GeneratedDirective):
    def prose(self, text: str | None) -> list[nodes.Node]:
        """A docstring: paragraphs, programs behind "::", and a list of what stands below "Attributes:"."""
        found: list[nodes.Node] = []
        literal = False
        for block in inspect.cleandoc(text or "").split("\n\n"):
            if not block.strip():
                continue
            if literal and block.startswith("    "):
                code = inspect.cleandoc(block)
                if found and isinstance(found[-1], nodes.literal_block):
                    code = f"{found.pop().astext()}\n\n{code}"
                found.append(nodes.literal_block(code, code, language="python"))
                continue
            literal = block.endswith("::")
            if block.startswith("Attributes:"):
                found.append(self.attributes(block.splitlines()[1:]))
            else:
                plain = " ".join(block.split())
                found.append(nodes.paragraph("", "", *self.text(plain.removesuffix(":") if literal else plain)))
        return found

    def attributes(self, lines: list[str]) -> nodes.Node:
        rows: list[tuple[str, str]] = []
        for line in lines:
            match = _ATTRIBUTE.match(line)
            if match and not line.startswith("     "):
                rows.append((match[1], match[2]))
            else:
                name, text = rows[-1]
                rows[-1] = (name, f"{text} {line.strip()}")
        return self.definitions((name, [nodes.paragraph("", "", *self.text(text))]) for name, text in rows)

    def definitions(self, rows: Any) -> nodes.definition_list:
        found = nodes.definition_list()
        for term, content in rows:
            item = nodes.definition_list_item()
            item += nodes.term("", "", nodes.literal(term, term))
            item += nodes.definition("", *content)
            found += item
        return found


class TestingClass(Documented):
    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        name = self.arguments[0]
        found = getattr(testing, name)
        if inspect.isfunction(found):
            return [self.definitions([(signature(name, found), self.prose(found.__doc__))])]
        content = self.prose(found.__doc__)
        made = vars(found).get("__init__")
        if made is not None and made.__doc__:
            call = signature(name, made)
            content.append(self.definitions([(call, self.prose(made.__doc__))]))
        fields = field_docs(found)
        known = getattr(found, "__annotations__", {})
        content.append(
            self.definitions(
                [(field, self.prose(fields.get(field, ""))) for field in known if fields.get(field)]
                + [
                    (each if isinstance(member, property) else signature(each, member), self.prose(member.__doc__))
                    for each, member in members(found)
                ]
            )
        )
        return [each for each in content if each.children]


class TestingFixtures(Documented):
    def run(self) -> list[nodes.Node]:
        rows = []
        for name in ("scenario", *plugin.CRAFTS, "faults", "assert_flight"):
            rows.append((name, self.prose(inspect.unwrap(getattr(plugin, name)).__doc__)))
        return [self.definitions(rows)]


class TestingOptions(Documented):
    def run(self) -> list[nodes.Node]:
        options = [
            [self.code(f"--mavsitl-{name}"), self.code(takes), self.code(f"mavsitl_{name}"), self.text(text),
             self.code(default or "")]
            for name, takes, text, default in plugin.OPTIONS
        ]  # fmt: skip
        marker = [[self.code(name), self.text(text)] for name, text in plugin.MARKER.items()]
        return [
            self.table(("option", "takes", "configuration", "what", "default"), options),
            nodes.paragraph("", "", *self.text("`@pytest.mark.mavsitl(...)` takes, by name:")),
            self.table(("argument", "what"), marker),
        ]


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("struct-tables", StructTables)
    app.add_directive("shipped-scenarios", ShippedScenarios)
    app.add_directive("shipped-airframes", ShippedAirframes)
    app.add_directive("streams", Streams)
    app.add_directive("commands", Commands)
    app.add_directive("mission-commands", MissionCommands)
    app.add_directive("messages-taken", MessagesTaken)
    app.add_directive("modes", Modes)
    app.add_directive("mode-changes", ModeChanges)
    app.add_directive("failsafes", Failsafes)
    app.add_directive("failures", FailureTable)
    app.add_directive("parameter-tables", ParameterTables)
    app.add_directive("chaos-modes", ChaosModes)
    app.add_directive("log-topics", LogTopics)
    app.add_directive("suite", SuiteTable)
    app.add_directive("cli-help", CliHelp)
    app.add_directive("testing-class", TestingClass)
    app.add_directive("testing-fixtures", TestingFixtures)
    app.add_directive("testing-options", TestingOptions)
    return {"version": "1", "parallel_read_safe": True}
