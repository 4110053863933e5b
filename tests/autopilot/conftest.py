"""A client of the vehicle: what it knows of the vehicle came over the wire, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from math import nan
from typing import Any

import pytest
from mavsitl_vehicle.autopilot.setpoints import ATTITUDE_TARGET_FIELDS, Refusal, Setpoint, from_attitude_target
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import Flight, load

OFFBOARD, GCS = 0, 1
"""Ports of the vehicle that `Client` speaks to."""

CLIENT = (245, 190)
"""The system and component id that `Client` sends with where a test names none."""

MAIN_OFFBOARD = 6
MAIN_AUTO, SUB_LOITER, SUB_LAND = 4, 3, 6

LEVEL = (1.0, 0.0, 0.0, 0.0)
HOVER_THRUST = 0.5

ZERO_NOISE = {f"noise.{key}": 0.0 for key in ("position_m", "velocity_m_s", "attitude_deg", "rate_deg_s")}


def flight(**changes: Any) -> Flight:
    """Calm air, exact sensors, standing on the ground at the origin; `changes` are scenario keys with "__" for dots."""
    overrides: dict[str, Any] = {**ZERO_NOISE, "rates.physics_hz": 1000}
    overrides.update({key.replace("__", "."): value for key, value in changes.items()})
    return load("takeoff-hover", overrides)


class Client:
    """Sends encoded messages, steps the vehicle tick by tick, keeps every message that came with its time and port."""

    def __init__(self, scenario: Flight | None = None, *, seed: int = 1) -> None:
        self.vehicle = Vehicle(scenario or flight(), MemoryRecorder(), seed=seed, ports=("offboard", "gcs"))
        self.now_us = 0
        self.inbox: list[tuple[int, int, Any]] = []
        """(time us, port, message), oldest first."""
        self.wire: list[list[bytes]] = [[], []]
        self.forwarded: list[tuple[int, Any]] = []
        """(port, frame) of others' frames that the vehicle passed on."""
        self._sequence = 0
        self.vehicle.step(0)
        self._collect()

    # --- the wire

    def send(self, message: Any, *, port: int = OFFBOARD, sender: tuple[int, int] = CLIENT) -> int:
        """The number of valid frames the vehicle saw."""
        datagram = encode(message, self._sequence, *sender)
        self._sequence = (self._sequence + 1) & 0xFF
        return self.vehicle.receive(port, datagram)

    def run(self, seconds: float, each: Callable[[], object] | None = None) -> None:
        """Step for `seconds`; `each` is called before every tick."""
        for _ in range(round(seconds * 1e6 / self.vehicle.period_us)):
            if each is not None:
                each()
            self.now_us += self.vehicle.period_us
            self.vehicle.step(self.now_us)
            self._collect()

    def tick(self) -> None:
        self.run(self.vehicle.period_us / 1e6)

    def run_until(
        self, condition: Callable[[], bool], limit_s: float, each: Callable[[], object] | None = None
    ) -> float:
        """Step until `condition`; how long it took, in seconds. Fails where the limit comes first."""
        start_us = self.now_us
        while not condition():
            assert self.now_us - start_us < limit_s * 1e6, f"not within {limit_s} s"
            self.run(self.vehicle.period_us / 1e6, each)
        return (self.now_us - start_us) / 1e6

    def _collect(self) -> None:
        for port in (OFFBOARD, GCS):
            for datagram in self.vehicle.datagrams(port, combine=False):
                self.wire[port].append(datagram)
                (frame,) = parse(datagram)
                if (frame.system_id, frame.component_id) != (1, 1):
                    self.forwarded.append((port, frame))
                    continue
                self.inbox.append((self.now_us, port, frame.message))

    def all(self, name: str, port: int | None = None, since_us: int = -1) -> list[Any]:
        """Messages of one name, of one port or of both."""
        return [
            message
            for time_us, from_port, message in self.inbox
            if message.get_type() == name and port in (None, from_port) and time_us > since_us
        ]

    def last(self, name: str, port: int | None = None) -> Any:
        return next(
            message
            for _, from_port, message in reversed(self.inbox)
            if message.get_type() == name and port in (None, from_port)
        )

    def texts(self, port: int = GCS) -> list[str]:
        """STATUSTEXT, its chunks joined."""
        joined: list[str] = []
        for message in self.all("STATUSTEXT", port):
            if message.chunk_seq:
                joined[-1] += message.text
            else:
                joined.append(message.text)
        return joined

    # --- commands

    def command(
        self,
        command: int,
        *params: float,
        confirmation: int = 0,
        port: int = OFFBOARD,
        sender: tuple[int, int] = CLIENT,
        target: tuple[int, int] = (1, 1),
    ) -> list[Any]:
        """Send a COMMAND_LONG, parameters filled up with NaN; the COMMAND_ACKs that came at once, on whichever port."""
        filled = (*params, *([nan] * (7 - len(params))))
        return self.acks_of(
            mavlink.MAVLink_command_long_message(*target, command, confirmation, *filled), port=port, sender=sender
        )

    def acks_of(self, message: Any, *, port: int = OFFBOARD, sender: tuple[int, int] = CLIENT) -> list[Any]:
        before = len(self.inbox)
        self.send(message, port=port, sender=sender)
        self._collect()
        return [message for _, _, message in self.inbox[before:] if message.get_type() == "COMMAND_ACK"]

    def result(self, command: int, *params: float, **options: Any) -> int:
        """The MAV_RESULT of the one COMMAND_ACK."""
        (ack,) = self.command(command, *params, **options)
        assert ack.command == command
        return int(ack.result)

    def arm(self) -> int:
        return self.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def disarm(self, magic: float = nan) -> int:
        return self.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, magic)

    def mode(self, main: int, sub: float = nan) -> int:
        return self.result(mavlink.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def offboard(self) -> int:
        return self.mode(MAIN_OFFBOARD)

    def hold(self) -> int:
        return self.mode(MAIN_AUTO, SUB_LOITER)

    def land(self) -> int:
        return self.result(mavlink.MAV_CMD_NAV_LAND)

    # --- setpoints, in FRD and NED

    def attitude(
        self, q: tuple[float, float, float, float] = LEVEL, thrust: float = HOVER_THRUST, **fields: Any
    ) -> None:
        self.send(attitude_target(7, q=q, thrust=thrust, **fields))

    def rates(self, rates: tuple[float, float, float] = (0.0, 0.0, 0.0), thrust: float = HOVER_THRUST) -> None:
        self.send(attitude_target(128, rates=rates, thrust=thrust))

    # --- what the vehicle says it is

    @property
    def heartbeat(self) -> Any:
        return self.last("HEARTBEAT", GCS)

    @property
    def armed(self) -> bool:
        return bool(self.heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def flight_mode(self) -> tuple[int, int]:
        """PX4's main and sub mode, from HEARTBEAT."""
        return self.heartbeat.custom_mode >> 16 & 0xFF, self.heartbeat.custom_mode >> 24 & 0xFF

    @property
    def critical(self) -> bool:
        return bool(self.heartbeat.system_status == mavlink.MAV_STATE_CRITICAL)

    @property
    def landed(self) -> bool:
        return bool(self.last("EXTENDED_SYS_STATE", GCS).landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND)

    @property
    def truth(self) -> list[float]:
        """Position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s, rotor speeds rad/s."""
        values: list[float] = self.vehicle.simulation.x[:, 0].tolist()
        return values

    # --- flying

    def start(self) -> None:
        """A stream of level setpoints, OFFBOARD, armed and spooled up, still on the ground."""
        self.attitude(thrust=0.0)
        assert self.offboard() == mavlink.MAV_RESULT_ACCEPTED
        assert self.arm() == mavlink.MAV_RESULT_ACCEPTED
        self.run(1.1, lambda: self.attitude(thrust=0.0))

    def climb(self, height_m: float) -> None:
        """From the ground to about `height_m`, and slow there: a pilot that reads LOCAL_POSITION_NED."""
        self.start()

        def pilot() -> None:
            state = self.last("LOCAL_POSITION_NED", OFFBOARD)
            climb = min(max(height_m + state.z, -1.0), 1.5)
            self.attitude(thrust=min(max(HOVER_THRUST + 0.2 * (climb + state.vz), 0.2), 0.9))

        def there() -> bool:
            state = self.last("LOCAL_POSITION_NED", OFFBOARD)
            return bool(abs(height_m + state.z) < 0.1 and abs(state.vz) < 0.15)

        self.run_until(there, 20.0, pilot)


def taken_of(message: Any) -> Setpoint | Refusal:
    """What a SET_ATTITUDE_TARGET asks for; `message` may have a `thrust_body`."""
    names = dict.fromkeys((*ATTITUDE_TARGET_FIELDS, "thrust_body"))
    values = [getattr(message, name) for name in names if hasattr(message, name)]
    return from_attitude_target(*chain.from_iterable(v if isinstance(v, Sequence) else (v,) for v in values))


def attitude_target(
    type_mask: int,
    *,
    q: tuple[float, float, float, float] = LEVEL,
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0),
    thrust: float = HOVER_THRUST,
    target: tuple[int, int] = (1, 1),
    time_boot_ms: int = 0,
) -> Any:
    """SET_ATTITUDE_TARGET; attitude FRD to NED, rates FRD rad/s."""
    return mavlink.MAVLink_set_attitude_target_message(time_boot_ms, *target, type_mask, list(q), *rates, thrust)


@pytest.fixture
def client() -> Client:
    """On the ground, disarmed, in calm air with exact sensors."""
    return Client()
