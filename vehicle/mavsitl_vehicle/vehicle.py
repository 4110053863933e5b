"""The vehicle: simulation and autopilot as one sans-IO core that a driver of the bridge runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.codec import Counters
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl.keep import Work
from mavsitl.link.budget import Excess
from mavsitl.link.settings import LinkName, Overlay
from mavsitl.log.block import Array
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl.services.files import Folder, Quota
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
from mavsitl_vehicle.failures import Change, Failures, Kind, Timeline
from mavsitl_vehicle.links import LinkControl, initial_links
from mavsitl_vehicle.mishaps import Mishaps, ParameterTimeline
from mavsitl_vehicle.record import Record
from mavsitl_vehicle.sensors.status import Readings
from mavsitl_vehicle.simulation import Simulation

if TYPE_CHECKING:
    from mavsitl.chaos import Chaos

PLAN_SCHEMA = 1
SIGNING_SCHEMA = 1


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
        """What was wrong before there was an autopilot to say it."""
        self._booted = False
        self.parameters = Parameters(
            *(Layer(name, values) for name, values in initial_links(flight.scenario).items()),
            Layer(f"airframe {flight.scenario.airframe}", flight.airframe.parameters),
            Layer(flight.name, flight.scenario.parameters),
            Layer("system id", {"MAV_SYS_ID": system_id}),
        )
        if state is not None:
            with suppress(OSError):  # the stores say what is wrong
                state.mkdir(mode=0o700, parents=True, exist_ok=True)  # the signing key will be in it
        parameter_store = keep_parameters(self.parameters, state, self.warn)
        self.parameters.put("MAV_SYS_ID", system_id)  # what was kept does not outweigh what was asked for
        plan_store = Store(state, "plan", PLAN_SCHEMA, self.warn)
        self.plan = VehiclePlan(
            report=lambda severity, text: self.autopilot.say(severity, text),
            changed=lambda mission_type: plan_store.put(self.plan.to_document),
        )
        self._load_plan(plan_store)
        self._signing_store = Store(state, "signing", SIGNING_SCHEMA, self.warn, private=True)
        self._signing = self._load_signing()
        self._signing_state = SigningState()
        """What the signing store was given last."""
        self._closed = False
        self._stores = (parameter_store, plan_store, self._signing_store)
        self._writing: dict[Work, Store] = {}
        """Taken from the stores, and not known to be written yet."""
        self._shared = Shared(
            self.parameters, self.plan, card=self._card(state), logs=logs, signing=self._signing, trusted=trusted
        )
        self.failures = Failures()
        self._timeline = Timeline(flight, self.failures, lockstep=lockstep)
        self.simulation = Simulation(flight, self.parameters, seed, failures=self.failures)
        self.autopilot = self._boot(0)
        self.links = LinkControl(self.parameters, self.failures, flight.scenario, lockstep=lockstep)
        self.parameters.subscribe(self._on_parameter)
        self._mishaps = Mishaps(self)
        self._changes = ParameterTimeline(flight, self.parameters, self.warn)
        self._seated = SeatedLaw(flight) if flight.scenario.controller.inner == "pidnn" else None
        self._wind = None if lockstep else WindEstimate(flight.airframe, self.period_us / 1e6)
        self._record = Record(recorder, flight, aboard=self._seated is not None)
        self._now_us = -self.period_us
        self._boot_us = 0
        """The driver's time at which the autopilot booted last."""
        self._done = False
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

    def _load_plan(self, store: Store) -> None:
        content = store.load()
        if content:
            try:
                self.plan.load_document(content)
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

    def _card(self, state: Path | None) -> Folder | None:
        """The memory card; None without a state folder, or where that cannot be used."""
        if state is None:
            return None
        try:
            return Folder(state / "card", Quota(), settles_later=True)
        except OSError as error:
            self.warn(f"{state / 'card'}: no memory card: {error.strerror or error}")
            return None

    def warn(self, text: str) -> None:
        """A warning for whoever flies it: a STATUSTEXT on every link."""
        if self._booted:
            self.autopilot.queue_text(mavlink.MAV_SEVERITY_WARNING, text)
        else:
            self._notes.append(text)

    def unsaved(self, now_us: int) -> list[Work]:
        """What has to be on the disk soon. `now_us` is wall time. See `mavsitl.keep.Keeping`."""
        if self._signing is not None and not self._closed:
            self._keep_signing(self._signing.unsaved())
        work: list[Work] = []
        for store in self._stores:
            document = store.take(now_us)
            if document is not None:
                self._writing[document] = store
                work.append(document)
        if self._shared.card is not None:
            work += self._shared.card.unsettled()
        return work

    def saved(self, work: Work, error: OSError | None, now_us: int) -> None:
        """What became of what `unsaved` gave."""
        store = self._writing.pop(work, None)
        if store is None:
            if error is not None:
                self.warn(f"memory card: {error.strerror or error}")
            return
        store.written(error, now_us)
        if store is self._signing_store and self._signing is not None and error is None:
            self._signing.saved(self._signing_state)

    def _keep_signing(self, state: SigningState | None) -> None:
        if state is not None:
            self._signing_state = state
            self._signing_store.put({"state": state.to_bytes().hex()})

    def _boot(self, now_us: int) -> Autopilot:
        """An autopilot whose clock begins at `now_us` of the driver's."""
        unix_us = 0 if self._unix_us is None else self._unix_us()
        autopilot = Autopilot(
            self._flight, self._system_id, self._port_names, self.parameters, _Body(self.simulation), self._shared,
            lockstep=self._lockstep, unix_boot_us=unix_us, failures=self.failures,
        )  # fmt: skip
        autopilot.estimate = self.simulation.estimate[:, 0].tolist()
        autopilot.estimator_status = self.simulation.estimator_status
        if not self._lockstep:
            autopilot.set_home_here()  # MAVSDK asks for it as soon as it hears the vehicle
        else:
            for port in autopilot.ports:
                for message_id in _STATE_MESSAGES[self._flight.scenario.controller.telemetry]:
                    port.schedule.set_interval(message_id, self.period_us, 0)
        for note in self._notes:
            autopilot.queue_text(mavlink.MAV_SEVERITY_WARNING, note)
        self._notes.clear()
        self._booted = True
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
        if self._timeline:
            self._timeline.step(self._now_us, self.flight_time_s)
        if self._changes:
            self._changes.step(self._now_us, self.flight_time_s)
        self._now_us = now_us
        if self._chaos is not None:
            self._chaos.step(now_us, self.flight_time_s)
        running = not (self._mishaps.busy and self._mishaps.step(now_us, self.period_us))
        if running and self.autopilot.reboot_requested and not self._lockstep:
            self._reboot(now_us)
        autopilot, simulation = self.autopilot, self.simulation
        now_us -= self._boot_us
        if not first and now_us:
            if running:
                simulation.held[0] = autopilot.land.held
                simulation.at_rest[0] = autopilot.at_rest
                setpoint = autopilot.decide(now_us - self.period_us)
                simulation.set_demand(0, self._inner_law(setpoint))
            released_us = autopilot.land.released_us
            flown_s = -1.0 if released_us is None else (now_us - self.period_us - released_us) / 1e6
            simulation.advance(flown_s)
        if running:
            autopilot.estimate = simulation.estimate[:, 0].tolist()
            autopilot.estimator_status = simulation.estimator_status
            if self._wind is not None:
                self._wind.update(simulation.estimate, simulation.demand[tick.THRUST, 0], not autopilot.on_ground)
                autopilot.wind = self._wind.value
            autopilot.observe(now_us)
            autopilot.report(now_us)
        self._record.write(self._now_us, self)
        if self._signing is not None:
            self._signing.policy.locked = autopilot.commander.armed
        if autopilot.land.released_us is not None and not autopilot.commander.armed:
            self._done = True
            self._after_flight()

    def note_failure(self, change: Change) -> None:
        """A failure was injected or cleared, whoever asked for it: say so on every link and in the log."""
        severity = mavlink.MAV_SEVERITY_NOTICE if change.kind is Kind.OK else mavlink.MAV_SEVERITY_WARNING
        self.autopilot.queue_text(severity, change.text)
        self._record.failed(max(self._now_us, 0), severity, change)

    def note(self, text: str) -> None:
        """Something happened to the vehicle: say so on every link and in the log."""
        self.autopilot.queue_text(mavlink.MAV_SEVERITY_WARNING, text)
        self._record.note(max(self._now_us, 0), mavlink.MAV_SEVERITY_WARNING, text)

    def close(self) -> None:
        """Close the files that clients had open. What is `unsaved` afterwards is the last there is to write."""
        for port in self.autopilot.ports:
            port.close()
        if self._signing is not None and (self._signing.has_key or self._signing.unsaved() is not None):
            self._keep_signing(self._signing.closing_state())
        self._closed = True

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
    def readings(self) -> Readings | None:
        return self._simulation.readings

    @property
    def rotor_speeds_rad_s(self) -> Sequence[float]:
        speeds: list[float] = self._simulation.x[13:17, 0].tolist()
        return speeds

    @property
    def outputs(self) -> Sequence[float]:
        largest = self._simulation.gains[tick.MAX_ROTOR_SPEED]
        shares: list[float] = (self._simulation.motors.commanded_rad_s / largest).tolist()
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
