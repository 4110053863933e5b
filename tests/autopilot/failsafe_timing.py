"""When each fail-safe acts, measured from outside: ``python -m tests.autopilot.failsafe_timing``.

Flies the vehicle's core over its datagrams once for each row of `commander.FAILSAFES` and writes
docs/reference/failsafes.md. The suite runs the same flights.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from math import cos, radians, sin
from pathlib import Path
from typing import NamedTuple

from mavsitl_vehicle.autopilot.health import Validity
from mavsitl_vehicle.failures import Kind, Unit

from mavsitl.dialect import mavlink
from mavsitl.quaternion import to_euler
from tests.autopilot.conftest import GCS, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    HOLD,
    LAND,
    RETURN,
    TERMINATION,
    flying,
    item,
    set_parameter,
    sticks,
    upload,
    waypoint,
)

OUTPUT = Path("docs") / "reference" / "failsafes.md"
SLACK_S = 0.1
"""A fail-safe acts within its parameters and this."""
HEARTBEAT = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)

Each = Callable[[], object]
DISARMED = (0, 0)
"""Stands for a mode where the action is to disarm."""


class Case(NamedTuple):
    """One flight. Modes are PX4's main and sub mode, as HEARTBEAT shows them; None: only a warning follows."""

    row: str
    cause: str
    set_up: dict[str, float]
    """Parameters."""
    due_s: float
    """From the cause to the action, as the parameters say."""
    mode: tuple[int, int] | None
    fly: Callable[[dict[str, float]], tuple[Client, Each]]
    """Into the air; what is to be sent before each tick."""
    trigger: Callable[[Client], Each | None]
    """Brings the cause about; what is sent from then on, None: as before."""
    holds_s: float = 0.0
    """COM_FAIL_ACT_T of holding first."""
    began: Callable[[Client], bool] | None = None
    """The cause is there, in truth; None: with `trigger`."""


class Measured(NamedTuple):
    acted_s: float
    """From the cause to the first HEARTBEAT (of a warning: STATUSTEXT) that shows it."""
    left_s: float
    """From there to the mode that follows a Hold; 0 where there is none."""


def measure(case: Case) -> Measured:
    """Raises AssertionError where nothing, or another thing, follows."""
    client, each = case.fly(case.set_up)
    assert not client.critical
    following = case.trigger(client)
    each = each if following is None else following
    began = case.began
    if began is not None:
        client.run_until(lambda: began(client), 30.0, each)
    said = len(client.texts())
    limit_s = case.due_s + 2.0

    def shown(mode: tuple[int, int]) -> bool:
        if mode == DISARMED:
            return not client.armed
        return client.flight_mode == mode and (client.critical or mode == TERMINATION)

    def warned() -> bool:
        return any(text == f"Warning: {case.row}" for text in client.texts()[max(said - 1, 0) :])

    if case.mode is None:
        return Measured(client.run_until(warned, limit_s, each), 0.0)
    first = HOLD if case.holds_s else case.mode
    acted_s = client.run_until(lambda: shown(first), limit_s, each)
    if not case.holds_s:
        return Measured(acted_s, 0.0)
    wanted = case.mode
    return Measured(acted_s, client.run_until(lambda: shown(wanted), case.holds_s + 2.0, each))


# --- flights


def silence() -> None:
    """Nothing is sent."""


def hover(height_m: float = 4.0, **changes: object) -> Callable[[dict[str, float]], tuple[Client, Each]]:
    return lambda set_up: (flying(height_m, parameters=set_up, **changes), silence)


def offboard(height_m: float = 4.0) -> Callable[[dict[str, float]], tuple[Client, Each]]:
    """Hovering by a stream of level setpoints."""

    def fly(set_up: dict[str, float]) -> tuple[Client, Each]:
        client = flying(height_m, parameters=set_up)
        client.attitude()
        assert client.offboard() == ACCEPTED
        client.run(0.3, client.attitude)
        return client, client.attitude

    return fly


def with_peer(peer: Callable[[Client], Each]) -> Callable[[dict[str, float]], tuple[Client, Each]]:
    """Holding, with somebody who sends all the time."""

    def fly(set_up: dict[str, float]) -> tuple[Client, Each]:
        client = Client(flight(parameters=set_up))
        each = peer(client)
        client.run(0.3, each)
        assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF) == ACCEPTED
        assert client.arm() == ACCEPTED
        client.run(6.0, each)
        assert client.flight_mode == HOLD
        return client, each

    return fly


def station(client: Client) -> Each:
    return lambda: client.send(HEARTBEAT, port=GCS, sender=(255, 190))


def in_mission(finished: bool) -> Callable[[dict[str, float]], tuple[Client, Each]]:
    def fly(set_up: dict[str, float]) -> tuple[Client, Each]:
        client = Client(flight(parameters=set_up))
        beat = station(client)
        client.run(0.3, beat)
        away_m = 2.0 if finished else 40.0
        assert upload(client, [item(client, 22, height_m=3.0), waypoint(client, away_m, 0, 3)]) == 0
        assert client.result(mavlink.MAV_CMD_MISSION_START, 0, 0) == ACCEPTED
        complete = mavlink.MISSION_STATE_COMPLETE
        if finished:
            client.run_until(lambda: client.last("MISSION_CURRENT", 0).mission_state == complete, 30.0, beat)
        else:
            client.run_until(lambda: client.truth[0] > 4.0, 30.0, beat)
        return client, beat

    return fly


# --- causes


def nothing(client: Client) -> None:
    """The cause comes by itself."""


def silent(client: Client) -> Each:
    return silence


def after_a_last(send: Callable[[Client], Each]) -> Callable[[Client], Each]:
    def trigger(client: Client) -> Each:
        send(client)()
        return silence

    return trigger


def parameter(name: str, value: float) -> Callable[[Client], None]:
    return lambda client: set_parameter(client, name, value)


def invalid(**parts: bool) -> Callable[[Client], None]:
    def trigger(client: Client) -> None:
        client.vehicle.autopilot.valid = Validity(**parts)

    return trigger


def charge_below(share: float) -> Callable[[Client], bool]:
    return lambda client: client.vehicle.autopilot.battery.charge < share


def airborne(seconds: float) -> Callable[[Client], bool]:
    return lambda client: client.now_us - client.vehicle.autopilot.flight_times.took_off_us >= seconds * 1e6


def tilt(axis: int) -> Callable[[Client], Each]:
    """A setpoint of 75 degrees about one axis."""
    half = radians(37.5)
    q = (cos(half), sin(half), 0.0, 0.0) if axis == 0 else (cos(half), 0.0, sin(half), 0.0)
    return lambda client: lambda: client.attitude(q, 0.9)


def tilted(axis: int) -> Callable[[Client], bool]:
    def seen(client: Client) -> bool:
        w, x, y, z = client.truth[6:10]
        return abs(to_euler((w, x, y, z))[axis]) > radians(60.0)

    return seen


def clear_mission(client: Client) -> None:
    client.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 0))


def lose_battery(client: Client) -> None:
    client.vehicle.failures.set(Unit.BATTERY, Kind.SLOW)


def lose_motor(client: Client) -> None:
    client.vehicle.failures.set(Unit.MOTOR, Kind.STUCK, 2)


def kill(client: Client) -> None:
    assert client.result(mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 2) == ACCEPTED


DRAIN = {"SIM_BAT_MIN_PCT": 0.0, "SIM_BAT_DRAIN": 25.0, "BAT_LOW_THR": 0.5}
BREEZE = {"SIM_WIND_SPD": 4.0}
CASES: tuple[Case, ...] = (
    Case(
        "off-board signal lost", "the last setpoint", {"COM_OBL_RC_ACT": 4, "COM_OF_LOSS_T": 1.0}, 1.0, LAND,
        offboard(), after_a_last(lambda client: client.attitude),
    ),
    Case(
        "manual control lost", "the last MANUAL_CONTROL", {"NAV_RCL_ACT": 3, "COM_RC_LOSS_T": 0.5}, 0.5, LAND,
        with_peer(sticks), after_a_last(sticks), 5.0,
    ),
    Case(
        "connection to ground station lost", "the last HEARTBEAT", {"NAV_DLL_ACT": 2, "COM_DL_LOSS_T": 5}, 5.0, RETURN,
        with_peer(station), after_a_last(station), 5.0,
    ),
    Case("low battery", "charge below BAT_LOW_THR", DRAIN, 0.0, None, hover(), nothing, began=charge_below(0.5)),
    Case(
        "critical battery", "charge below BAT_CRIT_THR", {**DRAIN, "BAT_CRIT_THR": 0.5, "COM_LOW_BAT_ACT": 3}, 0.0,
        RETURN, hover(), nothing, 5.0, charge_below(0.5),
    ),
    Case(
        "emergency battery level", "charge below BAT_EMERGEN_THR",
        {**DRAIN, "BAT_CRIT_THR": 0.5, "BAT_EMERGEN_THR": 0.5, "COM_LOW_BAT_ACT": 3}, 0.0, LAND, hover(), nothing, 5.0,
        charge_below(0.5),
    ),
    Case(
        "geofence breached", "GF_MAX_VER_DIST set below the vehicle", {"GF_ACTION": 5}, 0.0, LAND, hover(),
        parameter("GF_MAX_VER_DIST", 1.5),
    ),
    Case(
        "both links lost after the mission", "the last HEARTBEAT", {"COM_RC_IN_MODE": 4, "COM_DL_LOSS_T": 5}, 5.0,
        RETURN, in_mission(finished=True), after_a_last(station), 5.0,
    ),
    Case("battery unhealthy", "the battery is not read any more", {}, 5.0, None, hover(), lose_battery),
    Case(
        "remaining flight time low", "RTL_TIME_MARGIN set to an hour", {"COM_FLTT_LOW_ACT": 3, "SIM_BAT_DRAIN": 300},
        0.0, RETURN, hover(), parameter("RTL_TIME_MARGIN", 3600), 5.0,
    ),
    Case(
        "flight time nearly over", "0.9 COM_FLT_TIME_MAX after the take-off", {"COM_FLT_TIME_MAX": 20}, 0.0, None,
        hover(), nothing, began=airborne(18.0),
    ),
    Case(
        "maximum flight time exceeded", "COM_FLT_TIME_MAX after the take-off", {"COM_FLT_TIME_MAX": 16}, 0.0, RETURN,
        hover(), nothing, 5.0, airborne(16.0),
    ),
    Case(
        "strong wind", "COM_WIND_WARN set below the wind", BREEZE, 0.0, None, hover(), parameter("COM_WIND_WARN", 1.0)
    ),
    Case(
        "wind limit exceeded", "COM_WIND_MAX set below the wind", {**BREEZE, "COM_WIND_MAX_ACT": 5}, 0.0, LAND,
        hover(), parameter("COM_WIND_MAX", 1.0), 5.0,
    ),
    Case(
        "mission failure", "MISSION_CLEAR_ALL on the way", {}, 0.0, RETURN, in_mission(finished=False), clear_mission,
        5.0,
    ),
    Case(
        "position accuracy low", "COM_POS_LOW_EPH set below the noise", {"COM_POS_LOW_ACT": 5}, 0.0, LAND,
        hover(noise__position_m=0.1), parameter("COM_POS_LOW_EPH", 0.05), 5.0,
    ),
    Case("attitude estimate lost", "the estimate", {}, 0.0, TERMINATION, hover(), invalid(attitude=False)),
    Case("height estimate lost", "the estimate", {}, 0.0, LAND, hover(), invalid(height=False)),
    Case("velocity estimate lost", "the estimate", {}, 0.0, LAND, hover(), invalid(velocity=False)),
    Case("position estimate lost", "the estimate", {}, 0.0, LAND, hover(), invalid(position=False)),
    Case(
        "attitude failure (roll)", "roll beyond FD_FAIL_R", {"CBRK_FLIGHTTERM": 0, "FD_FAIL_R_TTRI": 0.3}, 0.3,
        TERMINATION, offboard(12.0), tilt(0), began=tilted(0),
    ),
    Case(
        "attitude failure (pitch)", "pitch beyond FD_FAIL_P", {"CBRK_FLIGHTTERM": 0, "FD_FAIL_P_TTRI": 0.3}, 0.3,
        TERMINATION, offboard(12.0), tilt(1), began=tilted(1),
    ),
    Case(
        "altitude loss", "FD_ALT_LOSS below the height held, by the mass",
        {"CBRK_FLIGHTTERM": 0, "FD_ALT_LOSS": 1.5, "FD_ALT_LOSS_T": 0.5}, 0.5, TERMINATION, hover(12.0),
        parameter("SIM_MASS_SCALE", 2.5), began=lambda client: client.truth[2] < 12.0 - 1.5,
    ),
    Case(
        "motor failure", "the second motor", {"FD_ACT_EN": 1, "COM_ACT_FAIL_ACT": 2, "MOTFAIL_TIME": 1.0}, 1.0, LAND,
        hover(), lose_motor, 5.0,
    ),
    Case("kill switch engaged", "the command", {"COM_KILL_DISARM": 1.0}, 1.0, DISARMED, hover(), kill),
)  # fmt: skip

NAMES = {
    LAND: "`AUTO.LAND`", RETURN: "`AUTO.RTL`", TERMINATION: "`TERMINATION`", DISARMED: "disarms", None: "a warning",
}  # fmt: skip


HEAD = """\
<!-- Generated by `python -m tests.autopilot.failsafe_timing`; do not edit. -->

# When fail-safes act

Each fail-safe of [the table](mavlink.md#fail-safes), flown once in simulated time: the vehicle's core, over its
datagrams. Due is what the parameters say from the cause to the action; acted is when the first `HEARTBEAT` shows it,
for a warning its `STATUSTEXT`. Where it holds first, `COM_FAIL_ACT_T` (5 s) comes between. What may be late by 0.1 s
was late by {late_ms:.0f} ms at most.

| fail-safe | counted from | parameters | due, s | acted, s | held, s | then |
|---|---|---|---:|---:|---:|---|
"""
FOOT = """
`AUTO.DESCEND`, where the position is lost, shows as `AUTO.LAND`. A battery is unhealthy 5 s after it was read last,
which is done ten times a second.
"""


def page(results: list[tuple[Case, Measured]]) -> str:
    """The reference page."""
    rows = []
    for case, measured in results:
        set_up = ", ".join(f"`{name}` {value:g}" for name, value in case.set_up.items() if not name.startswith("SIM_"))
        held = f"{measured.left_s:.3f}" if case.holds_s else ""
        rows.append(
            f"| {case.row} | {case.cause} | {set_up} | {case.due_s:g} | {measured.acted_s:.3f} | {held} "
            f"| {NAMES[case.mode]} |\n"
        )
    late_ms = 1e3 * max(late_s(case, measured) for case, measured in results)
    return HEAD.format(late_ms=late_ms) + "".join(rows) + FOOT


def late_s(case: Case, measured: Measured) -> float:
    """Beyond what is due; negative: too early."""
    holding_s = measured.left_s - case.holds_s if case.holds_s else 0.0
    return max(measured.acted_s - case.due_s, holding_s)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="the page (default: %(default)s)")
    arguments = parser.parse_args()
    from rich.progress import Progress

    results = []
    with Progress(transient=True) as progress:
        for case in progress.track(CASES, description="flights"):
            results.append((case, measure(case)))
    for case, measured in results:
        print(f"{case.row:36} due {case.due_s:4.1f} s, acted {measured.acted_s:6.3f} s, held {measured.left_s:6.3f} s")
    arguments.output.write_text(page(results), "utf-8")
    return int(max(late_s(case, measured) for case, measured in results) > SLACK_S)


if __name__ == "__main__":
    sys.exit(main())
