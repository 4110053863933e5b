"""Lock-step beside a plain pymavlink + numpy loop in the same run: ``python -m tests.bench.bench_lockstep``.

Rows: two processes over UDP with logs, on one core as `mavsitl fly` runs them, and wherever the system puts them; the
same flight in one process; and the rival, two processes as one writes them with mavutil and numpy alone. The rows take
turns, so that load meets all alike.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
import numpy.typing as npt

from mavsitl import ends, pair, scenario
from mavsitl.airframes import Airframe

Array = npt.NDArray[np.float64]

SCENARIO = "hover-wind"
RIVAL = "pymavlink + numpy, two processes over UDP"
TICK_S = 0.004
SUBSTEPS = 4
"""The rival's exchange and its physics: those of the shipped rates, 250 Hz and 1 kHz."""


@contextmanager
def one_core() -> Iterator[None]:
    """This process and those it starts meanwhile, on one core. Linux only."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def fly_pair(duration_s: float) -> float:
    """As `mavsitl fly`: two processes with logs, on one core where the system lets one choose. Times real time."""
    with tempfile.TemporaryDirectory() as folder:
        result = pair.fly(SCENARIO, [f"duration_s={duration_s}"], Path(folder), lambda end, event: None)
    return float(result.vehicle["speed"])


def fly_unpinned(duration_s: float) -> float:
    """The same two processes, on the cores that the system gives them: times real time."""
    vehicle_port, ground_port = pair.free_ports(2)
    here, there = f"127.0.0.1:{vehicle_port}", f"127.0.0.1:{ground_port}"
    with tempfile.TemporaryDirectory() as folder:
        common = ["--lockstep", "--run-dir", folder, "--status", "json", "--set", f"duration_s={duration_s}"]
        mavsitl = [sys.executable, "-m", "mavsitl"]
        ground = [*mavsitl, "ground", SCENARIO, *common, "--link", f"udpin:{there}", "--vehicle", here]
        vehicle = [
            *mavsitl, "vehicle", SCENARIO, *common, "--offboard-port", str(vehicle_port), "--offboard-remote", there,
        ]  # fmt: skip
        with subprocess.Popen(ground, stdout=subprocess.DEVNULL) as other:
            try:
                said = subprocess.run(vehicle, stdout=subprocess.PIPE, check=True, timeout=600.0).stdout
                other.wait(timeout=30.0)
            finally:
                if other.poll() is None:
                    other.terminate()
    return float(json.loads(said.splitlines()[-1])["speed"])


def fly_memory(duration_s: float) -> float:
    """One process with logs: times real time."""
    flight = scenario.load(SCENARIO, {"duration_s": duration_s})
    with tempfile.TemporaryDirectory() as folder:
        return ends.in_memory(flight, Path(folder), report=lambda text: None, progress=None).speed


def fly_rival(duration_s: float) -> float:
    """The rival's two processes: times real time, by its vehicle, from the first answer to the last. It must hover."""
    (port,) = pair.free_ports(1)
    command = [sys.executable, "-m", "tests.bench.bench_lockstep", "--duration", str(duration_s), "--port", str(port)]
    environment = os.environ | {"MAVLINK20": "1"}
    with subprocess.Popen([*command, "--end", "ground"], env=environment) as ground:
        try:
            vehicle = subprocess.run(
                [*command, "--end", "vehicle"], env=environment, capture_output=True, check=False, timeout=600.0
            )
        finally:
            ground.terminate()
    if vehicle.returncode:
        raise RuntimeError(f"the rival's vehicle failed: {vehicle.stderr.decode(errors='replace')}")
    speed, error_m = map(float, vehicle.stdout.split())
    if not error_m < 0.1:
        raise RuntimeError(f"the rival did not hover: {error_m:g} m off at the end")
    return speed


def _derivative(
    x: Array, thrust_n: float, torque_n_m: Array, mass_kg: float, gravity_m_s2: float, inertia: Array
) -> Array:
    """13 states: position, velocity (NED), quaternion, body rates (FRD)."""
    w, i, j, k = x[6:10]
    rotation = np.array([
        [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
        [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
        [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
    ])  # fmt: skip
    p, q, r = omega = x[10:13]
    rate = 0.5 * np.array([
        -i * p - j * q - k * r, w * p + j * r - k * q, w * q - i * r + k * p, w * r + i * q - j * p,
    ])  # fmt: skip
    acceleration = rotation @ np.array([0.0, 0.0, -thrust_n / mass_kg]) + np.array([0.0, 0.0, gravity_m_s2])
    spin = (torque_n_m - np.cross(omega, inertia * omega)) / inertia
    return np.concatenate([x[3:6], acceleration, rate, spin])


def rival_vehicle(port: int, duration_s: float, airframe: Airframe) -> tuple[float, float]:
    """Plant and attitude loop: ODOMETRY out, SET_ATTITUDE_TARGET in. Times real time, and metres off at the end."""
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=1, source_component=1)
    inertia = np.array(airframe.inertia_kg_m2)
    x = np.zeros(13)
    x[2], x[6] = -1.0, 1.0
    step_s = TICK_S / SUBSTEPS
    ticks = round(duration_s / TICK_S)
    started = 0.0
    for tick in range(ticks):
        message = None
        while message is None:
            link.mav.odometry_send(
                tick * 4000, mavutil.mavlink.MAV_FRAME_LOCAL_NED, mavutil.mavlink.MAV_FRAME_BODY_FRD,
                *x[0:3], list(x[6:10]), *x[3:6], *x[10:13], [0.0] * 21, [0.0] * 21,
            )  # fmt: skip
            message = link.recv_match(type="SET_ATTITUDE_TARGET", blocking=True, timeout=1.0)
        if not tick:
            started = perf_counter()
        wanted = np.array(message.q)
        w, v = x[6], x[7:10]
        # Vector part of conj(q) * wanted: half the rotation vector to go, in the body frame.
        error = w * wanted[1:] - wanted[0] * v - np.cross(v, wanted[1:])
        torque = inertia * (400.0 * 2.0 * error - 40.0 * x[10:13])
        thrust = message.thrust * airframe.max_thrust_n
        plant = (thrust, torque, airframe.mass_kg, airframe.gravity_m_s2, inertia)
        for _ in range(SUBSTEPS):
            k1 = _derivative(x, *plant)
            k2 = _derivative(x + 0.5 * step_s * k1, *plant)
            k3 = _derivative(x + 0.5 * step_s * k2, *plant)
            k4 = _derivative(x + step_s * k3, *plant)
            x = x + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            x[6:10] /= np.linalg.norm(x[6:10])
    wall_s = perf_counter() - started
    return (ticks - 1) * TICK_S / wall_s, float(np.linalg.norm(x[0:3] - np.array([0.0, 0.0, -1.0])))


def rival_ground(port: int, airframe: Airframe) -> None:
    """Position PID; answers each ODOMETRY, until it is ended."""
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=250, source_component=191)
    wanted = np.array([0.0, 0.0, -1.0])
    integral = np.zeros(3)
    while True:
        message = link.recv_match(type="ODOMETRY", blocking=True)
        position = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        error = wanted - position
        integral += error * TICK_S
        acceleration = 6.0 * error + 1.0 * integral - 4.5 * velocity
        roll = acceleration[1] / airframe.gravity_m_s2
        pitch = -acceleration[0] / airframe.gravity_m_s2
        cr, sr, cp, sp = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
        thrust = airframe.mass_kg * (airframe.gravity_m_s2 - acceleration[2]) / airframe.max_thrust_n
        link.mav.set_attitude_target_send(
            message.time_usec // 1000,
            1,
            1,
            7,
            [cr * cp, sr * cp, cr * sp, -sr * sp],
            0.0,
            0.0,
            0.0,
            np.clip(thrust, 0.0, 1.0),
        )


def measure(duration_s: float, rival_duration_s: float, repeats: int) -> dict[str, list[float]]:
    """Row name to times real time, a value a round."""

    def pinned(run: Callable[[float], float]) -> Callable[[float], float]:
        def on_one_core(seconds: float) -> float:
            with one_core():
                return run(seconds)

        return on_one_core

    rows: dict[str, tuple[Callable[[float], float], float]] = {
        "mavsitl, two processes over UDP, as shipped": (fly_pair, duration_s),
        "mavsitl, two processes over UDP, unpinned": (fly_unpinned, duration_s),
        "mavsitl, one process, in memory": (fly_memory, duration_s),
        RIVAL: (fly_rival, rival_duration_s),
    }
    if hasattr(os, "sched_setaffinity"):
        rows[f"{RIVAL}, one core"] = (pinned(fly_rival), rival_duration_s)
    fly_memory(1.0)  # compiles, or loads what was compiled
    found: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(repeats):
        for name, (run, seconds) in rows.items():
            found[name].append(run(seconds))
    return found


def lines(found: dict[str, list[float]]) -> list[str]:
    """The table: median and range of times real time, and the ratio of medians to the rival's."""
    base = median(found[RIVAL])
    width = max(map(len, found))
    made = [f"{'times real time':{width}}  median     min     max  ratio to the rival"]
    for name, values in found.items():
        middle = median(values)
        made.append(f"{name:{width}}{middle:8.1f}{min(values):8.1f}{max(values):8.1f}{middle / base:8.1f}")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.bench_lockstep", description="Times real time in lock-step."
    )
    parser.add_argument("--duration", type=float, default=60.0, metavar="S", help="flight time (default: 60)")
    parser.add_argument("--rival-duration", type=float, default=20.0, metavar="S", help="the rival's (default: 20)")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="rounds (default: 3)")
    parser.add_argument("--end", choices=("vehicle", "ground"), help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    airframe = scenario.load(SCENARIO).airframe
    if options.end == "ground":
        rival_ground(options.port, airframe)
    elif options.end == "vehicle":
        speed, error_m = rival_vehicle(options.port, options.duration, airframe)
        print(speed, error_m)
    else:
        print("\n".join(lines(measure(options.duration, options.rival_duration, options.repeats))))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
