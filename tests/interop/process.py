"""Programs that are clients, each in a process of its own, which is ended by its id."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from mavsitl.clock import monotonic_us
from tests.interop.conftest import PATIENCE_S, await_end


class Program:
    """A program at whose prompt we type and whose output we read."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self._process = process
        self._stdin: IO[bytes] = process.stdin
        self._stdout: IO[bytes] = process.stdout
        self._printed = ""
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def printed(self) -> str:
        """All that it has printed so far."""
        with self._news:
            return self._printed

    def type(self, line: str) -> int:
        """Enter a line; how much had been printed before, for `wait`."""
        mark = len(self.printed)
        self._stdin.write(f"{line}\n".encode())
        self._stdin.flush()
        return mark

    def wait(self, pattern: str, since: int = 0, limit_s: float = PATIENCE_S) -> re.Match[str]:
        """The first match of a regular expression (. is any character but a line's end) in what was printed."""
        until_us = monotonic_us() + round(limit_s * 1e6)
        with self._news:
            while True:
                match = re.compile(pattern, re.MULTILINE).search(self._printed, since)
                if match is not None:
                    return match
                left_us = until_us - monotonic_us()
                said = self._printed[since:]
                assert left_us > 0, f"waited {limit_s:g} s for {pattern!r}; since then it has printed:\n{said}"
                assert self._process.poll() is None, f"it ended before {pattern!r}; since then it has printed:\n{said}"
                self._news.wait(min(left_us / 1e6, 1.0))

    def do(self, line: str, *patterns: str, limit_s: float = PATIENCE_S) -> list[re.Match[str]]:
        """Enter a line and wait for all of `patterns`, in whatever order they come."""
        mark = self.type(line)
        return [self.wait(pattern, mark, limit_s) for pattern in patterns]

    def end(self) -> int:
        """Close its input, which most programs take for a farewell; the exit code."""
        self._stdin.close()
        try:
            return await_end(self._process)
        finally:
            self._reader.join()
            self._stdout.close()

    def _read(self) -> None:
        while chunk := os.read(self._stdout.fileno(), 65536):
            with self._news:
                self._printed += chunk.decode(errors="replace")
                self._news.notify_all()


@contextmanager
def mavproxy(master: str, folder: Path) -> Iterator[Program]:
    """MAVProxy without windows at an endpoint; its settings, logs and downloads are kept in `folder`."""
    program = Program(
        subprocess.Popen(
            [sys.executable, "-m", "MAVProxy.mavproxy", f"--master={master}", f"--state-basedir={folder}"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder,
            env=os.environ | {"HOME": str(folder), "PYTHONUNBUFFERED": "1", "TERM": "dumb"},
        )
    )  # fmt: skip
    try:
        yield program
    except BaseException as error:
        error.add_note(f"MAVProxy:\n{program.printed}")
        raise
    finally:
        program.end()  # MAVProxy's exit code is 1 whenever its input ends


@contextmanager
def server(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A program without a prompt; what it prints goes to `log`."""
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)
        try:
            yield process
            assert process.poll() is None, f"{command[0]} ended by itself with {process.returncode}"
        except BaseException as error:
            error.add_note(f"{command[0]}:\n{log.read_text('utf-8', errors='replace')[-10_000:]}")
            raise
        finally:
            process.terminate()
            await_end(process)
