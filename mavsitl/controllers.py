"""A controller of one's own: what it is given, what it answers, and how it is found by its name.

A controller is an object with one method, called once a control period while the vehicle flies::

    def update(self, time_s: float, state: State, reference: Reference) -> AttitudeDemand | RateDemand | PositionDemand

World NWU (north, west, up), body FLU (forward, left, up), SI units, quaternions scalar first and FLU -> NWU. Vectors
are NumPy arrays (3,), read-only. `time_s` is flight time by the vehicle's clock.

Two more are called where it has them: ``reset()`` before a flight, and each time the vehicle has been out of OFFBOARD
(without it a new object is made), and ``log()`` after each update, for up to eight numbers that are to be in the
log, topic `own_controller`.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import inspect
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from math import hypot, isfinite
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mavsitl import quaternion
from mavsitl.errors import UsageError, did_you_mean
from mavsitl.scenario import Flight

Vector: TypeAlias = npt.NDArray[np.float64]
"""(3,)"""
Numbers: TypeAlias = Sequence[float] | npt.NDArray[np.float64]
"""What a demand takes for a vector: any sequence of numbers."""

GROUP = "mavsitl.controller"
"""Of the entry points: ``name = "module:Controller"``."""
PAPER = ("pidnn", "pid")
"""The paper's own laws. They are compiled and have a place in the scenario, `controller.law`."""


@dataclass(frozen=True)
class State:
    """The vehicle as telemetry tells it, at the time of the newest message; with its noise and its delay."""

    position: Vector
    """m, NWU, from the scenario's origin."""
    velocity: Vector
    """m/s, NWU."""
    quaternion: npt.NDArray[np.float64]
    """(4,) unit, scalar first: the attitude, FLU -> NWU."""
    omega: Vector
    """rad/s, body rates about x, y, z of FLU."""
    age_s: float
    """Since it was measured, beyond the link's fastest transport."""

    @cached_property
    def rotation(self) -> npt.NDArray[np.float64]:
        """(3, 3): a vector's body components to its world components; the last column is the thrust's direction."""
        w, x, y, z = self.quaternion.tolist()
        return np.array((
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        ))  # fmt: skip

    @cached_property
    def angles(self) -> Vector:
        """rad: roll, pitch, yaw (Z-Y-X) of FLU in NWU."""
        w, x, y, z = self.quaternion.tolist()
        return np.array(quaternion.to_euler((w, x, y, z)))


@dataclass(frozen=True)
class Reference:
    """Where the vehicle should be now."""

    position: Vector
    """m, NWU."""
    velocity: Vector
    """m/s, NWU; 0 where the path jumps."""
    acceleration: Vector
    """m/s^2, NWU."""
    yaw: float
    """rad, counter-clockwise from north."""


@dataclass(frozen=True)
class AttitudeDemand:
    """Hold this attitude, with this thrust: SET_ATTITUDE_TARGET to the attitude loop aboard."""

    quaternion: Numbers
    """(4,) unit, scalar first, FLU -> NWU."""
    thrust: float
    """N, of all rotors together along the body's z axis. The wire cuts it at 0 and the airframe's largest."""

    @classmethod
    def along(cls, force: Numbers, yaw: float) -> AttitudeDemand:
        """The attitude whose z axis is along `force` (N, NWU) and whose x axis looks towards `yaw` (rad), and its size.

        This is what a position controller wants: ``mass * (acceleration + gravity upwards)``. A force without a
        direction, or a heading along it, is taken as upright.
        """
        x, y, z = _numbers("force", force, 3)
        size = hypot(x, y, z)
        return cls(_upright(x / size, y / size, z / size, yaw) if size > 0.0 else quaternion.from_yaw(yaw), size)


@dataclass(frozen=True)
class RateDemand:
    """Turn at these body rates, with this thrust: SET_ATTITUDE_TARGET to the rate loop aboard."""

    omega: Numbers
    """(3,) rad/s, about x, y, z of FLU."""
    thrust: float
    """N, as of `AttitudeDemand`."""
    quaternion: Numbers | None = None
    """The attitude that this is to lead to, FLU -> NWU. For the log and its attitude error alone; None: the attitude
    that the reference itself needs in still air."""


@dataclass(frozen=True)
class PositionDemand:
    """Be there: SET_POSITION_TARGET_LOCAL_NED to the position loop aboard. What is None is left to the vehicle."""

    position: Numbers | None = None
    """m, NWU."""
    velocity: Numbers | None = None
    """m/s, NWU; fed forward where there is a position."""
    acceleration: Numbers | None = None
    """m/s^2, NWU; fed forward."""
    yaw: float = 0.0
    """rad, counter-clockwise from north."""


Demand: TypeAlias = AttitudeDemand | RateDemand | PositionDemand


class ControllerError(UsageError):
    """A controller cannot be found or made, or has failed; the message says which and why.

    Attributes:
        trace: the traceback, of the controller's own code; empty where there is none.
    """

    def __init__(self, message: str, trace: str = "") -> None:
        super().__init__(message)
        self.trace = trace
        if trace:
            self.add_note(trace)


# --- finding


@dataclass(frozen=True)
class _Place:
    """Where a controller's code is."""

    module: str
    name: str
    file: Path | None = None
    """Of a controller given by its file."""


ASKED: dict[str, Callable[[Flight], Any]] = {
    "airframe": lambda flight: flight.airframe,
    "period_s": lambda flight: flight.scenario.rates.control_period_us / 1e6,
    "seed": lambda flight: flight.scenario.seed,
}
"""What a controller may ask for at construction, by the name of the argument: the nominal airframe
(`mavsitl.airframes.Airframe`: mass_kg, inertia_kg_m2, max_thrust_n, ...), the control period, the scenario's seed."""


def settings(name: str) -> dict[str, Any]:
    """The scenario's settings that choose a controller by its name. Raises `ControllerError` for one that is none.

    A relative path of a file is made absolute, so that the scenario means the same file everywhere.
    """
    if name in PAPER:
        return {"controller.law": name, "controller.own": ""}
    place = _place(name)
    return {"controller.own": name if place.file is None else f"{place.file}:{place.name}"}


def installed() -> dict[str, EntryPoint]:
    """Those found by entry point, by name."""
    return {point.name: point for point in entry_points(group=GROUP)}


def shipped() -> tuple[str, ...]:
    """Names of those that come with mavsitl, the paper's first."""
    own = sorted(point.name for point in entry_points(group=GROUP) if point.dist and point.dist.name == "mavsitl")
    return (*PAPER, *own)


def make(flight: Flight) -> Any:
    """The controller that a scenario names in `controller.own`, new. Raises `ControllerError`."""
    name = flight.scenario.controller.own
    place = _place(name)
    module = _load(name, place)
    factory = getattr(module, place.name, None)
    if factory is None:
        raise ControllerError(f"{name}: no {place.name!r} there; {_offered(place)}")
    if not callable(factory):
        raise ControllerError(f"{name}: {place.name} is {_kind(factory)}; needed: a class or a function")
    wanted = _arguments(name, factory)
    try:
        made = factory(**{key: ASKED[key](flight) for key in wanted})
    except Exception as error:
        raise failure(f"{name}: cannot be made", error) from error
    _check(name, made)
    return made


def source_digest(name: str) -> str:
    """32 hexadecimal digits of a controller's source: its file, and the modules beside it that these import.

    Raises `ControllerError`.
    """
    if name in PAPER:
        return ""
    place = _place(name)
    digest = hashlib.blake2b(digest_size=16)
    for inside, data in _sources(_file(name, place)):
        digest.update(inside.encode() + b"\0" + data)
    return digest.hexdigest()


def _place(name: str) -> _Place:
    left, colon, right = name.rpartition(":")
    if colon and left.endswith(".py"):
        file = Path(left).absolute()
        if not file.is_file():
            raise ControllerError(f"{name}: no such file: {left}")
        return _Place(_module_name(file), right, file)
    if colon and left:
        return _Place(left, right)
    if name.endswith(".py"):
        offered = _offered(_Place("", "", Path(name))) if Path(name).is_file() else "no such file"
        raise ControllerError(f"{name}: which controller of that file? Needed: FILE.py:NAME; {offered}")
    points = installed()
    if name not in points:
        known = tuple(dict.fromkeys((*PAPER, *sorted(points))))
        raise ControllerError(
            f"{name!r} is no controller; {did_you_mean(name, known)}allowed: {', '.join(known)}, "
            "FILE.py:NAME or MODULE:NAME"
        )
    return _Place(points[name].module, points[name].attr)


def _module_name(file: Path) -> str:
    """One of its own for each file, so that `random.py` is not the library's."""
    return f"mavsitl_own_{hashlib.blake2b(str(file).encode(), digest_size=8).hexdigest()}"


_loaded: dict[Path, tuple[bytes, ModuleType]] = {}
"""By file: its text as it was executed."""


def _load(name: str, place: _Place) -> ModuleType:
    try:
        if place.file is None:
            return importlib.import_module(place.module)
        text = place.file.read_bytes()
        known = _loaded.get(place.file)
        if known is not None and known[0] == text:
            return known[1]
        folder = str(place.file.parent)
        if folder not in sys.path:
            sys.path.append(folder)  # last: a file of the user's does not stand in for a library's
        spec = importlib.util.spec_from_file_location(place.module, place.file)
        assert spec is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[place.module] = module  # as dataclasses need it
        exec(compile(text, str(place.file), "exec"), module.__dict__)
    except Exception as error:
        raise failure(f"{name}: cannot be loaded", error) from error
    _loaded[place.file] = (text, module)
    return module


def _offered(place: _Place) -> str:
    """What could have been meant."""
    try:
        text = (place.file or Path(_spec_file(place.module))).read_text("utf-8")
        body = ast.parse(text).body
    except (OSError, SyntaxError, UnicodeDecodeError, ControllerError):
        return "it cannot be read"
    found = [
        node.name
        for node in body
        if isinstance(node, ast.ClassDef)
        and any(isinstance(part, ast.FunctionDef) and part.name == "update" for part in node.body)
    ]
    return f"there: {', '.join(found)}" if found else "no class there has a method 'update'"


def _arguments(name: str, factory: Any) -> list[str]:
    """Those of `ASKED` that it asks for."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return []
    wanted = []
    for each in parameters:
        if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD):
            continue
        if each.name in ASKED and each.kind is not each.POSITIONAL_ONLY:
            wanted.append(each.name)
        elif each.default is each.empty:
            raise ControllerError(
                f"{name}: asks for {each.name!r} at construction; allowed: {', '.join(ASKED)}, or a default of its own"
            )
    return wanted


def _check(name: str, made: Any) -> None:
    for method, arguments in (("update", ("time_s", "state", "reference")), ("reset", ()), ("log", ())):
        found = getattr(made, method, None)
        if found is None and method != "update":
            continue
        if not callable(found):
            what = "has no method" if found is None else f"has {_kind(found)} for a method"
            raise ControllerError(f"{name}: {type(made).__name__} {what} {method}({', '.join(arguments)})")
        try:
            inspect.signature(found).bind(*arguments)
        except TypeError as error:
            raise ControllerError(
                f"{name}: {method}{inspect.signature(found)} cannot be called as "
                f"{method}({', '.join(arguments)}): {error}"
            ) from error


def failure(what: str, error: Exception) -> ControllerError:
    """An exception of the controller's own code as the error to say: in a line, and with the traceback."""
    if isinstance(error, ControllerError):
        return ControllerError(f"{what}: {error}", error.trace)
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename not in _NOT_THEIRS and not frame.filename.startswith("<frozen")
    ]
    own = [frame for frame in frames if not _of_a_library(Path(frame.filename))] or frames
    at = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    lines = [*traceback.format_list(frames), *traceback.format_exception_only(error)]
    trace = "Traceback (most recent call last):\n" + "".join(lines).rstrip() if frames else ""
    return ControllerError(f"{what}: {type(error).__name__}: {error}{at}", trace)


def _of_a_library(file: Path) -> bool:
    """Whether it came with Python or by pip: where the user has nothing to mend."""
    return any(file.is_relative_to(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib"))


_NOT_THEIRS = {__file__, importlib.__file__}
"""Files whose frames say nothing of a controller."""


def not_theirs(file: str) -> None:
    """`file` calls controllers: its frames are left out of tracebacks."""
    _NOT_THEIRS.add(file)


def _kind(value: Any) -> str:
    kind = type(value).__name__
    return f"{kind} {str(value)[:40]!r}" if isinstance(value, str | int | float) else kind


# --- what decides a flight of it


def _file(name: str, place: _Place) -> Path:
    return place.file or Path(_spec_file(place.module, name))


def _spec_file(module: str, name: str = "") -> str:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError) as error:
        raise ControllerError(f"{name or module}: no module {module!r}: {error}") from error
    if spec is None or spec.origin is None:
        raise ControllerError(f"{name or module}: no module {module!r}")
    return spec.origin


_CODE_OF_MAVSITL = ("mavsitl", "mavsitl_ground", "mavsitl_vehicle")
"""A campaign's key has these by itself."""


def _sources(file: Path) -> Iterator[tuple[str, bytes]]:
    """(path, bytes) of a Python file and of what it imports from its own folder or package, each once, in one order."""
    root = file.parent
    while (root / "__init__.py").is_file():
        root = root.parent
    waiting, seen = [file], {file}
    while waiting:
        each = waiting.pop()
        data = each.read_bytes()
        yield each.relative_to(root).as_posix(), data
        try:
            tree = ast.parse(data)
        except (SyntaxError, ValueError):
            continue  # what loads it says so
        for parts in _imported(tree, each.relative_to(root).parts[:-1]):
            for length in range(1, len(parts) + 1):
                base = root.joinpath(*parts[:length])
                for found in (base.with_suffix(".py"), base / "__init__.py"):
                    if found.is_file() and found not in seen:
                        seen.add(found)
                        waiting.append(found)


def _imported(tree: ast.Module, package: tuple[str, ...]) -> Iterator[list[str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = list(package[: len(package) + 1 - node.level]) if node.level else []
            base = above + (node.module.split(".") if node.module else [])
            names = [[*base, alias.name] for alias in node.names]
        else:
            continue
        yield from (parts for parts in names if parts[0] not in _CODE_OF_MAVSITL)


# --- numbers


def _numbers(what: str, values: Any, count: int) -> list[float]:
    """As plain floats. Raises `ControllerError` for another shape, and for what is no number or not finite."""
    try:
        numbers: list[float] = np.asarray(values, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError) as error:
        raise ControllerError(f"{what} is {values!r}; needed: {count} numbers") from error
    if len(numbers) != count:
        raise ControllerError(f"{what} has {len(numbers)} numbers; needed: {count}")
    if not isfinite(sum(numbers)):
        raise ControllerError(f"{what} is {tuple(numbers)}: not finite")
    return numbers


def vector(what: str, values: Any) -> tuple[float, float, float]:
    """Three finite numbers, or `ControllerError`."""
    x, y, z = _numbers(what, values, 3)
    return x, y, z


def unit(what: str, values: Any) -> tuple[float, float, float, float]:
    """A quaternion of unit length to 1 %, made exactly so, or `ControllerError`."""
    w, x, y, z = _numbers(what, values, 4)
    if abs(hypot(w, x, y, z) - 1.0) > 0.01:
        raise ControllerError(f"{what} is {(w, x, y, z)}, of length {hypot(w, x, y, z):.3g}; needed: 1")
    return quaternion.normalise((w, x, y, z))


def number(what: str, value: Any) -> float:
    """One finite number, or `ControllerError`."""
    return _numbers(what, value, 1)[0]


def _upright(x: float, y: float, z: float, yaw: float) -> tuple[float, float, float, float]:
    """The attitude with z axis (x, y, z), a unit vector, and the x axis as near to `yaw` as that allows.

    As the columns of Lee, Leok, McClamroch 2010, section V: b_3 given, b_2 along b_3 x b_1d.
    """
    third = np.array((x, y, z))
    heading = np.array((np.cos(yaw), np.sin(yaw), 0.0))
    second = np.cross(third, heading)
    length = float(np.linalg.norm(second))
    if length < 1e-6:
        return quaternion.from_yaw(yaw)
    second /= length
    first = np.cross(second, third)
    return _from_columns(first.tolist(), second.tolist(), (x, y, z))


def _from_columns(a: Sequence[float], b: Sequence[float], c: Sequence[float]) -> tuple[float, float, float, float]:
    """The quaternion of a rotation matrix with these columns, by its largest part (Shepperd 1978)."""
    trace = a[0] + b[1] + c[2]
    parts = (
        (trace, (1.0 + trace, b[2] - c[1], c[0] - a[2], a[1] - b[0])),
        (a[0], (b[2] - c[1], 1.0 + 2.0 * a[0] - trace, b[0] + a[1], c[0] + a[2])),
        (b[1], (c[0] - a[2], b[0] + a[1], 1.0 + 2.0 * b[1] - trace, c[1] + b[2])),
        (c[2], (a[1] - b[0], c[0] + a[2], c[1] + b[2], 1.0 + 2.0 * c[2] - trace)),
    )
    _, (w, x, y, z) = max(parts)
    return quaternion.normalise((w, x, y, z) if w >= 0.0 else (-w, -x, -y, -z))
