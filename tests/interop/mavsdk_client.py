"""MAVSDK's plugins of one vehicle in one hand, and waiting for what they report."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from mavsitl.clock import monotonic_us
from mavsitl.dialect import mavlink
from tests.interop.conftest import PATIENCE_S, Sitl

METRES_PER_DEGREE = 111319.49


class Pilot:
    """A ground station of MAVSDK's that knows one vehicle; plugins by their own names: `pilot.action.arm()`."""

    def __init__(self, system: Any) -> None:
        self.system = system
        self._plugins: dict[str, Any] = {}
        self.texts: list[str] = []
        """STATUSTEXT since the last `reset`."""
        self._told = threading.Condition()
        self.telemetry.subscribe_status_text(self._hear)

    def _hear(self, text: Any, _: Any) -> None:
        with self._told:
            self.texts.append(text.text)
            self._told.notify_all()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._plugins:
            module = __import__(f"mavsdk.plugins.{name}", fromlist=["*"])
            self._plugins[name] = getattr(module, "".join(part.title() for part in name.split("_")))(self.system)
        return self._plugins[name]

    # --- waiting

    def wait(
        self, stream: str, condition: Callable[[Any], bool], limit_s: float = PATIENCE_S, plugin: str = "telemetry"
    ) -> Any:
        """The first value of a subscription that fulfils `condition`."""
        with self.values(stream, plugin) as values:
            return first(values, condition, limit_s, f"{stream}; the vehicle said {self.texts}")

    @contextmanager
    def values(self, stream: str, plugin: str = "telemetry") -> Iterator[queue.SimpleQueue[Any]]:
        """What a subscription delivers from now on."""
        values: queue.SimpleQueue[Any] = queue.SimpleQueue()
        owner = getattr(self, plugin)
        handle = getattr(owner, f"subscribe_{stream}")(lambda value, _: values.put(value))
        try:
            yield values
        finally:
            getattr(owner, f"unsubscribe_{stream}")(handle)

    def height(self, low_m: float, high_m: float = float("inf"), limit_s: float = PATIENCE_S) -> float:
        """Wait until the height above home is in a band."""
        position = self.wait("position", lambda p: low_m <= p.relative_altitude_m <= high_m, limit_s)
        return float(position.relative_altitude_m)

    def near(self, north_m: float, east_m: float, down_m: float, within_m: float, limit_s: float = PATIENCE_S) -> Any:
        """Wait until it is near a point of the local frame."""
        return self.wait(
            "position_velocity_ned",
            lambda p: (
                (p.position.north_m - north_m) ** 2
                + (p.position.east_m - east_m) ** 2
                + (p.position.down_m - down_m) ** 2
                < within_m**2
            ),
            limit_s,
        )

    def mode(self, name: str, limit_s: float = PATIENCE_S) -> None:
        self.wait("flight_mode", lambda mode: bool(mode.name == name), limit_s)

    def text(self, part: str, limit_s: float = PATIENCE_S) -> str:
        """Wait for a STATUSTEXT since the last `reset`."""
        with self._told:
            self._told.wait_for(lambda: any(part in text for text in self.texts), limit_s)
            found = [text for text in self.texts if part in text]
            assert found, f"no {part!r} in {self.texts}"
            return found[0]

    # --- what no plugin has a method for

    def send(self, name: str, **fields: Any) -> None:
        """Any message, to the autopilot."""
        from mavsdk.plugins.mavlink_direct import MavlinkMessage

        fields = {"target_system": 1, "target_component": 1, **fields}
        self.mavlink_direct.send_message(MavlinkMessage(name, 245, 190, 1, 1, json.dumps(fields)))

    @contextmanager
    def messages(self, name: str) -> Iterator[queue.SimpleQueue[dict[str, Any]]]:
        """Fields of the messages of one name that come from now on."""
        values: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        handle = self.mavlink_direct.subscribe_message(name, lambda m, _: values.put(json.loads(m.fields_json)))
        try:
            yield values
        finally:
            self.mavlink_direct.unsubscribe_message(handle)

    def command(self, command: int, *params: float) -> int:
        """COMMAND_LONG; the MAV_RESULT of its acknowledgement."""
        filled = {f"param{k}": value for k, value in enumerate((*params, *([0.0] * (7 - len(params)))), start=1)}
        with self.messages("COMMAND_ACK") as acks:
            self.send("COMMAND_LONG", command=command, confirmation=0, **filled)
            ack = first(acks, lambda fields: fields["command"] == command, PATIENCE_S, f"answer to {command}")
            return int(ack["result"])

    # --- states to begin with

    def reset(self) -> None:
        """Whatever was before: on the ground, disarmed, in Hold, home here, no plans, default parameters."""
        # Asked for whatever the telemetry says: what a test did last may not have come in a HEARTBEAT yet.
        force = 21196.0
        assert self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, force) == mavlink.MAV_RESULT_ACCEPTED
        self.wait("armed", lambda armed: not armed)
        self.wait("landed_state", lambda state: bool(state.name == "ON_GROUND"))
        if not _level(self.wait("attitude_euler", lambda _: True)):  # as a kill in the air may leave it
            self.wait("health", lambda health: not health.is_armable)
            self.action.reboot()
            self.wait("attitude_euler", _level)
        for mission_type in (0, 1, 2):
            with self.messages("MISSION_ACK") as acks:
                self.send("MISSION_CLEAR_ALL", mission_type=mission_type)
                ack = first(acks, lambda fields: True, PATIENCE_S, "MISSION_ACK")
                assert (ack["type"], ack["mission_type"]) == (0, mission_type)
        assert self.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 2) == mavlink.MAV_RESULT_ACCEPTED
        assert self.command(mavlink.MAV_CMD_DO_SET_HOME, 1) == mavlink.MAV_RESULT_ACCEPTED
        self.action.hold()
        self.mode("HOLD")
        self.wait("health", lambda health: bool(health.is_armable))
        self.texts.clear()

    def fly(self, height_m: float = 3.0) -> None:
        """Hovering in Hold at `height_m` above home."""
        self.action.set_takeoff_altitude(height_m)
        self.action.arm()
        self.action.takeoff()
        self.height(0.95 * height_m)
        self.mode("HOLD")


def _level(angle: Any) -> bool:
    return bool(abs(angle.roll_deg) < 45.0 and abs(angle.pitch_deg) < 45.0)


def first(values: queue.SimpleQueue[Any], condition: Callable[[Any], bool], limit_s: float, what: str) -> Any:
    """The first value that fulfils `condition`; fails after `limit_s` of wall time."""
    until_us = monotonic_us() + round(limit_s * 1e6)
    seen: Any = "nothing"
    while (left_us := until_us - monotonic_us()) > 0:
        try:
            seen = values.get(timeout=left_us / 1e6)
        except queue.Empty:
            break
        if condition(seen):
            return seen
    raise AssertionError(f"waited {limit_s:g} s for {what}; last was {seen}")


@contextmanager
def connected(vehicle: Sitl) -> Iterator[Pilot]:
    """A MAVSDK ground station at the off-board link of a vehicle."""
    from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk

    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    mavsdk = Mavsdk(configuration)
    try:
        assert mavsdk.add_any_connection(f"udpin://127.0.0.1:{vehicle.offboard_port}") == ConnectionResult.SUCCESS
        system = mavsdk.first_autopilot(PATIENCE_S)
        assert system is not None, f"MAVSDK saw no autopilot:\n{vehicle.log()}"
        yield Pilot(system)
    finally:
        mavsdk.destroy()
        configuration.destroy()
