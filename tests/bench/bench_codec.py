"""Microseconds per message beside pymavlink in the same run: ``python -m tests.bench.bench_codec``.

The messages are those of a flight: the default streams of both links and what the controller sends, each as it was on
the wire, and the last row weighs them by how often they came. Three ways out and in are compared:

- pack: fields to bytes. pymavlink's is ``mav.NAME_encode(...).pack(mav)``, which is what ``mav.NAME_send(...)`` does.
- encode: an object to bytes. pymavlink's is ``message.pack(mav)``.
- frame, fields, message: bytes to a checked frame, to all of its fields by a `reader`, and to a message object.
  pymavlink's is ``mav.parse_buffer(datagram)`` for all three: it has no other way.

Below the table stands the exchange of a control period as the two ends do it: what does not change (ODOMETRY's
covariances) is packed once, and of the fields those are read that are used. pymavlink has no such choice.

The ratios are what counts: absolute figures follow the machine's load, and the columns of a row are taken in turns, in
CPU time, the best of several.
"""

from __future__ import annotations

import argparse
import struct
import time
import timeit
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from mavsitl import ends, scenario, wings
from mavsitl.codec import Counters, Frame, Message, encode, packer, parse, reader
from mavsitl.dialect import mavlink

SCENARIO = "hover-wind"
FLIGHT_S = 12.0
USED = {
    "ODOMETRY": (
        "time_usec", "x", "y", "z", "q", "vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed", "frame_id",
        "child_frame_id",
    ),
    "SET_ATTITUDE_TARGET": (
        "time_boot_ms", "type_mask", "q", "body_roll_rate", "body_pitch_rate", "body_yaw_rate", "thrust",
    ),
}  # fmt: skip
"""The two messages of every control period in lock-step, and what the other end reads of them."""
REPEATS = 9
CALLS = 1000


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


class Row(NamedTuple):
    """One message. Times are microseconds of CPU a message, ours first and pymavlink's second."""

    name: str
    per_s: float
    pack: tuple[float, float]
    encode: tuple[float, float]
    frame: tuple[float, float]
    fields: tuple[float, float]
    message: tuple[float, float]


def traffic(duration_s: float) -> list[tuple[Frame, float]]:
    """Each message of a flight with both links, as it was last seen, and how often per second; the frequent first."""
    flight = scenario.load(SCENARIO, {"duration_s": duration_s})
    seed = flight.scenario.seed
    ports = ("offboard", "gcs")
    vehicle = wings.find(wings.VEHICLE_GROUP)(flight, ends.NullRecorder(), seed=seed, ports=ports)
    ground = wings.find(wings.GROUND_GROUP)(flight, ends.NullRecorder(), report=lambda text: None)
    seen: dict[int, Frame] = {}
    counts: Counter[int] = Counter()

    def note(datagrams: Sequence[bytes]) -> Sequence[bytes]:
        for datagram in datagrams:
            for frame in parse(datagram):
                seen[frame.message_id] = frame
                counts[frame.message_id] += 1
        return datagrams

    now_us = 0
    while not vehicle.finished:
        vehicle.step(now_us)
        note(vehicle.datagrams(1, combine=False))
        for datagram in note(vehicle.datagrams(0, combine=True)):
            ground.receive(0, datagram)
        ground.step(ground.vehicle_time_us)
        for datagram in note(ground.datagrams(0, combine=True)):
            vehicle.receive(0, datagram)
        now_us += vehicle.period_us
    return [(seen[message_id], count / (now_us * 1e-6)) for message_id, count in counts.most_common()]


def best_us(functions: Sequence[Callable[[], Any]], calls: int, repeats: int) -> list[float]:
    """Best CPU time per call of each function, microseconds; the functions take turns, so that load meets all alike."""
    timers = [timeit.Timer(function, timer=time.process_time) for function in functions]
    rounds = [[timer.timeit(calls) for timer in timers] for _ in range(repeats)]
    return [min(column) / calls * 1e6 for column in zip(*rounds, strict=True)]


def measure(frame: Frame, per_s: float, *, as_used: bool = False, calls: int = CALLS, repeats: int = REPEATS) -> Row:
    """One message, as `frame` has it. `as_used`: long arrays are packed before, and the fields in `USED` are read."""
    message, counters = frame.message, Counters()
    message_class = mavlink.mavlink_map[frame.message_id]
    reference = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    theirs = reference.parse_buffer(frame.raw)[0]
    fields = [getattr(theirs, f"_{name}_raw", getattr(theirs, name)) for name in message_class.fieldnames]
    make = getattr(reference, f"{message_class.msgname.lower()}_encode")
    given = [_packed(field) for field in fields] if as_used else fields
    wanted = USED[message_class.msgname] if as_used else message_class.fieldnames
    pack, read, wire = packer(message_class), reader(message_class, *wanted), frame.raw
    pack_us, their_pack_us, encode_us, their_encode_us, frame_us, fields_us, message_us, parse_us = best_us(
        (
            lambda: pack(7, 1, 1, *given),
            lambda: make(*fields).pack(reference),
            lambda: encode(message, 7, 1, 1),
            lambda: theirs.pack(reference),
            lambda: parse(wire, counters),
            lambda: read(parse(wire, counters)[0]),
            lambda: parse(wire, counters)[0].message,
            lambda: reference.parse_buffer(wire),
        ),
        calls,
        repeats,
    )
    return Row(
        message_class.msgname,
        per_s,
        (pack_us, their_pack_us),
        (encode_us, their_encode_us),
        (frame_us, parse_us),
        (fields_us, parse_us),
        (message_us, parse_us),
    )


def _packed(field: Any) -> Any:
    return struct.pack(f"<{len(field)}f", *field) if isinstance(field, list) and len(field) > 8 else field


def total(rows: Sequence[Row]) -> Row:
    """All messages, each as often as it came: the mean message."""
    per_s = sum(row.per_s for row in rows)

    def mean(way: str) -> tuple[float, float]:
        ours, theirs = (sum(row.per_s * getattr(row, way)[side] for row in rows) / per_s for side in (0, 1))
        return ours, theirs

    return Row("all, as often as sent", per_s, *map(mean, Row._fields[2:]))


def line(row: Row) -> str:
    ways = "".join(f"{ours:9.2f}{theirs / ours:6.1f}" for ours, theirs in row[2:])
    return f"{row.name:32}{row.per_s:8.1f}{ways}"


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--duration", type=float, default=FLIGHT_S, help="of the flight, s")
    arguments.add_argument("--repeats", type=int, default=REPEATS)
    given = arguments.parse_args()
    ways = "".join(f"{way:>9}{'x':>6}" for way in Row._fields[2:])
    print(f"{'us per message; x: pymavlink / us':32}{'per s':>7}{ways}")
    flown = traffic(given.duration)
    found = []
    for frame, per_s in flown:
        found.append(measure(frame, per_s, repeats=given.repeats))
        print(line(found[-1]), flush=True)
    print(line(total(found)))
    exchanged = [
        measure(frame, per_s, as_used=True, repeats=given.repeats)
        for frame, per_s in flown
        if mavlink.mavlink_map[frame.message_id].msgname in USED
    ]
    for row in exchanged:
        print(line(row._replace(name=f"{row.name}, as used")))
    ours, theirs = (sum(row.pack[side] + row.fields[side] for row in exchanged) for side in (0, 1))
    print(
        f"the exchange of a control period: {ours:.2f} us, pymavlink {theirs:.2f} us, {theirs / ours:.1f} times as long"
    )


if __name__ == "__main__":
    main()
