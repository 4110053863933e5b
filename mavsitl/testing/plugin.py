"""pytest's plugin, by the entry point `pytest11`: fixtures of vehicles and flights, their logs kept where a test fails.

It imports nothing but pytest before a test asks for a vehicle.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

import pytest

if TYPE_CHECKING:
    from mavsitl.scenario import Flight as Scenario
    from mavsitl.testing import Faults, Flight, FlightCheck, RunningVehicle, Vehicle
    from mavsitl.testing.craft import Craft

KEPT = ("failed", "all", "none")
"""Of whose logs are kept."""

MARKER = {
    "scenario": "a shipped scenario's name, the path of a .toml file, or a dict of keys",
    "overrides": "a dict of the scenario's keys, dotted, over it",
    "seed": "a whole number",
    "controller": "of the fixture flight: a class of yours, FILE.py:NAME, MODULE:NAME or an installed one's name",
    "port": '"offboard" or "gcs": the link that the fixture vehicle means where a call names none',
    "speed": "simulated over wall time, of vehicle_udp",
    "lockstep": "True: vehicle_udp waits for the program's answers",
}
"""What `@pytest.mark.mavsitl(...)` takes."""

OPTIONS = (
    ("scenario", "NAME", "scenario of the fixtures, where a test's marker names none", "takeoff-hover"),
    ("seed", "N", "seed of the fixtures, where a test's marker names none (default: the scenario's)", None),
    ("speed", "X", "simulated over wall time, of vehicle_udp", "1"),
    ("logs", "DIR", "folder for the logs of flights, a folder for each test", ".mavsitl-logs"),
    ("keep", "|".join(KEPT), "whose logs are kept", "failed"),
)
"""Name, what it takes, help, default: each is --mavsitl-NAME and, in the configuration file, mavsitl_NAME."""

CRAFTS = ("vehicle", "flight", "vehicle_udp")
"""The fixtures that something can be wrong with."""

_failed = pytest.StashKey[bool]()
_flown = pytest.StashKey[list[tuple[str, Any]]]()

LONGEST_NAME = 100


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("mavsitl", "simulated vehicles (mavsitl)")
    for name, takes, text, default in OPTIONS:
        told = text if default is None else f"{text} (default: {default})"
        group.addoption(
            f"--mavsitl-{name}", metavar=takes, default=None, help=told, choices=KEPT if name == "keep" else None
        )
        parser.addini(f"mavsitl_{name}", told, default=default)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        f"mavsitl({', '.join(f'{name}=...' for name in MARKER)}): sets up mavsitl's fixtures vehicle, flight, ...",
    )


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    """A failed test says where its flights' logs are, and what was the matter with them."""
    outcome = yield
    flown = item.stash.get(_flown, None)
    if flown is None:
        return
    report = outcome.get_result()
    if report.failed:
        item.stash[_failed] = True
        if report.when == "call":
            told = getattr(call.excinfo and call.excinfo.value, "craft", None)
            report.sections += [(f"mavsitl {name}", _story(craft)) for name, craft in flown if craft is not told]
    if report.when == "call" and (report.failed or _setting(item.config, "keep") == "all"):
        report.user_properties += [
            ("mavsitl_logs", str(craft.folder)) for _, craft in flown if craft.folder is not None
        ]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    found = [
        value
        for reports in terminalreporter.stats.values()
        for report in reports
        for name, value in getattr(report, "user_properties", ())
        if name == "mavsitl_logs"
    ]
    if found:
        terminalreporter.section("mavsitl logs")
        for folder in dict.fromkeys(found):
            terminalreporter.line(folder)


def _story(craft: Craft) -> str:
    try:
        return "\n".join((craft.name, *craft.story()))
    except Exception as error:  # a report of a failure must not fail itself
        return f"{craft.name}: nothing can be told: {type(error).__name__}: {error}"


# --- what a test is set up with


def _setting(config: pytest.Config, name: str) -> Any:
    given = config.getoption(f"mavsitl_{name}")
    return config.getini(f"mavsitl_{name}") if given is None else given


class _SetupError(Exception):
    """A marker, an option or a line of the configuration is wrong."""


@contextmanager
def _told() -> Generator[None, None, None]:
    """What is wrong with the set-up is told without a traceback: it is the user's."""
    from mavsitl.errors import UsageError

    try:
        yield
    except (UsageError, _SetupError) as error:
        raise pytest.fail.Exception(f"mavsitl: {error}", pytrace=False) from None


def _marked(request: pytest.FixtureRequest) -> dict[str, Any]:
    """The markers' arguments: of the function over those of class and module; `overrides` are put together."""
    found: dict[str, Any] = {}
    for marker in reversed(list(request.node.iter_markers("mavsitl"))):
        if marker.args:
            raise _SetupError(f"@pytest.mark.mavsitl takes names alone: {', '.join(MARKER)}")
        for name, value in marker.kwargs.items():
            if name not in MARKER:
                raise _SetupError(f"@pytest.mark.mavsitl({name}=...): allowed: {', '.join(MARKER)}")
            if name == "overrides":
                if not isinstance(value, dict):
                    raise _SetupError(f"@pytest.mark.mavsitl(overrides={value!r}): allowed: {MARKER[name]}")
                value = {**found.get(name, {}), **value}
            found[name] = value
    return found


def _number(config: pytest.Config, marked: dict[str, Any], name: str, kind: Callable[[Any], Any]) -> Any:
    """Of the marker, else of the options; None where there is none."""
    value = marked[name] if name in marked else _setting(config, name)
    if value is None or value == "":
        return None
    try:
        return kind(value)
    except (TypeError, ValueError):
        where = f"@pytest.mark.mavsitl({name}=...)" if name in marked else f"--mavsitl-{name} or mavsitl_{name}"
        raise _SetupError(f"{where}: {value!r} is not allowed; allowed: {MARKER[name]}") from None


def _speed(value: Any) -> float:
    speed = float(value)
    if not 0.0 < speed <= 1000.0:
        raise ValueError
    return speed


def _whole(value: Any) -> int:
    if isinstance(value, bool | float):
        raise TypeError
    return int(value)


def _scenario_file(request: pytest.FixtureRequest, name: str) -> str:
    """A relative path is looked for beside the test, and then from the root of the tests."""
    if not name.endswith(".toml") or Path(name).is_absolute():
        return name
    places = (request.path.parent / name, request.config.rootpath / name)
    for place in places:
        if place.is_file():
            return str(place)
    raise _SetupError(f"scenario {name!r}: no such file: neither {places[0]} nor {places[1]}")


# --- where the logs go


def _folder_name(node_id: str) -> str:
    """Of a test's logs, another for each test: "test_hover.py::test_it[1]" as "test_hover.test_it[1]"."""
    plain = node_id.replace(".py::", ".").replace("::", ".").replace("/", ".")
    name = re.sub(r"[^\w.\[\]=-]+", "_", plain)
    if name == plain and len(name) <= LONGEST_NAME:
        return name
    return f"{name[:LONGEST_NAME]}-{crc32(node_id.encode()):08x}"


def _folder(request: pytest.FixtureRequest, craft: str) -> Path | None:
    if _setting(request.config, "keep") not in KEPT:
        raise _SetupError(
            f"mavsitl_keep: {_setting(request.config, 'keep')!r} is not allowed; allowed: {', '.join(KEPT)}"
        )
    if _setting(request.config, "keep") == "none":
        return None
    base: Path = request.config.rootpath / _setting(request.config, "logs")
    if not base.exists():
        base.mkdir(parents=True, exist_ok=True)
        (base / ".gitignore").write_text("*\n", "utf-8")
    return base / _folder_name(request.node.nodeid) / craft


def _note(request: pytest.FixtureRequest, name: str, craft: Craft) -> None:
    request.node.stash.setdefault(_flown, []).append((name, craft))


def _end(request: pytest.FixtureRequest, craft: Craft) -> None:
    """After the test: its logs are complete, or gone."""
    craft.close()
    keep = _setting(request.config, "keep")
    if craft.folder is None or keep == "all" or (keep == "failed" and request.node.stash.get(_failed, False)):
        return
    craft.discard()
    test_folder = craft.folder.parent
    for folder in (test_folder, test_folder.parent):
        if folder.is_dir() and not any(path.name != ".gitignore" for path in folder.iterdir()):
            if folder is not test_folder:
                break  # the folder of all stays: another worker may be about to use it
            folder.rmdir()


# --- the fixtures


@pytest.fixture
def scenario(request: pytest.FixtureRequest) -> Scenario:
    """The scenario that `vehicle`, `flight` and `vehicle_udp` fly: by the marker, else by `--mavsitl-scenario`.

    A fixture of this name of your own may return a name, a path, a dict of keys, or what `mavsitl.scenario.load` gives.
    """
    from mavsitl.testing.craft import prepare

    with _told():
        marked = _marked(request)
        what = marked.get("scenario", _setting(request.config, "scenario"))
        if isinstance(what, str | Path):
            what = _scenario_file(request, str(what))
        elif not isinstance(what, dict):
            raise _SetupError(f"@pytest.mark.mavsitl(scenario={what!r}): allowed: {MARKER['scenario']}")
        seed = _number(request.config, marked, "seed", _whole)
        return prepare(what, seed=seed, overrides=marked.get("overrides"), live=False)


@pytest.fixture
def flight(request: pytest.FixtureRequest, scenario: Any) -> Iterator[Flight]:
    """A whole flight in memory and lock-step, which has not begun: `mavsitl.testing.Flight`."""
    from mavsitl.testing import Flight

    with _told():
        controller = _marked(request).get("controller")
        made = Flight(scenario, controller=controller, logs=_folder(request, "flight"))
    _note(request, "flight", made)
    yield made
    _end(request, made)


@pytest.fixture
def vehicle(request: pytest.FixtureRequest, scenario: Any) -> Iterator[Vehicle]:
    """A vehicle that the test drives by MAVLink messages, in simulated time: `mavsitl.testing.Vehicle`."""
    from mavsitl.testing import Vehicle

    with _told():
        port = _marked(request).get("port", "offboard")
        if port not in ("offboard", "gcs"):
            raise _SetupError(f"@pytest.mark.mavsitl(port={port!r}): allowed: {MARKER['port']}")
        made = Vehicle(scenario, port=port, logs=_folder(request, "vehicle"))
    _note(request, "vehicle", made)
    yield made
    _end(request, made)


@pytest.fixture
def vehicle_udp(request: pytest.FixtureRequest, scenario: Any) -> Iterator[RunningVehicle]:
    """A vehicle on free UDP ports, in real time or in lock-step with a program: `mavsitl.testing.RunningVehicle`."""
    from mavsitl import testing

    with _told():
        marked = _marked(request)
        lockstep = marked.get("lockstep", False)
        if not isinstance(lockstep, bool):
            raise _SetupError(f"@pytest.mark.mavsitl(lockstep={lockstep!r}): allowed: True, False")
        speed = 1.0 if lockstep else _number(request.config, marked, "speed", _speed)
        record = _folder(request, "vehicle_udp")
    with testing.vehicle(scenario, speed=speed, lockstep=lockstep, record=record) as made:
        _note(request, "vehicle_udp", made)
        yield made
    _end(request, made)


@pytest.fixture
def faults(request: pytest.FixtureRequest) -> Iterator[Faults]:
    """What goes wrong with the test's `vehicle`, `flight` or `vehicle_udp`: `mavsitl.testing.Faults`."""
    used = [name for name in CRAFTS if name in request.fixturenames]
    if len(used) != 1:
        has = f"has {' and '.join(used)}: say e.g. {used[0]}.faults" if used else f"has none of {', '.join(CRAFTS)}"
        pytest.fail(f"mavsitl: faults: with what? The test {has}", pytrace=False)
    craft = request.getfixturevalue(used[0])
    found: Faults = craft.faults
    yield found
    if all(craft is not each for _, each in request.node.stash.get(_flown, [])):
        found.clear()  # one of the user's own, that outlives the test; else its log is to end as the test left it


@pytest.fixture
def assert_flight() -> Callable[[Craft], FlightCheck]:
    """Assertions on a flight, with failures that tell what happened: `mavsitl.testing.assert_flight`."""
    from mavsitl.testing import assert_flight

    return assert_flight
