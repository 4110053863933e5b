"""One control period of the paper's nested loops (fig 3) in one compiled call: from state to demand and log row.

Each law's text is its own in `mavsitl.control`; here they are put in order, for one vehicle. Inside NWU and FLU, the
demand in the wire's terms: the ground's frame boundary out.
"""

from __future__ import annotations

from math import sqrt
from typing import Any, TypeAlias

from mavsitl.compiled import compiled, inlined
from mavsitl.control.arrays import Floats, Record
from mavsitl.control.filters import first_order_step
from mavsitl.control.inner_loop import torque_shares
from mavsitl.control.pid import position_step
from mavsitl.control.pidnn import net_step, pid_step
from mavsitl.control.rotation import from_euler
from mavsitl.control.wind_observer import model_step, observer_step
from mavsitl.frames import Quaternion

# What W_1..W_3 are, by the scenario's `wind_information`.
WIND_SOURCES = ("none", "observer", "oracle")
NONE, OBSERVER, ORACLE = range(3)

# What the demand's three numbers are, by the scenario's `level`.
LEVELS = ("attitude", "body_rate", "torque")
ATTITUDE, BODY_RATE, TORQUE = range(3)

# Columns of a row of the ground's log, each topic's beside each other. NED and FRD:
POSITION = 0  # 0:3, the reference's
VELOCITY = 3  # 3:6
YAW = 6
DESIRED = 7  # 7:10, phi_d, theta_d, psi_d
THRUST_BODY = 10  # 10:13, of the largest; of these the last is written
# The paper's frame:
U1 = 13  # N
ACCELERATION = 14  # 14:17, rad/s^2
WIND = 17  # 17:20, W_1..W_3
LINK = 20  # 20:24, frames, lost, rejected, age us
WEIGHTS = 24  # 24:33, (P, I, D) of roll, pitch and yaw
COLUMNS = 33

Demand: TypeAlias = tuple[Quaternion, float, float, float, float]
"""Attitude FRD -> NED; about x, y, z of FRD the body rates in rad/s or, at level `torque`, shares of the largest
torque; thrust 0..1. The order is SET_ATTITUDE_TARGET's; what a level does not use is the identity and 0.
"""


@inlined
def _wind(own: Any, state: Any, stamp_us: int) -> None:
    """W_1..W_3 of eq 11 by the scenario's source; the model includes the rotors' lag where the airframe has one."""
    acting = own["acting_n"]
    acting[0] = acting[0] + own["thrust_share"] * (own["thrust_n"] - acting[0])
    wind, source = own["wind"], own["wind_source"]
    if source == ORACLE:
        scale = own["coupling"] * sqrt(max(acting[0], 0.0))
        for axis in range(3):
            true = state["true_wind"][axis, 0]
            wind[axis, 0] = scale * true if true == true else 0.0
    elif source == OBSERVER:
        model_step(state["quaternion"], acting, own["mass_kg"], own["gravity_m_s2"], own["model"])
        period_s = own["period_s"] if own["stamp_us"] < 0 else (stamp_us - own["stamp_us"]) / 1e6
        own["stamp_us"] = stamp_us
        observer = own["observer"]
        observer_step(
            state["velocity"], own["model"], period_s, observer["horizontal"], observer["vertical"],
            observer["last_velocity"], observer["started"], wind,
        )  # fmt: skip


@inlined
def _outer(own: Any, state: Any, wanted: Any, stamp_us: int) -> None:
    """Wind, position loop (eqs 18-26) and filter: thrust, and the desired angles with their rates."""
    _wind(own, state, stamp_us)
    # The tilt is flown at the reference's yaw where all is sent as one attitude, else at the measured.
    own["yaw"][0] = wanted["yaw"][0] if own["whole_attitude"] else state["angles"][2, 0]
    loop, tilt = own["position"], own["filter"]
    position_step(
        state["position"], state["velocity"], state["quaternion"],
        wanted["position"], wanted["velocity"], wanted["acceleration"], own["yaw"], own["wind"],
        loop["parameters"], loop["integral"], loop["out"],
    )  # fmt: skip
    own["thrust_n"] = loop["out"][0, 0]
    first_order_step(loop["out"][1:], tilt["share"], tilt["bandwidth"], own["desired"][:2], own["desired_rates"][:2])
    own["desired"][2, 0] = wanted["yaw"][0]


@inlined
def _direct(own: Any, state: Any, acceleration: Floats) -> Demand:
    """The inner loop's angular acceleration (3, 1) as body rates or as torque."""
    thrust = own["thrust_n"] / own["max_thrust_n"]
    out = own["direct"]
    if own["level"] == TORQUE:
        torque_shares(acceleration, own["acceleration_limit"], out)
    else:
        # The rates that make a proportional rate loop give the wanted angular acceleration.
        for axis in range(3):
            out[axis, 0] = state["omega"][axis, 0] + acceleration[axis, 0] / own["rate_gain"][axis]
    return (1.0, 0.0, 0.0, 0.0), out[0, 0], -out[1, 0], -out[2, 0], thrust


@inlined
def _log(own: Any, wanted: Any, row: Floats, thrust: float, frames: int, lost: int, rejected: int, age_us: int) -> None:
    """The row but for what the inner loop says."""
    position, velocity, desired = wanted["position"], wanted["velocity"], own["desired"]
    row[POSITION], row[POSITION + 1], row[POSITION + 2] = position[0, 0], -position[1, 0], -position[2, 0]
    row[VELOCITY], row[VELOCITY + 1], row[VELOCITY + 2] = velocity[0, 0], -velocity[1, 0], -velocity[2, 0]
    row[YAW] = -wanted["yaw"][0]
    row[DESIRED], row[DESIRED + 1], row[DESIRED + 2] = desired[0, 0], -desired[1, 0], -desired[2, 0]
    row[THRUST_BODY + 2] = -thrust
    for axis in range(3):
        row[WIND + axis] = own["wind"][axis, 0]
    row[U1] = own["thrust_n"]
    row[LINK] = frames
    row[LINK + 1] = lost
    row[LINK + 2] = rejected
    row[LINK + 3] = age_us


@compiled
def attitude_cycle(
    memory: Record, state: Record, reference: Record, row: Floats,
    stamp_us: int, frames: int, lost: int, rejected: int, age_us: int,
) -> Demand:  # fmt: skip
    """Level `attitude`: the desired angles, leading by the known lag of the loop aboard.

    The loop aboard gets no angle rates over the wire, so without the lead it would follow phi_d late.
    """
    own = memory[0]
    _outer(own, state[0], reference[0], stamp_us)
    desired, rates, lead_s = own["desired"], own["desired_rates"], own["lead_s"]
    w, x, y, z = from_euler(desired[0, 0] + lead_s * rates[0, 0], desired[1, 0] + lead_s * rates[1, 0], desired[2, 0])
    thrust = own["thrust_n"] / own["max_thrust_n"]
    _log(own, reference[0], row, thrust, frames, lost, rejected, age_us)
    for axis in range(3):
        row[ACCELERATION + axis] = 0.0
    return (w, x, -y, -z), 0.0, 0.0, 0.0, thrust


@compiled
def pid_cycle(
    memory: Record, state: Record, reference: Record, row: Floats,
    stamp_us: int, frames: int, lost: int, rejected: int, age_us: int,
) -> Demand:  # fmt: skip
    """Levels `body_rate` and `torque` with the identical PID (eq 42)."""
    own, feedback = memory[0], state[0]
    _outer(own, feedback, reference[0], stamp_us)
    law = own["law"]
    pid_step(
        feedback["angles"], feedback["angle_rates"], own["desired"], own["desired_rates"],
        law["by_rate"], law["period"], law["limit"], law["gains"], law["memory"], law["out"],
    )  # fmt: skip
    demand = _direct(own, feedback, law["out"])
    _log(own, reference[0], row, demand[4], frames, lost, rejected, age_us)
    for axis in range(3):
        row[ACCELERATION + axis] = law["out"][axis, 0]
    return demand


@compiled
def net_cycle(
    memory: Record, state: Record, reference: Record, row: Floats,
    stamp_us: int, frames: int, lost: int, rejected: int, age_us: int,
) -> Demand:  # fmt: skip
    """Levels `body_rate` and `torque` with the PIDNN (eqs 27-57)."""
    own, feedback = memory[0], state[0]
    _outer(own, feedback, reference[0], stamp_us)
    law = own["law"]
    net_step(
        feedback["angles"], feedback["angle_rates"], own["desired"], own["desired_rates"],
        law["by_rate"], True, law["learn_inputs"], law["known_sign"], law["guarded"], law["settings"], law["initial"],
        law["memory"], law["weights"], law["input_weights"], law["bounded"], law["input_bounded"], law["hidden"],
        law["out"],
    )  # fmt: skip
    demand = _direct(own, feedback, law["out"])
    _log(own, reference[0], row, demand[4], frames, lost, rejected, age_us)
    for axis in range(3):
        row[ACCELERATION + axis] = law["out"][axis, 0]
        for output in range(3):
            row[WEIGHTS + 3 * axis + output] = law["weights"][output, axis, 0]
    return demand
