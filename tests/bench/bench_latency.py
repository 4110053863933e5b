"""How soon a vehicle in real time answers, and what it costs: ``python -m tests.bench.bench_latency``. Linux only.

A client in this process asks over UDP on loopback, one question at a time and at random instants of the control
period, and reads until the answer is there; default streams run on both links. The vehicle stands on the ground with
its rotors turning, so that setpoints take effect. Then the share of a core that an undisturbed vehicle takes.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable
from statistics import median
from time import perf_counter, sleep
from typing import Any

from mavsitl.dialect import mavlink
from tests.bench.live import Live, live

CONTROL_PERIOD_US = 4000
GAP_S = (0.004, 0.012)
"""Between an answer and the next question: 1 to 3 control periods, so that questions come at every phase of one."""
SPOOL_UP_S = 2.0
SETTLE_S = 8.0
"""Take-off and the first seconds after start are over."""
PARAMETER = b"MIS_TAKEOFF_ALT"

Question = Callable[[int], Any]
Answer = Callable[[int, Any], bool]


def thrust(index: int) -> float:
    """Of the setpoint with that number; too little to lift off, and no two within 256 alike."""
    return 0.05 + (index & 0xFF) / 4096.0


def attitude(index: int) -> Any:
    return mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, thrust(index))


def command(index: int) -> Any:
    return mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 0, 30, 0, 0, 0, 0, 0, 0)


ROWS: dict[str, tuple[Question, Answer]] = {
    "SET_ATTITUDE_TARGET to ATTITUDE_TARGET": (
        attitude,
        lambda index, m: m.get_type() == "ATTITUDE_TARGET" and abs(m.thrust - thrust(index)) < 1e-5,
    ),
    "COMMAND_LONG to COMMAND_ACK": (command, lambda index, m: m.get_type() == "COMMAND_ACK"),
    "TIMESYNC to TIMESYNC": (
        lambda index: mavlink.MAVLink_timesync_message(0, index + 1),
        lambda index, m: m.get_type() == "TIMESYNC" and m.tc1 != 0 and m.ts1 == index + 1,
    ),
    "PARAM_REQUEST_READ to PARAM_VALUE": (
        lambda index: mavlink.MAVLink_param_request_read_message(1, 1, PARAMETER, -1),
        lambda index, m: m.get_type() == "PARAM_VALUE" and m.param_id.encode() == PARAMETER,
    ),
}


def spin_up(vehicle: Live) -> None:
    """Armed in OFFBOARD, rotors turning, on the ground; ATTITUDE_TARGET at the control rate."""
    never = mavlink.MAVLink_param_set_message(1, 1, b"COM_DISARM_PRFLT", -1.0, mavlink.MAV_PARAM_TYPE_REAL32)
    vehicle.send(never)
    vehicle.wait_for(lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == "COM_DISARM_PRFLT")
    target = mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET
    assert vehicle.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, target, CONTROL_PERIOD_US) == 0
    vehicle.send(attitude(0))
    assert vehicle.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6) == 0
    assert vehicle.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0
    until_s = perf_counter() + SPOOL_UP_S
    while perf_counter() < until_s:
        vehicle.send(attitude(0))
        sleep(0.05)


def ask(vehicle: Live, question: Question, answer: Answer, repeats: int, seed: int) -> list[float]:
    """Times to the answer, milliseconds, sorted."""
    draw = random.Random(seed)
    times: list[float] = []
    for index in range(repeats):
        sleep(draw.uniform(*GAP_S))
        if index % 32 == 0:
            vehicle.send(attitude(255))  # or the off-board stream would be lost
            sleep(GAP_S[0])
        vehicle.drain()
        begin_s = perf_counter()
        vehicle.send(question(index))
        vehicle.wait_for(lambda message, index=index: answer(index, message))  # type: ignore[misc]
        times.append((perf_counter() - begin_s) * 1e3)
    return sorted(times)


def cpu_share(seconds: float, *, fly: bool) -> float:
    """Of one core, by the system's account of the process; the client meanwhile only empties its sockets."""
    with live() as vehicle:
        vehicle.wait_ready()
        if fly:
            assert vehicle.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0
            assert vehicle.command(mavlink.MAV_CMD_NAV_TAKEOFF) == 0
        idle(vehicle, SETTLE_S)
        begin_s, cpu_s = perf_counter(), vehicle.cpu_now_s()
        idle(vehicle, seconds)
        return (vehicle.cpu_now_s() - cpu_s) / (perf_counter() - begin_s)


def idle(vehicle: Live, seconds: float) -> None:
    until_s = perf_counter() + seconds
    while perf_counter() < until_s:
        sleep(0.1)
        vehicle.drain()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=500)
    parser.add_argument("--cpu-seconds", type=float, default=20.0)
    options = parser.parse_args()
    print("| milliseconds | median | p99 | max |")
    print("|---|---:|---:|---:|")
    with live() as vehicle:
        vehicle.wait_ready()
        spin_up(vehicle)
        for seed, (name, (question, answer)) in enumerate(ROWS.items()):
            times = ask(vehicle, question, answer, options.repeats, seed)
            print(f"| {name} | {median(times):.2f} | {times[int(0.99 * len(times))]:.2f} | {times[-1]:.2f} |")
        vehicle.end()
        p50_us, p99_us = vehicle.lateness_us
        print(f"| tick's lateness meanwhile | {p50_us / 1e3:.3f} | {p99_us / 1e3:.2f} | |")
    if options.cpu_seconds > 0.0:
        print("\n| share of a core | |")
        print("|---|---:|")
        print(f"| standing, default streams on both links | {cpu_share(options.cpu_seconds, fly=False):.1%} |")
        print(f"| flying, default streams on both links | {cpu_share(options.cpu_seconds, fly=True):.1%} |")


if __name__ == "__main__":
    main()
