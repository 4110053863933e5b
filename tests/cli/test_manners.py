"""What every command has: mistakes that say what was meant, one JSON value on stdout, help that fits the terminal."""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

import pytest

from mavsitl import cli, errors, pair
from mavsitl.campaign.errors import GridError, StoreError
from mavsitl.cli import main
from mavsitl.cli.common import logs_in
from mavsitl.link.base import LinkError
from mavsitl.log.errors import LogError
from mavsitl.scenario import ScenarioError


def below(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found = (each.choices for each in parser._actions if isinstance(each, argparse._SubParsersAction))
    return dict(next(found, {}))


def parsers() -> dict[str, argparse.ArgumentParser]:
    return below(cli.build_parser())


def leaves() -> dict[str, argparse.ArgumentParser]:
    """Those that do something: where a command has commands of its own, these, as ``log info``."""
    found = {}
    for name, parser in parsers().items():
        inner = {f"{name} {each}": one for each, one in below(parser).items()}
        found.update(inner or {name: parser})
    return found


def examples(parser: argparse.ArgumentParser) -> list[str]:
    """The command lines that a help shows, without what is said about them."""
    return re.findall(r"^  mavsitl (.+?)(?:  .*)?$", parser.epilog or "", re.M)


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["fyl"], "mavsitl: argument COMMAND: 'fyl' is not allowed; did you mean fly? allowed: fly, "),
        (["fly", "--sed", "3"], "mavsitl fly: --sed: no such option; did you mean --seed"),
        (["fly", "--durations=3"], "mavsitl fly: --durations: no such option; did you mean --duration"),
        (
            ["fly", "--dur", "3"],
            "mavsitl fly: --dur: no such option",
        ),  # it could be another one some day
        (["check", "now"], "mavsitl check: 'now': one argument too many"),
        (["fly", "--level", "atitude"], "'atitude' is not allowed; did you mean attitude? allowed: attitude"),
        (["fly", "hover-clam"], "did you mean hover-calm"),
        (["fly", "--airframe", "papper"], "did you mean paper? "),
        (["inject", "gsp", "off"], "UNIT: 'gsp' is not allowed; did you mean gps? allowed: gyro"),
    ],
)
def test_a_mistake_suggests_what_was_meant(arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == errors.EXIT_USAGE
    assert told in capsys.readouterr().err


def test_a_mistake_of_the_parser_is_two_lines_and_names_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["vehicle", "--speed", "fast"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.splitlines()[1:] == ["mavsitl vehicle --help says what it takes"]


def test_exit_codes_are_the_errors_own() -> None:
    for error in (ScenarioError, GridError, errors.UsageError):
        assert error("").exit_code == 2
    for failed in (LinkError, LogError, StoreError, pair.PairError):
        assert failed("").exit_code == 1


# --- JSON -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", leaves())
def test_every_command_speaks_json(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each has the option, and says as JSON what it cannot parse: the last line of stdout, whatever else there is."""
    assert any("--json" in each.option_strings for each in leaves()[command]._actions)
    needed = [each for each in leaves()[command]._actions if not each.option_strings and each.required]
    given = [next(iter(each.choices)) if each.choices else "something" for each in needed]
    assert main([*command.split(), "--json", "--xyz", *given]) == 2
    said = capsys.readouterr()
    assert json.loads(said.out) == {
        "event": "error", "command": f"mavsitl {command}", "error": "--xyz: no such option",
        "notes": [f"mavsitl {command} --help says what it takes"], "exit_code": 2,
    }  # fmt: skip
    assert said.err == f"mavsitl {command}: --xyz: no such option\n"


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["fly", "--json", "hover-clam"], 2, "hover-clam: no such shipped file"),
        (["vehicle", "--status", "json", "hover-clam"], 2, "hover-clam: no such shipped file"),
        (["ground", "--status=json", "--link", "14540"], 2, "'14540' is not an endpoint"),
        (["sweep", "hover-calm", "--json", "--seeds", "x"], 2, "seeds: 'x' is not allowed"),
        (["tune", "hover-calm", "--json", "--seeds", "x"], 2, "seeds: 'x' is not allowed"),
        (["report", "--json", "/nonexistent"], 2, "run.json"),
        (["check", "--json", "--listen", "14540"], 2, "'14540' is not an endpoint"),
    ],
)
def test_an_error_is_json_on_stdout_and_text_on_stderr(
    arguments: list[str], code: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == code
    said = capsys.readouterr()
    error = json.loads(said.out)
    assert (error["event"], error["command"], error["exit_code"]) == ("error", f"mavsitl {arguments[0]}", code)
    assert told in error["error"]
    assert told in said.err


def test_a_formation_and_its_report_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = ["fly", "formation-spiral", "--count", "2", "--duration", "1", "--json", "--run-dir", str(tmp_path)]
    assert main(flown) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["event"] == "end"
    assert told["folder"] == str(tmp_path)
    assert [each["system_id"] for each in told["vehicles"]] == [1, 2]
    assert main(["fly", "hover-calm", "--in-memory", "--duration", "1", "--json", "--run-dir", str(tmp_path)]) == 0
    capsys.readouterr()
    assert main(["report", "--json", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out) == {"reports": [str(tmp_path / "report.html")]}


# --- where the logs are ---------------------------------------------------------------------------


def test_what_was_written_is_told_however_it_ends(tmp_path: Path) -> None:
    (tmp_path / "earlier").write_text("of another run")
    with pytest.raises(LinkError) as nothing, logs_in(tmp_path):
        raise LinkError("port in use")
    assert not hasattr(nothing.value, "__notes__")

    def fly() -> None:
        (tmp_path / "vehicle.ulg").write_text("a log")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as written, logs_in(tmp_path):
        fly()
    assert written.value.__notes__ == [f"logs so far: {tmp_path}"]


# --- help -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["", *parsers()])
@pytest.mark.parametrize("columns", [80, 200])
def test_help_fits_the_terminal(
    command: str, columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Except for examples: a command line that is broken cannot be copied."""
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit, match="0"):
        main([*command.split(), "--help"])
    lines = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("  mavsitl ")]
    assert [line for line in lines if len(line) > min(columns, 110)] == []


def test_every_example_parses() -> None:
    parser = cli.build_parser()
    shown = {name: examples(each) for name, each in parsers().items()}
    for name, lines in shown.items():
        for line in lines:
            assert callable(parser.parse_args(line.split()).run), f"{name}: {line}"
    assert sum(map(len, shown.values())) >= 40


def test_a_second_column_is_wrapped_or_begins_below(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    with pytest.raises(SystemExit):
        main(["tune", "--help"])
    text = capsys.readouterr().out
    assert "  error      of each scenario and state the RMSE over the\n             paper's number" in text
    assert "  mavsitl tune hover-wind-realistic --jobs 8 --evaluations 300\n" in text
