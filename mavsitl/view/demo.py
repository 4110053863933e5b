"""`mavsitl view --demo`: a vehicle and a ground as processes of their own, which end with the page's server."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

from mavsitl.link.udp import LOOPBACK
from mavsitl.pair import PairError, free_ports

__all__ = ["Demo"]

END_STEPS = 10
"""A process that is told to end and has not in so many steps, seconds that is, is killed."""


class Demo:
    """The two processes, on free ports. One flight after the other: when the ground has ended, both begin anew.

    Attributes:
        gcs_ports: of the vehicles' links for ground stations.
        monitor_port: where the ground tells what it knows.
    """

    def __init__(
        self, scenario: str, settings: Sequence[str], *, count: int | None = None, run_dir: Path | None = None,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:  # fmt: skip
        """`settings` are ``--set`` arguments of both; `count`: a formation of so many."""
        vehicle_port, ground_port, gcs_port, unheard_port, self.monitor_port = free_ports(5)
        self.gcs_port = gcs_port
        common = [scenario, *(f"--set={setting}" for setting in settings)]
        if count is not None:
            common += ["--count", str(count), "--one-link"]
        if run_dir is not None:
            common += ["--run-dir", str(run_dir)]
        self._commands = {
            "vehicle": [
                "vehicle", *common, "--no-state",
                "--offboard-port", str(vehicle_port), "--offboard-remote", f"{LOOPBACK}:{ground_port}",
                "--gcs-port", str(gcs_port), "--gcs-remote", f"{LOOPBACK}:{unheard_port}",
            ],
            "ground": [
                "ground", *common, "--link", f"udpin:{LOOPBACK}:{ground_port}",
                "--monitor", f"udpout:{LOOPBACK}:{self.monitor_port}",
            ],
        }  # fmt: skip
        self._report = report
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._said: dict[str, IO[bytes]] = {}
        self._ending = 0
        """Steps that are left to those which were told to end; 0: none was."""

    def start(self) -> None:
        for end, arguments in self._commands.items():
            said = self._said[end] = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the process
            self._processes[end] = subprocess.Popen(
                [sys.executable, "-m", "mavsitl", *arguments],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said,
            )  # fmt: skip

    def step(self) -> None:
        """Look after them, without a wait. Raises `PairError` with the words of one that failed."""
        ended = [end for end, process in self._processes.items() if process.poll() is not None]
        for end in ended:
            words = self._words(end)
            if words:
                raise PairError(f"{end}: {words}")
        if len(ended) == len(self._processes):
            self._forget()
            self.start()
        elif ended and not self._ending:
            self._report(f"the {' and the '.join(ended)} ended: both begin anew")
            self._ending = END_STEPS
            for process in self._processes.values():
                process.terminate()
        elif self._ending:
            self._ending -= 1
            if not self._ending:
                for process in self._processes.values():
                    process.kill()

    def close(self) -> None:
        """End both; a second call does nothing."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(END_STEPS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._forget()

    def _forget(self) -> None:
        """Those that have ended."""
        for said in self._said.values():
            said.close()
        self._said.clear()
        self._processes.clear()
        self._ending = 0

    def _words(self, end: str) -> str:
        said = self._said[end]
        said.seek(0)
        return said.read().decode(errors="replace").strip()
