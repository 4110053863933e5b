"""Every compiled law on the same random inputs: ``python -m tests.control.exercise`` prints the outputs' digests."""

from __future__ import annotations

import hashlib
import json
from itertools import product

import numpy as np

from mavsitl.control.allocation import allocate, wrench
from mavsitl.control.arrays import Floats
from mavsitl.control.filters import FirstOrder
from mavsitl.control.mix import Mix
from mavsitl.control.pid import PositionLoop
from mavsitl.control.pidnn import AttitudePid, Derivative, Pidnn
from mavsitl.control.wind_observer import WindObserver, model_acceleration
from mavsitl.scenario import Controller, Learning

N = 2
CALLS = 40
PERIOD_S = 0.004
LIMIT: tuple[float, float, float] = (40.0, 40.0, 3.0)

LEARNING = {
    "guarded": Learning(rate=(100.0, 50.0, 200.0), input_weights="learned"),
    "as printed": Learning(
        rate=(5.0, 5.0, 5.0), guards=False, bound="printed", delta="printed", input_weights="learned"
    ),
    "unbounded": Learning(rate=(1.0, 1.0, 1.0), guards=False, bound="none"),
}


def _unit(quaternion: Floats) -> Floats:
    norm: Floats = np.sqrt((quaternion * quaternion).sum(axis=0))
    return np.divide(quaternion, norm)


def digests() -> dict[str, str]:
    """A digest of every output of each law, by its name."""
    rng = np.random.default_rng(20)
    controller = Controller()
    found: dict[str, str] = {}

    def add(name: str, *arrays: Floats) -> None:
        digest = hashlib.blake2b(digest_size=8)
        digest.update(bytes.fromhex(found.get(name, "")))
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        found[name] = digest.hexdigest()

    position = PositionLoop(controller.altitude, controller.position, 0.723, 9.81, 0.9, 14.2, PERIOD_S, N)
    angle_filter = FirstOrder(controller.angle_filter_rad_s, PERIOD_S, 2, N)
    observer = WindObserver(22.0, 16.5, N)
    mix = Mix((8.678e-3, 8.678e-3, 3.217e-2), 0.31, N)
    modes: tuple[Derivative, ...] = ("rate", "difference")
    pids = {mode: AttitudePid(controller.roll_pitch, controller.yaw, PERIOD_S, mode, LIMIT, N) for mode in modes}
    nets = {
        (mode, name): Pidnn(controller.roll_pitch, controller.yaw, LEARNING[name], PERIOD_S, mode, LIMIT, N)
        for mode, name in product(modes, LEARNING)
    }
    acceleration = np.zeros((3, N))
    for _ in range(CALLS):
        quaternion = _unit(rng.normal(size=(4, N)) * np.array([[3.0], [1.0], [1.0], [1.0]]))
        velocity = rng.normal(size=(3, N))
        wind = rng.normal(size=(3, N))
        yaw = rng.uniform(-4.0, 4.0, N)
        thrust, phi, theta = position.update(
            rng.normal(size=(3, N)), velocity, quaternion, rng.normal(size=(3, N)), wind, acceleration, yaw, wind
        )
        add("position", thrust, phi, theta, position.integral_m_s)
        add("filter", angle_filter.update(np.stack((phi, theta))), angle_filter.rate)
        add("model", model_acceleration(quaternion, thrust, 0.723, 9.81, acceleration))
        add("observer", observer.update(velocity, acceleration, PERIOD_S))
        angles = rng.normal(size=(3, N)) * 0.2
        angles[2] = rng.uniform(-4.0, 4.0, N)
        rates = rng.normal(size=(3, N))
        desired = rng.normal(size=(3, N)) * 0.2
        desired_rates = rng.normal(size=(3, N))
        for mode, pid in pids.items():
            add(f"pid {mode}", pid.update(angles, rates, desired, desired_rates))
        for key, net in nets.items():
            out = net.update(angles, rates, desired, desired_rates)
            add(f"net {key}", out, net.weights, net.input_weights, net.hidden)
        add("mix", mix.update(rates), mix.u)
        u1, x, y, z = (float(v) for v in rng.normal(size=4) * np.array([10.0, 1.0, 1.0, 0.2]))
        s_1, s_2, s_3, s_4, bits = allocate(u1, x, y, z, 5.324e-5, 8.721e-7, 0.31, 258.0)
        back = wrench(s_1, s_2, s_3, s_4, 5.324e-5, 8.721e-7, 0.31)
        add("allocation", np.array([s_1, s_2, s_3, s_4, bits, *back]))
    return found


if __name__ == "__main__":
    print(json.dumps(digests()))
