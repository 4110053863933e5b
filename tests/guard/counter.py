"""Counts the bytecode instructions that a piece of Python executes, by function: the same number in every run.

A busy machine, a cold cache and another clock change nothing. What C and compiled kernels do inside a call is not seen;
that they are called is.
"""

from __future__ import annotations

import gc
import sys
import sysconfig
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path, PurePath
from threading import get_ident
from types import CodeType, FrameType
from typing import Any

PACKAGES = ("mavsitl", "mavsitl_vehicle", "mavsitl_ground")
OURS = str(Path(__file__).parent)
_STANDARD_LIBRARY = sysconfig.get_path("stdlib")


@cache
def name_of(code: CodeType) -> str | None:
    """`module:function` of one of the project's packages, or the name of another package; None for the guard's own."""
    file = code.co_filename
    if file.startswith(OURS):
        return None
    if file.startswith("<mavsitl.codec "):  # generated, and named after the message
        return f"mavsitl.codec:{code.co_name}"
    parts = PurePath(file).with_suffix("").parts
    for place in range(len(parts) - 1, -1, -1):
        if parts[place] in PACKAGES:
            return f"{'.'.join(parts[place:])}:{code.co_qualname}"
        if parts[place] == "site-packages":
            return parts[place + 1]
    return "python" if file.startswith((_STANDARD_LIBRARY, "<")) else "others"


class InstructionCounter:
    """Counts inside its `with`, for the side that `into` named last; one at a time, in the thread that began it.

    Garbage is not collected meanwhile: when that happens depends on what else is in the process.
    """

    def __init__(self) -> None:
        self._found: defaultdict[str, defaultdict[CodeType, int]] = defaultdict(partial(defaultdict, int))
        self.into("")

    def into(self, side: str) -> None:
        """What is executed from now on is counted for `side`."""
        self._into = self._found[side]

    def counts(self, side: str) -> Counter[str]:
        """By function, what is not the guard's own."""
        named: Counter[str] = Counter()
        for code, count in self._found[side].items():
            name = name_of(code)
            if name is not None:
                named[name] += count
        return named

    def __enter__(self) -> InstructionCounter:
        self._collecting = gc.isenabled()
        gc.disable()
        self._start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop()
        if self._collecting:
            gc.enable()

    if sys.version_info >= (3, 12):

        def _start(self) -> None:
            monitoring, thread = sys.monitoring, get_ident()

            def instruction(code: CodeType, offset: int) -> None:
                if get_ident() == thread:
                    self._into[code] += 1

            free = [tool for tool in range(6) if monitoring.get_tool(tool) is None]
            self._tool = free[-1]
            monitoring.use_tool_id(self._tool, "mavsitl guard")
            monitoring.register_callback(self._tool, monitoring.events.INSTRUCTION, instruction)
            monitoring.set_events(self._tool, monitoring.events.INSTRUCTION)

        def _stop(self) -> None:
            sys.monitoring.set_events(self._tool, 0)
            sys.monitoring.register_callback(self._tool, sys.monitoring.events.INSTRUCTION, None)
            sys.monitoring.free_tool_id(self._tool)

    else:

        def _start(self) -> None:
            def local(frame: FrameType, event: str, argument: Any) -> Callable[..., Any]:
                if event == "opcode":
                    self._into[frame.f_code] += 1
                return local

            def begin(frame: FrameType, event: str, argument: Any) -> Callable[..., Any]:
                frame.f_trace_opcodes, frame.f_trace_lines = True, False
                return local

            self._before = sys.gettrace()
            self._callers: list[tuple[FrameType, Any, bool, bool]] = []
            # What called us goes on, too, and is not begun again.
            caller: FrameType | None = sys._getframe(1)
            while caller is not None:
                name = name_of(caller.f_code)
                if name is not None and name.startswith(PACKAGES):
                    self._callers.append((caller, caller.f_trace, caller.f_trace_opcodes, caller.f_trace_lines))
                    caller.f_trace, caller.f_trace_opcodes, caller.f_trace_lines = local, True, False
                caller = caller.f_back
            sys.settrace(begin)

        def _stop(self) -> None:
            sys.settrace(self._before)
            for caller, *before in self._callers:
                caller.f_trace, caller.f_trace_opcodes, caller.f_trace_lines = before
