"""What the tests of whole flights share: a vehicle in the air, plans uploaded, sticks held, tracks kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavsitl.dialect import mavlink
from mavsitl.geodesy import Origin
from tests.autopilot.conftest import CLIENT, GCS, OFFBOARD, Client, flight

ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
REJECTED: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: int = mavlink.MAV_RESULT_UNSUPPORTED
WRONG_FRAME = 9

MANUAL, ALTCTL, POSCTL, ACRO, STABILIZED, OFFBOARD_MODE = (1, 0), (2, 0), (3, 0), (5, 0), (7, 0), (6, 0)
TAKEOFF, HOLD, MISSION, RETURN, LAND = (4, 2), (4, 3), (4, 4), (4, 5), (4, 6)
ORBIT, TERMINATION = (3, 1), (10, 0)

RELATIVE = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
AMSL = mavlink.MAV_FRAME_GLOBAL_INT
MISSION_FRAME = mavlink.MAV_FRAME_MISSION


def origin(client: Client) -> Origin:
    return client.vehicle.autopilot.origin


def degrees_e7(client: Client, north_m: float, west_m: float) -> tuple[int, int]:
    latitude, longitude = origin(client).to_global(north_m, west_m)
    return round(latitude * 1e7), round(longitude * 1e7)


def command_int(
    command: int, *params: float, x: int = 2**31 - 1, y: int = 2**31 - 1, z: float = nan, frame: int = RELATIVE
) -> Any:
    """COMMAND_INT, parameters filled up with NaN, place unknown."""
    filled = (*params, *([nan] * (4 - len(params))))
    return mavlink.MAVLink_command_int_message(1, 1, frame, command, 0, 0, *filled, x, y, z)


def result_int(client: Client, command: int, *params: float, **place: Any) -> int:
    (ack,) = client.acks_of(command_int(command, *params, **place))
    assert ack.command == command
    return int(ack.result)


def go_to(
    client: Client, north_m: float, west_m: float, height_m: float, *, speed: float = -1, yaw: float = nan
) -> int:
    """DO_REPOSITION; height over home, yaw rad clockwise."""
    x, y = degrees_e7(client, north_m, west_m)
    return result_int(client, mavlink.MAV_CMD_DO_REPOSITION, speed, 1, nan, yaw, x=x, y=y, z=height_m)


def take_off(client: Client, height_m: float = 2.5) -> Client:
    """NAV_TAKEOFF and arm; until AUTO.LOITER flies, a little later at rest."""
    client.run(0.2)
    client.send(parameter("MIS_TAKEOFF_ALT", height_m))
    assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF) == ACCEPTED
    assert client.arm() == ACCEPTED
    client.run_until(lambda: client.flight_mode == HOLD and not client.landed, 3.0 + height_m)
    client.run(1.5)
    return client


def flying(height_m: float = 2.5, **changes: Any) -> Client:
    return take_off(Client(flight(**changes)), height_m)


def parameter(name: str, value: float) -> Any:
    """PARAM_SET as a client sends it: INT32 byte by byte."""
    from mavsitl_vehicle.autopilot.parameters import TABLE

    if TABLE[name].is_integer:
        raw = float(np.array([int(value)], dtype="<i4").view("<f4")[0])
        return mavlink.MAVLink_param_set_message(1, 1, name.encode(), raw, mavlink.MAV_PARAM_TYPE_INT32)
    return mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)


def set_parameter(client: Client, name: str, value: float) -> None:
    client.send(parameter(name, value))
    assert client.vehicle.parameters[name] == np.float32(value)


def distance(client: Client, north_m: float, west_m: float, height_m: float) -> float:
    x, y, z = client.truth[:3]
    return hypot(x - north_m, y - west_m, z - height_m)


def track(client: Client, seconds: float, each: Callable[[], object] | None = None) -> NDArray[np.float64]:
    """The truth at every tick, (ticks, 17)."""
    rows: list[list[float]] = []

    def keep() -> None:
        if each is not None:
            each()
        rows.append(client.truth)

    client.run(seconds, keep)
    return np.array(rows)


# --- sticks


def sticks(
    client: Client, pitch: float = 0.0, roll: float = 0.0, yaw: float = 0.0, throttle: float = 0.5
) -> Callable[[], int]:
    """Sends MANUAL_CONTROL when called; deflections -1..1, throttle 0..1."""
    message = mavlink.MAVLink_manual_control_message(
        1, round(1000 * pitch), round(1000 * roll), round(1000 * throttle), round(1000 * yaw), 0
    )
    return lambda: client.send(message, port=GCS)


# --- plans


def item(
    client: Client, command: int, *params: float, at: tuple[float, float] | None = None, height_m: float = 0.0,
    frame: int | None = None, autocontinue: int = 1,
) -> dict[str, Any]:  # fmt: skip
    """One mission item; `at` north and west of the origin in metres, height over home."""
    x, y = (0, 0) if at is None else degrees_e7(client, *at)
    return {
        "command": command, "params": (*params, *([0.0] * (4 - len(params)))), "x": x, "y": y, "z": height_m,
        "frame": RELATIVE if frame is None else frame, "autocontinue": autocontinue,
    }  # fmt: skip


def waypoint(
    client: Client, north_m: float, west_m: float, height_m: float, hold_s: float = 0.0, yaw_deg: float = nan
) -> dict[str, Any]:
    return item(
        client, mavlink.MAV_CMD_NAV_WAYPOINT, hold_s, 0.0, 0.0, yaw_deg, at=(north_m, west_m), height_m=height_m
    )


def upload(client: Client, items: Sequence[dict[str, Any]], mission_type: int = 0) -> int:
    """The mission protocol's upload as a client does it; the MAV_MISSION_RESULT."""
    since_us = client.now_us
    seen = len(client.inbox)
    client.send(mavlink.MAVLink_mission_count_message(1, 1, len(items), mission_type))
    while True:
        client.tick()
        assert client.now_us - since_us < 5e6
        new, seen = client.inbox[seen:], len(client.inbox)
        for _, port, message in new:
            kind = message.get_type()
            if port != OFFBOARD or kind not in ("MISSION_REQUEST_INT", "MISSION_REQUEST", "MISSION_ACK"):
                continue
            assert (message.target_system, message.target_component) == CLIENT
            if kind == "MISSION_ACK":
                return int(message.type)
            row = items[message.seq]
            client.send(
                mavlink.MAVLink_mission_item_int_message(
                    1,
                    1,
                    message.seq,
                    row["frame"],
                    row["command"],
                    int(message.seq == 0),
                    row["autocontinue"],
                    *row["params"],
                    row["x"],
                    row["y"],
                    row["z"],
                    mission_type,
                )
            )


def fence_circle(client: Client, radius_m: float) -> dict[str, Any]:
    """An inclusion circle around the origin."""
    return item(client, mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, radius_m, at=(0.0, 0.0))


def reached(client: Client) -> list[int]:
    """The items told as reached on the off-board link, repeats of the newest left out."""
    told: list[int] = []
    for message in client.all("MISSION_ITEM_REACHED", OFFBOARD):
        if not told or told[-1] != message.seq:
            told.append(message.seq)
    return told
