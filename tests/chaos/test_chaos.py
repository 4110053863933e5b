"""Protocol chaos as a whole: nothing where nothing is on, repeatable, combinable, by scenario and by name."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import pytest
from fastcrc import crc16
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import ends
from mavsitl.chaos import TABLE, ChaosError, parse
from mavsitl.chaos.base import Mode
from mavsitl.clock import unix_us
from mavsitl.codec import encode, packer, renumber
from mavsitl.dialect import mavlink
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import ScenarioError, load
from mavsitl.signing import EPOCH_UNIX_US
from tests.autopilot.conftest import CLIENT, GCS, OFFBOARD, Client, flight
from tests.chaos.client import ChaosClient
from tests.drivers.exercise import shortened

LAND = mavlink.MAV_CMD_NAV_LAND
ACCEPTED, IN_PROGRESS = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS


def session(client: Client) -> list[list[bytes]]:
    """Everything a vehicle says to a client that asks for this and that."""
    client.run(0.5)
    client.send(mavlink.MAVLink_param_request_list_message(1, 1))
    client.run(0.3)
    client.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148)
    client.send(mavlink.MAVLink_mission_request_list_message(1, 1, 0), port=GCS)
    client.send(mavlink.MAVLink_timesync_message(0, 5))
    client.command(LAND)
    client.run(1.0)
    return client.wire


# --- off -------------------------------------------------------------------------------------------------------------


def test_a_vehicle_that_was_never_asked_has_nothing_between_node_and_link() -> None:
    client = ChaosClient()
    assert [port.node.tamper for port in client.vehicle.autopilot.ports] == [None, None]
    assert client.vehicle.chaos.active == ()
    assert [port.node.tamper for port in client.vehicle.autopilot.ports] == [None, None]


def test_modes_that_meet_nothing_to_spoil_change_no_byte() -> None:
    idle = ChaosClient()
    idle.begin(
        "param-missing:COM_DL_LOSS_T@gcs", "ack-lost:400", "mission-item-lost:3", "log-silent", "request-silent:1"
    )
    assert session(idle) == session(ChaosClient())


def test_what_has_ended_leaves_no_trace() -> None:
    """Numbered on, and the same bytes again: a mode that lost nothing, and two that did."""
    quiet, client = ChaosClient(), ChaosClient()
    with client.vehicle.chaos.during("ack-late:0.1", "landed-unknown") as chaos:
        assert chaos.active == ("ack-late:0.1@all", "landed-unknown@all")
        quiet.run(0.5)
        client.run(0.5)
    client.run(0.1)
    quiet.run(0.1)
    assert [port.node.tamper for port in client.vehicle.autopilot.ports] == [None, None]
    before = [len(client.wire[port]) for port in (OFFBOARD, GCS)]
    assert [len(quiet.wire[port]) for port in (OFFBOARD, GCS)] == before
    ours, others = session(client), session(quiet)
    assert [wire[n:] for wire, n in zip(ours, before, strict=True)] == [
        wire[n:] for wire, n in zip(others, before, strict=True)
    ]


def test_what_is_held_back_leaves_no_gap_and_comes_after_the_mode_has_ended() -> None:
    client = ChaosClient()
    client.begin("heartbeat-lost", "ack-late:1")
    client.command(LAND)
    client.vehicle.chaos.clear()
    client.run(2.0)
    assert len(client.all("COMMAND_ACK", OFFBOARD)) == 1
    for port in (OFFBOARD, GCS):
        numbers = [frame.sequence for _, from_port, frame in client.frames if from_port == port]
        assert numbers == [n & 0xFF for n in range(len(numbers))]


def test_others_frames_pass_untouched() -> None:
    """What one client says to another goes on byte for byte, whatever becomes of the vehicle's own."""
    client = Client()
    beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    client.send(beat)  # somebody is there to hand it on to
    client.send(beat, port=GCS, sender=(200, 1))
    client.run(0.01)
    client.vehicle.chaos.begin("sequence-gaps:1")
    client.vehicle.chaos.begin("heartbeat-lost")
    client.send(beat, port=GCS, sender=(200, 1))
    client.run(0.01)
    assert [(port, frame.sequence) for port, frame in client.forwarded] == [(OFFBOARD, 1), (OFFBOARD, 2)]


# --- repeatable and combinable ---------------------------------------------------------------------------------------

WILD = ("timesync-jumps", "ftp-drops:0.5", "system-time-garbage", "ack-late:0.3", "sequence-gaps:7", "crc-wrong:11")


def test_the_same_seed_misbehaves_the_same_way() -> None:
    wires = []
    for seed in (3, 3, 4):
        client = ChaosClient(seed=seed)
        client.begin(*WILD)
        wires.append(session(client))
    assert wires[0] == wires[1]
    assert wires[0] != wires[2]


def test_modes_act_one_after_the_other() -> None:
    client = ChaosClient()
    client.begin("ack-progress-forever", "ack-doubled", "ack-late:0.1")
    sent_s, seen = client.now_us / 1e6, len(client.inbox)
    client.command(LAND)
    client.run(0.45)
    told = [(round(t - sent_s, 2), ack.result) for t, ack in client.timed(seen, "COMMAND_ACK")]
    assert told == [(0.1, IN_PROGRESS)] * 2


def test_all_modes_at_once_leave_a_vehicle_that_flies_and_recovers() -> None:
    client = ChaosClient()
    client.begin(*(name for name in TABLE if name not in ("comm-lost", "mute", "deaf")))
    session(client)
    client.run(5.0)
    client.vehicle.chaos.clear()
    client.run(3.0)
    assert client.results(LAND) == [ACCEPTED]
    assert len(client.list_parameters()) == len(client.vehicle.parameters.names) + 1


def test_one_port_suffers_and_the_other_does_not_notice() -> None:
    client = ChaosClient()
    client.begin("comm-lost@gcs")
    client.run(2.0)
    assert client.results(LAND) == [ACCEPTED]
    assert client.all("HEARTBEAT", GCS, since_us=0) == []
    assert len(client.all("HEARTBEAT", OFFBOARD, since_us=0)) >= 2


def test_a_client_whose_words_are_lost_is_known_all_the_same() -> None:
    """The link goes by the number of good frames: an answer needs an address."""
    client = ChaosClient()
    client.begin("deaf")
    assert client.send(mavlink.MAVLink_command_long_message(1, 1, LAND, 0, *[0.0] * 7)) == 1


def test_memory_stays_bounded() -> None:
    """Whoever asks with ever other ids and numbers fills nothing up."""
    client = ChaosClient()
    client.begin("ack-progress-forever", "command-first-lost", "param-read-first-ignored", "mission-ack-early")
    for n in range(2000):
        sender = (n % 250 + 1, n // 250 + 1)
        client.send(mavlink.MAVLink_mission_count_message(1, 1, 5, 0), sender=sender)
        client.send(mavlink.MAVLink_command_long_message(1, 1, n, 0, *[0.0] * 7), sender=sender)
        client.send(mavlink.MAVLink_param_request_read_message(1, 1, f"P{n}".encode(), -1), sender=sender)
    (port, _) = client.vehicle.chaos._ports
    forever, lost, read, early = port._modes.values()
    kept: list[Any] = [getattr(forever, "_running"), getattr(lost, "_repeats")._counts]  # noqa: B009
    kept += [getattr(read, "_repeats")._counts, getattr(early, "_counts")]  # noqa: B009
    assert [len(each) <= 64 for each in kept] == [True] * 4


TAKEN = (
    "COMMAND_LONG", "COMMAND_INT", "SET_MODE", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET", "MISSION_COUNT",
    "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_REQUEST_INT", "MISSION_REQUEST_LIST", "MISSION_ACK",
    "FILE_TRANSFER_PROTOCOL", "LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "TIMESYNC", "PING",
)  # fmt: skip


def frame_of(name: str, payload: bytes) -> bytes:
    """A good frame with this payload, whatever it means."""
    kind = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]
    body = payload[: kind.unpacker.size].rstrip(b"\0") or b"\0"
    head = bytes((0xFD, len(body), 0, 0, 0, *CLIENT)) + kind.id.to_bytes(3, "little")
    crc = crc16.mcrf4xx(head[1:] + body + bytes((kind.crc_extra,)))
    return bytes(head + body + crc.to_bytes(2, "little"))


ALL_ON = ChaosClient()
ONE_ON = ChaosClient()
ALL_ON.begin(*(name for name in TABLE if name not in ("comm-lost", "mute", "deaf")))


@given(st.lists(st.tuples(st.sampled_from(TAKEN), st.binary(min_size=1, max_size=255)), max_size=8))
def test_whatever_is_asked_nothing_is_raised(asked: list[tuple[str, bytes]]) -> None:
    """Of a vehicle with all modes on; each mode alone sees more, so one of them in turn is on alone."""
    for name, payload in asked:
        frame = frame_of(name, payload)
        assert ALL_ON.vehicle.receive(OFFBOARD, frame) == 1
        alone = list(TABLE)[zlib.crc32(payload) % len(TABLE)]
        with ONE_ON.vehicle.chaos.during(alone):
            ONE_ON.vehicle.receive(OFFBOARD, frame)
            ONE_ON.tick()
    ALL_ON.tick()


# --- by name ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ack-lst", "no chaos mode 'ack-lst'; did you mean ack-lost, .*'mavsitl chaos' lists all"),
        ("ack-late:soon", "ack-late:soon': seconds: 'soon' is not allowed; allowed: seconds from 0.001 to 3600"),
        ("ack-lost:FLY", "command: 'FLY' is not allowed; allowed: a number or a name of MAV_CMD, for example "),
        ("ack-lost:1:2", "too many arguments; allowed: ack-lost\\[:command\\]"),
        ("ack-lost@nowhere", "port 'nowhere' is not allowed; allowed: all, offboard, gcs"),
        ("ack-refused:300", "result: '300' is not allowed"),
        ("mission-item-lost:-1", "item: '-1' is not allowed; allowed: a whole number from 0 to 65535"),
        ("ftp-drops:nan", "share: 'nan' is not allowed; allowed: a share from 0 to 1"),
        ("param-missing:NO_SUCH_NAME", "the vehicle has no parameter 'NO_SUCH_NAME'"),
    ],
)
def test_what_is_not_there_is_named(text: str, message: str) -> None:
    with pytest.raises(ChaosError, match=message):
        ChaosClient().begin(text)


def test_what_is_on_is_not_begun_twice_and_what_is_off_not_ended() -> None:
    chaos = ChaosClient().vehicle.chaos
    chaos.begin("ack-lost")
    with pytest.raises(ChaosError, match="'ack-lost' on port 'all' is on already"):
        chaos.begin("ack-lost")
    chaos.begin("ack-lost", "gcs")
    chaos.end("ack-lost@gcs")
    with pytest.raises(ChaosError, match="'ack-late' on port 'all' is not on; on: ack-lost@all"):
        chaos.end("ack-late")
    only = Vehicle(flight(), MemoryRecorder(), seed=1, ports=("offboard",)).chaos
    with pytest.raises(ChaosError, match="this vehicle has no port 'gcs'; it has: offboard"):
        only.begin("ack-lost", "gcs")


def test_names_of_mavlink_are_taken_as_they_are_spoken() -> None:
    assert {
        parse(f"ack-lost:{each}").values for each in ("400", "COMPONENT_ARM_DISARM", "mav_cmd_component_arm_disarm")
    } == {(400,)}
    assert parse("mission-ack-error:MAV_MISSION_NO_SPACE").values == parse("mission-ack-error:4").values == (4,)
    assert parse("ack-late::NAV_LAND@gcs") == ("ack-late", (2.5, LAND), "gcs")


@pytest.mark.parametrize("name", TABLE)
def test_every_default_is_allowed(name: str) -> None:
    row = TABLE[name]
    assert parse(name).make() is not None
    assert row.text
    assert [each.name for each in row.arguments] == row.usage(name).replace("]", "").split("[:")[1:]


@given(st.text(max_size=30) | st.builds(lambda name, rest: f"{name}:{rest}", st.sampled_from(sorted(TABLE)), st.text()))
def test_any_text_is_a_mode_or_a_clear_error(text: str) -> None:
    try:
        made = parse(text).make()
    except ChaosError:
        return
    assert isinstance(made, Mode)


@given(st.integers(0, 255), st.integers(0, 255), st.text("abc", max_size=16))
def test_renumbering_is_packing_with_another_number(first: int, second: int, name: str) -> None:
    pack = packer(mavlink.MAVLink_param_request_read_message)
    assert renumber(pack(first, 1, 2, 3, 4, name, 5), second) == pack(second, 1, 2, 3, 4, name, 5)


# --- by scenario -----------------------------------------------------------------------------------------------------


def test_windows_by_the_vehicles_clock() -> None:
    entries: list[dict[str, Any]] = [
        {"mode": "heartbeat-lost", "port": "gcs", "start_s": 2.0, "duration_s": 3.0},
        {"mode": "landed-unknown", "start_s": 1.0},
    ]
    client = ChaosClient(flight(chaos=entries))
    client.run(8.5)
    beats = [round(t) for t, _ in client.timed(0, "HEARTBEAT", GCS)]
    assert beats == [0, 1, 5, 6, 7, 8]
    states = {(t >= 1.0, m.landed_state) for t, m in client.timed(0, "EXTENDED_SYS_STATE")}
    assert states == {(False, 1), (True, 0)}


def test_windows_that_overlap_and_a_hand_that_interferes() -> None:
    entries = [
        {"mode": "ack-lost"},
        {"mode": "heartbeat-lost", "start_s": 1.0, "duration_s": 2.0},
        {"mode": "heartbeat-lost", "start_s": 2.0, "duration_s": 2.0},
    ]
    client = ChaosClient(flight(chaos=entries))
    on = []
    for _ in range(5):
        client.run(1.0)
        client.tick()
        on.append("heartbeat-lost@all" in client.vehicle.chaos.active)
        client.vehicle.chaos.end("ack-lost")  # by hand, and stays so until it is begun by hand
        client.run(0.1)
        assert "ack-lost@all" not in client.vehicle.chaos.active
        client.begin("ack-lost")
    assert on == [True, True, True, False, False]


def test_windows_by_flight_time() -> None:
    entries = [{"mode": "ack-lost", "start_s": 1.0, "clock": "flight"}]
    client = ChaosClient(flight(chaos=entries))
    client.run(3.0)
    assert client.results(LAND) == [ACCEPTED]
    client.climb(1.0)
    client.run_until(lambda: client.vehicle.flight_time_s >= 1.0, 5.0, client.attitude)
    client.tick()
    assert client.results(LAND) == []


def test_a_wrong_mode_in_a_scenario_is_named_with_its_key() -> None:
    for entry, message in (
        ({"mode": "ack-lst"}, r"chaos\[1\].mode: no chaos mode 'ack-lst'"),
        ({"mode": "ack-lost@gcs"}, r"chaos\[1\].mode: .* the port has a key of its own"),
        ({"mode": "ack-lost", "port": "usb"}, r"chaos\[1\].port: 'usb' is not allowed"),
        ({"port": "gcs"}, r"chaos\[1\].mode: missing"),
    ):
        with pytest.raises(ScenarioError, match=message):
            load("takeoff-hover", {"chaos": [{"mode": "ack-late"}, entry]})
    with pytest.raises(ChaosError, match="no parameter"):
        Vehicle(flight(chaos=[{"mode": "param-nan:NOT_THERE"}]), MemoryRecorder(), seed=1)


BROKEN = ["ack-first-lost", "crc-wrong:5", "frame-cut:7", "frame-unknown:3", "sequence-gaps:4", "text-flood:100"]


def test_a_flight_in_lock_step_with_a_vehicle_that_misbehaves_ends_and_is_repeatable() -> None:
    """Telemetry that does not come is late news, not the end; the controller repeats what is not acknowledged."""
    hashes = set()
    for _ in range(2):
        entries: list[dict[str, Any]] = [{"mode": mode} for mode in BROKEN]
        entries += [{"mode": "mute", "start_s": 1.0, "duration_s": 0.3, "clock": "flight"}]
        scenario = shortened("hover-calm", 2.0, chaos=entries)
        outcome = ends.in_memory(scenario, None, report=lambda text: None, progress=None)
        assert outcome.finished
        hashes.add(outcome.wire_hash)
    assert len(hashes) == 1


def test_the_log_says_what_was_done_to_the_vehicle() -> None:
    recorder = MemoryRecorder()
    vehicle = Vehicle(flight(), recorder, seed=1)
    with vehicle.chaos.during("ack-lost"):
        vehicle.step(0)
    said = [text for _, _, text in recorder.messages]
    assert said == ["chaos: ack-lost on port all begins", "chaos: ack-lost on port all ends"]


# --- with the rest of the vehicle ------------------------------------------------------------------------------------


def test_it_outlives_a_reboot() -> None:
    client = ChaosClient()
    client.begin("ack-lost:NAV_LAND")
    assert client.results(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == [ACCEPTED]
    client.run(1.0)
    assert client.results(LAND) == []
    client.vehicle.chaos.clear()
    client.run(0.1)
    assert client.results(LAND) == [ACCEPTED]


def test_what_is_spoilt_is_signed_and_wrong_checksums_stay_wrong(tmp_path: Path) -> None:
    client = ChaosClient()
    client.vehicle = Vehicle(
        flight(), MemoryRecorder(), seed=1, ports=("offboard", "gcs"), state=tmp_path, unix_us=unix_us
    )
    client.now_us = 0
    client.vehicle.step(0)
    key = list(range(32))
    client.vehicle.receive(
        OFFBOARD,
        encode(mavlink.MAVLink_setup_signing_message(1, 1, key, (unix_us() - EPOCH_UNIX_US) // 10), 0, *CLIENT),
    )
    assert client.vehicle.parameters.set("MAV_SIGN_CFG", 2) is None
    client.run(1.0)
    client.begin("landed-unknown", "crc-wrong:10")
    seen = len(client.frames)
    client.run(1.5)
    states = [frame for _, _, frame in client.frames[seen:] if frame.message.get_type() == "EXTENDED_SYS_STATE"]
    assert {(frame.signed, frame.message.landed_state) for frame in states} == {(True, 0)}
    assert len(client.bad) > 50
    client.vehicle.close()
