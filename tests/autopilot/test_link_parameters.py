"""SIM_LINK_* and SIM_GLINK_*: what the vehicle tells of its links, and when it refuses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from mavsitl_vehicle import failures
from mavsitl_vehicle.autopilot.parameters import TABLE
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.links import FAILURES, NAMES, NO_GCS, PERFECT, initial_links
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.link.settings import AS_IN_SCENARIO, KEYS, Overlay
from mavsitl.scenario import ScenarioError
from tests.autopilot.conftest import GCS, Client, flight


class Told:
    """What a vehicle tells of its links."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.all: list[tuple[str, Overlay]] = []
        vehicle.subscribe_links(lambda link, overlay: self.all.append((link, overlay)))

    def take(self) -> list[tuple[str, Overlay]]:
        taken, self.all = self.all, []
        return taken


def lockstep(**changes: Any) -> Vehicle:
    return Vehicle(flight(**changes), NullRecorder(), seed=1, lockstep=True)


def set_real(client: Client, name: str, value: float, port: int = GCS) -> None:
    client.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32), port=port)


def test_a_parameter_over_the_wire_changes_the_link_at_once() -> None:
    client = Client()
    told = Told(client.vehicle)
    assert told.take() == [("link", AS_IN_SCENARIO), ("gcs_link", AS_IN_SCENARIO)]
    set_real(client, "SIM_LINK_LOSS", 0.25)
    assert told.take() == [("link", Overlay({"LOSS": 0.25}))]
    set_real(client, "SIM_GLINK_LAT", 40.0)
    assert told.take() == [("gcs_link", Overlay({"LAT": 40.0}))]
    set_real(client, "SIM_LINK_LOSS", 0.25)
    set_real(client, "SIM_LINK_LOSS", 2.0)
    assert told.take() == []
    set_real(client, "SIM_LINK_LOSS", 0.0)
    assert told.take() == [("link", AS_IN_SCENARIO)]


def test_a_direction_is_told_with_what_holds_there() -> None:
    vehicle = Client().vehicle
    told = Told(vehicle)
    told.take()
    assert vehicle.parameters.set("SIM_LINK_DOWN", 1) is None
    assert vehicle.parameters.set("SIM_LINK_DIR", 2) is None
    assert told.take() == [("link", Overlay({"DOWN": 1})), ("link", Overlay({"DOWN": 1}, 2))]


def test_they_begin_with_the_scenarios() -> None:
    made = flight(
        link__to_ground__latency_ms=30.0, link__to_vehicle__latency_ms=20.0, gcs_link__to_vehicle__loss=0.1,
        link__to_vehicle__bandwidth_kbit_s=1e9,
    )  # fmt: skip
    vehicle = Vehicle(made, NullRecorder(), seed=1)
    values = vehicle.parameters.as_dict()
    assert (values["SIM_LINK_LAT"], values["SIM_GLINK_LOSS"], values["SIM_GLINK_LAT"]) == (20.0, 0.1, 0.0)
    assert values["SIM_LINK_BW"] == TABLE["SIM_LINK_BW"].maximum
    told = Told(vehicle)
    assert [overlay for _, overlay in told.take()] == [AS_IN_SCENARIO] * 2
    assert vehicle.parameters.set("SIM_GLINK_LOSS", 0.1) is None
    assert told.take() == []  # the float32 next to it is the same parameter
    assert vehicle.parameters.set("SIM_LINK_LAT", 0.0) is None
    assert told.take() == [("link", Overlay({"LAT": 0.0}))]


def test_a_scenario_may_set_the_parameter_itself() -> None:
    vehicle = Vehicle(flight(parameters={"SIM_LINK_LOSS": 0.5}), NullRecorder(), seed=1)
    assert Told(vehicle).take()[0] == ("link", Overlay({"LOSS": 0.5}))


def test_the_links_parameters_are_kept_nowhere() -> None:
    rows = [TABLE[name] for names in NAMES.values() for name in names.values()]
    assert len(rows) == 2 * (len(KEYS) + 1)
    assert all(row.volatile and row.live == "now" and row.group == "Simulation" for row in rows)


def refusals(vehicle: Vehicle) -> Iterator[str]:
    for name in ("SIM_LINK_LOSS", "SIM_GLINK_LOSS"):
        refused = vehicle.parameters.set(name, 0.5)
        yield "" if refused is None else refused.text


def test_lock_step_says_which_links_cannot_change() -> None:
    assert list(refusals(lockstep())) == [f"SIM_LINK_LOSS: {PERFECT}", f"SIM_GLINK_LOSS: {NO_GCS}"]
    for change in ({"link__live": True}, {"link__to_ground__loss": 0.1}):
        assert list(refusals(lockstep(**change))) == ["", f"SIM_GLINK_LOSS: {NO_GCS}"]


def test_a_scenario_for_lock_step_cannot_set_what_cannot_change() -> None:
    with pytest.raises(ScenarioError, match=r"parameters\.SIM_LINK_LOSS: .*link\.live = true"):
        lockstep(parameters={"SIM_LINK_LOSS": 0.5})
    lockstep(parameters={"SIM_LINK_LOSS": 0.5}, link__live=True)
    lockstep(parameters={"SIM_GLINK_LOSS": 0.5}, gcs_link__to_ground__loss=0.5)  # there is no such link


def test_a_failure_of_the_unit_mavlink_lies_over_the_parameters() -> None:
    vehicle = Client().vehicle
    assert vehicle.parameters.set("SIM_LINK_LOSS", 0.5) is None
    told = Told(vehicle)
    told.take()
    for instance, kind in ((1, Kind.DELAYED), (2, Kind.INTERMITTENT), (1, Kind.OK)):
        vehicle.failures.set(Unit.MAVLINK, kind, instance)
    assert told.take() == [
        ("link", Overlay({"LOSS": 0.5}, 0, {"LAT": 500.0})),
        ("gcs_link", Overlay({}, 0, FAILURES[Kind.INTERMITTENT])),
        ("link", Overlay({"LOSS": 0.5})),
    ]


def test_each_failure_of_a_link_is_made_by_its_channel_or_by_the_port() -> None:
    kinds = {kind for unit, kind in failures.TABLE if unit is Unit.MAVLINK}
    assert kinds == {*FAILURES, Kind.OFF, Kind.STUCK}


def test_every_failure_is_within_the_parameters_limits() -> None:
    for settings in FAILURES.values():
        assert all(TABLE[NAMES["link"][key]].problem(value) is None for key, value in settings.items())


def test_what_a_scenario_may_say_the_parameters_can_show() -> None:
    extreme = {"good_ms": 1e12, "bad_ms": 10_000.0}
    values = initial_links(flight(link__to_vehicle__bursts=extreme).scenario)["link"]
    assert all(
        TABLE[name].problem(value if name[-3:] != "DIR" else int(value)) is None for name, value in values.items()
    )
