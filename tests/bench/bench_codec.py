"""Microseconds per message, encode and decode, beside pymavlink in the same run: ``python -m tests.bench.bench_codec``.

The ratios are what counts: absolute figures follow the machine's load, and both columns of a row are taken in turns.
"""

from __future__ import annotations

import timeit
from collections.abc import Callable
from typing import Any

from mavsitl.codec import Counters, Message, encode, packer, parse
from mavsitl.dialect import mavlink

REPEATS = 7
CALLS = 3000


def messages() -> list[Message]:
    """The messages a cycle of the simulation is made of, with no field zero (the longest frames)."""
    return [
        mavlink.MAVLink_heartbeat_message(2, 12, 209, 0x60000, 4, 3),
        mavlink.MAVLink_attitude_quaternion_message(
            123456, 0.99, 0.01, -0.02, 0.1, 0.3, -0.2, 0.1, (1.0, 0.5, 0.25, 0.125)
        ),
        mavlink.MAVLink_odometry_message(
            123456789, 1, 12, 1.5, -2.5, 3.5, (1.0, 0.1, 0.2, 0.3), 0.1, 0.2, 0.3, 0.4, 0.5, 0.6,
            tuple(0.01 * k + 0.01 for k in range(21)), tuple(0.02 * k + 0.01 for k in range(21)), 1, 2, 90,
        ),
        mavlink.MAVLink_set_attitude_target_message(
            123456, 1, 1, 7, (1.0, 0.1, 0.2, 0.3), 0.1, 0.2, 0.3, 0.7
        ),
        mavlink.MAVLink_param_value_message(b"MPC_XY_VEL_P_ACC", 1.8, 9, 120, 17),
    ]  # fmt: skip


def _best_us(*functions: Callable[[], Any]) -> list[float]:
    """Best time per call of each function, microseconds; the functions take turns, so that load meets all alike."""
    timers = [timeit.Timer(function) for function in functions]
    rounds = [[timer.timeit(CALLS) for timer in timers] for _ in range(REPEATS)]
    return [min(column) / CALLS * 1e6 for column in zip(*rounds, strict=True)]


def rows() -> list[tuple[str, list[float]]]:
    """Per message, in microseconds: pack fields, encode object, pymavlink encode, parse, pymavlink parse."""
    result = []
    for message in messages():
        reference = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        wire = encode(message, 0, 1, 1)
        pack = packer(type(message))
        counters = Counters()
        fields = [getattr(message, f"_{name}_raw", getattr(message, name)) for name in message.fieldnames]
        times = _best_us(
            lambda pack=pack, fields=fields: pack(7, 1, 1, *fields),  # type: ignore[misc]
            lambda message=message: encode(message, 7, 1, 1),  # type: ignore[misc]
            lambda message=message, reference=reference: message.pack(reference),  # type: ignore[misc]
            lambda wire=wire, counters=counters: parse(wire, counters),  # type: ignore[misc]
            lambda wire=wire, reference=reference: reference.parse_buffer(wire),  # type: ignore[misc]
        )
        result.append((message.msgname, times))
    return result


def main() -> None:
    print(f"{'us per message':22}{'pack':>7}{'encode':>8}{'pymavlink':>11}{'ratio':>7}", end="")
    print(f"{'parse':>9}{'pymavlink':>11}{'ratio':>7}")
    for name, (pack, whole, their_pack, read, their_read) in rows():
        print(f"{name:22}{pack:7.2f}{whole:8.2f}{their_pack:11.2f}{their_pack / whole:7.1f}", end="")
        print(f"{read:9.2f}{their_read:11.2f}{their_read / read:7.1f}")


if __name__ == "__main__":
    main()
