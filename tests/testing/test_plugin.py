"""The plugin as a user has it: fixtures, marker, options, failures with their logs, workers; nothing where unused."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from mavsitl import testing
from mavsitl.log.ulog import read
from mavsitl.px4_modes import MODES
from mavsitl.testing.plugin import MARKER, OPTIONS, _folder_name

pytest_plugins = ["pytester"]

ALL = [getattr(testing, name) for name in testing.__all__]
"""Loaded here: after a run in this process pytester forgets the modules that the run was first to load."""

INSTALLED = any(point.name == "mavsitl" for point in entry_points(group="pytest11"))
"""Of the mavsitl whose metadata this environment has: an older one did not have the plugin."""
LOADED = () if INSTALLED else ("-p", "mavsitl.testing.plugin")

Run = Callable[..., pytest.RunResult]


@pytest.fixture
def run(pytester: pytest.Pytester) -> Run:
    """Run tests of a user's in this process: `run(text, *options)`."""

    def run(text: str, *options: str) -> pytest.RunResult:
        pytester.makepyfile(test_user=text)
        return pytester.runpytest_inprocess(*LOADED, *options)

    return run


def logs(pytester: pytest.Pytester, folder: str = ".mavsitl-logs") -> set[str]:
    base = pytester.path / folder
    return {path.relative_to(base).as_posix() for path in base.rglob("*") if path.is_file()}


FAILING = """
    import pytest

    @pytest.mark.mavsitl(scenario="hover-calm", overrides={"duration_s": 3.0})
    def test_motor(flight, faults, assert_flight):
        faults.inject("motor", "off", instance=3, at_s=1.0)
        flight.run()
        assert_flight(flight).stays_within(0.3)
"""


def test_a_minute_over_20_percent_loss(run: Run, pytester: pytest.Pytester) -> None:
    """What the plugin is for. That it takes a second or two is said by `python -m tests.bench.bench_testing`."""
    run("""
        import pytest

        @pytest.mark.mavsitl(scenario="hover-wind", seed=3)
        def test_hover(flight, faults, assert_flight):
            faults.link(loss=0.2)
            flight.run()
            assert flight.time_s > 60.0
            assert_flight(flight).completes().stays_within(0.5, after_s=5).mode_was("OFFBOARD").never_failsafe()
            assert_flight(flight).rmse_below(x=0.09072, y=0.08675, z=0.124)
    """).assert_outcomes(passed=1)
    assert logs(pytester) == {".gitignore"}


def test_a_failure_tells_its_story_and_keeps_its_logs(run: Run, pytester: pytest.Pytester) -> None:
    result = run(FAILING)
    result.assert_outcomes(failed=1)
    folder = ".mavsitl-logs/test_user.test_motor/flight"
    result.stdout.fnmatch_lines([
        ">       assert_flight(flight).stays_within(0.3)",
        "E       *FlightAssertionError: hover-calm (seed 1): stays within 0.3 m of its reference",
        "E         from 1.?? s on it was not, for 1.?? s in all",
        "E         the most was * m away, at 3.00 s (north *",
        "E         mode        AUTO.LOITER from * s, OFFBOARD from -1.00 s",
        "E         faults      motor 3 off: from 1.00 s on",
        "E         said *Armed by external command",
        "E *1.00 s  Failure injected: motor 3 off",
        f"E         logs        {folder}",
        f"E                     mavsitl log info {folder}/vehicle.ulg",
        "test_user.py:7: FlightAssertionError",
        "*= mavsitl logs =*",
        f"*{folder}",
    ])  # fmt: skip
    assert "checks.py" not in result.stdout.str()
    names = {
        f"test_user.test_motor/flight/{name}" for name in ("vehicle.ulg", "ground.ulg", "link.tlog", "scenario.toml")
    }
    assert logs(pytester) == {".gitignore"} | names
    table = read(pytester.path / folder / "vehicle.ulg")
    assert (table["vehicle_status"]["nav_state"] == MODES["OFFBOARD"].nav_state).any()
    assert table["injected_failure"]["type"].tolist() == [1]
    assert table["vehicle_attitude_groundtruth"]["timestamp"][-1] > 3_000_000
    assert len(read(pytester.path / folder / "ground.ulg")["trajectory_setpoint"]["timestamp"]) > 700


def test_a_plain_assert_has_its_story_in_a_section(run: Run) -> None:
    result = run("""
        def test_height(vehicle):
            vehicle.takeoff(1.0)
            assert vehicle.now.height_m > 5.0
    """)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines([
        "*<State at *: NED (*) m, AUTO.LOITER, armed, in the air>*",
        "*- mavsitl vehicle -*",
        "takeoff-hover (seed 1)",
        "mode        AUTO.LOITER from 0.00 s, AUTO.TAKEOFF from *, AUTO.LOITER from *",
        "said *Armed by external command",
        "logs        .mavsitl-logs/test_user.test_height/vehicle",
    ])  # fmt: skip


@pytest.mark.parametrize(("keep", "kept"), [("failed", {"bad"}), ("all", {"bad", "good"}), ("none", set())])
def test_whose_logs_are_kept(run: Run, pytester: pytest.Pytester, keep: str, kept: set[str]) -> None:
    result = run(
        """
        def test_good(vehicle):
            vehicle.run(0.1)

        def test_bad(vehicle):
            vehicle.run(0.1)
            assert False
        """,
        "--mavsitl-keep", keep, "--mavsitl-logs", "out/flights",
    )  # fmt: skip
    result.assert_outcomes(passed=1, failed=1)
    found = {name.split("/")[0].rpartition("_")[2] for name in logs(pytester, "out/flights") if name != ".gitignore"}
    assert found == kept
    assert ("logs        out/flights" in result.stdout.str()) == (keep != "none")


def test_logs_of_an_earlier_failure_go_when_it_passes(run: Run, pytester: pytest.Pytester) -> None:
    run(FAILING).assert_outcomes(failed=1)
    assert len(logs(pytester)) == 5
    run(FAILING.replace("0.3", "1000.0")).assert_outcomes(passed=1)
    assert logs(pytester) == {".gitignore"}


def test_variants_are_kept_with_their_flight(run: Run, pytester: pytest.Pytester) -> None:
    run("""
        import pytest

        @pytest.mark.mavsitl(scenario="hover-calm", overrides={"duration_s": 0.5})
        def test_seeds(flight):
            for seed in (2, 3):
                flight.variant(seed=seed).run()
            assert False
    """).assert_outcomes(failed=1)
    assert {name.split("/")[1] for name in logs(pytester) if "/" in name} == {"flight", "flight-2", "flight-3"}


@pytest.mark.sockets
def test_two_workers_share_nothing(run: Run, pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        test_user="""
        import pytest
        from mavsitl import ends
        from mavsitl.ask import ListTask
        from mavsitl.link.address import Address

        @pytest.mark.mavsitl(speed=4.0)
        @pytest.mark.parametrize("number", range(6))
        def test_udp(vehicle_udp, number):
            port = vehicle_udp.gcs_own
            reply = ends.ask(ListTask(), Address("udpout", "127.0.0.1", port), system_id=None, patience_s=30.0)
            assert len(reply.parameters) > 100
            assert number % 3

        @pytest.mark.mavsitl(scenario="hover-wind", overrides={"duration_s": 0.5})
        @pytest.mark.parametrize("seed", [1, 1, 2, 2])
        def test_memory(flight, seed):
            print("hash", seed, flight.variant(seed=seed).run().wire_hash)
            assert False
        """
    )
    result = pytester.runpytest_subprocess(*LOADED, "-n", "2")
    result.assert_outcomes(passed=4, failed=6)
    hashes = set(re.findall(r"hash (\d) ([0-9a-f]{32})", result.stdout.str()))
    assert len(hashes) == 2
    folders = {name.split("/")[0] for name in logs(pytester) if "/" in name}
    assert len(folders) == 6
    assert "test_user.test_udp[3]" in folders
    result.stdout.fnmatch_lines(["*= mavsitl logs =*", "*test_user.test_udp[[]0]/vehicle_udp"])


# --- settings


SEEN = """
    def test_seen(scenario, flight):
        print("seen", scenario.name, scenario.scenario.seed, flight.scenario.scenario.duration_s)
"""


def seen(result: pytest.RunResult) -> str:
    result.assert_outcomes(passed=1)
    (line,) = re.findall(r"seen (.*)", result.stdout.str())
    return str(line)


def test_what_a_test_flies_marker_over_command_line_over_configuration(run: Run, pytester: pytest.Pytester) -> None:
    assert seen(run(SEEN, "-s")) == "takeoff-hover 1 30.0"
    pytester.makeini("[pytest]\nmavsitl_scenario = hover-calm\nmavsitl_seed = 5\n")
    assert seen(run(SEEN, "-s")) == "hover-calm 5 60.0"
    assert seen(run(SEEN, "-s", "--mavsitl-scenario", "spiral-calm", "--mavsitl-seed", "7")) == "spiral-calm 7 60.0"
    marked = f"import pytest\n@pytest.mark.mavsitl(scenario='hover-wind', seed=9)\n{SEEN.strip()}"
    assert seen(run(marked, "-s", "--mavsitl-seed", "7")) == "hover-wind 9 60.0"


def test_markers_of_module_class_and_function_come_together(run: Run) -> None:
    text = """
        import pytest

        pytestmark = pytest.mark.mavsitl(scenario="hover-calm", overrides={"duration_s": 7.0, "seed": 2})

        @pytest.mark.mavsitl(overrides={"seed": 3})
        class TestOne:
            @pytest.mark.mavsitl(overrides={"noise.position_m": 0.0})
            def test_seen(self, scenario, flight):
                print("seen", scenario.name, scenario.scenario.seed, flight.scenario.scenario.duration_s)
    """
    assert seen(run(text, "-s")) == "hover-calm 3 7.0"


def test_a_scenario_of_ones_own(run: Run, pytester: pytest.Pytester) -> None:
    (pytester.path / "mine.toml").write_text('title = "mine"\nduration_s = 8.0\n', "utf-8")
    for fixture in ('"mine.toml"', "{'duration_s': 8.0}", "scenario.load('mine.toml')"):
        text = f"""
            import pytest
            from mavsitl import scenario

            @pytest.fixture(name="scenario")
            def my_scenario():
                return {fixture}

            def test_seen(flight):
                print("seen", flight.scenario.scenario.duration_s)
        """
        assert seen(run(text, "-s")) == "8.0"
    marked = f"import pytest\n@pytest.mark.mavsitl(scenario='mine.toml')\n{SEEN.strip()}"
    assert seen(run(marked, "-s")) == "mine 1 8.0"


@pytest.mark.parametrize(
    ("marker", "fixture", "told"),
    [
        (
            "scenario='hover-winnd'",
            "flight",
            "hover-winnd: no such shipped file and not a .toml path; did you mean hover-wind*",
        ),
        ("scenario='no.toml'", "flight", "scenario 'no.toml': no such file: neither *"),
        ("scenario=3", "vehicle", "*scenario=3): allowed: a shipped scenario's name, *"),
        ("scenaro='hover-wind'", "vehicle", f"*scenaro=...): allowed: {', '.join(MARKER)}"),
        ("'hover-wind'", "vehicle", f"*takes names alone: {', '.join(MARKER)}"),
        ("overrides={'noise.position': 1}", "flight", "*noise.position: unknown key; did you mean position_m? *"),
        ("overrides='x'", "flight", "*overrides='x'): allowed: a dict *"),
        ("seed='x'", "flight", "*seed=...): 'x' is not allowed; allowed: a whole number"),
        ("seed=1.5", "flight", "*seed=...): 1.5 is not allowed; allowed: a whole number"),
        ("seed=-2", "flight", "seed: -2 is not allowed; allowed: whole number >= 0"),
        ("speed=0", "vehicle_udp", "*speed=...): 0 is not allowed; *"),
        ("lockstep=1", "vehicle_udp", "*lockstep=1): allowed: True, False"),
        ("port='gsc'", "vehicle", "*port='gsc'): allowed: *"),
        ("seed=1", "faults", "faults: with what? The test has none of vehicle, flight, vehicle_udp"),
        (
            "seed=1",
            "faults, vehicle, flight",
            "faults: with what? The test has vehicle and flight: say e.g. vehicle.faults",
        ),
    ],
)
def test_what_is_wrong_is_told_at_set_up(run: Run, marker: str, fixture: str, told: str) -> None:
    result = run(f"import pytest\n@pytest.mark.mavsitl({marker})\ndef test_it({fixture}): pass\n")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([f"mavsitl: {told}"])
    assert "Traceback" not in result.stdout.str()
    assert "During handling" not in result.stdout.str()


def test_wrong_options_are_told(run: Run, pytester: pytest.Pytester) -> None:
    for options, told in (
        (("--mavsitl-seed", "x"), "*--mavsitl-seed or mavsitl_seed: 'x' is not allowed*"),
        (("-o", "mavsitl_keep=some"), "*mavsitl_keep: 'some' is not allowed; allowed: failed, all, none"),
    ):
        result = run(SEEN, *options)
        result.assert_outcomes(errors=1)
        result.stdout.fnmatch_lines([told])
    result = run(SEEN, "--mavsitl-keep", "some")
    assert result.ret == pytest.ExitCode.USAGE_ERROR


def test_help_names_all_of_it(pytester: pytest.Pytester) -> None:
    told = pytester.runpytest_inprocess(*LOADED, "--help").stdout.str()
    for name, *_ in OPTIONS:
        assert f"--mavsitl-{name}" in told
        assert f"mavsitl_{name}" in told
    marked = pytester.runpytest_inprocess(*LOADED, "--markers").stdout.str()
    assert f"mavsitl({', '.join(f'{name}=...' for name in MARKER)})" in marked
    shown = pytester.runpytest_inprocess(*LOADED, "--fixtures").stdout.str()
    for name in ("scenario", "flight", "vehicle", "vehicle_udp", "faults", "assert_flight"):
        assert re.search(rf"^{name} -- .*plugin", shown, re.MULTILINE), name


def test_folders_are_tests_one_to_one() -> None:
    ids = ["a.py::test", "a.py::test[1]", "a.py::test[a/b]", "a.py::test[a:b]", "a.py::test[a b]"]
    ids += ["x/a.py::TestA::test", f"a.py::test[{300 * 'y'}]", f"a.py::test[{301 * 'y'}]"]
    names = [_folder_name(each) for each in ids]
    assert names[:2] == ["a.test", "a.test[1]"]
    assert names[5] == "x.a.TestA.test"
    assert len(set(names)) == len(ids)
    assert all(len(name) <= 120 and not set(name) & set('/\\:*?"<>| ') for name in names)


# --- where it is not used


def test_a_run_without_vehicles_loads_nothing_and_writes_nothing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        test_user="""
        import sys

        def test_nothing_is_loaded():
            heavy = ("mavsitl", "numpy", "pymavlink", "numba")
            loaded = [name for name in sys.modules if name.partition(".")[0] in heavy]
            assert sorted(loaded) == ["mavsitl", "mavsitl.testing", "mavsitl.testing.plugin"]
        """
    )
    pytester.runpytest_subprocess(*LOADED).assert_outcomes(passed=1)
    assert not (pytester.path / ".mavsitl-logs").exists()


@pytest.mark.skipif(not INSTALLED, reason="the installed mavsitl's metadata has no pytest11 entry point")
def test_without_it_the_names_are_free(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(test_user="def test_it(vehicle): pass\n")
    result = pytester.runpytest_subprocess("-p", "no:mavsitl")
    result.stdout.fnmatch_lines(["*fixture 'vehicle' not found"])


def test_faults_of_a_vehicle_that_outlives_a_test_end_with_the_test(run: Run) -> None:
    run("""
        import pytest
        from mavsitl.testing import Vehicle

        @pytest.fixture(scope="module")
        def vehicle():
            return Vehicle()

        def test_one(vehicle, faults):
            faults.inject("battery", "off")
            faults.link(loss=0.5, at_s=100.0)

        def test_two(vehicle, faults):
            assert not vehicle.core.failures.active
            assert faults.told()[0].endswith("from 0.00 s to 0.00 s")
            assert faults.told()[1].endswith("not begun")
    """).assert_outcomes(passed=2)


def test_a_users_own_fixture_of_the_same_name_wins(run: Run) -> None:
    run("""
        import pytest

        @pytest.fixture
        def vehicle():
            return "a car"

        def test_it(vehicle):
            assert vehicle == "a car"
    """).assert_outcomes(passed=1)


def test_the_package_names_it_and_does_not_need_pytest() -> None:
    root = Path(__file__).parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["entry-points"]["pytest11"] == {"mavsitl": "mavsitl.testing.plugin"}
    assert not [each for each in project["dependencies"] if each.startswith("pytest")]
    program = (
        "import sys, mavsitl.testing as t; t.Flight, t.vehicle, t.assert_flight; assert 'pytest' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
