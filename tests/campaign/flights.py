"""Short flights, and tasks for workers: a module's functions, as other processes load them by name."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import msgspec

from mavsitl import scenario
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Case, case

SHORT: dict[str, Any] = {"duration_s": 2.0}


def short(name: str, seed: int, **labels: Any) -> Case:
    return case(scenario.load(name, SHORT), seed, labels)


def measured(row: Row) -> Row:
    """What does not depend on how busy the machine was."""
    return msgspec.structs.replace(row, cpu_s=0.0)


def square(number: int) -> int:
    return number * number


def refuse(number: int) -> int:
    raise ArithmeticError(f"not {number}")


def die_on_3(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_told(number: int) -> str:
    """Never tells."""
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def die_once(file: str) -> str:
    """Kills its process where the file is still there."""
    if Path(file).exists():
        Path(file).unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def one_thread(number: int) -> str:
    return os.environ["OPENBLAS_NUM_THREADS"]
