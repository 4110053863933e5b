"""What a process does for its own start, memory and place in the system's queue."""

from __future__ import annotations

import ctypes
import gc
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from mavsitl import cli, process, realtime
from mavsitl.cli.common import EXIT_FAILED, EXIT_USAGE
from mavsitl.realtime import RealTimeError, Wish

linux = pytest.mark.skipif(sys.platform != "linux", reason="Linux's own")


def run(program: str) -> str:
    """What it prints, in an interpreter of its own: here everything may have been imported."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300.0, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


NEVER = "scipy", "matplotlib", "rich", "jinja2", "pyulog", "multiprocessing", "numpy.f2py", "numpy.testing"


@pytest.mark.parametrize(("end", "wing"), [("vehicle", "mavsitl.vehicle"), ("ground", "mavsitl.ground")])
def test_a_process_that_flies_never_loads_what_only_reports_need(end: str, wing: str) -> None:
    options = "seed=1, lockstep=True" if end == "vehicle" else "report=print"
    said = run(
        "import sys\n"
        "from mavsitl import cli, ends, scenario, wings\n"
        f"core = wings.find({wing!r})(scenario.load('hover-wind', {{}}), ends.NullRecorder(), {options})\n"
        "core.step(0)\n"
        "assert 'numba' in sys.modules\n"
        f"print(*sorted(set({NEVER!r}) & set(sys.modules)))"
    )
    assert said == ""


@pytest.mark.sockets
def test_the_first_word_is_said_before_anything_heavy_is_loaded() -> None:
    """By the command itself, up to the first datagram that it sends."""
    said = run(
        "import sys, os\n"
        "from mavsitl import cli\n"
        "from mavsitl.link.udp import UdpLink\n"
        "def send(link, datagram):\n"
        "    heavy = {'numpy', 'numba', 'llvmlite', 'ctypes', 'pyulog', *NEVER} & set(sys.modules)\n"
        "    print('heavy:', *sorted(heavy), flush=True)\n"
        "    os._exit(0)\n"
        "UdpLink.send = send\n"
        f"NEVER = {NEVER!r}\n"
        "cli.main(['vehicle', '--no-state', '--offboard-port', '0', '--gcs-port', '0', '--status', 'json'])"
    )
    assert said.splitlines()[-1] == "heavy:"


def test_scipy_comes_when_a_kernel_multiplies_matrices() -> None:
    said = run(
        "import sys, numpy as np, mavsitl.compiled, numba\n"
        "print('scipy' in sys.modules)\n"
        "print(numba.njit(lambda a, b: a @ b)(np.full((2, 2), 2.0), np.ones(2)).tolist())\n"
        "print('scipy.linalg' in sys.modules)"
    )
    assert said.splitlines() == ["False", "[4.0, 4.0]", "True"]


def test_numba_meets_the_scipy_that_was_there_before_it() -> None:
    said = run("import sys, scipy\nimport mavsitl.compiled\nprint(sys.modules['scipy'] is scipy)")
    assert said == "True"


def test_one_blas_thread_unless_the_user_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "8")
    process.one_blas_thread()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "8"
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    process.one_blas_thread()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"


def test_garbage_is_collected_in_flight_and_what_was_loaded_is_passed_over() -> None:
    with process.starting():
        assert not gc.isenabled()
        with process.flying():
            assert gc.isenabled()
            assert gc.get_freeze_count() > 0
        assert gc.get_freeze_count() == 0
    assert gc.isenabled()


def test_garbage_is_collected_again_after_a_start_that_failed() -> None:
    def fails() -> None:
        with process.starting():
            raise RealTimeError("no")

    with pytest.raises(RealTimeError):
        fails()
    assert gc.isenabled()


@linux
def test_the_compilers_pages_go_and_come_back() -> None:
    said = run(
        "import re, mavsitl.compiled, numba\n"
        "from mavsitl import process\n"
        "def text_kb():\n"
        "    found = re.search(r'r-xp [^\\n]*libllvmlite.*?Rss: +(\\d+)', open('/proc/self/smaps').read(), re.DOTALL)\n"
        "    return int(found[1])\n"
        "numba.njit(lambda x: x + 1)(1)\n"
        "before = text_kb()\n"
        "with process.flying():\n"
        "    after = text_kb()\n"
        "    print(after < before / 10, numba.njit(lambda x: x * 2)(21))"
    )
    assert said == "True 42"


@linux
def test_sleeps_end_when_they_are_due() -> None:
    def slack_ns() -> tuple[int, int]:
        set_to, get = 29, 30
        prctl = ctypes.CDLL(None).prctl
        prctl(set_to, 50_000, 0, 0, 0)  # a thread begins with its maker's, which another test may have made fine
        before = prctl(get, 0, 0, 0, 0)
        realtime.fine_timers()
        return before, prctl(get, 0, 0, 0, 0)

    with ThreadPoolExecutor(1) as pool:  # it is a setting of the thread
        before, after = pool.submit(slack_ns).result()
    assert after == 1
    assert before > after


class System:
    """What the system was asked for. `allows`: whatever; else nothing."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, allows: bool) -> None:
        self.calls: list[Any] = []
        self._allows = allows
        monkeypatch.setattr(os, "sched_setscheduler", self._set_scheduler)
        monkeypatch.setattr(os, "setpriority", lambda which, who, nice: self.calls.append(("nice", nice)))
        monkeypatch.setattr(os, "getpriority", lambda which, who: 0)
        monkeypatch.setattr(realtime, "_may_lock", lambda: allows)
        monkeypatch.setattr(realtime, "_libc", lambda: self)
        self.nice_limit = 0
        monkeypatch.setattr("resource.getrlimit", lambda which: (self.nice_limit, 40))

    def _set_scheduler(self, pid: int, policy: int, parameter: Any) -> None:
        if not self._allows:
            raise PermissionError
        self.calls.append((policy & ~os.SCHED_RESET_ON_FORK, parameter.sched_priority))
        assert policy & os.SCHED_RESET_ON_FORK

    def mlockall(self, flags: int) -> int:
        self.calls.append(("lock", flags))
        return 0

    def munlockall(self) -> int:
        self.calls.append("unlock")
        return 0


@linux
def test_what_is_allowed_is_taken_and_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(monkeypatch, allows=True)
    said: list[str] = []
    realtime.check(Wish.DEMANDED)
    system.calls.clear()  # it tried and undid
    with realtime.claim(Wish.DEMANDED, said.append):
        assert system.calls == [(os.SCHED_FIFO, realtime.PRIORITY), ("lock", 7)]
    assert system.calls[2:] == [(os.SCHED_OTHER, 0), "unlock"]
    assert said == []


@linux
def test_what_is_demanded_and_not_allowed_is_an_error_that_says_how_to_allow_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    System(monkeypatch, allows=False)
    for ask in (realtime.check, lambda wish: realtime.claim(wish, print).__enter__()):
        with pytest.raises(RealTimeError, match=r"rtprio.*memlock.*--best-effort"):
            ask(Wish.DEMANDED)


@linux
def test_best_effort_goes_on_with_the_best_ordinary_priority_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(monkeypatch, allows=False)
    system.nice_limit = 31
    said: list[str] = []
    realtime.check(Wish.BEST_EFFORT)
    with realtime.claim(Wish.BEST_EFFORT, said.append):
        assert system.calls == [("nice", -11)]
    assert system.calls == [("nice", -11), ("nice", 0)]
    assert len(said) == 2


@linux
def test_nothing_is_asked_for_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(monkeypatch, allows=False)
    realtime.check(Wish.ORDINARY)
    with realtime.claim(Wish.ORDINARY, print):
        assert system.calls == []


@pytest.mark.parametrize(
    ("arguments", "blamed"),
    [
        (["vehicle", "--best-effort"], "--best-effort: only with --realtime"),
        (["vehicle", "--realtime", "--speed", "2"], "--realtime: not with --speed 2"),
        (["vehicle", "--realtime", "--lockstep"], "--realtime: not with --lockstep"),
        (["ground", "--best-effort"], "--best-effort: only with --realtime"),
        (["ground", "--realtime", "--lockstep"], "--realtime: not with --lockstep"),
    ],
)
def test_options_that_do_not_go_together(arguments: list[str], blamed: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == EXIT_USAGE
    assert blamed in capsys.readouterr().err


@linux
@pytest.mark.parametrize("arguments", [["vehicle", "--no-state"], ["ground"]], ids=["vehicle", "ground"])
def test_an_end_that_may_not_says_so_before_it_opens_a_port(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    System(monkeypatch, allows=False)
    monkeypatch.setattr("mavsitl.ends.UdpLink", None)
    monkeypatch.setattr("mavsitl.ends.open_link", None)
    assert cli.main([*arguments, "--realtime"]) == EXIT_FAILED
    assert "LimitRTPRIO=20" in capsys.readouterr().err
