"""Directives that write reference pages from the program itself, so that a page cannot say what the program does not.

``{struct-tables} mavsitl.scenario.Scenario``
    A section for each struct below that one: key, type and allowed values, unit, default, meaning.
``{shipped-scenarios}``
    Name, title and description of each shipped scenario.
``{shipped-airframes}``
    Each shipped airframe's numbers side by side.
``{streams}``
    The vehicle's telemetry: each message with its default rates on both links, PX4's beside, and their sums.
``{parameter-tables}``
    A section for each group of the vehicle's parameters: name, type, default, allowed values, meaning.
``{cli-help} SUBCOMMAND``
    What ``mavsitl SUBCOMMAND --help`` prints.
"""

from __future__ import annotations

import ast
import inspect
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Sequence
from importlib import import_module, resources
from typing import Any, ClassVar

import msgspec
from docutils import nodes
from mavsitl_vehicle.autopilot import telemetry
from mavsitl_vehicle.autopilot.parameters import TABLE, Parameter
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from mavsitl import scenario

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


class CliHelp(GeneratedDirective):
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        command = ["mavsitl", *self.arguments, "--help"]
        result = subprocess.run(
            [sys.executable, "-m", *command],
            env={**os.environ, "COLUMNS": "100", "NO_COLOR": "1"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            check=False,
        )
        if result.returncode:
            raise self.error(f"`{' '.join(command)}` failed: {result.stderr}")
        return [nodes.literal_block(result.stdout, result.stdout, language="text")]


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("struct-tables", StructTables)
    app.add_directive("shipped-scenarios", ShippedScenarios)
    app.add_directive("shipped-airframes", ShippedAirframes)
    app.add_directive("streams", Streams)
    app.add_directive("parameter-tables", ParameterTables)
    app.add_directive("cli-help", CliHelp)
    return {"version": "1", "parallel_read_safe": True}
