"""The attitude law changed in flight, PID to PIDNN and back, so that the demand does not jump.

A PIDNN begins as the identical PID (eqs 39, 42), with the PID's sum: the demand goes on bit for bit. A PID that follows
nets which have learned has other gains than they; its sum is made such that it demands what they demanded last.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from mavsitl.control.arrays import Record

__all__ = ["Law", "carry_over"]

Law = Literal["pid", "pidnn"]


def carry_over(before: Record, after: Record) -> None:
    """Let the memory of a controller with the other law, at rest, go on from where `before` is.

    Both are as the controller of one flight makes them: all but the law's own record is the same in both.
    """
    names = before.dtype.names or ()
    for name in names:
        if name != "law":
            after[name] = before[name]
    old, new = before["law"][0], after["law"][0]
    new["out"] = old["out"]
    if "weights" in (new.dtype.names or ()):
        _to_nets(old, new)
    else:
        _to_pid(old, new)


def _to_nets(old: Any, new: Any) -> None:
    """Memories: of a PID the sum, the last error, and whether there was one; of a net o_2, u_3, x_2, the demand and
    whether there was one. Where x_2 is needed (delta `sign`) nothing is learned from the first period.
    """
    total, error, started = old["memory"]
    new["memory"][0] = total
    new["memory"][1] = error
    new["memory"][2] = np.nan
    new["memory"][3] = old["out"]
    new["memory"][4] = started


def _to_pid(old: Any, new: Any) -> None:
    u_1, _, o_3 = old["hidden"]
    proportional, integral, derivative = new["gains"][:, :, np.newaxis]
    rest = old["out"] - proportional * u_1 - derivative * o_3
    total = old["memory"][0]
    new["memory"][0] = np.divide(rest, integral, out=total.copy(), where=integral != 0.0)
    new["memory"][1] = old["memory"][1]
    new["memory"][2] = old["memory"][4]
