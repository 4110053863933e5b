"""`Ask` without sockets: against the vehicle's core, and against peers that are silent, wrong or still starting."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.ask import Ask, CommandTask, ListTask, ParameterTask, Reply, Task, failure_kinds, failure_units
from mavsitl.codec import Message, encode
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from tests.autopilot.conftest import flight

STEP_US = 4000


def answer(task: Task, vehicle: Vehicle, *, port: int = 1, keep: Callable[[int], bool] = lambda n: True) -> Reply:
    """Ask over one port of a vehicle; `keep` says which of the datagrams, both ways, come through."""
    ask = Ask(task, patience_us=2_000_000)
    now_us = number = 0
    while not ask.done:
        assert now_us < 20_000_000
        ask.step(now_us)
        for datagram in ask.datagrams():
            number += 1
            if keep(number):
                vehicle.receive(port, datagram)
        vehicle.step(now_us)
        for datagram in vehicle.datagrams(port, combine=False):
            number += 1
            if keep(number):
                ask.receive(datagram, now_us)
        now_us += STEP_US
    return ask.reply()


def vehicle() -> Vehicle:
    return Vehicle(flight(), NullRecorder(), seed=1, ports=("offboard", "gcs"))


def test_parameters_are_read_and_set_in_order() -> None:
    flying = vehicle()
    task = ParameterTask([("SIM_LINK_LOSS", 0.25), ("SIM_LINK_DOWN", 1), ("COM_OF_LOSS_T", None)])
    reply = answer(task, flying)
    assert reply == Reply(
        ok=True, vehicle=1, parameters={"SIM_LINK_LOSS": 0.25, "SIM_LINK_DOWN": 1, "COM_OF_LOSS_T": 1.0}, result="",
        texts=(), problem="",
    )  # fmt: skip
    assert (flying.parameters["SIM_LINK_LOSS"], flying.parameters["SIM_LINK_DOWN"]) == (0.25, 1)


def test_it_comes_through_a_third_lost() -> None:
    reply = answer(ParameterTask([("SIM_LINK_LOSS", 0.25)]), vehicle(), keep=lambda number: number % 3 != 0)
    assert reply.ok


def test_the_first_refusal_ends_it_with_the_vehicles_reason() -> None:
    flying = vehicle()
    reply = answer(ParameterTask([("SIM_LINK_LOSS", 3.0), ("SIM_LINK_LAT", 40.0)]), flying)
    assert not reply.ok
    assert reply.problem == "vehicle 1 refuses SIM_LINK_LOSS = 3 (VALUE_OUT_OF_RANGE); it says 0"
    assert reply.texts == ("SIM_LINK_LOSS: 3 is not allowed; allowed: 0 to 1",)
    assert flying.parameters["SIM_LINK_LAT"] == 0.0


@pytest.mark.parametrize(
    ("wish", "problem"),
    [
        (("NOPE", None), "vehicle 1 has no parameter NOPE"),
        (("MAV_SYS_ID", 3), "vehicle 1 refuses MAV_SYS_ID = 3 (READ_ONLY); it says 1"),
        (("SIM_LINK_DOWN", 0.5), "vehicle 1 refuses SIM_LINK_DOWN = 0.5 (TYPE_MISMATCH); it says 0"),
    ],
)
def test_other_refusals_are_named(wish: tuple[str, float | None], problem: str) -> None:
    assert answer(ParameterTask([wish]), vehicle()).problem == problem


def test_a_link_that_is_cut_by_the_wish_itself_is_told() -> None:
    flying = vehicle()
    cut = []
    flying.subscribe_links(lambda link, overlay: cut.append(bool(overlay.values)))
    reply = answer(ParameterTask([("SIM_GLINK_DOWN", 1)]), flying, keep=lambda number: not any(cut))
    assert reply.problem == "vehicle 1 does not confirm SIM_GLINK_DOWN = 1; it says 0"


def test_the_whole_list_comes() -> None:
    flying = vehicle()
    reply = answer(ListTask(), flying)
    assert reply.ok
    assert list(reply.parameters) == list(flying.parameters.names)


def test_a_list_that_does_not_come_is_counted() -> None:
    heard = [0]

    def keep(number: int) -> bool:
        heard[0] += 1
        return heard[0] < 100

    reply = answer(ListTask(), vehicle(), keep=keep)
    assert not reply.ok
    assert "vehicle 1 did not send all its parameters: " in reply.problem


def test_a_command_is_answered_with_the_vehicles_text() -> None:
    reply = answer(CommandTask(mavlink.MAV_CMD_INJECT_FAILURE, 4.0, 1.0, 0.0), vehicle())
    assert (reply.ok, reply.result) == (False, "DENIED")
    assert reply.problem == "vehicle 1 answers INJECT_FAILURE with DENIED"
    assert reply.texts == ("Failure injection refused: SYS_FAILURE_EN is 0",)
    done = answer(CommandTask(mavlink.MAV_CMD_REQUEST_MESSAGE, 148.0), vehicle())
    assert (done.ok, done.result, done.problem) == (True, "ACCEPTED", "")


def heartbeat(system_id: int, *, autopilot: int = mavlink.MAV_AUTOPILOT_PX4, status: int = 4) -> bytes:
    return encode(mavlink.MAVLink_heartbeat_message(2, autopilot, 0, 0, status, 3), 0, system_id, 1)


def alone(task: Task, *heard: bytes, system_id: int | None = None) -> Reply:
    """Ask where these come again and again and nothing else."""
    ask = Ask(task, system_id=system_id, patience_us=1_000_000)
    now_us = 0
    while not ask.done:
        ask.step(now_us)
        for datagram in heard:
            ask.receive(datagram, now_us)
        now_us += 100_000
        assert now_us < 20_000_000
    return ask.reply()


def test_who_is_not_there_is_told_with_what_to_do() -> None:
    read = [("COM_OF_LOSS_T", None)]
    nobody = alone(ParameterTask(read), heartbeat(255, autopilot=mavlink.MAV_AUTOPILOT_INVALID))
    assert (nobody.ok, nobody.vehicle) == (False, None)
    assert nobody.problem.startswith("no vehicle is heard within 1 s: start one with mavsitl vehicle")
    other = alone(ParameterTask(read), heartbeat(1), heartbeat(2), system_id=7)
    assert "no vehicle with system id 7 is heard within 1 s, but 1, 2: choose it with --system" in other.problem
    boots = alone(ParameterTask(read), heartbeat(1, status=mavlink.MAV_STATE_BOOT))
    assert boots.problem.startswith("vehicle 1 is still starting within 1 s")
    silent = alone(ParameterTask(read), heartbeat(1))
    assert silent.problem.startswith("vehicle 1 does not answer for COM_OF_LOSS_T")
    assert alone(CommandTask(420), heartbeat(1)).problem == "vehicle 1 does not acknowledge INJECT_FAILURE"


def test_the_vehicle_does_not_take_it_for_a_ground_station() -> None:
    ask = Ask(ListTask())
    ask.step(0)
    [first] = ask.datagrams()
    flying = vehicle()
    flying.step(0)
    flying.receive(1, first)
    assert flying.autopilot._gcs_us is None


@given(st.lists(st.binary(max_size=300), max_size=5))
def test_nothing_that_comes_raises_or_is_an_answer(datagrams: list[bytes]) -> None:
    reply = alone(ParameterTask([("A", None)]), *datagrams)
    assert not reply.ok


def messages() -> list[Message]:
    return [
        mavlink.MAVLink_statustext_message(6, b"\x1b[2Jx", 0, 0),
        mavlink.MAVLink_command_ack_message(420, 0, 0, 0, 9, 9),
    ]


def test_texts_steer_no_terminal_and_others_acknowledgements_do_not_count() -> None:
    said = [encode(message, 0, 1, 1) for message in messages()]
    reply = alone(CommandTask(420), heartbeat(1), *said * 4)
    assert reply.result == ""
    assert set(reply.texts) == {"?[2Jx"}
    assert len(reply.texts) == 20


def test_failures_have_the_vehicles_names() -> None:
    units, kinds = failure_units(), failure_kinds()
    assert {unit.name.lower(): int(unit) for unit in Unit}.items() <= units.items()
    assert {kind.name.lower(): int(kind) for kind in Kind} == kinds


@pytest.mark.parametrize("name", ["", "A" * 17, "Ü"])
def test_a_name_that_is_none_is_refused_before_anybody_is_asked(name: str) -> None:
    with pytest.raises(ValueError, match="1 to 16 ASCII characters"):
        ParameterTask([(name, None)])
