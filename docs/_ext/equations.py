"""``{equations}``: for each of the paper's equations, where the code cites it. Read from docstrings and comments."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

ROOT = Path(__file__).resolve().parents[2]

CODE = (
    "mavsitl/control", "mavsitl/airframes", "mavsitl/quaternion.py", "mavsitl/scenario.py",
    "vehicle/mavsitl_vehicle", "ground/mavsitl_ground",
)  # fmt: skip
TESTS = ("tests/control", "tests/plant", "tests/wind", "tests/ground", "tests/frames")

WIDEST = 10
"""A range of more equations names a chapter, not the place of one."""

SECTIONS: Mapping[str, Mapping[int, str]] = {
    "A rotor in wind": {
        1: "the air's speed through a rotor: its own and the wind's",
        2: "induced velocity, from the thrust",
        3: "thrust and drag torque, from the square of the rotor's speed",
        4: "the force of thrust and wind together",
        5: "the drag torque of thrust and wind together",
    },
    "The rigid body": {
        6: "acceleration of the mass centre",
        7: "Euler's equation with the rotors' gyroscopic moment",
        8: "sum of the rotors' speeds, with their direction",
        9: "moments of the rotors' thrust",
        10: "moments of the wind at the rotors",
        11: "the six accelerations from U_1 to U_4 and W_1 to W_6",
        12: "U_1 to U_4 from the rotors' forces",
        13: "W_1 to W_6 from the wind's forces",
    },
    "Dryden wind": {
        14: "spectra of u, v and w",
        15: "scales and intensities near the ground",
        16: "spectrum of filtered white noise",
        17: "the shaping filters",
    },
    "Height and position": {
        18: "vertical acceleration",
        19: "thrust for a vertical acceleration",
        20: "PID of the height",
        21: "acceleration in x from thrust and angles",
        22: "acceleration in y from thrust and angles",
        23: "PID of x",
        24: "PID of y",
        25: "roll angle for an acceleration",
        26: "pitch angle for an acceleration",
    },
    "The PID neural network: forward": {
        27: "inputs of the hidden neurons",
        28: "their outputs: P, I and D",
        29: "the net's output",
    },
    "The PID neural network: learning": {
        30: "what is made small",
        31: "step of an output weight",
        32: "its gradient, by the chain rule",
        33: "its gradient",
        34: "step of an input weight",
        35: "its gradient, by the chain rule",
        36: "its gradient",
        37: "the plant's gain, as a sign",
    },
    "The PID neural network: where it starts": {
        38: "input weights +1 and -1",
        39: "output weights K_P, K_I and K_D",
        40: "each neuron's input is then the error",
        41: "and its output P, I or D of it",
        42: "and the net is a PID",
    },
    "Learning rates": {
        43: "change of the error's square",
        44: "the next error",
        45: "the error's change, by the weight",
        46: "the weight's change",
        47: "change of the error's square, by the rate",
        48: "the condition for it to fall",
        49: "bound of a rate",
        50: "derivative of the root of the squared error",
        51: "bound of a rate by it",
        52: "for an output weight",
        53: "its value",
        54: "bound of an output weight's rate",
        55: "for an input weight",
        56: "its value",
        57: "bound of an input weight's rate",
    },
}
"""The paper's equations in our words, by its sections."""

_ROOTS = re.compile(r"^(?:vehicle/mavsitl_vehicle|ground/mavsitl_ground|mavsitl|tests)/")
"""Of the packages; the names below them do not repeat but for package files."""

_NUMBERS = r"\d+(?:-\d+)?(?: \((?:(?!eq)[^()])*\))?"
_CITATION = re.compile(rf"\b[Ee]qs?\.? ({_NUMBERS}(?:(?:, | and |, and | to ){_NUMBERS})*)")


class Place(NamedTuple):
    """Where an equation is cited: a file below the project's root and the class or function in it ("" for the file)."""

    path: str
    name: str
    width: int
    """Equations in the range that names it, less one."""


def places(roots: Sequence[str]) -> dict[int, list[Place]]:
    """By number, what is cited in these files and folders."""
    found: dict[int, list[Place]] = {}
    for root in roots:
        for path in sorted((ROOT / root).rglob("*.py")) if (ROOT / root).is_dir() else [ROOT / root]:
            for number, place in cited(path.read_text("utf-8"), path.relative_to(ROOT).as_posix()):
                if place not in found.setdefault(number, []):
                    found[number].append(place)
    return found


def cited(source: str, path: str) -> Iterator[tuple[int, Place]]:
    """Of one file; comments that follow one another are one text, and so is a docstring."""
    owners = dict(_owners(ast.parse(source)))
    for line, text in _texts(source):
        for match in _CITATION.finditer(text):
            for first, last in re.findall(r"(\d+)(?:-(\d+))?(?![^(]*\))", match[1]):
                low, high = int(first), int(last or first)
                for number in range(low, high + 1):
                    yield number, Place(path, owners.get(line, ""), high - low)


def _owners(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """The innermost class or function of each line, dotted."""

    def walk(node: ast.AST, name: str) -> Iterator[tuple[int, str]]:
        for child in ast.iter_child_nodes(node):
            inner = name
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                inner = f"{name}.{child.name}".lstrip(".")
                for line in range(child.lineno, (child.end_lineno or child.lineno) + 1):
                    yield line, inner
            yield from walk(child, inner)

    yield from walk(tree, "")


def _texts(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of comments and of strings, where docstrings are."""
    comment: tuple[int, int, str] | None = None
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            text = token.string.lstrip("# ")
            if comment is not None and token.start[0] == comment[1] + 1:
                comment = (comment[0], token.start[0], f"{comment[2]} {text}")
            else:
                if comment is not None:
                    yield comment[0], comment[2]
                comment = (token.start[0], token.start[0], text)
        elif token.type == tokenize.STRING:
            yield token.start[0], " ".join(token.string.split())
    if comment is not None:
        yield comment[0], comment[2]


def closest(found: Sequence[Place]) -> list[Place]:
    """Of classes and functions, that name the equation itself; where there are none, of files; else the chapters."""
    near = [place for place in found if place.width <= WIDEST]
    return [place for place in near if place.name] or near or list(found)


class Equations(SphinxDirective):
    def run(self) -> list[nodes.Node]:
        code, tests = places(CODE), places(TESTS)
        made: list[nodes.Node] = []
        for title, equations in SECTIONS.items():
            section = nodes.section(ids=[nodes.make_id(f"{self.env.docname}-{title}")], names=[])
            section += nodes.title("", title)
            section += self.table(equations, code, tests)
            made.append(section)
        return made

    def table(
        self, equations: Mapping[int, str], code: Mapping[int, Sequence[Place]], tests: Mapping[int, Sequence[Place]]
    ) -> nodes.table:
        header = ("eq", "what it says", "where", "tested in")
        table = nodes.table(classes=["colwidths-auto"])
        group = nodes.tgroup(cols=len(header))
        group += [nodes.colspec(colwidth=1) for _ in header]
        head, body = nodes.thead(), nodes.tbody()
        top = nodes.row()
        for name in header:
            top += nodes.entry("", nodes.paragraph(name, name))
        head += top
        for number, text in equations.items():
            row = nodes.row()
            row += nodes.entry("", nodes.paragraph("", f"{number}"))
            row += nodes.entry("", nodes.paragraph(text, text))
            row += nodes.entry("", self.cell(closest(code.get(number, [])), names=True))
            row += nodes.entry("", self.cell(closest(tests.get(number, [])), names=False))
            body += row
        group += [head, body]
        table += group
        return table

    def cell(self, found: Sequence[Place], *, names: bool) -> nodes.paragraph:
        """Files, each once, with the names in it that cite the equation."""
        by_path: dict[str, list[str]] = {}
        for place in found:
            listed = by_path.setdefault(place.path, [])
            if names and place.name and place.name not in listed:
                listed.append(place.name)
        paragraph = nodes.paragraph()
        for index, (path, listed) in enumerate(by_path.items()):
            short = _ROOTS.sub("", path)
            paragraph += nodes.Text("; " if index else "")
            paragraph += nodes.literal(short, short)
            if listed:
                paragraph += nodes.Text(": " + ", ".join(listed))
        return paragraph


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("equations", Equations)
    return {"version": "1", "parallel_read_safe": True}
