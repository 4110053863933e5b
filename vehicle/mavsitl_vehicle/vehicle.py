"""The vehicle: simulation and autopilot as one sans-IO core that a driver of the bridge runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mavsitl.codec import Counters
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl.keep import Work
from mavsitl.link.budget import Excess
from mavsitl.link.settings import LinkName, Overlay
from mavsitl.log.block import Array
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Failure, Flight
from mavsitl.signing import SigningMode
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot.autopilot import Autopilot
from mavsitl_vehicle.autopilot.battery import settings as battery_settings
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.seated import SeatedLaw
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, Setpoint
from mavsitl_vehicle.autopilot.wind_estimate import WindEstimate
from mavsitl_vehicle.failures import Change, Failures, Kind, Timeline, has_sensors, understood
from mavsitl_vehicle.kept import Kept
from mavsitl_vehicle.links import LinkControl
from mavsitl_vehicle.mishaps import Mishaps, ParameterTimeline
from mavsitl_vehicle.record import Record
from mavsitl_vehicle.sensors.status import Readings
from mavsitl_vehicle.simulation import Simulation

if TYPE_CHECKING:
    from mavsitl.chaos import Chaos


class Seat(NamedTuple):
    """A vehicle's place in a fleet: what is its own before there is an autopilot, and its column of a simulation."""

    kept: Kept
    failures: Failures
    simulation: Simulation
    column: int


def take_seats(
    flights: Sequence[Flight], kept: Sequence[Kept], seed: int, *, first: int = 0, shared_wind: bool = False
) -> list[Seat]:
    """For vehicles of one scenario that differ in where they start; those with sensors have a simulation each.

    `first`: the first one's number in the fleet, see `Simulation`.
    """
    failures = [Failures() for _ in flights]
    parameters = [each.parameters for each in kept]
    if has_sensors(flights[0].scenario):
        return [
            Seat(
                kept[j],
                failures[j],
                Simulation(flights[j], parameters[j], seed, 1, failures[j], first=first + j, shared_wind=shared_wind),
                0,
            )
            for j in range(len(flights))
        ]
    positions = [flight.scenario.start.position_nwu_m for flight in flights]
    simulation = Simulation(
        flights[0], parameters, seed, len(flights), failures,
        first=first, positions_nwu_m=positions, shared_wind=shared_wind,
    )  # fmt: skip
    return [Seat(each, broken, simulation, j) for j, (each, broken) in enumerate(zip(kept, failures, strict=True))]


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
        forwards: bool = True,
        stream_hz: float | None = None,
        seat: Seat | None = None,
    ) -> None:
        """`ports` name the links in order: "offboard", "gcs".

        In `lockstep` the state is streamed every tick from the first. `state` is a folder for what outlives the process
        (parameters, plans, the memory card), `logs` where its logs are; None: nothing is kept, or shown. `unix_us` is
        a clock that does not jump, for SYSTEM_TIME and signatures; None: not known, and then there is no signing. A
        first signing key is taken only where the links are `trusted`: on loopback.

        `forwards`: frames of others are passed on from link to link. `stream_hz`: default streams are no faster, and
        go out together. `seat`: of a fleet; what it keeps, its state,
        logs and clock, are then the seat's. None: a fleet of one.
        """
        self.period_us = flight.scenario.rates.control_period_us
        self._flight = flight
        self.system_id = system_id
        self._forwards = forwards
        self._stream_hz = stream_hz
        self._port_names = tuple(ports)
        self._lockstep = lockstep
        if seat is None:
            kept = Kept(flight, system_id=system_id, state=state, logs=logs, unix_us=unix_us, trusted=trusted)
            seat = take_seats([flight], [kept], seed)[0]
        self.kept, self.failures, self.simulation, self.column = seat
        self.parameters, self.plan = self.kept.parameters, self.kept.plan
        self._signing = self.kept.signing
        failures = Timeline(flight, self.failures, lockstep=lockstep)
        self.kept.say = lambda severity, text: self.autopilot.say(severity, text)
        self._seated = SeatedLaw(flight) if flight.scenario.controller.inner == "pidnn" else None
        recorder.begin(self.parameters.as_dict(), self.parameters.defaults)
        self._record = Record(recorder, flight, self.simulation, self.column, aboard=self._seated is not None)
        self.autopilot = self._boot(0)
        self.links = LinkControl(self.parameters, self.failures, flight.scenario, lockstep=lockstep)
        self.parameters.subscribe(self._on_parameter)
        self._mishaps = Mishaps(self)
        changes = ParameterTimeline(flight, self.parameters, self.warn)
        self._timelines: list[Timeline | ParameterTimeline] = [line for line in (failures, changes) if line]
        self._wind = None if lockstep else WindEstimate(flight.airframe, self.period_us / 1e6)
        self._now_us = -self.period_us
        self._held: bool | None = None
        self._at_rest: bool | None = None
        """What the simulation was told last; None: nothing. At rest is in the clamp, or disarmed on the ground."""
        self._running = True
        """The autopilot does, in this control period."""
        self._boot_us = 0
        """The driver's time at which the autopilot booted last."""
        self._clock_us = 0
        """The autopilot's clock at the last step."""
        self.finished = False
        """It has flown and is disarmed again."""
        self._recorder = recorder
        self._seed = seed
        self._chaos: Chaos | None = None
        if flight.scenario.chaos:
            self.chaos.schedule(flight.scenario.chaos)

    @property
    def chaos(self) -> Chaos:
        """Makes the vehicle misbehave by MAVLink's rules, e.g. ``vehicle.chaos.begin("ack-lost")``."""
        if self._chaos is None:
            from mavsitl.chaos import Chaos  # here, for few ask for it

            self._chaos = Chaos(
                [(port.name, port.node) for port in self.autopilot.ports],
                self._seed,
                now_us=max(self._now_us, 0),
                parameters=frozenset(self.parameters.names),
                note=lambda text: self._recorder.message(max(self._now_us, 0), mavlink.MAV_SEVERITY_WARNING, text),
            )
        return self._chaos

    @property
    def name(self) -> str:
        """The scenario's."""
        return self._flight.name

    def warn(self, text: str) -> None:
        """A warning for whoever flies it: a STATUSTEXT on every link."""
        self.autopilot.queue_text(mavlink.MAV_SEVERITY_WARNING, text)

    def set_load(self, load: float) -> None:
        """The share of a processor that the process takes, as its driver measures it: SYS_STATUS.load."""
        self.autopilot.load = load

    def unsaved(self, now_us: int) -> list[Work]:
        """What has to be on the disk soon. `now_us` is wall time. See `mavsitl.keep.Keeping`."""
        return self.kept.unsaved(now_us)

    def saved(self, work: Work, error: OSError | None, now_us: int) -> None:
        """What became of what `unsaved` gave."""
        self.kept.saved(work, error, now_us)

    def _boot(self, now_us: int) -> Autopilot:
        """An autopilot whose clock begins at `now_us` of the driver's."""
        kept, simulation, j = self.kept, self.simulation, self.column
        unix_us = 0 if kept.unix_us is None else kept.unix_us()
        autopilot = Autopilot(
            self._flight, self.system_id, self._port_names, self.parameters, _Body(simulation, j), kept.shared,
            lockstep=self._lockstep, unix_boot_us=unix_us, failures=self.failures,
            forwards=self._forwards, stream_hz=self._stream_hz, journal=self._record,
        )  # fmt: skip
        autopilot.estimate = simulation.estimates[j]
        autopilot.estimator_status = simulation.estimator_status
        if not self._lockstep:
            autopilot.set_home_here()  # MAVSDK asks for it as soon as it hears the vehicle
        else:
            for port in autopilot.ports:
                for message_id in _STATE_MESSAGES[self._flight.scenario.controller.telemetry]:
                    port.schedule.set_interval(message_id, self.period_us, 0)
        for note in kept.notes:
            autopilot.queue_text(mavlink.MAV_SEVERITY_WARNING, note)
        kept.notes.clear()
        kept.warn = self.warn
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
        return self._signing is not None and self._signing.active(self.kept.shared.trusted)

    @property
    def truth(self) -> Sequence[float]:
        """Position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s, rotor speeds rad/s: 17 numbers."""
        return self.autopilot.body.truth

    def check_failure(self, failure: Failure) -> None:
        """Raise ValueError for a failure that this vehicle cannot have."""
        understood(failure, self._flight.scenario, lockstep=self._lockstep)

    def inject(self, failure: Failure) -> None:
        """What an entry of the scenario's `[[failures]]` does when its time comes, now; it stays. Raises ValueError."""
        unit, kind = understood(failure, self._flight.scenario, lockstep=self._lockstep)
        self.failures.set(unit, kind, failure.instance, failure.value)

    def mend(self, failure: Failure) -> None:
        """What a failure names is well again. Raises ValueError."""
        unit, _ = understood(failure, self._flight.scenario, lockstep=self._lockstep)
        self.failures.set(unit, Kind.OK, failure.instance)

    @property
    def clock_us(self) -> int:
        """The autopilot's clock at the last step: since it booted."""
        return self._clock_us

    @property
    def weights(self) -> Array | None:
        """Output weights (3 outputs P I D, 3 axes, 1) of the PIDNN aboard; None where none is seated."""
        return None if self._seated is None else self._seated.weights

    @property
    def succeeded(self) -> bool:
        """As `finished`: for a vehicle every landing is one."""
        return self.finished

    @property
    def flight_time_s(self) -> float:
        """Since the release; negative before it."""
        released = self.autopilot.land.released_us
        return -1.0 if released is None else (self._now_us - self._boot_us - released) / 1e6

    @property
    def counters(self) -> Any:
        """Frames received and refused, by reason, of all links."""
        return sum((port.node.counters for port in self.autopilot.ports), Counters())

    def subscribe_links(self, listener: Callable[[LinkName, Overlay], None]) -> None:
        """`listener(link, overlay)` is told of what parameters and failures make of a link: now, and at each change.

        The vehicle itself delays and loses nothing.
        """
        self.links.subscribe(listener)

    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int:
        """One datagram from a link; the number of valid frames in it.

        What it decides counts from the last tick. `at_us`, between that and the next, is what the services' clock
        shows, TIMESYNC's above all; None: the tick.
        """
        if self._mishaps.stalled:
            return 0
        if at_us is not None:
            at_us -= self._boot_us
        return self.autopilot.receive(port, datagram, self._clock_us, at_us)

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
        flight_time_s = self.decide(now_us)
        if not first:
            self.simulation.advance(flight_time_s)
        self.observe(now_us)

    def decide(self, now_us: int) -> float:
        """Before the physics up to `now_us`: what the inner loops shall follow until then.

        Returns the flight's time at their beginning, negative before the release.
        """
        first = self._now_us < 0
        for timeline in self._timelines:
            timeline.step(self._now_us, self.flight_time_s)
        self._now_us = now_us
        if self._chaos is not None:
            self._chaos.step(now_us, self.flight_time_s)
        self._running = running = not (self._mishaps.busy and self._mishaps.step(now_us, self.period_us))
        if running and self.autopilot.reboot_requested and not self._lockstep:
            self._reboot(now_us)
        autopilot, simulation, j = self.autopilot, self.simulation, self.column
        now_us -= self._boot_us
        self._clock_us = now_us
        if first or not now_us:
            return -1.0
        land = autopilot.land
        if running:
            held = land.held
            at_rest = held or (land.on_ground and not autopilot.commander.armed)
            if held is not self._held or at_rest is not self._at_rest:
                simulation.held[j], simulation.at_rest[j] = self._held, self._at_rest = held, at_rest
            setpoint = autopilot.decide(now_us - self.period_us)
            if self._seated is not None:
                setpoint = self._inner_law(self._seated, setpoint)
            simulation.set_demand(j, setpoint)
        released_us = land.released_us
        return -1.0 if released_us is None else (now_us - self.period_us - released_us) / 1e6

    def observe(self, now_us: int) -> None:
        """After the physics up to `now_us`: what the vehicle makes of it, says and logs."""
        autopilot, simulation, j = self.autopilot, self.simulation, self.column
        if self._running:
            now_us = self._clock_us
            autopilot.estimate = simulation.estimates[j]
            if simulation.sensed is not None:
                autopilot.estimator_status = simulation.sensed.status
            if self._wind is not None:
                estimate = np.ascontiguousarray(simulation.estimate[:, j : j + 1])
                self._wind.update(estimate, simulation.demand[tick.THRUST, j], not autopilot.on_ground)
                autopilot.wind = self._wind.value
            autopilot.observe(now_us)
            autopilot.report(now_us)
        self._record.write(self._now_us, self)
        if self._signing is not None:
            self._signing.policy.locked = autopilot.commander.armed
        if autopilot.land.released_us is not None and not autopilot.commander.armed:
            self.finished = True
            self._after_flight()

    def note_failure(self, change: Change) -> None:
        """A failure was injected or cleared, whoever asked for it: say so on every link and in the log."""
        severity = mavlink.MAV_SEVERITY_NOTICE if change.kind is Kind.OK else mavlink.MAV_SEVERITY_WARNING
        self.autopilot.queue_text(severity, change.text)
        self._record.failed(max(self._now_us, 0), change)

    def note(self, text: str) -> None:
        """Something happened to the vehicle: say so on every link and in the log."""
        self.autopilot.queue_text(mavlink.MAV_SEVERITY_WARNING, text)

    def close(self) -> None:
        """Close the files that clients had open. What is `unsaved` afterwards is the last there is to write."""
        for port in self.autopilot.ports:
            port.close()
        self.kept.close()

    def _after_flight(self) -> None:
        """Ready for the next: where the flight began in a clamp, the clamp takes the vehicle back."""
        if self._flight.scenario.start.clamp:
            self.simulation.put_back(self.column)
            self.autopilot.land.put_back()
        if self.autopilot.on_ground:
            self.autopilot.land.released_us = None

    def _reboot(self, now_us: int) -> None:
        """PREFLIGHT_REBOOT_SHUTDOWN: clock, links and autopilot begin anew; the vehicle stays where it stands.

        One that has fallen over is set upright there.
        """
        old = self.autopilot
        if not old.health.upright and old.on_ground:
            self.simulation.set_upright(self.column)
        self.simulation.restart_estimator()
        self._boot_us = now_us
        self._mishaps.mend()
        self.plan.stores.transaction = None  # it counts in the old time
        self.autopilot = self._boot(now_us)
        self.autopilot.land.held = old.land.held
        for port, before in zip(self.autopilot.ports, old.ports, strict=True):
            port.node = before.node  # the answer to the command is still in it, and clients count on with its numbers
            before.close()

    def _on_parameter(self, name: str, value: float) -> None:
        self._record.parameter(name, value)
        self.simulation.set_parameter(self.column, name)
        if name == "MAV_SIGN_CFG" and self._signing is not None:
            self._signing.policy.mode = SigningMode(int(value))
        if name.startswith(("BAT", "SIM_BAT")):
            self.autopilot.battery.settings = battery_settings(self.parameters)

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        """What goes out on a link: one message a datagram, or all of a tick in one (`combine`)."""
        return self.autopilot.ports[port].node.datagrams(combine)

    def _inner_law(self, law: SeatedLaw, setpoint: Setpoint | None) -> Setpoint | None:
        """With the PIDNN aboard, an off-board attitude becomes a torque by it; all else passes."""
        if not isinstance(setpoint, AttitudeSetpoint) or self.autopilot.commander.mode is not Mode.OFFBOARD:
            return setpoint
        if self.autopilot.land.released_us is None:
            law.reset()
        return law.update(setpoint, self.autopilot.setpoint_us or 0, self.simulation.estimate[:, self.column])


class _Body:
    """The simulation as the autopilot's telemetry looks at it."""

    def __init__(self, simulation: Simulation, column: int) -> None:
        self._simulation = simulation
        self._column = column

    @property
    def truth(self) -> Sequence[float]:
        truth: list[float] = self._simulation.x[:, self._column].tolist()
        return truth

    @property
    def true_wind(self) -> Vector:
        x, y, z = self._simulation.wind[:, self._column].tolist()
        return x, y, z

    @property
    def readings(self) -> Readings | None:
        return self._simulation.readings

    @property
    def rotor_speeds_rad_s(self) -> Sequence[float]:
        speeds: list[float] = self._simulation.x[13:17, self._column].tolist()
        return speeds

    @property
    def outputs(self) -> Sequence[float]:
        simulation, j = self._simulation, self._column
        largest = simulation.gains[tick.MAX_ROTOR_SPEED, j]
        shares: list[float] = (simulation.motors[j].commanded_rad_s / largest).tolist()
        return shares

    @property
    def specific_force_flu_m_s2(self) -> Vector:
        return self._simulation.specific_force(self._column)

    @property
    def rate_setpoint_flu_rad_s(self) -> Vector:
        p, q, r = self._simulation.inner[tick.RATE_SETPOINT : tick.RATE_SETPOINT + 3, self._column].tolist()
        return p, q, r


_STATE_MESSAGES = {
    "odometry": (mavlink.MAVLINK_MSG_ID_ODOMETRY,),
    "split": (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED),
}


def build(flight: Flight, recorder: Any, *, count: int | None = None, **options: Any) -> Any:
    """The entry point `mavsitl.vehicle`: a vehicle core for the bridge's drivers; with `count` a `Fleet`.

    `recorder` is one of these, for a fleet as many.
    """
    if count is None:
        return Vehicle(flight, recorder, **options)
    from mavsitl_vehicle.fleet import Fleet  # here, for it is made of vehicles

    return Fleet(flight, recorder, count=count, **options)
