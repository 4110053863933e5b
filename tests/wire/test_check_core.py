"""What `mavsitl check` concludes, from datagrams made by hand; no socket, no clock."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot import modes

from mavsitl import check
from mavsitl.check import Check, Ear, Heard, Report, VehiclePort
from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink

GCS_EAR, OFFBOARD_EAR = Ear(endpoint="udpin:127.0.0.1:14550"), Ear(endpoint="udpin:127.0.0.1:14540")
VEHICLE = ("127.0.0.1", 18570)
SECOND_US = 1_000_000
PX4_LOITER = 3 << 24 | 4 << 16


def heartbeat(*, autopilot: int = mavlink.MAV_AUTOPILOT_PX4, kind: int = 2, armed: bool = False) -> Any:
    base_mode = 29 | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, base_mode, PX4_LOITER, mavlink.MAV_STATE_STANDBY, 3)


def attitude() -> Any:
    return mavlink.MAVLink_attitude_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def version() -> Any:
    return mavlink.MAVLink_autopilot_version_message(0, 0x011100FF, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)


def ack(result: int = 0, target: tuple[int, int] = (check.SYSTEM_ID, check.COMPONENT_ID)) -> Any:
    return mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_REQUEST_MESSAGE, result, 0, 0, *target)


class Sender:
    """Somebody with an address, an id and a sequence number."""

    def __init__(self, source: tuple[str, int] = VEHICLE, ids: tuple[int, int] = (1, 1)) -> None:
        self.source, self.ids, self.sequence = source, ids, 0

    def frame(self, message: Any) -> bytes:
        self.sequence = (self.sequence + 1) & 0xFF
        return encode(message, self.sequence, *self.ids)

    def say(self, core: Check, now_us: int, *messages: Any, port: int = 0) -> None:
        for message in messages:
            core.receive(port, self.frame(message), self.source, now_us)


def begun(*ears: Ear, ask: bool = True, ports: tuple[VehiclePort, ...] = ()) -> Check:
    core = Check(ears or (GCS_EAR,), ports, ask=ask)
    core.step(0)
    return core


def texts(report: Report, level: str) -> str:
    return "\n".join(finding.text for finding in report.findings if finding.level == level)


def only(report: Report) -> Heard:
    [heard] = report.ports[0].heard
    return heard


def sent(core: Check, port: int = 0) -> list[Any]:
    return [frame.message for datagram in core.datagrams(port) for frame in parse(datagram)]


# --- a vehicle that is well -------------------------------------------------------------------------------------------


def test_a_vehicle_that_answers() -> None:
    core, vehicle = begun(), Sender()
    vehicle.say(core, 100_000, heartbeat(armed=True), *[attitude()] * 19)
    core.step(100_000)
    said, question = sent(core)
    assert (type(said).id, said.type) == (mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAV_TYPE_GCS)
    assert (question.command, question.param1) == (mavlink.MAV_CMD_REQUEST_MESSAGE, 148.0)
    assert (question.target_system, question.target_component) == (1, 1)
    vehicle.say(core, 107_000, ack(), version())
    report = core.report(2_100_000)
    heard = only(report)
    assert report.ok
    assert (heard.address, heard.identity, heard.vehicle) == ("127.0.0.1:18570", (1, 1), True)
    assert (heard.type, heard.autopilot, heard.mode, heard.armed) == ("QUADROTOR", "PX4", "AUTO.LOITER", True)
    assert (heard.answer, heard.answer_ms, heard.version) == ("answered", 7.0, "1.17.0")
    assert (heard.messages, heard.lost, heard.mavlink_versions, heard.signed) == (22, 0, (2,), 0)
    assert (heard.kinds[0].name, heard.kinds[0].messages, heard.kinds[0].per_s) == ("ATTITUDE", 19, 9.5)
    assert heard.per_s == 11.0
    assert "answers after 7 ms; it says version 1.17.0" in texts(report, "good")
    assert texts(report, "problem") == ""
    assert "No ground station's HEARTBEAT" in texts(report, "note")
    assert msgspec.json.decode(msgspec.json.encode(report))["ports"][0]["heard"][0]["mode"] == "AUTO.LOITER"


def test_modes_are_named_as_the_vehicle_names_them() -> None:
    named = {(info.main_mode, info.sub_mode): info.name for info in modes.TABLE.values()}
    assert {numbers: check.PX4_MODES.get(numbers) for numbers in named} == named


def test_it_listens_only_when_told_to_be_quiet() -> None:
    core, vehicle = begun(ask=False), Sender()
    vehicle.say(core, 0, heartbeat())
    core.step(SECOND_US)
    report = core.report(2 * SECOND_US)
    assert core.datagrams(0) == []
    assert report.ok
    assert only(report).answer == "not asked"


def test_nothing_is_sent_before_somebody_was_heard_unless_the_endpoint_says_whom_to_call() -> None:
    core = begun(GCS_EAR, Ear(endpoint="udpout:127.0.0.1:18570", speaks_first=True))
    core.step(2 * SECOND_US)
    assert core.datagrams(0) == []
    assert [type(message).id for message in sent(core, 1)] == [mavlink.MAVLINK_MSG_ID_HEARTBEAT] * 2


def test_the_question_is_repeated_until_it_is_answered_and_not_for_ever() -> None:
    core, vehicle = begun(), Sender()
    vehicle.say(core, 0, heartbeat())
    for now_us in range(0, 10 * SECOND_US, 100_000):
        core.step(now_us)
    questions = [each for each in sent(core) if type(each).id == mavlink.MAVLINK_MSG_ID_COMMAND_LONG]
    assert len(questions) == check.MAX_ASKED == only(core.report(0)).asked
    assert {question.confirmation for question in questions} == {0}


# --- what is wrong ----------------------------------------------------------------------------------------------------


def test_a_vehicle_that_does_not_answer() -> None:
    core, vehicle = begun(), Sender()
    for second in range(3):
        vehicle.say(core, second * SECOND_US, heartbeat(), ack(target=(255, 190)))
        core.step(second * SECOND_US)
    report = core.report(3 * SECOND_US)
    assert not report.ok
    assert only(report).answer == "none"
    assert "does not answer: asked 3 times" in texts(report, "problem")
    assert "PX4 serves the first one" in texts(report, "problem")


def test_a_vehicle_that_still_starts_is_not_blamed() -> None:
    core, vehicle = begun(), Sender()
    booting = heartbeat()
    booting.system_status = mavlink.MAV_STATE_BOOT
    vehicle.say(core, 0, booting)
    core.step(0)
    report = core.report(SECOND_US)
    assert not report.ok
    assert "still starts (MAV_STATE_BOOT)" in texts(report, "problem")
    assert "PX4" not in texts(report, "problem")


@pytest.mark.parametrize(
    ("result", "answer", "level", "words"),
    [(3, "refused", "problem", "UNSUPPORTED"), (0, "acknowledged", "good", "sent no AUTOPILOT_VERSION")],
)
def test_a_vehicle_that_answers_without_the_message(result: int, answer: str, level: str, words: str) -> None:
    core, vehicle = begun(), Sender()
    vehicle.say(core, 0, heartbeat())
    core.step(0)
    vehicle.say(core, 5000, ack(result))
    report = core.report(SECOND_US)
    assert only(report).answer == answer
    assert words in texts(report, level)
    assert report.ok is (answer == "acknowledged")


def test_no_heartbeat() -> None:
    core, vehicle = begun(), Sender()
    for tick in range(30):
        vehicle.say(core, tick * 100_000, attitude())
        core.step(tick * 100_000)
    report = core.report(3 * SECOND_US)
    assert not report.ok
    assert only(report).type == ""
    assert only(report).asked > 0  # it may be a vehicle all the same
    assert "10 messages a second but no HEARTBEAT" in texts(report, "problem")


def test_a_ground_station_is_neither_a_vehicle_nor_asked() -> None:
    core, station = begun(), Sender(("127.0.0.1", 40000), (255, 190))
    station.say(core, 0, heartbeat(autopilot=mavlink.MAV_AUTOPILOT_INVALID, kind=mavlink.MAV_TYPE_GCS))
    core.step(2 * SECOND_US)
    report = core.report(2 * SECOND_US)
    assert only(report).ground_station
    assert not only(report).vehicle
    assert only(report).asked == 0
    assert not report.ok
    assert "No vehicle: the HEARTBEATs that came" in texts(report, "problem")


def test_junk_alone() -> None:
    core = begun()
    for _ in range(3):
        core.receive(0, b"hello, world, this is no MAVLink", ("127.0.0.1", 9999), 0)
    report = core.report(SECOND_US)
    [junk] = report.ports[0].junk
    assert (junk.address, junk.datagrams, junk.frames, junk.junk_bytes) == ("127.0.0.1:9999", 3, 0, 96)
    assert junk.begins.startswith("68 65 6c 6c 6f")
    assert "3 datagrams without one good frame, beginning 68 65 6c 6c 6f" in texts(report, "problem")
    assert not report.ok


def test_bad_frames_among_good_ones_are_told_by_reason() -> None:
    core, vehicle = begun(), Sender()
    vehicle.say(core, 0, heartbeat())
    damaged = bytearray(vehicle.frame(attitude()))
    damaged[12] ^= 0x40
    core.receive(0, bytes(damaged), VEHICLE, 0)
    core.receive(0, vehicle.frame(heartbeat())[:12], VEHICLE, 0)
    flagged = bytearray(vehicle.frame(heartbeat()))
    flagged[2] = 0x80
    core.receive(0, bytes(flagged), VEHICLE, 0)
    report = core.report(SECOND_US)
    [junk] = report.ports[0].junk
    assert junk.frames == 1
    assert junk.bad == {"bad_crc": 1, "bad_length": 1, "incompatible": 1}
    for words in ("1 x wrong checksum", "1 x cut short", "1 x incompatibility flags"):
        assert words in texts(report, "problem")


def test_unknown_messages_are_named_and_are_no_damage() -> None:
    """EVENT and friends of PX4; the payload has bytes that look like the beginning of frames."""
    core, vehicle = begun(), Sender()
    unknown = bytes((0xFD, 12, 0, 0, 7, 1, 1)) + (410).to_bytes(3, "little") + b"\xfd" * 6 + b"\xfe" * 6 + b"\x12\x34"
    core.receive(0, vehicle.frame(heartbeat()) + unknown, VEHICLE, 0)
    core.receive(0, unknown, VEHICLE, 0)
    report = core.report(SECOND_US)
    [junk] = report.ports[0].junk
    assert junk.unknown_ids == {410: 2}
    assert (junk.bad, junk.junk_bytes) == ({}, 0)
    assert "410 (2 x)" in texts(report, "note")
    assert "bad frames" not in texts(report, "problem")


def test_losses_are_counted_by_sequence_numbers_each_address_for_itself() -> None:
    core, vehicle, other = begun(), Sender(), Sender(("127.0.0.1", 18571), (2, 1))
    for index in range(100):
        if index % 10 == 9:
            vehicle.frame(attitude())  # never arrives
        vehicle.say(core, index * 10_000, heartbeat())
        other.say(core, index * 10_000, heartbeat())
    first, second = core.report(SECOND_US).ports[0].heard
    assert (first.lost, second.lost) == (10, 0)
    assert first.loss == pytest.approx(10 / 110)
    assert "10 of 110 frames are missing (9%)" in texts(core.report(SECOND_US), "problem")


def test_one_id_from_two_addresses_on_a_port_is_a_duplicate_but_two_ports_of_one_vehicle_are_none() -> None:
    core, gcs, offboard = begun(GCS_EAR, OFFBOARD_EAR), Sender(), Sender(("127.0.0.1", 14580))
    gcs.say(core, 0, heartbeat())
    offboard.say(core, 0, heartbeat(), port=1)
    assert "addresses" not in texts(core.report(SECOND_US), "problem")
    Sender(("127.0.0.1", 18571)).say(core, 0, heartbeat())
    problems = texts(core.report(SECOND_US), "problem")
    assert "1/1 comes from 2 addresses: 127.0.0.1:18570, 127.0.0.1:18571" in problems
    assert "--instance" in problems


def test_mavlink_1_and_signatures_are_shown() -> None:
    core, vehicle = begun(), Sender()
    old = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    core.receive(0, heartbeat().pack(old, force_mavlink1=True), VEHICLE, 0)
    assert only(core.report(0)).mavlink_versions == (1,)
    signing = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    signing.signing.secret_key = b"k" * 32
    signing.signing.sign_outgoing = True
    signing.signing.timestamp = 1
    core.receive(0, heartbeat().pack(signing), VEHICLE, 0)
    for now_us in (0, SECOND_US):
        core.step(now_us)
    vehicle.say(core, SECOND_US, heartbeat())
    report = core.report(2 * SECOND_US)
    assert (only(report).mavlink_versions, only(report).signed, only(report).messages) == ((1, 2), 1, 3)
    assert "believes only those signed with its key" in texts(report, "problem")


def test_our_own_frames_that_come_back_are_no_source() -> None:
    core = begun(GCS_EAR, OFFBOARD_EAR)
    own = Sender(("127.0.0.1", 14580), (check.SYSTEM_ID, check.COMPONENT_ID))
    own.say(core, 0, heartbeat(autopilot=mavlink.MAV_AUTOPILOT_INVALID, kind=mavlink.MAV_TYPE_GCS), port=1)
    report = core.report(SECOND_US)
    assert report.ports[1].heard == ()
    assert report.ports[1].own_echoes == 1
    assert "forwards between its links" in texts(report, "note")


# --- silence ----------------------------------------------------------------------------------------------------------


def test_nothing_heard_and_no_vehicle_here_says_who_should_send_where() -> None:
    report = begun(GCS_EAR, OFFBOARD_EAR).report(3 * SECOND_US)
    assert not report.ok
    assert "Nothing came: udpin:127.0.0.1:14550, udpin:127.0.0.1:14540" in texts(report, "problem")
    for words in ("18570 and 14580", "14550 and 14540", "--gcs-remote", "--listen udpin:0.0.0.0:14550"):
        assert words in texts(report, "note")


def test_nothing_heard_but_a_vehicle_port_is_bound_says_that_it_sends_elsewhere() -> None:
    held = VehiclePort(port=18570, sends_to=14550, option="--gcs-remote", holder="px4 (process 12)")
    report = begun(ports=(held,)).report(3 * SECOND_US)
    note = texts(report, "note")
    assert "18570, which a vehicle binds to send to 14550, is taken by px4 (process 12)" in note
    assert "--listen udpout:127.0.0.1:18570" in note
    assert "No program on this machine" not in note


def test_nobody_answers_where_we_speak_first() -> None:
    core = begun(Ear(endpoint="udpout:127.0.0.1:18570", speaks_first=True))
    note = texts(core.report(3 * SECOND_US), "note")
    assert "We spoke first and nobody answered" in note
    assert "another machine" not in note


def test_a_port_in_use_is_told_with_who_has_it_and_how_to_go_on() -> None:
    named = Ear(endpoint="udpin:127.0.0.1:14550", error="in use", taken=True, holder="QGroundControl (process 4711)")
    nameless = Ear(endpoint="udpin:127.0.0.1:14540", error="in use", taken=True, find_holder="who-has 14540")
    report = begun(named, nameless).report(0)
    first, second = (finding.text for finding in report.findings)
    assert "14550 is in use by QGroundControl (process 4711)" in first
    assert "--listen udpout:127.0.0.1:18570" in first
    assert "14540 is in use by another program" in second
    assert "Find it with: who-has 14540." in second
    assert "Nothing came" not in texts(report, "problem")


# --- hostile input ----------------------------------------------------------------------------------------------------


def test_what_peers_can_make_it_keep_is_bounded() -> None:
    core = begun()
    for number in range(300):
        Sender(("127.0.0.1", 20000 + number), (1 + number % 250, 1)).say(core, 0, heartbeat())
    for number in range(300):
        unknown = bytes((0xFD, 0, 0, 0, 7, 1, 1)) + (60000 + number).to_bytes(3, "little") + b"\0\0"
        core.receive(0, unknown, ("127.0.0.1", 20000), 0)
    core.step(0)
    [port] = core.report(SECOND_US).ports
    assert len(port.heard) == check.MAX_IDENTITIES
    assert sum(len(junk.unknown_ids) for junk in port.junk) == check.MAX_UNKNOWN_IDS
    assert len(port.junk) <= check.MAX_ADDRESSES
    assert port.not_listed > 0
    assert len(core.datagrams(0)) <= check.MAX_IDENTITIES + 1


HEARTBEATS = st.builds(
    lambda *fields: mavlink.MAVLink_heartbeat_message(*fields, 3),
    *[st.integers(0, 255)] * 3, st.integers(0, 2**32 - 1), st.integers(0, 255),
)  # fmt: skip


@given(st.lists(st.one_of(st.binary(max_size=80), st.builds(lambda m: encode(m, 0, 1, 1), HEARTBEATS)), max_size=8))
def test_nothing_that_comes_makes_it_raise(datagrams: list[bytes]) -> None:
    core = begun()
    for number, datagram in enumerate(datagrams):
        core.receive(0, datagram, ("::1", 5000 + number % 3, 0, 0), number * 400_000)
        core.step(number * 400_000)
    report = core.report(4 * SECOND_US)
    assert report.ports[0].datagrams == len(datagrams)
    assert msgspec.json.decode(msgspec.json.encode(report), type=Report) == report
