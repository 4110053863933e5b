"""The monitor link: what a ground tells of a vehicle beside the off-board link. Both ends of it look here.

The ground speaks as a companion of the vehicle that it flies: the vehicle's system id, component `COMPONENT_ID`. World
NED, body FRD, as on every wire.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from mavsitl.dialect import mavlink

COMPONENT_ID: int = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER

PORT = 14560
"""Where a listener is looked for."""

INTERVAL_US = 50_000
"""Between two sets of messages."""


class Array(NamedTuple):
    """A DEBUG_FLOAT_ARRAY: its name and id, and what its numbers are."""

    name: str
    id: int
    fields: tuple[str, ...]


_OUTPUTS = tuple(f"{net}_{output}" for net in ("roll", "pitch", "yaw") for output in "pid")

WEIGHTS = Array("PIDNN", 1, (*_OUTPUTS, *(f"{name}_initial" for name in _OUTPUTS)))
"""Output weights of the nets, and what they start from, which is the identical PID."""
CONTROL = Array("CONTROL", 2, ("u1_n", "wind_n_m_s2", "wind_e_m_s2", "wind_d_m_s2"))
"""Thrust U_1, and W_1..W_3 of the position loop."""
LINK = Array("LINK", 3, ("received", "lost", "rejected", "state_age_ms"))
"""Frames of the vehicle's, since the start, and the age of the newest state beyond the fastest transport."""

ARRAYS = (WEIGHTS, CONTROL, LINK)

PHASES = {
    1: "SEARCH", 2: "CONNECT", 3: "STREAM", 4: "OFFBOARD", 5: "ARM", 6: "RELEASE", 7: "FLY", 8: "STOP", 9: "DONE",
    10: "ABORTED", 11: "LOST",
}  # fmt: skip
"""Of a flight, by HEARTBEAT.custom_mode."""

CONTROL_LAW = "CTRL_LAW"
"""The parameter that shows the attitude law and changes it."""
LAWS: dict[Literal["pid", "pidnn"], int] = {"pid": 0, "pidnn": 1}
NO_LAW = -1
"""No law that could be changed: the attitude is controlled aboard, or by a controller of one's own."""
