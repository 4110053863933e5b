"""Fly a short flight in wind and noise and write the bytes of the truth: run with MAVSITL_JIT=0 by test_same_bits."""

from __future__ import annotations

import sys

from tests.autopilot.conftest import Client, attitude_target, flight


def fly(seed: int = 3) -> Client:
    """0.6 s of attitude, then rates: both inner loops, wind and sensor noise."""
    wind = [{"model": "dryden-paper"}]
    scenario = flight(
        wind=wind,
        parameters={"COM_SPOOLUP_TIME": 0.05, "MC_ROLLRATE_I": 0.1, "MC_ROLLRATE_D": 0.001},
        noise__position_m=0.005,
        noise__velocity_m_s=0.005,
        noise__attitude_deg=0.02,
        noise__rate_deg_s=0.1,
    )
    client = Client(scenario, seed=seed)
    client.attitude()
    client.offboard()
    client.arm()
    client.run(0.3, lambda: client.attitude((0.96, 0.28, 0.0, 0.0), 0.8))
    client.run(0.1, lambda: client.send(attitude_target(3, rates=(0.0, 0.0, 0.5), thrust=0.7)))
    client.run(0.2, lambda: client.rates((0.4, -0.3, 0.2), 0.7))
    return client


if __name__ == "__main__":
    sys.stdout.buffer.write(fly().vehicle.simulation.x.tobytes())
