"""Scenarios: one TOML file says what flies, in what air, under which controller. Strict, frozen, units in key names.

``load`` finds a shipped scenario by name or reads a file by path, and raises `ScenarioError` with the file, the key and
what is allowed for whatever it does not accept.
"""

from __future__ import annotations

import copy
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import msgspec

from mavsitl.airframes import Airframe, NonNegative, Positive
from mavsitl.errors import UsageError, did_you_mean

Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Level: TypeAlias = Literal["attitude", "body_rate", "torque"]
Vector3: TypeAlias = tuple[float, float, float]

MICROSECONDS_PER_SECOND = 1_000_000


class ScenarioError(UsageError):
    """The user's scenario or airframe file is wrong; the message names the file, the key and what is allowed."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What all parts of a scenario share: frozen, and strict about unknown keys."""


_S = TypeVar("_S", bound=Section)


class Rates(Section, frozen=True):
    physics_hz: Annotated[int, msgspec.Meta(ge=50, le=20_000)] = 1000
    control_hz: Annotated[int, msgspec.Meta(ge=10, le=1000)] = 250
    """Off-board cycle: telemetry out, setpoint in. A whole number of milliseconds, as the wire's stamp is in ms."""

    @property
    def control_period_us(self) -> int:
        return MICROSECONDS_PER_SECOND // self.control_hz

    @property
    def substeps(self) -> int:
        return self.physics_hz // self.control_hz


class Start(Section, frozen=True):
    position_nwu_m: Vector3 = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    clamp: bool = False
    """Held at the start pose, rotors free, until it has been armed in OFFBOARD for COM_SPOOLUP_TIME."""
    latitude_deg: Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)] = 47.397742
    """Of the world's origin, with the two below; defaults are PX4 SITL's home."""
    longitude_deg: Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)] = 8.545594
    altitude_amsl_m: Annotated[float, msgspec.Meta(ge=-500.0, le=10_000.0)] = 488.0
    """Of the plane z = 0."""


class Offnominal(Section, frozen=True):
    """What the vehicle is and the controller does not know."""

    mass_scale: Positive = 1.0
    inertia_scale: Positive = 1.0
    rotor_thrust_scale: tuple[NonNegative, NonNegative, NonNegative, NonNegative] = (1.0, 1.0, 1.0, 1.0)


class Steady(Section, frozen=True, tag_field="model", tag="steady"):
    """A constant wind: the air moves along `velocity_nwu_m_s`."""

    velocity_nwu_m_s: Vector3


class Gust(Section, frozen=True, tag_field="model", tag="gust"):
    """MIL-F-8785C's 1-cosine gust: 0 before `start_s`, rising over `length_s` to its amplitude, then held or gone.

    `start_s` is flight time.
    """

    velocity_nwu_m_s: Vector3
    start_s: NonNegative
    length_s: Positive
    shape: Literal["pulse", "ramp"] = "pulse"


class DrydenPaper(Section, frozen=True, tag_field="model", tag="dryden-paper"):
    """Eqs 14-17 with Table 1's numbers (sigma_v = sigma_u^2 / sigma_w as printed, metres in the formulas)."""

    speed_20ft_m_s: NonNegative = 10.0
    """0: no turbulence."""
    altitude_m: Positive = 1.0
    form: Literal["first-order", "spectrum"] = "first-order"
    """``first-order``: the filters of eq 17; ``spectrum``: second-order v and w filters that have eq 14's densities."""
    intensity: Literal["two-pi", "unit"] = "two-pi"
    """Intensity of eq 16's white noise: R(tau) = 2 pi delta(tau), which gives sigma, or delta(tau) as the words say."""


class DrydenMil(Section, frozen=True, tag_field="model", tag="dryden-mil"):
    """MIL-F-8785C / MIL-HDBK-1797 low-altitude model, turned with the mean wind; the mean included on request."""

    speed_20ft_m_s: NonNegative
    """0: no turbulence, no mean."""
    altitude_m: Annotated[float, msgspec.Meta(gt=0.0, le=304.8)]
    from_deg: float = 0.0
    """Where the mean wind comes from, clockwise from north."""
    include_mean: bool = False


Wind: TypeAlias = Steady | Gust | DrydenPaper | DrydenMil


class Noise(Section, frozen=True):
    """1-sigma of the Gaussian white noise on every feedback variable (section 5 of the paper; levels: see the docs).

    Only with estimator.kind = "white-noise".
    """

    position_m: NonNegative = 0.005
    velocity_m_s: NonNegative = 0.005
    attitude_deg: NonNegative = 0.02
    rate_deg_s: NonNegative = 0.1


SensorRate = Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)]
SensorDelay = Annotated[float, msgspec.Meta(ge=0.0, le=500.0)]


class Imu(Section, frozen=True):
    """Gyroscope and accelerometer, sampled at every physics step; the defaults are of ICM-20689's class, calibrated."""

    gyro_noise_deg_s_rt_hz: NonNegative = 0.006
    gyro_bias_deg_s: NonNegative = 0.5
    """1 sigma of the offset at switching on, each axis for itself."""
    gyro_bias_walk_deg_s_rt_s: NonNegative = 0.003
    """The offset's random walk: 1 sigma of its change in a second."""
    accel_noise_m_s2_rt_hz: NonNegative = 0.0015
    accel_bias_m_s2: NonNegative = 0.03
    """1 sigma of what is left of the offset after calibration."""
    accel_bias_walk_m_s2_rt_s: NonNegative = 0.0003


class Gps(Section, frozen=True):
    """Position and velocity; the defaults are of a u-blox M8 or M9. Noise is 1 sigma of each fix, drift correlated."""

    rate_hz: SensorRate = 10.0
    delay_ms: SensorDelay = 100.0
    """From the measurement to its arrival; the filter knows it."""
    horizontal_noise_m: NonNegative = 0.1
    vertical_noise_m: NonNegative = 0.2
    horizontal_drift_m: NonNegative = 1.0
    """1 sigma of the slow error of each axis, a first-order Gauss-Markov process."""
    vertical_drift_m: NonNegative = 1.5
    drift_time_s: Positive = 100.0
    """Correlation time of the slow error."""
    velocity_noise_m_s: NonNegative = 0.05


class Barometer(Section, frozen=True):
    """Height by pressure; the defaults are of MS5611's class."""

    rate_hz: SensorRate = 50.0
    delay_ms: SensorDelay = 0.0
    noise_m: NonNegative = 0.15
    offset_m: NonNegative = 5.0
    """1 sigma of the weather's offset from the standard atmosphere at the start."""
    drift_m_rt_s: NonNegative = 0.01
    """The offset's random walk: 1 sigma of its change in a second."""


class Magnetometer(Section, frozen=True):
    """The Earth's field in body axes."""

    rate_hz: SensorRate = 50.0
    delay_ms: SensorDelay = 0.0
    noise_gauss: NonNegative = 0.003
    offset_gauss: NonNegative = 0.003
    """1 sigma of what is left of the vehicle's own field after calibration, each axis for itself."""


class Estimator(Section, frozen=True):
    """Where the vehicle's state is from: the truth with white noise (table noise), or an EKF over these sensors."""

    kind: Literal["white-noise", "ekf"] = "white-noise"
    imu: Imu = Imu()
    gps: Gps = Gps()
    barometer: Barometer = Barometer()
    magnetometer: Magnetometer = Magnetometer()


Milliseconds = Annotated[float, msgspec.Meta(ge=0.0, le=10_000.0)]
QueueBytes = Annotated[int, msgspec.Meta(ge=280, le=1_000_000)]


class Bursts(Section, frozen=True):
    """Gilbert and Elliott's two states in simulated time; the time spent in each is exponentially distributed."""

    bad_ms: Milliseconds = 0.0
    """Mean length of a burst; 0: none."""
    good_ms: Annotated[float, msgspec.Meta(ge=1.0)] = 2000.0
    """Mean time between two bursts."""
    loss_bad: Fraction = 1.0
    loss_good: Fraction = 0.0


class Outage(Section, frozen=True):
    """Everything sent from `start_s` on is lost, for `duration_s`."""

    start_s: NonNegative
    duration_s: Positive
    clock: Literal["flight", "simulated"] = "flight"
    """Of `start_s`: since the release or the lift-off, or since the vehicle's start."""


class Impairment(Section, frozen=True):
    """What one direction of a link does to the messages on it. The default does nothing."""

    latency_ms: Milliseconds = 0.0
    jitter_ms: Milliseconds = 0.0
    """Half the width of ``uniform``, 1 sigma of ``normal`` and ``gamma``; each message has a delay of its own."""
    distribution: Literal["uniform", "normal", "gamma"] = "normal"
    """Of the delay, with mean `latency_ms`; ``normal`` is cut at 0."""
    keep_order: bool = False
    """True: none overtakes an earlier one, it waits for it; jitter then adds to the mean delay."""
    loss: Fraction = 0.0
    """Each message for itself, beside what bursts lose."""
    bursts: Bursts = Bursts()
    reorder: Fraction = 0.0
    """Share of messages held back by `reorder_ms` more, so that later ones overtake them."""
    reorder_ms: Milliseconds = 20.0
    duplicate: Fraction = 0.0
    """Share of messages of which a second copy comes, with a delay of its own."""
    corrupt: Fraction = 0.0
    """Share of messages of which one to three bits are flipped."""
    bandwidth_kbit_s: NonNegative = 0.0
    """MAVLink bytes alone are counted; 0: unlimited."""
    queue_bytes: QueueBytes = 8192
    """Waiting for the bandwidth; what does not fit any more is lost."""
    outages: tuple[Outage, ...] = ()
    down: bool = False
    """Everything is lost, until it is changed."""


class LinkChange(Section, frozen=True):
    """From `at_s` on the keys that stand here hold, for what is sent then; the others stay as they are."""

    at_s: NonNegative
    clock: Literal["flight", "simulated"] = "flight"
    """Of `at_s`, as in `outages`. The next flight of the same vehicle goes through its changes again."""
    direction: Literal["both", "to_ground", "to_vehicle"] = "both"
    latency_ms: Milliseconds | None = None
    jitter_ms: Milliseconds | None = None
    distribution: Literal["uniform", "normal", "gamma"] | None = None
    keep_order: bool | None = None
    loss: Fraction | None = None
    bursts: Bursts | None = None
    """As a whole: what is left out of it is the default."""
    reorder: Fraction | None = None
    reorder_ms: Milliseconds | None = None
    duplicate: Fraction | None = None
    corrupt: Fraction | None = None
    bandwidth_kbit_s: NonNegative | None = None
    queue_bytes: QueueBytes | None = None
    down: bool | None = None

    def of(self, impairment: Impairment) -> Impairment:
        """What a direction's impairment becomes."""
        given = {key: value for key in _CHANGEABLE if (value := getattr(self, key)) is not None}
        return msgspec.structs.replace(impairment, **given)


_CHANGEABLE = tuple(key for key in LinkChange.__struct_fields__ if key in Impairment.__struct_fields__)


class LinkModel(Section, frozen=True):
    """A link, direction by direction."""

    to_ground: Impairment = Impairment()
    """Telemetry and acknowledgements."""
    to_vehicle: Impairment = Impairment()
    """Setpoints and commands."""
    changes: tuple[LinkChange, ...] = ()
    """What changes as time goes, in this order."""
    live: bool = False
    """True: in lock-step the exchange is that of an impaired link even if nothing is impaired yet, so that parameters
    may change it. Any other key that is not the default does the same; in real time they always may.
    """


class ChaosWindow(Section, frozen=True):
    """The vehicle misbehaves on purpose, from `start_s` on, for `duration_s`. See the how-to on protocol chaos."""

    mode: str
    """A mode with its arguments, e.g. `ack-late:2.5`; `mavsitl chaos` lists all."""
    port: Literal["all", "offboard", "gcs"] = "all"
    start_s: NonNegative = 0.0
    duration_s: Positive | None = None
    """None: to the end."""
    clock: Literal["flight", "simulated"] = "simulated"
    """Of `start_s`: since the release or the lift-off, or since the vehicle's start."""


class Failure(Section, frozen=True):
    """A part of the vehicle fails at `start_s`: what MAV_CMD_INJECT_FAILURE does, by the scenario's time line.

    Which `type` each `unit` knows is in the reference of failures.
    """

    unit: Literal["gyro", "accel", "mag", "baro", "gps", "battery", "motor", "rc", "mavlink"]
    """FAILURE_UNIT"""
    type: Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
    """FAILURE_TYPE"""
    start_s: NonNegative
    instance: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Counted from 1; 0: all."""
    duration_s: NonNegative = 0.0
    """0: it stays."""
    clock: Literal["flight", "simulated"] = "flight"
    """Of `start_s`: since the release or the lift-off, or since the vehicle's start."""
    value: float | None = None
    """How much, where the reference has a number for it; else its default."""


class ParameterChange(Section, frozen=True):
    """Parameters of the vehicle are set at `at_s`: what PARAM_SET does, by the scenario's time line."""

    at_s: NonNegative
    parameters: dict[str, float]
    """E.g. `SIM_GUST_TRIG = 1`, `SIM_CPU_STALL = 0.5`; one that the vehicle refuses then is said and left."""
    clock: Literal["flight", "simulated"] = "flight"
    """Of `at_s`: since the release or the lift-off, or since the vehicle's start."""


class Fleet(Section, frozen=True):
    """Of a run with `--count`: vehicle 0 starts where the scenario says, the others where the formation has them."""

    formation: Literal["grid", "line", "circle"] = "grid"
    """A square filled row by row, eastward, then southward; a line to the east; a circle with vehicle 0 in the north.
    References are shifted alike."""
    spacing_m: Positive = 3.0
    """Between neighbours."""
    shared_wind: bool = False
    """True: one turbulence that is everywhere the same; false: each vehicle has its own."""
    collision_m: NonNegative = 0.5
    """Two vehicles nearer than this have collided; 0: they are not looked at."""
    collision_hz: Annotated[int, msgspec.Meta(ge=1, le=50)] = 20
    """How often they are looked at."""
    on_collision: Literal["report", "crash"] = "report"
    """What it does: it is said to both and logged; or all rotors of both fail as well."""
    stream_hz: Positive | None = None
    """None: default streams as a single vehicle's. Else none is faster, and those that are due go out together; in real
    time. What a client asks for is sent as it asks."""


class Hover(Section, frozen=True, tag_field="kind", tag="hover"):
    position_nwu_m: Vector3 = (0.0, 0.0, 1.0)
    yaw_deg: float = 0.0


class Spiral(Section, frozen=True, tag_field="kind", tag="spiral"):
    """Section 5.2: X_d = [r sin(w t), r cos(w t), v t]."""

    radius_m: Positive = 1.0
    rate_rad_s: Positive = 0.2094
    climb_m_s: float = 0.0333


class Step(Section, frozen=True):
    time_s: NonNegative
    position_nwu_m: Vector3
    yaw_deg: float = 0.0


class Steps(Section, frozen=True, tag_field="kind", tag="steps"):
    """Holds each position from its time on."""

    steps: Annotated[tuple[Step, ...], msgspec.Meta(min_length=1)]


class Figure8(Section, frozen=True, tag_field="kind", tag="figure-8"):
    """A Gerono lemniscate, entered from its centre with a smooth start over `ramp_s`."""

    length_m: Positive = 4.0
    width_m: Positive = 2.0
    period_s: Positive = 12.0
    altitude_m: float = 1.0
    ramp_s: NonNegative = 4.0


class Waypoints(Section, frozen=True, tag_field="kind", tag="waypoints"):
    """Straight legs at `speed_m_s` through the rows of a CSV file: x, y, z in m NWU, yaw in degrees, hold in s."""

    file: str
    speed_m_s: Positive = 1.0


Reference: TypeAlias = Hover | Spiral | Steps | Figure8 | Waypoints


class Gains(Section, frozen=True):
    """A PID on acceleration: acceleration = k_p e + k_i integral(e) + k_d e'."""

    k_p_per_s2: NonNegative
    k_i_per_s3: NonNegative
    k_d_per_s: NonNegative


class Learning(Section, frozen=True):
    """On-line learning of the three PIDNNs, eqs 30-57, and the guards that keep it stable (docs: explanation/pidnn)."""

    rate: tuple[NonNegative, NonNegative, NonNegative] = (13.4, 13.4, 13.4)
    """eta of the P, I and D output weights (eq 31), relative to each weight's initial value."""
    projection: tuple[Fraction, Annotated[float, msgspec.Meta(ge=1.0)]] = (0.5, 1.5)
    """Output weights stay within these multiples of their initial value."""
    leakage_per_s: NonNegative = 0.1
    """Pull of each weight towards its initial value."""
    dead_zone_deg: NonNegative = 0.1
    """No learning from a tracking error smaller than this."""
    guards: bool = True
    """False: the law as printed, with no projection, leakage or dead zone. It diverges in turbulence."""
    bound: Literal["derived", "printed", "none"] = "derived"
    """Largest rate by eqs 54 and 57: 2 / (o delta)^2 as derived, 8 / (o delta)^2 as printed, or none."""
    delta: Literal["known", "printed"] = "known"
    """delta of eq 33: the known sign +1, or eq 37 as printed (0 where its denominator vanishes)."""
    input_weights: Literal["fixed", "learned"] = "fixed"
    """Input weights: +1 and -1 (eq 38), or learned by eqs 34-36."""


class WindObserver(Section, frozen=True):
    """Bandwidths of the velocity disturbance observer that stands in for W_1..W_3."""

    horizontal_rad_s: Positive = 9.926
    vertical_rad_s: Positive = 16.5


class Controller(Section, frozen=True):
    """Gains, angle filter, learning rate and observer are what `mavsitl tune --against start --no-worse 1.02` found on
    the paper's airframe from ones set by hand; the whole command, and what it was judged by: docs, howto/tuning.
    """

    law: Literal["pidnn", "pid"] = "pidnn"
    level: Level = "body_rate"
    """Where the loop closes: q + thrust, body rates + thrust, or U1..U4 over the wire."""
    inner: Literal["stock", "pidnn"] = "stock"
    """Level `attitude` only: the vehicle's stock cascade, or the same PIDNN seated aboard."""
    own: str = ""
    """A controller in place of the paper's: an installed one's name, FILE.py:NAME or MODULE:NAME. Of this table then
    `telemetry` alone has a meaning. Empty: the paper's."""
    wind_information: Literal["oracle", "observer", "none"] = "observer"
    """W_1..W_3 of eqs 19-26: true wind (no real vehicle has it), estimated from telemetry, or 0."""
    telemetry: Literal["odometry", "split"] = "odometry"
    """State from ODOMETRY, or from ATTITUDE_QUATERNION and LOCAL_POSITION_NED."""
    derivative: Literal["rate", "difference"] = "rate"
    """The D neuron's input: the measured body rate, or the differenced angle error of eq 28."""
    altitude: Gains = Gains(k_p_per_s2=5.29, k_i_per_s3=0.608, k_d_per_s=6.67)
    position: Gains = Gains(k_p_per_s2=11.56, k_i_per_s3=0.216, k_d_per_s=5.277)
    roll_pitch: Gains = Gains(k_p_per_s2=1600.0, k_i_per_s3=639.3, k_d_per_s=89.51)
    """For ideal rotors; with 30 ms of lag they are unstable, see the scenario hover-wind-realistic."""
    yaw: Gains = Gains(k_p_per_s2=440.6, k_i_per_s3=463.5, k_d_per_s=88.61)
    angle_filter_rad_s: NonNegative = 7.98
    """First-order filter on phi_d and theta_d; 0 is none."""
    tilt_limit_deg: Annotated[float, msgspec.Meta(gt=0.0, lt=90.0)] = 50.0
    learning: Learning = Learning()
    wind_observer: WindObserver = WindObserver()


class Scenario(Section, frozen=True):
    title: str
    description: str = ""
    duration_s: Positive = 60.0
    """Flight time, from the release of the clamp or the first lift-off."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 1
    airframe: str = "paper"
    """A shipped airframe's name or the path of a TOML file."""
    rates: Rates = Rates()
    start: Start = Start()
    offnominal: Offnominal = Offnominal()
    ground_contact: bool = True
    """False: no ground, as in the paper."""
    wind: tuple[Wind, ...] = ()
    """Summed."""
    noise: Noise = Noise()
    estimator: Estimator = Estimator()
    link: LinkModel = LinkModel()
    """The off-board link."""
    gcs_link: LinkModel = LinkModel()
    """Each of the ground stations' links, over UDP and TCP; there is none in lock-step."""
    chaos: tuple[ChaosWindow, ...] = ()
    """What the vehicle does wrong on its MAVLink ports."""
    failures: tuple[Failure, ...] = ()
    """What breaks, and when."""
    parameter_changes: tuple[ParameterChange, ...] = ()
    """What else happens, and when."""
    parameters: dict[str, float] = {}
    """PX4 parameters of the vehicle, over the airframe's."""
    controller: Controller = Controller()
    reference: Reference = Hover()
    fleet: Fleet = Fleet()

    @property
    def impaired(self) -> bool:
        """In lock-step: a tick may pass without an answer, over a link that is not perfect, or where the vehicle
        misbehaves. Then each tick is an exchange of whatever is due, of nothing, too.
        """
        return self.link != LinkModel() or bool(self.chaos)


class Flight(msgspec.Struct, frozen=True):
    """A scenario made ready: its file resolved, its airframe loaded."""

    name: str
    scenario: Scenario
    airframe: Airframe


def names() -> list[str]:
    """The shipped scenarios."""
    folder = resources.files("mavsitl") / "scenarios"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load(name_or_path: str, overrides: dict[str, Any] | None = None) -> Flight:
    """Read a shipped scenario by name, or a file by path.

    `overrides` are dotted keys, e.g. ``{"controller.law": "pid"}``; through an array of tables they go by the index,
    ``wind[0].altitude_m``, or without it where there is one alone. What stands beside a key in a table that the file
    leaves out keeps its default. Raises `ScenarioError`.
    """
    text, where, folder = _read("scenarios", name_or_path, names())
    data = _parse(text, where)
    for key, value in copy.deepcopy(overrides or {}).items():  # one may be set within another
        _override(data, key, value, where)
    scenario = _convert(data, Scenario, where)
    reference = scenario.reference
    own, colon, name = scenario.controller.own.rpartition(":")
    if colon and own.endswith(".py") and not Path(own).is_absolute():
        controller = msgspec.structs.replace(scenario.controller, own=f"{folder / own}:{name}")
        scenario = msgspec.structs.replace(scenario, controller=controller)
    if isinstance(reference, Waypoints) and not Path(reference.file).is_absolute():
        path = str(folder / reference.file)
        scenario = msgspec.structs.replace(scenario, reference=msgspec.structs.replace(reference, file=path))
    _check(scenario, where)
    name = name_or_path.removesuffix(".toml").replace("\\", "/").rsplit("/", 1)[-1]
    return Flight(name=name, scenario=scenario, airframe=load_airframe(scenario.airframe, folder))


def changed(flight: Flight, overrides: Mapping[str, Any]) -> Flight:
    """One that is loaded, with other keys over it, as `load` takes them. Raises `ScenarioError`."""
    data = _without_none(msgspec.to_builtins(flight.scenario))
    for key, value in copy.deepcopy(dict(overrides)).items():
        _override(data, key, value, flight.name)
    scenario = _convert(data, Scenario, flight.name)
    _check(scenario, flight.name)
    same = scenario.airframe == flight.scenario.airframe
    return Flight(flight.name, scenario, flight.airframe if same else load_airframe(scenario.airframe))


def _without_none(data: Any) -> Any:
    """A key that is None is one that a file leaves out."""
    if isinstance(data, dict):
        return {key: _without_none(value) for key, value in data.items() if value is not None}
    return [_without_none(value) for value in data] if isinstance(data, list | tuple) else data


def text_of(name_or_path: str) -> str:
    """The scenario's file as it is. Raises `ScenarioError`."""
    return _read("scenarios", name_or_path, names())[0]


def airframe_names() -> list[str]:
    """The shipped airframes."""
    folder = resources.files("mavsitl") / "airframes"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def section(kind: type[_S], where: str, keys: Mapping[str, Any]) -> _S:
    """One table of a scenario from its keys, checked as a file's: ``section(Bursts, "bursts", {"bad_ms": 5.0})``.

    Raises `ScenarioError`, which begins with `where`.
    """
    made: _S = _convert(msgspec.to_builtins(dict(keys)), kind, where)
    return made


def load_airframe(name_or_path: str, folder: Path | None = None) -> Airframe:
    """Read a shipped airframe by name, or a file by path (relative to `folder`). Raises `ScenarioError`."""
    text, where, _ = _read("airframes", name_or_path, airframe_names(), folder)
    airframe: Airframe = _convert(_parse(text, where), Airframe, where)
    return airframe


def _read(kind: str, name_or_path: str, shipped: list[str], folder: Path | None = None) -> tuple[str, str, Path]:
    if name_or_path in shipped:
        resource = resources.files("mavsitl") / kind / f"{name_or_path}.toml"
        return resource.read_text("utf-8"), f"{name_or_path} (shipped)", Path()
    path = (folder or Path()) / name_or_path
    if path.suffix != ".toml":
        raise ScenarioError(
            f"{name_or_path}: no such shipped file and not a .toml path; "
            f"{did_you_mean(name_or_path, shipped)}shipped {kind}: {', '.join(shipped)}"
        )
    try:
        return path.read_text("utf-8"), str(path), path.parent
    except FileNotFoundError as error:
        raise ScenarioError(f"{path}: no such file; a name without .toml is one of the shipped {kind}") from error
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not UTF-8 text, as TOML is: {error}") from error


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{where}: not valid TOML: {error}") from error


_STEP = re.compile(r"([^\[\]]+)(?:\[(\d+)\])?")
"""A part of a dotted key, e.g. ``wind[0]``, as the messages about a scenario have it."""


def _override(data: dict[str, Any], key: str, value: Any, where: str) -> None:
    *parents, last = key.split(".")
    table = data
    path = ""
    default: Any = Scenario(title="")
    for parent in parents:
        step = _STEP.fullmatch(parent)
        if step is None:
            raise ScenarioError(
                f"{where}: {key}: '{parent}' is no part of a key; allowed: NAME or NAME[0], NAME[1], ..."
            )
        name, index = step[1], step[2]
        path = _join(path, name)
        default = getattr(default, name, None)
        table = table.setdefault(name, _whole(default))
        if isinstance(table, list):
            table = _element(table, index, path, key, where)
            path += f"[{index or 0}]"
        elif index is not None:
            raise ScenarioError(f"{where}: {key}: '{path}' is no array, so it has no element {index}")
        if not isinstance(table, dict):
            raise ScenarioError(f"{where}: {key}: '{path}' is not a table, so it has no key to set")
    table[last] = value


def _whole(default: Any) -> dict[str, Any]:
    """A table to set one key in: its default where it is one that must be given whole, as `Gains`."""
    if isinstance(default, Section) and any(field.required for field in msgspec.structs.fields(default)):
        table: dict[str, Any] = msgspec.to_builtins(default)
        return table
    return {}


def _element(array: list[Any], index: str | None, path: str, key: str, where: str) -> Any:
    """Of an array of tables: the one with that index, or without it the only one."""
    if index is None and len(array) == 1:
        return array[0]
    if not array:
        raise ScenarioError(f"{where}: {key}: '{path}' is empty, so it has no element to set")
    if index is None or int(index) >= len(array):
        allowed = ", ".join(f"{path}[{number}]" for number in range(len(array)))
        raise ScenarioError(f"{where}: {key}: '{path}' has {len(array)} element(s); allowed: {allowed}")
    return array[int(index)]


def _convert(data: dict[str, Any], kind: type[Any], where: str) -> Any:
    for problem in _problems(data, msgspec.inspect.type_info(kind), ""):
        raise ScenarioError(f"{where}: {problem}")
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        reason, _, path = str(error).partition(" - at `$")
        key = path.rstrip("`").lstrip(".") or "top level"
        raise ScenarioError(f"{where}: {key}: {reason}") from error


def _problems(data: Any, info: msgspec.inspect.Type, path: str) -> Iterator[str]:
    """What msgspec's own message would not say in full: each problem with its key and what is allowed there."""
    fits = True
    match info:
        case msgspec.inspect.Metadata():
            yield from _problems(data, info.type, path)
        case msgspec.inspect.UnionType():
            options = [option for option in info.types if not isinstance(option, msgspec.inspect.NoneType)]
            tags = {option.tag: option for option in options if isinstance(option, msgspec.inspect.StructType)}
            field = next((option.tag_field for option in tags.values()), None)
            if field is not None and isinstance(data, dict):
                tag = data.get(field)
                if isinstance(tag, str) and tag in tags:
                    yield from _problems(data, tags[tag], path)
                else:
                    allowed = ", ".join(f"'{name}'" for name in tags)
                    found = f"{_shown(tag)} is not allowed" if field in data else "missing"
                    meant = did_you_mean(tag, [str(name) for name in tags]) if isinstance(tag, str) else ""
                    yield f"{_join(path, field)}: {found}; {meant}allowed: {allowed}"
            elif len(options) == 1:
                yield from _problems(data, options[0], path)
            else:
                fits = field is None
        case msgspec.inspect.StructType() if isinstance(data, dict):
            fields = {field.encode_name: field for field in info.fields}
            allowed_keys = [*([info.tag_field] if info.tag_field else []), *fields]
            for key, value in data.items():
                if key not in allowed_keys:
                    meant = did_you_mean(key, allowed_keys)
                    yield f"{_join(path, key)}: unknown key; {meant}allowed here: {', '.join(allowed_keys)}"
                elif key in fields:
                    yield from _problems(value, fields[key].type, _join(path, key))
            for key, struct_field in fields.items():
                if struct_field.required and key not in data:
                    yield f"{_join(path, key)}: missing; allowed: {describe(struct_field.type)}"
        case msgspec.inspect.TupleType() if isinstance(data, list) and len(data) == len(info.item_types):
            for index, (value, item) in enumerate(zip(data, info.item_types, strict=True)):
                yield from _problems(value, item, f"{path}[{index}]")
        case msgspec.inspect.VarTupleType() if isinstance(data, list):
            fits = len(data) >= (info.min_length or 0)
            for index, value in enumerate(data):
                yield from _problems(value, info.item_type, f"{path}[{index}]")
        case msgspec.inspect.DictType() if isinstance(data, dict):
            for key, value in data.items():
                yield from _problems(value, info.value_type, _join(path, key))
        case msgspec.inspect.LiteralType():
            fits = data in info.values
        case msgspec.inspect.FloatType() if isinstance(data, int | float) and not isinstance(data, bool):
            fits = -sys.float_info.max <= data <= sys.float_info.max and _within_bounds(data, info)
        case msgspec.inspect.IntType() if isinstance(data, int) and not isinstance(data, bool):
            fits = _within_bounds(data, info)
        case msgspec.inspect.StrType():
            fits = isinstance(data, str)
        case msgspec.inspect.BoolType():
            fits = isinstance(data, bool)
        case _:
            fits = False
    if not fits:
        names = [str(value) for value in info.values] if isinstance(info, msgspec.inspect.LiteralType) else []
        meant = did_you_mean(data, names) if isinstance(data, str) else ""
        yield f"{path}: {_shown(data)} is not allowed; {meant}allowed: {describe(info)}"


def describe(info: msgspec.inspect.Type) -> str:
    """What a key of this type takes, in words: for error messages, and for the table of keys in the docs."""
    match info:
        case msgspec.inspect.Metadata():
            return describe(info.type)
        case msgspec.inspect.FloatType() | msgspec.inspect.IntType():
            whole = "whole number" if isinstance(info, msgspec.inspect.IntType) else "number"
            bounds = ((">", info.gt), (">=", info.ge), ("<", info.lt), ("<=", info.le))
            return " ".join(
                [whole, " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)]
            ).strip()
        case msgspec.inspect.LiteralType():
            return ", ".join(f"'{value}'" for value in info.values)
        case msgspec.inspect.StrType():
            return "text"
        case msgspec.inspect.BoolType():
            return "true, false"
        case msgspec.inspect.TupleType():
            items = [describe(item) for item in info.item_types]
            return f"array of {len(items)}: {items[0] if len(set(items)) == 1 else ', '.join(items)}"
        case msgspec.inspect.VarTupleType():
            return f"array{f' of at least {info.min_length}' if info.min_length else ''}: {describe(info.item_type)}"
        case msgspec.inspect.DictType():
            return f"table of names: {describe(info.value_type)}"
        case msgspec.inspect.UnionType():
            options = [option for option in info.types if not isinstance(option, msgspec.inspect.NoneType)]
            structs = [option for option in options if isinstance(option, msgspec.inspect.StructType)]
            if structs and structs[0].tag_field is not None:
                return f"table with {structs[0].tag_field} = {', '.join(repr(struct.tag) for struct in structs)}"
            return " or ".join(describe(option) for option in options)
        case msgspec.inspect.StructType():
            return f"table of {', '.join(field.encode_name for field in info.fields)}"
        case _:
            raise NotImplementedError(f"no words for {info}")


def _within_bounds(value: float, info: msgspec.inspect.FloatType | msgspec.inspect.IntType) -> bool:
    return (
        (info.gt is None or value > info.gt)
        and (info.ge is None or value >= info.ge)
        and (info.lt is None or value < info.lt)
        and (info.le is None or value <= info.le)
    )


def _shown(data: Any) -> str:
    """The user's own value, as TOML would write it, at a length that fits a message."""
    match data:
        case dict():
            return "a table"
        case list():
            return f"an array of {len(data)}"
        case bool():
            return str(data).lower()
        case str():
            return repr(data if len(data) <= 40 else f"{data[:40]}...")
        case int() if abs(data) >= 10**40:
            return "a whole number of more than 40 digits"
        case _:
            return str(data)


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _check(scenario: Scenario, where: str) -> None:
    """Rules that tie keys together."""
    rates = scenario.rates
    if rates.physics_hz % rates.control_hz:
        raise ScenarioError(
            f"{where}: rates.physics_hz: {rates.physics_hz} is not a multiple of rates.control_hz ({rates.control_hz})"
        )
    if 1000 % rates.control_hz:
        raise ScenarioError(
            f"{where}: rates.control_hz: one cycle of {rates.control_hz} Hz is not a whole number of milliseconds; "
            "allowed: " + ", ".join(str(hz) for hz in range(10, 1001) if 1000 % hz == 0)
        )
    if MICROSECONDS_PER_SECOND % rates.physics_hz:
        raise ScenarioError(
            f"{where}: rates.physics_hz: one step of {rates.physics_hz} Hz is not a whole number of microseconds"
        )
    if not scenario.start.clamp and not scenario.ground_contact:
        raise ScenarioError(
            f"{where}: start.clamp: false is not allowed with ground_contact = false: "
            "the vehicle would fall from the start"
        )
    controller = scenario.controller
    if not controller.learning.leakage_per_s / rates.control_hz < 1.0:
        raise ScenarioError(
            f"{where}: controller.learning.leakage_per_s: {controller.learning.leakage_per_s:g} is not allowed; "
            f"allowed: less than one per control cycle ({rates.control_hz})"
        )
    if controller.inner == "pidnn" and controller.level != "attitude":
        raise ScenarioError(
            f"{where}: controller.inner: 'pidnn' needs controller.level 'attitude', not '{controller.level}'"
        )
    if controller.own and (controller.inner == "pidnn" or controller.wind_information == "oracle"):
        raise ScenarioError(
            f"{where}: controller.own: {controller.own!r} makes nothing of controller.inner and "
            "controller.wind_information; allowed: their defaults"
        )
    fleet = scenario.fleet
    if fleet.collision_m >= fleet.spacing_m:
        raise ScenarioError(
            f"{where}: fleet.collision_m: {fleet.collision_m:g} is not allowed; "
            f"allowed: less than fleet.spacing_m ({fleet.spacing_m:g})"
        )
    _check_estimator(scenario, where)
    _check_link(scenario.link, f"{where}: link")
    _check_link(scenario.gcs_link, f"{where}: gcs_link")
    if scenario.chaos:
        _check_chaos(scenario.chaos, where)
    steps = scenario.reference.steps if isinstance(scenario.reference, Steps) else ()
    if any(later.time_s <= earlier.time_s for earlier, later in pairwise(steps)):
        raise ScenarioError(f"{where}: reference.steps: time_s must increase from step to step")


def _check_link(model: LinkModel, where: str) -> None:
    for name in ("to_ground", "to_vehicle"):
        impairment: Impairment = getattr(model, name)
        _check_impairment(impairment, f"{where}.{name}")
        for index, change in enumerate(model.changes):
            if change.direction in ("both", name):
                impairment = change.of(impairment)
                _check_impairment(impairment, f"{where}.changes[{index}]")
    for clock in ("flight", "simulated"):
        times_s = [change.at_s for change in model.changes if change.clock == clock]
        if any(later < earlier for earlier, later in pairwise(times_s)):
            raise ScenarioError(f"{where}.changes: at_s must not decrease from change to change (clock = '{clock}')")


def _check_chaos(windows: tuple[ChaosWindow, ...], where: str) -> None:
    from mavsitl.chaos.table import ChaosError, parse  # here, for few scenarios need it

    for index, window in enumerate(windows):
        try:
            if "@" in window.mode:
                raise ChaosError(f"'{window.mode}' is not allowed; the port has a key of its own")
            parse(window.mode)
        except ChaosError as error:
            raise ScenarioError(f"{where}: chaos[{index}].mode: {error}") from None


def _check_estimator(scenario: Scenario, where: str) -> None:
    """Settings that the chosen kind does not read are refused."""
    estimator, control_hz = scenario.estimator, scenario.rates.control_hz
    if estimator.kind == "ekf":
        if scenario.noise != Noise():
            raise ScenarioError(
                f"{where}: noise: is of estimator.kind 'white-noise', not 'ekf'; allowed: absent; "
                "each sensor has its own noise in estimator.imu, gps, barometer, magnetometer"
            )
        for name in ("gps", "barometer", "magnetometer"):
            rate_hz = getattr(estimator, name).rate_hz
            if rate_hz > control_hz:
                raise ScenarioError(
                    f"{where}: estimator.{name}.rate_hz: {rate_hz:g} is not allowed; "
                    f"allowed: at most rates.control_hz ({control_hz})"
                )
    elif estimator != Estimator():
        raise ScenarioError(
            f"{where}: estimator: settings of sensors need estimator.kind 'ekf'; 'white-noise' has none"
        )


def _check_impairment(impairment: Impairment, where: str) -> None:
    latency_ms, jitter_ms = impairment.latency_ms, impairment.jitter_ms
    if impairment.distribution == "uniform" and jitter_ms > latency_ms:
        raise ScenarioError(
            f"{where}.jitter_ms: {jitter_ms:g} is not allowed; "
            f"allowed: at most latency_ms ({latency_ms:g}) with distribution 'uniform'"
        )
    if impairment.distribution == "gamma" and jitter_ms > 0.0 and not latency_ms > 0.0:
        raise ScenarioError(f"{where}.latency_ms: 0 is not allowed; allowed: > 0 with distribution 'gamma' and jitter")
