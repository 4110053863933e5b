"""A client of a vehicle that misbehaves: `tests.autopilot.conftest.Client` that keeps frames and bad datagrams, too."""

from __future__ import annotations

from typing import Any

from mavsitl.codec import Frame, parse
from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, OFFBOARD, Client

VEHICLE = (1, 1)


class ChaosClient(Client):
    """On both ports; speaks on the off-board one where a method does not say otherwise."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.frames: list[tuple[int, int, Frame]] = []
        """(time us, port, frame) of all good frames."""
        self.bad: list[bytes] = []
        """Datagrams without a good frame."""
        super().__init__(*args, **options)

    def begin(self, *modes: str) -> None:
        for mode in modes:
            self.vehicle.chaos.begin(mode)

    def _collect(self) -> None:
        for port in (OFFBOARD, GCS):
            for datagram in self.vehicle.datagrams(port, combine=False):
                self.wire[port].append(datagram)
                found = parse(datagram)
                if not found:
                    self.bad.append(datagram)
                for frame in found:
                    self.frames.append((self.now_us, port, frame))
                    if (frame.system_id, frame.component_id) == VEHICLE:
                        self.inbox.append((self.now_us, port, frame.message))

    def since(self, seen: int, name: str, port: int = OFFBOARD) -> list[Any]:
        """What came of one kind on one port after the first `seen` messages."""
        return [m for _, from_port, m in self.inbox[seen:] if from_port == port and m.get_type() == name]

    def timed(self, seen: int, name: str, port: int = OFFBOARD) -> list[tuple[float, Any]]:
        """The same with the time in seconds."""
        return [(t / 1e6, m) for t, from_port, m in self.inbox[seen:] if from_port == port and m.get_type() == name]

    def ask(self, message: Any, *names: str, run_s: float = 0.02, port: int = OFFBOARD) -> list[Any]:
        """Send, run, and what came of these kinds."""
        seen = len(self.inbox)
        self.send(message, port=port)
        self._collect()
        self.run(run_s)
        return [m for _, from_port, m in self.inbox[seen:] if from_port == port and m.get_type() in names]

    # --- commands

    def results(self, command: int, *params: float, run_s: float = 0.02, **options: Any) -> list[int]:
        """The MAV_RESULT of every COMMAND_ACK of this command that came within `run_s`."""
        seen = len(self.inbox)
        self.command(command, *params, **options)
        self.run(run_s)
        return [ack.result for ack in self.since(seen, "COMMAND_ACK") if ack.command == command]

    # --- parameters

    def list_parameters(self, run_s: float = 1.5) -> list[Any]:
        """The PARAM_VALUEs of the list."""
        return self.ask(mavlink.MAVLink_param_request_list_message(1, 1), "PARAM_VALUE", run_s=run_s)

    def read(self, name: str) -> list[Any]:
        request = mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1)
        return self.ask(request, "PARAM_VALUE", "PARAM_ERROR")

    def set(self, name: str, value: float) -> list[Any]:
        """REAL32."""
        request = mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)
        return self.ask(request, "PARAM_VALUE", "PARAM_ERROR")

    # --- missions

    def put(self, count: int, *, run_s: float = 0.3) -> list[Any]:
        """Upload a plan of so many waypoints as a client does that answers what it is asked; what the vehicle said."""
        said: list[Any] = []
        seen = len(self.inbox)
        self.send(mavlink.MAVLink_mission_count_message(1, 1, count, 0))
        for _ in range(round(run_s / 0.004)):
            self.tick()
            new, seen = self.inbox[seen:], len(self.inbox)
            for _, port, message in new:
                kind = message.get_type()
                if port != OFFBOARD or kind not in ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK"):
                    continue
                said.append(message)
                if kind != "MISSION_ACK" and message.seq < count:
                    self.send(waypoint(message.seq))
        return said

    def get(self, count: int, *, run_s: float = 0.3) -> list[Any]:
        """Download as a client does that asks for one item after the other; what the vehicle said."""
        said: list[Any] = []
        seen = len(self.inbox)
        self.send(mavlink.MAVLink_mission_request_list_message(1, 1, 0))
        for _ in range(round(run_s / 0.004)):
            self.tick()
            new, seen = self.inbox[seen:], len(self.inbox)
            for _, port, message in new:
                kind = message.get_type()
                if port != OFFBOARD or kind not in ("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK"):
                    continue
                said.append(message)
                following = 0 if kind == "MISSION_COUNT" else message.seq + 1 if kind == "MISSION_ITEM_INT" else count
                if following < count:
                    self.send(mavlink.MAVLink_mission_request_int_message(1, 1, following, 0))
        return said

    @property
    def plan(self) -> int:
        """Items of the mission in force."""
        return len(self.vehicle.plan.stores.items(0))


def waypoint(seq: int) -> Any:
    """Of a plan that is accepted: a take-off, then points above the start."""
    command = mavlink.MAV_CMD_NAV_TAKEOFF if seq == 0 else mavlink.MAV_CMD_NAV_WAYPOINT
    frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    return mavlink.MAVLink_mission_item_int_message(
        1, 1, seq, frame, command, int(seq == 0), 1, 0.0, 0.0, 0.0, 0.0, 473977420, 85455940, 10.0 + seq, 0
    )


def acks(said: list[Any]) -> list[int]:
    """The MAV_MISSION_RESULTs."""
    return [message.type for message in said if message.get_type() == "MISSION_ACK"]


def asked(said: list[Any]) -> list[int]:
    """The items asked for or sent, in order, repeats and all."""
    kinds = ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ITEM_INT")
    return [message.seq for message in said if message.get_type() in kinds]
