"""Nothing is compiled once the clock runs: on a fresh installation that would stop a flying vehicle for seconds."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import gc
from numba.core.dispatcher import Dispatcher
from mavsitl.dialect import mavlink
from tests.autopilot.conftest import Client, flight

def compiled():
    return {each.py_func.__qualname__ for each in gc.get_objects() if isinstance(each, Dispatcher) and each.signatures}

client = Client(flight())
before = compiled()
assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF) == client.arm() == 0
client.run(5.0)
assert client.truth[2] > 1.0
client.offboard()
client.run(1.0, client.attitude)
assert client.vehicle.autopilot.wind is not None
client.land()
client.run_until(lambda: not client.armed, 30.0)
print(len(before), sorted(compiled() - before))
"""


def test_no_kernel_meets_its_first_call_in_flight() -> None:
    """In a process of its own: here others may have flown before."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    number, _, late = done.stdout.strip().partition(" ")
    assert done.returncode == 0, done.stderr
    assert int(number) > 0
    assert late == "[]"
