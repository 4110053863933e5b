"""The vehicle: simulation and autopilot as one sans-IO core that a driver of the bridge runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mavsitl.codec import Counters
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl.link.budget import Excess
from mavsitl.log.block import Array
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl.signing import EPOCH_UNIX_US, Signing, SigningMode, SigningState
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot.autopilot import Autopilot
from mavsitl_vehicle.autopilot.battery import settings as battery_settings
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.parameters import Layer, Parameters
from mavsitl_vehicle.autopilot.plan import PlanError, VehiclePlan
from mavsitl_vehicle.autopilot.ports import Shared
from mavsitl_vehicle.autopilot.seated import SeatedLaw
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, Setpoint
from mavsitl_vehicle.autopilot.storage import Store, keep_parameters
from mavsitl_vehicle.autopilot.wind_estimate import WindEstimate
from mavsitl_vehicle.record import Record
from mavsitl_vehicle.simulation import Simulation

PLAN_SCHEMA = 1
SIGNING_SCHEMA = 1
SIGNING_STORE_US = 1_000_000
"""So often the signing state is looked at; it is written when the time stamps near what was stored."""


class Vehicle:
    """One vehicle. `receive` datagrams at any time; `step` once a control period; then take each port's `datagrams`."""

    def __init__(
        self,
        flight: Flight,
        recorder: Recorder,
        *,
        seed: int,
        system_id: int = 1,
        ports: Sequence[str] = ("offboard",),
        lockstep: bool = False,
        state: Path | None = None,
        logs: Path | None = None,
        unix_us: Callable[[], int] | None = None,
        trusted: bool = True,
    ) -> None:
        """`ports` name the links in order: "offboard", "gcs".

        In `lockstep` the state is streamed every tick from the first. `state` is a folder for what outlives the process
        (parameters, plans, the memory card), `logs` where its logs are; None: nothing is kept, or shown. `unix_us` is
        a clock that does not jump, for SYSTEM_TIME and signatures; None: not known, and then there is no signing. A
        first signing key is taken only where the links are `trusted`: on loopback.
        """
        self.period_us = flight.scenario.rates.control_period_us
        self._flight = flight
        self._system_id = system_id
        self._port_names = tuple(ports)
        self._lockstep = lockstep
        self._unix_us = unix_us
        self._notes: list[str] = []
        """What was wrong with the stored state, for a STATUSTEXT at the first step."""
        self.parameters = Parameters(
            Layer(f"airframe {flight.scenario.airframe}", flight.airframe.parameters),
            Layer(flight.name, flight.scenario.parameters),
            Layer("system id", {"MAV_SYS_ID": system_id}),
        )
        if state is not None:
            with suppress(OSError):  # the stores say what is wrong
                state.mkdir(mode=0o700, parents=True, exist_ok=True)  # the signing key will be in it
        parameter_store = keep_parameters(self.parameters, state, self._notes.append)
        self.parameters.put("MAV_SYS_ID", system_id)  # what was kept does not outweigh what was asked for
        plan_store = Store(state, "plan", PLAN_SCHEMA, self._notes.append)
        self._stores = () if state is None else (parameter_store, plan_store)
        self.plan = VehiclePlan(
            report=lambda severity, text: self.autopilot.say(severity, text),
            changed=lambda mission_type: plan_store.put(lambda: json.loads(self.plan.to_json())),
        )
        self._load_plan(plan_store)
        self._signing_store = Store(state, "signing", SIGNING_SCHEMA, self._notes.append, private=True)
        self._signing = self._load_signing()
        self._signing_us = 0
        card = None if state is None else state / "card"
        self._shared = Shared(self.parameters, self.plan, card=card, logs=logs, signing=self._signing, trusted=trusted)
        self.simulation = Simulation(flight, self.parameters, seed)
        self.autopilot = self._boot(0)
        self.parameters.subscribe(self._on_parameter)
        self._seated = SeatedLaw(flight) if flight.scenario.controller.inner == "pidnn" else None
        self._wind = None if lockstep else WindEstimate(flight.airframe, self.period_us / 1e6)
        self._record = Record(recorder, flight, aboard=self._seated is not None)
        self._now_us = -self.period_us
        self._boot_us = 0
        """The driver's time at which the autopilot booted last."""
        self._done = False

    def _load_plan(self, store: Store) -> None:
        content = store.load()
        if content:
            try:
                self.plan.load_json(json.dumps(content))
            except PlanError as error:
                store.set_aside(str(error))

    def _load_signing(self) -> Signing | None:
        if self._unix_us is None:
            return None
        unix_us, state = self._unix_us, SigningState()
        content = self._signing_store.load()
        if content:
            try:
                state = SigningState.from_bytes(bytes.fromhex(content["state"]))
            except (KeyError, TypeError, ValueError):
                self._signing_store.set_aside("signing begins without a key")
        signing = Signing(lambda: unix_us() - EPOCH_UNIX_US, state=state)
        signing.policy.mode = SigningMode(int(self.parameters["MAV_SIGN_CFG"]))
        return signing

    def _keep_signing(self, state: SigningState | None) -> None:
        if self._signing is not None and state is not None:
            self._signing_store.put({"state": state.to_bytes().hex()})
            if self._signing_store.flush():
                self._signing.saved(state)

    def _boot(self, now_us: int) -> Autopilot:
        """An autopilot whose clock begins at `now_us` of the driver's."""
        unix_us = 0 if self._unix_us is None else self._unix_us()
        autopilot = Autopilot(
            self._flight, self._system_id, self._port_names, self.parameters, _Body(self.simulation), self._shared,
            lockstep=self._lockstep, unix_boot_us=unix_us,
        )  # fmt: skip
        autopilot.estimate = self.simulation.estimate[:, 0].tolist()
        if not self._lockstep:
            autopilot.set_home_here()  # MAVSDK asks for it as soon as it hears the vehicle
        else:
            for port in autopilot.ports:
                for message_id in _STATE_MESSAGES[self._flight.scenario.controller.telemetry]:
                    port.schedule.set_interval(message_id, self.period_us, 0)
        for note in self._notes:
            autopilot.queue_text(mavlink.MAV_SEVERITY_WARNING, note)
        self._notes.clear()
        return autopilot

    def continue_from(self, sequence: int) -> None:
        """The sequence number that comes next on every link: of `boot.heartbeat` some were sent before."""
        for port in self.autopilot.ports:
            port.node.continue_from(sequence)

    @property
    def token_us(self) -> int:
        """The stamp that the newest off-board setpoint echoes; lock-step advances when it is the tick's own."""
        return self.autopilot.token_us

    @property
    def signed_only(self) -> bool:
        """Every link obeys messages alone that carry a good signature."""
        return self._signing is not None and self._signing.active(self._shared.trusted)

    @property
    def weights(self) -> Array | None:
        """Output weights (3 outputs P I D, 3 axes, 1) of the PIDNN aboard; None where none is seated."""
        return None if self._seated is None else self._seated.weights

    @property
    def finished(self) -> bool:
        """It has flown and is disarmed again."""
        return self._done

    @property
    def succeeded(self) -> bool:
        """As `finished`: for a vehicle every landing is one."""
        return self._done

    @property
    def flight_time_s(self) -> float:
        """Since the release; negative before it."""
        released = self.autopilot.land.released_us
        return -1.0 if released is None else (self._now_us - self._boot_us - released) / 1e6

    @property
    def counters(self) -> Any:
        """Frames received and refused, by reason, of all links."""
        return sum((port.node.counters for port in self.autopilot.ports), Counters())

    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int:
        """One datagram from a link; the number of valid frames in it.

        What it decides counts from the last tick. `at_us`, between that and the next, is what the services' clock
        shows, TIMESYNC's above all; None: the tick.
        """
        now_us = max(self._now_us - self._boot_us, 0)
        return self.autopilot.receive(port, datagram, now_us, None if at_us is None else at_us - self._boot_us)

    def refuse(self, port: int, excess: Excess) -> None:
        """A datagram from a link was dropped unread, for its source had used up its budget; only counted."""
        counters = self.autopilot.ports[port].node.counters
        if excess is Excess.SOURCE:
            counters.over_budget += 1
        else:
            counters.crowded += 1

    def step(self, now_us: int) -> None:
        """Fly from the last step to `now_us`, one control period later, and say what is to be said there."""
        first = self._now_us < 0
        self._now_us = now_us
        if self.autopilot.reboot_requested and not self._lockstep:
            self._reboot(now_us)
        autopilot, simulation = self.autopilot, self.simulation
        now_us -= self._boot_us
        if not first and now_us:
            simulation.held[0] = autopilot.land.held
            setpoint = autopilot.decide(now_us - self.period_us)
            simulation.set_demand(0, self._inner_law(setpoint))
            released_us = autopilot.land.released_us
            flown_s = -1.0 if released_us is None else (now_us - self.period_us - released_us) / 1e6
            simulation.advance(flown_s)
        autopilot.estimate = simulation.estimate[:, 0].tolist()
        if self._wind is not None:
            self._wind.update(simulation.estimate, simulation.demand[tick.THRUST, 0], not autopilot.on_ground)
            autopilot.wind = self._wind.value
        autopilot.observe(now_us)
        autopilot.report(now_us)
        self._record.write(self._now_us, self)
        for store in self._stores:
            store.step(self._now_us)
        if self._signing is not None:
            self._signing.policy.locked = autopilot.commander.armed
            if self._now_us - self._signing_us >= SIGNING_STORE_US:
                self._signing_us = self._now_us
                self._keep_signing(self._signing.unsaved())
        if autopilot.land.released_us is not None and not autopilot.commander.armed:
            self._done = True
            self._after_flight()

    def close(self) -> None:
        """Write what is not written yet and close the files that clients had open."""
        for store in self._stores:
            store.close()
        if self._signing is not None and self._signing.has_key:
            self._keep_signing(self._signing.closing_state())
        for port in self.autopilot.ports:
            port.close()

    def _after_flight(self) -> None:
        """Ready for the next: where the flight began in a clamp, the clamp takes the vehicle back."""
        if self._flight.scenario.start.clamp:
            self.simulation.put_back()
            self.autopilot.land.put_back()
        if self.autopilot.on_ground:
            self.autopilot.land.released_us = None

    def _reboot(self, now_us: int) -> None:
        """PREFLIGHT_REBOOT_SHUTDOWN: clock, links and autopilot begin anew; the vehicle stays where it stands.

        One that has fallen over is set upright there.
        """
        old = self.autopilot
        if not old.health.upright and old.on_ground:
            self.simulation.set_upright()
        self._boot_us = now_us
        self.plan.stores.transaction = None  # it counts in the old time
        self.autopilot = self._boot(now_us)
        self.autopilot.land.held = old.land.held
        for port, before in zip(self.autopilot.ports, old.ports, strict=True):
            port.node = before.node  # the answer to the command is still in it, and clients count on with its numbers
            before.close()

    def _on_parameter(self, name: str, value: float) -> None:
        self.simulation.set_parameter(name)
        if name == "MAV_SIGN_CFG" and self._signing is not None:
            self._signing.policy.mode = SigningMode(int(value))
        if name.startswith(("BAT", "SIM_BAT")):
            self.autopilot.battery.settings = battery_settings(self.parameters)

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        """What goes out on a link: one message a datagram, or all of a tick in one (`combine`)."""
        return self.autopilot.ports[port].node.datagrams(combine=combine)

    def _inner_law(self, setpoint: Setpoint | None) -> Setpoint | None:
        """With the PIDNN aboard, an off-board attitude becomes a torque by it; all else passes."""
        law = self._seated
        if (
            law is None
            or not isinstance(setpoint, AttitudeSetpoint)
            or self.autopilot.commander.mode is not Mode.OFFBOARD
        ):
            return setpoint
        if self.autopilot.land.released_us is None:
            law.reset()
        return law.update(setpoint, self.autopilot.setpoint_us or 0, self.simulation.estimate[:, 0])


class _Body:
    """The simulation as the autopilot's telemetry looks at it."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    @property
    def truth(self) -> Sequence[float]:
        truth: list[float] = self._simulation.x[:, 0].tolist()
        return truth

    @property
    def true_wind(self) -> Vector:
        x, y, z = self._simulation.wind[:, 0].tolist()
        return x, y, z

    @property
    def rotor_speeds_rad_s(self) -> Sequence[float]:
        speeds: list[float] = self._simulation.x[13:17, 0].tolist()
        return speeds

    @property
    def outputs(self) -> Sequence[float]:
        largest = self._simulation.gains[tick.MAX_ROTOR_SPEED]
        shares: list[float] = (self._simulation.x[13:17, 0] / largest).tolist()
        return shares

    @property
    def specific_force_flu_m_s2(self) -> Vector:
        return self._simulation.specific_force(0)

    @property
    def rate_setpoint_flu_rad_s(self) -> Vector:
        p, q, r = self._simulation.inner[tick.RATE_SETPOINT : tick.RATE_SETPOINT + 3, 0].tolist()
        return p, q, r


_STATE_MESSAGES = {
    "odometry": (mavlink.MAVLINK_MSG_ID_ODOMETRY,),
    "split": (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED),
}


def build(flight: Flight, recorder: Recorder, **options: Any) -> Vehicle:
    """The entry point `mavsitl.vehicle`: a vehicle core for the bridge's drivers."""
    return Vehicle(flight, recorder, **options)
