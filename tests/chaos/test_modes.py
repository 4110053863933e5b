"""Each mode of protocol chaos as it is seen on the wire, in simulated time."""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise
from math import isnan
from pathlib import Path

import pytest
from mavsitl_vehicle.autopilot import metadata

from mavsitl.chaos import TABLE
from mavsitl.dialect import mavlink
from mavsitl.services.ftp import FtpError, FtpPayload, Opcode
from tests.autopilot.conftest import GCS, OFFBOARD, flight
from tests.chaos.client import ChaosClient, acks, asked

LAND, ARM = mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKEOFF, REQUEST, SET_MODE = mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAV_CMD_DO_SET_MODE
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
VERSION, HOME = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, mavlink.MAVLINK_MSG_ID_HOME_POSITION
NAME = "MIS_TAKEOFF_ALT"

Check = Callable[[ChaosClient], None]
CHECKS: dict[str, tuple[str, Check]] = {}
"""By the mode's name: as it is begun, and what is looked at."""


def mode(text: str) -> Callable[[Check], Check]:
    def note(check: Check) -> Check:
        CHECKS[text.partition(":")[0].partition("@")[0]] = (text, check)
        return check

    return note


def test_every_mode_is_checked() -> None:
    assert CHECKS.keys() == TABLE.keys()


@pytest.mark.parametrize("name", CHECKS)
def test_mode(name: str) -> None:
    text, check = CHECKS[name]
    client = ChaosClient(flight())
    client.run(1.2)
    client.begin(text)
    check(client)
    assert client.vehicle.counters.unsupported == 0


# --- commands --------------------------------------------------------------------------------------------------------


def lands(client: ChaosClient) -> bool:
    """The vehicle has done NAV_LAND."""
    client.run(0.02)
    return client.vehicle.autopilot.commander.intended.name == "LAND"


@mode("ack-lost")
def _(client: ChaosClient) -> None:
    assert client.results(LAND) == []
    assert lands(client)
    client.run(6.0)
    assert client.since(0, "COMMAND_ACK") == []
    assert client.results(LAND, confirmation=1) == []


@mode("ack-first-lost:2")
def _(client: ChaosClient) -> None:
    answers = [client.results(LAND, confirmation=n) for n in range(3)]
    assert answers == [[], [], [ACCEPTED]]
    assert client.results(LAND) == []  # a new command


@mode("ack-late:2.5:NAV_LAND")
def _(client: ChaosClient) -> None:
    assert client.results(ARM, 1) == [ACCEPTED]  # another command
    sent_us, seen = client.now_us, len(client.inbox)
    client.command(LAND)
    assert lands(client)
    client.run(3.0)
    (came,) = [t for t, _ in client.timed(seen, "COMMAND_ACK")]
    assert came == pytest.approx(sent_us / 1e6 + 2.5, abs=0.005)


@mode("ack-doubled")
def _(client: ChaosClient) -> None:
    assert client.results(LAND) == [ACCEPTED, ACCEPTED]


@mode("ack-refused")
def _(client: ChaosClient) -> None:
    assert client.results(LAND) == [DENIED]
    assert not lands(client)
    client.vehicle.chaos.end("ack-refused")
    client.begin("ack-refused:FAILED:400")
    assert client.results(ARM, 1) == [FAILED]
    assert client.results(LAND) == [ACCEPTED]


@mode("ack-busy:2")
def _(client: ChaosClient) -> None:
    assert [client.results(LAND) for _ in range(2)] == [[REJECTED], [REJECTED]]
    assert not lands(client)
    assert client.results(LAND) == [ACCEPTED]
    assert lands(client)


@mode("ack-progress-forever")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    client.command(LAND)
    client.run(10.0)
    client.command(LAND, confirmation=1)  # a repeat is no second one
    client.run(10.0)
    said = client.since(seen, "COMMAND_ACK")
    assert {ack.result for ack in said} == {IN_PROGRESS}
    assert len(said) == pytest.approx(40, abs=2)
    assert [ack.progress for ack in said] == list(range(len(said)))
    assert not lands(client)


@mode("ack-progress-stuck")
def _(client: ChaosClient) -> None:
    assert client.results(LAND, run_s=10.0) == [IN_PROGRESS]
    assert not lands(client)


@mode("ack-progress-accepted:2")
def _(client: ChaosClient) -> None:
    sent_s, seen = client.now_us / 1e6, len(client.inbox)
    client.command(LAND)
    assert lands(client)
    client.run(3.0)
    said = [(round(t - sent_s, 1), ack.result, ack.progress) for t, ack in client.timed(seen, "COMMAND_ACK")]
    assert said == [(0.0, 5, 0), (0.5, 5, 25), (1.0, 5, 50), (1.5, 5, 75), (2.0, ACCEPTED, 0)]


@mode("ack-progress-failed:1")
def _(client: ChaosClient) -> None:
    assert client.results(LAND, run_s=2.0) == [IN_PROGRESS, IN_PROGRESS, FAILED]
    assert not lands(client)


@mode("ack-wrong-command")
def _(client: ChaosClient) -> None:
    (ack,) = client.command(LAND)
    assert (ack.command, ack.result) == (LAND + 1, ACCEPTED)


@mode("ack-wrong-target")
def _(client: ChaosClient) -> None:
    (ack,) = client.command(LAND)
    assert (ack.command, ack.target_system) == (LAND, 246)


@mode("ack-no-target")
def _(client: ChaosClient) -> None:
    (ack,) = client.command(LAND)
    assert (ack.command, ack.result, ack.target_system, ack.target_component) == (LAND, ACCEPTED, 0, 0)


@mode("ack-unasked:NAV_LAND:0.5")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    client.run(2.0)
    said = client.since(seen, "COMMAND_ACK")
    assert [(ack.command, ack.result) for ack in said] == [(LAND, ACCEPTED)] * 4
    assert not lands(client)


@mode("command-lost:NAV_LAND")
def _(client: ChaosClient) -> None:
    assert client.results(LAND) == []
    assert not lands(client)
    assert client.results(REQUEST, VERSION) == [ACCEPTED]


@mode("command-first-lost")
def _(client: ChaosClient) -> None:
    assert client.results(LAND) == []
    assert not lands(client)
    assert client.results(LAND, confirmation=1) == [ACCEPTED]
    assert lands(client)


@mode("command-not-done:NAV_LAND")
def _(client: ChaosClient) -> None:
    assert client.results(LAND) == [ACCEPTED]
    assert not lands(client)
    assert client.results(TAKEOFF) == [ACCEPTED]
    assert client.flight_mode == (4, 2)


@mode("arm-not-done")
def _(client: ChaosClient) -> None:
    assert client.results(ARM, 1, run_s=1.5) == [ACCEPTED]
    assert not client.armed
    assert client.results(TAKEOFF) == [ACCEPTED]  # modes change


@mode("mode-not-done")
def _(client: ChaosClient) -> None:
    before = client.flight_mode
    for command, params in ((SET_MODE, (1, 1)), (TAKEOFF, ()), (LAND, ())):
        assert client.results(command, *params, run_s=0.5) == [ACCEPTED]
    client.send(mavlink.MAVLink_set_mode_message(1, 1, 1 << 16))
    client.run(1.5)
    assert client.flight_mode == before
    assert client.results(ARM, 1, run_s=1.1) == [ACCEPTED]
    assert client.armed


@mode("user-commands")
def _(client: ChaosClient) -> None:
    user = mavlink.MAV_CMD_USER_1
    said = [[client.results(user + n, confirmation=again, run_s=1.5) for again in (0, 1)] for n in range(9)]
    assert said == [
        [[ACCEPTED], [ACCEPTED]], [[FAILED], [FAILED]], [[], [ACCEPTED]], [[], [FAILED]], [[], []], [[], []],
        [[IN_PROGRESS, IN_PROGRESS, ACCEPTED]] * 2, [[IN_PROGRESS, IN_PROGRESS, FAILED]] * 2, [[IN_PROGRESS]] * 2,
    ]  # fmt: skip
    assert client.results(LAND) == [ACCEPTED]


# --- signs of life ---------------------------------------------------------------------------------------------------


def counted(client: ChaosClient, seconds: float, name: str, port: int = OFFBOARD) -> int:
    seen = len(client.inbox)
    client.run(seconds)
    return len(client.since(seen, name, port))


@mode("heartbeat-lost@offboard")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    assert counted(client, 3.0, "HEARTBEAT") == 0
    assert len(client.since(seen, "ATTITUDE")) > 250
    assert len(client.since(seen, "HEARTBEAT", GCS)) == 3  # the other port
    assert client.results(LAND) == [ACCEPTED]
    assert client.since(seen, "HEARTBEAT") == []  # nor on a change


@mode("heartbeat-slow:4")
def _(client: ChaosClient) -> None:
    assert counted(client, 12.0, "HEARTBEAT") == 3


@mode("heartbeat-other-system")
def _(client: ChaosClient) -> None:
    seen = len(client.frames)
    client.run(4.0)
    beats = [
        frame.system_id for _, port, frame in client.frames[seen:]
        if port == OFFBOARD and frame.message.get_type() == "HEARTBEAT"
    ]  # fmt: skip
    assert beats == [1, 2, 1, 2]
    rest = {frame.system_id for _, _, frame in client.frames[seen:] if frame.message.get_type() != "HEARTBEAT"}
    assert rest == {1}


@mode("heartbeat-autopilot")
def _(client: ChaosClient) -> None:
    client.run(1.1)
    assert client.heartbeat.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA


@mode("heartbeat-type:GCS")
def _(client: ChaosClient) -> None:
    client.run(1.1)
    assert client.heartbeat.type == mavlink.MAV_TYPE_GCS


def silence(client: ChaosClient, seconds: float) -> int:
    """Datagrams within `seconds`, of the off-board port."""
    before = len(client.wire[OFFBOARD])
    client.run(seconds)
    return len(client.wire[OFFBOARD]) - before


@mode("comm-lost:2@offboard")
def _(client: ChaosClient) -> None:
    client.command(LAND)
    assert silence(client, 1.9) == 0
    assert not lands(client)
    assert silence(client, 1.0) > 100
    assert client.results(LAND) == [ACCEPTED]


@mode("mute")
def _(client: ChaosClient) -> None:
    client.command(LAND)
    assert lands(client)
    assert silence(client, 10.0) == 0


@mode("deaf")
def _(client: ChaosClient) -> None:
    assert client.results(LAND) == []
    assert not lands(client)
    assert silence(client, 1.0) > 100


# --- parameters ------------------------------------------------------------------------------------------------------


def count(client: ChaosClient) -> int:
    return len(client.vehicle.parameters.names)


@mode("param-list-ignored")
def _(client: ChaosClient) -> None:
    assert client.list_parameters() == []
    assert len(client.read(NAME)) == 1


@mode("param-list-without:MIS_TAKEOFF_ALT")
def _(client: ChaosClient) -> None:
    for _ in range(2):
        values = client.list_parameters()
        assert NAME not in {value.param_id for value in values}
        assert len(values) == count(client)  # with _HASH_CHECK
    assert [value.param_id for value in client.read(NAME)] == [NAME]
    index = client.vehicle.parameters.names.index(NAME)
    by_index = mavlink.MAVLink_param_request_read_message(1, 1, b"", index)
    assert [value.param_id for value in client.ask(by_index, "PARAM_VALUE")] == [NAME]


@mode("param-missing:MIS_TAKEOFF_ALT")
def _(client: ChaosClient) -> None:
    assert NAME not in {value.param_id for value in client.list_parameters()}
    assert client.read(NAME) == []
    assert client.set(NAME, 4.0) == []
    assert len(client.read("COM_OF_LOSS_T")) == 1


@mode("param-list-ends:20")
def _(client: ChaosClient) -> None:
    values = client.list_parameters()
    assert [value.param_index for value in values if value.param_index != 65535] == list(range(20))
    assert len(client.read(NAME)) == 1
    assert len(client.list_parameters()) == 21


@mode("param-count-wrong:3")
def _(client: ChaosClient) -> None:
    assert {value.param_count for value in client.list_parameters()} == {count(client) + 3}


@mode("param-index-doubled")
def _(client: ChaosClient) -> None:
    indices = [value.param_index for value in client.list_parameters()][1:]
    assert indices[:6] == [0, 0, 2, 2, 4, 4]
    assert len(indices) == count(client)


@mode("param-doubled")
def _(client: ChaosClient) -> None:
    assert [value.param_id for value in client.read(NAME)] == [NAME, NAME]


@mode("param-type-wrong")
def _(client: ChaosClient) -> None:
    (value,) = client.read(NAME)
    assert value.param_type == mavlink.MAV_PARAM_TYPE_INT32
    (value,) = client.read("COM_RC_IN_MODE")
    assert value.param_type == mavlink.MAV_PARAM_TYPE_REAL32


@mode("param-nan:MIS_TAKEOFF_ALT")
def _(client: ChaosClient) -> None:
    assert isnan(client.read(NAME)[0].param_value)
    assert not isnan(client.vehicle.parameters[NAME])


@mode("param-hash-silent")
def _(client: ChaosClient) -> None:
    values = client.list_parameters()
    assert len(values) == count(client)
    assert "_HASH_CHECK" not in {value.param_id for value in values}
    assert client.read("_HASH_CHECK") == []


@mode("param-set-ignored")
def _(client: ChaosClient) -> None:
    assert client.set(NAME, 4.0) == []
    assert client.vehicle.parameters[NAME] == 2.5


@mode("param-set-first-ignored")
def _(client: ChaosClient) -> None:
    assert client.set(NAME, 4.0) == []
    assert client.vehicle.parameters[NAME] == 2.5
    (value,) = client.set(NAME, 4.0)
    assert value.param_value == client.vehicle.parameters[NAME] == 4.0


@mode("param-set-unanswered@offboard")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    assert client.set(NAME, 4.0) == []
    assert client.vehicle.parameters[NAME] == 4.0
    client.run(0.15)
    assert [value.param_value for value in client.since(seen, "PARAM_VALUE", GCS)] == [4.0]
    assert [value.param_value for value in client.read(NAME)] == [4.0]


@mode("param-set-refused:READ_ONLY")
def _(client: ChaosClient) -> None:
    (error,) = client.set(NAME, 4.0)
    assert (error.get_type(), error.param_id, error.error) == ("PARAM_ERROR", NAME, mavlink.MAV_PARAM_ERROR_READ_ONLY)
    assert client.vehicle.parameters[NAME] == 2.5


@mode("param-set-kept")
def _(client: ChaosClient) -> None:
    (value,) = client.set(NAME, 4.0)
    assert (value.get_type(), value.param_id, value.param_value) == ("PARAM_VALUE", NAME, 2.5)
    # To everybody: what the vehicle gets in its place is for the router to pass on, too.
    client.send(mavlink.MAVLink_param_set_message(0, 0, NAME.encode(), 4.0, mavlink.MAV_PARAM_TYPE_REAL32))
    assert client.vehicle.parameters[NAME] == 2.5


@mode("param-read-ignored")
def _(client: ChaosClient) -> None:
    assert client.read(NAME) == []
    assert len(client.set(NAME, 4.0)) == 1


@mode("param-read-first-ignored")
def _(client: ChaosClient) -> None:
    assert [len(client.read(NAME)) for _ in range(4)] == [0, 1, 0, 1]


@mode("param-read-refused")
def _(client: ChaosClient) -> None:
    (error,) = client.read(NAME)
    assert (error.get_type(), error.param_id, error.param_index, error.error) == ("PARAM_ERROR", NAME, -1, 1)


# --- missions --------------------------------------------------------------------------------------------------------


def with_plan(client: ChaosClient, items: int = 4) -> None:
    """A plan is aboard, put there while all was well."""
    active = client.vehicle.chaos.active
    client.vehicle.chaos.clear()
    assert acks(client.put(items)) == [0]
    client.begin(*active)


@mode("mission-count-lost")
def _(client: ChaosClient) -> None:
    with_plan(client)
    assert client.get(4) == client.get(4) == []
    assert acks(client.put(3)) == [0]


@mode("mission-count-first-lost")
def _(client: ChaosClient) -> None:
    with_plan(client)
    assert client.get(4) == []
    assert asked(client.get(4)) == [0, 1, 2, 3]
    assert client.get(4) == []


@mode("mission-count-wrong:2")
def _(client: ChaosClient) -> None:
    with_plan(client)
    said = client.get(6)
    assert said[0].count == 6
    assert asked(said) == [0, 1, 2, 3]
    assert acks(said) == [mavlink.MAV_MISSION_INVALID_SEQUENCE]


@mode("mission-item-lost:1")
def _(client: ChaosClient) -> None:
    with_plan(client)
    assert [asked(client.get(4)) for _ in range(2)] == [[0], [0]]


@mode("mission-item-first-lost:1")
def _(client: ChaosClient) -> None:
    with_plan(client)
    assert asked(client.get(4)) == [0]
    again = mavlink.MAVLink_mission_request_int_message(1, 1, 1, 0)
    assert asked(client.ask(again, "MISSION_ITEM_INT")) == [1]


@mode("mission-item-wrong-seq:1")
def _(client: ChaosClient) -> None:
    with_plan(client)
    assert asked(client.get(4)) == [0, 2, 3]


@mode("mission-item-refused:1:INVALID_PARAM1")
def _(client: ChaosClient) -> None:
    with_plan(client)
    said = client.get(4)
    assert (asked(said), acks(said)) == ([0], [mavlink.MAV_MISSION_INVALID_PARAM1])


@mode("mission-begin-ignored")
def _(client: ChaosClient) -> None:
    assert client.put(4) == client.put(4) == []
    assert client.plan == 0


@mode("mission-begin-first-ignored")
def _(client: ChaosClient) -> None:
    assert client.put(4) == []
    assert acks(client.put(4)) == [0]


@mode("mission-request-lost:1")
def _(client: ChaosClient) -> None:
    said = client.put(4, run_s=6.0)
    assert (asked(said), acks(said)) == ([0], [mavlink.MAV_MISSION_OPERATION_CANCELLED])
    assert client.plan == 0


@mode("mission-request-wrong-seq:0")
def _(client: ChaosClient) -> None:
    assert set(asked(client.put(4))) == {1}
    assert client.plan == 0


@mode("mission-request-refused:1")
def _(client: ChaosClient) -> None:
    said = client.put(4, run_s=6.0)
    assert (asked(said), acks(said)) == ([0], [mavlink.MAV_MISSION_ERROR])
    assert client.plan == 0
    assert acks(client.put(1)) == [0]  # a plan that ends before that item
    client.vehicle.chaos.clear()
    client.begin("mission-request-refused:0:NO_SPACE")
    said = client.put(4, run_s=1.0)
    assert (asked(said), acks(said)) == ([], [mavlink.MAV_MISSION_NO_SPACE])


@mode("mission-ack-lost")
def _(client: ChaosClient) -> None:
    said = client.put(4, run_s=6.0)
    assert (asked(said), acks(said)) == ([0, 1, 2, 3], [])
    assert client.plan == 4


@mode("mission-ack-error")
def _(client: ChaosClient) -> None:
    assert acks(client.put(4)) == [mavlink.MAV_MISSION_ERROR]
    assert client.plan == 4


@mode("mission-ack-early:3")
def _(client: ChaosClient) -> None:
    said = client.put(5, run_s=6.0)
    assert (asked(said), acks(said)) == ([0, 1, 2], [0])
    assert client.plan == 0


@mode("mission-ack-late:1")
def _(client: ChaosClient) -> None:
    said = client.put(4, run_s=0.9)
    assert (asked(said), acks(said)) == ([0, 1, 2, 3], [])
    seen = len(client.inbox)
    client.run(0.3)
    assert [ack.type for ack in client.since(seen, "MISSION_ACK")] == [0]


@mode("mission-ack-doubled")
def _(client: ChaosClient) -> None:
    assert acks(client.put(4)) == [0, 0]


@mode("mission-ack-unasked:0.5")
def _(client: ChaosClient) -> None:
    assert counted(client, 2.0, "MISSION_ACK") == 4


@mode("mission-item-unasked:0.5")
def _(client: ChaosClient) -> None:
    assert counted(client, 2.0, "MISSION_ITEM_INT") == 4


@mode("mission-request-unasked:0.5")
def _(client: ChaosClient) -> None:
    assert counted(client, 2.0, "MISSION_REQUEST_INT") == 4


@mode("mission-reached-lost")
def _(client: ChaosClient) -> None:
    client.vehicle.plan.stores.reached(0)
    assert counted(client, 2.0, "MISSION_ITEM_REACHED") == 0
    client.vehicle.chaos.clear()
    assert counted(client, 1.5, "MISSION_ITEM_REACHED") > 0


# --- files -----------------------------------------------------------------------------------------------------------

PATH = f"{metadata.FOLDER}/{metadata.GENERAL_URI.rsplit('/', 1)[-1]}"


def ftp(client: ChaosClient, opcode: int, sequence: int, data: bytes = b"", **fields: int) -> list[FtpPayload]:
    """The replies to one request."""
    size = fields.pop("size", len(data))
    payload = FtpPayload(sequence=sequence, opcode=opcode, size=size, data=data, **fields).encode()
    request = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, payload)
    replies = [FtpPayload.decode(bytes(m.payload)) for m in client.ask(request, "FILE_TRANSFER_PROTOCOL", run_s=0.1)]
    return [reply for reply in replies if reply is not None]


def opened(client: ChaosClient) -> int:
    """The size of the file, now open in session 0, by its opening's answer with sequence 1."""
    (reply,) = ftp(client, Opcode.OPEN_FILE_RO, 0, PATH.encode())
    assert (reply.opcode, reply.sequence) == (Opcode.ACK, 1)
    return int(struct.unpack_from("<I", reply.data)[0])


def read(client: ChaosClient, sequence: int, offset: int = 0) -> list[FtpPayload]:
    return ftp(client, Opcode.READ_FILE, sequence, offset=offset, size=80)


def error(reply: FtpPayload) -> int:
    assert reply.opcode == Opcode.NAK
    return reply.data[0]


def content() -> bytes:
    found: bytes = metadata.files()[f"{metadata.FOLDER}/{PATH.rsplit('/', 1)[-1]}"]
    return found


@mode("ftp-silent")
def _(client: ChaosClient) -> None:
    assert ftp(client, Opcode.RESET_SESSIONS, 0) == []
    assert ftp(client, Opcode.LIST_DIRECTORY, 1, b"/") == []


@mode("ftp-nak:FILENOTFOUND")
def _(client: ChaosClient) -> None:
    (reply,) = ftp(client, Opcode.LIST_DIRECTORY, 7, b"/")
    assert (error(reply), reply.sequence, reply.requested_opcode) == (10, 8, Opcode.LIST_DIRECTORY)


@mode("ftp-second-silent")
def _(client: ChaosClient) -> None:
    assert opened(client) == len(content())
    assert read(client, 2) == read(client, 2) == []
    assert len(ftp(client, Opcode.LIST_DIRECTORY, 3, b"/")) == 1
    assert ftp(client, Opcode.LIST_DIRECTORY, 4, b"/", offset=2) == []


@mode("ftp-second-first-silent")
def _(client: ChaosClient) -> None:
    opened(client)
    assert read(client, 2) == []
    assert [reply.data for reply in read(client, 2)] == [content()[:80]]
    assert len(read(client, 3, 80)) == 1
    ftp(client, Opcode.TERMINATE_SESSION, 4)
    opened(client)
    assert read(client, 2) == []


@mode("ftp-second-nak:FAIL")
def _(client: ChaosClient) -> None:
    opened(client)
    assert error(read(client, 2)[0]) == FtpError.FAIL


@mode("ftp-bad-sequence")
def _(client: ChaosClient) -> None:
    (reply,) = ftp(client, Opcode.LIST_DIRECTORY, 7, b"/")
    assert (reply.opcode, reply.sequence) == (Opcode.ACK, 9)


@mode("ftp-wrong-session")
def _(client: ChaosClient) -> None:
    (reply,) = ftp(client, Opcode.OPEN_FILE_RO, 0, PATH.encode())
    assert reply.session == 0x80


@mode("ftp-drops:0.3")
def _(client: ChaosClient) -> None:
    opened_or_not = [len(ftp(client, Opcode.LIST_DIRECTORY, n, b"/")) for n in range(100)]
    assert 0.3 < sum(opened_or_not) / 100 < 0.7  # 0.7 of 0.7


@mode("ftp-wrong-size:100")
def _(client: ChaosClient) -> None:
    assert opened(client) == len(content()) + 100
    assert [reply.data for reply in read(client, 2)] == [content()[:80]]


@mode("ftp-cut:0.5")
def _(client: ChaosClient) -> None:
    size = opened(client)
    half = size // 2
    assert size == len(content())
    found, sequence = b"", 2
    while True:
        (reply,) = read(client, sequence, len(found))
        sequence += 1
        if reply.opcode == Opcode.NAK:
            break
        found += reply.data
        assert reply.size == len(reply.data)
    assert error(reply) == FtpError.EOF
    assert found == content()[:half]
    burst = ftp(client, Opcode.BURST_READ_FILE, sequence, offset=0, size=40)
    assert b"".join(reply.data for reply in burst if reply.opcode == Opcode.ACK) == content()[:half]
    assert [error(reply) for reply in burst if reply.opcode == Opcode.NAK] == [FtpError.EOF]


@mode("ftp-gaps:3")
def _(client: ChaosClient) -> None:
    opened(client)
    burst = ftp(client, Opcode.BURST_READ_FILE, 2, offset=0, size=20)
    missing = set(range(0, len(content()), 20)) - {reply.offset for reply in burst}
    assert missing == set(range(40, len(content()), 60))


@mode("ftp-corrupt:2")
def _(client: ChaosClient) -> None:
    opened(client)
    replies = [read(client, 2 + n, 80)[0].data for n in range(4)]
    good = content()[80:160]
    bad = bytes((good[0] ^ 0xFF,)) + good[1:]
    assert replies == [good, bad, good, bad]


@mode("log-silent")
def _(client: ChaosClient) -> None:
    request = mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF)
    assert client.ask(request, "LOG_ENTRY") == []
    client.vehicle.chaos.clear()
    assert len(client.ask(request, "LOG_ENTRY")) == 1


def with_log(tmp_path: Path) -> ChaosClient:
    """Of a vehicle with a log of 20 kB."""
    from mavsitl_vehicle.vehicle import Vehicle

    from mavsitl.log.ulog import MemoryRecorder

    (tmp_path / "flight.ulg").write_bytes(bytes(20_000))
    client = ChaosClient()
    client.vehicle = Vehicle(flight(), MemoryRecorder(), seed=1, ports=("offboard", "gcs"), logs=tmp_path)
    client.now_us = 0
    client.vehicle.step(0)
    return client


@mode("log-drops:0.2")
def _(client: ChaosClient) -> None:
    """In `test_logs`: it takes a vehicle that has one."""


@mode("log-wrong-size:1000")
def _(client: ChaosClient) -> None:
    """In `test_logs`: it takes a vehicle that has one."""


def test_logs(tmp_path: Path) -> None:
    client = with_log(tmp_path)
    wanted = mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF)
    (entry,) = client.ask(wanted, "LOG_ENTRY")
    client.begin("log-wrong-size:1000")
    (promised,) = client.ask(wanted, "LOG_ENTRY")
    assert (entry.size, promised.size) == (20_000, 21_000)
    client.begin("log-drops:0.2")
    data = client.ask(mavlink.MAVLink_log_request_data_message(1, 1, entry.id, 0, 20_000), "LOG_DATA", run_s=3.0)
    whole = -(-20_000 // 90)
    assert 0.7 * whole < len({each.ofs for each in data}) < 0.9 * whole


# --- telemetry and requests ------------------------------------------------------------------------------------------


def requested(client: ChaosClient, message_id: int) -> tuple[list[int], list[str]]:
    """The results of REQUEST_MESSAGE, and the kinds of message that came of it."""
    name = str(mavlink.mavlink_map[message_id].msgname)
    seen = len(client.inbox)
    results = client.results(REQUEST, message_id)
    return results, [message.get_type() for message in client.since(seen, name)]


@mode("version-refused")
def _(client: ChaosClient) -> None:
    assert requested(client, VERSION) == ([FAILED], [])
    assert client.results(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1) == [FAILED]
    assert requested(client, HOME)[0] == [ACCEPTED]


@mode("version-lost")
def _(client: ChaosClient) -> None:
    assert requested(client, VERSION) == ([ACCEPTED], [])
    client.vehicle.chaos.clear()
    assert requested(client, VERSION) == ([ACCEPTED], ["AUTOPILOT_VERSION"])


@mode("request-not-sent")
def _(client: ChaosClient) -> None:
    assert requested(client, VERSION) == requested(client, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES) == ([ACCEPTED], [])


@mode("request-unsupported:AUTOPILOT_VERSION")
def _(client: ChaosClient) -> None:
    assert requested(client, VERSION) == ([UNSUPPORTED], [])
    assert requested(client, HOME)[0] == [ACCEPTED]


@mode("request-silent:148")
def _(client: ChaosClient) -> None:
    assert requested(client, VERSION) == ([], [])
    assert requested(client, HOME)[0] == [ACCEPTED]


def clock_ns(client: ChaosClient) -> list[int]:
    answers = client.ask(mavlink.MAVLink_timesync_message(0, 12345), "TIMESYNC")
    return [answer.tc1 - client.now_us * 1000 for answer in answers]


@mode("timesync-silent")
def _(client: ChaosClient) -> None:
    assert clock_ns(client) == []


@mode("timesync-jumps:0.5")
def _(client: ChaosClient) -> None:
    errors = [clock_ns(client)[0] for _ in range(20)]
    assert all(abs(each) <= 0.53e9 for each in errors)
    assert max(errors) - min(errors) > 0.3e9


@mode("ping-silent")
def _(client: ChaosClient) -> None:
    ping = mavlink.MAVLink_ping_message(1, 7, 0, 0)
    assert client.ask(ping, "PING") == []
    client.vehicle.chaos.clear()
    assert len(client.ask(ping, "PING")) == 1


@mode("system-time-garbage")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    client.run(5.0)
    told = [message.time_boot_ms for message in client.since(seen, "SYSTEM_TIME")]
    assert len(set(told)) == len(told) == 5
    assert max(told) > 100_000


@mode("home-lost")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    assert client.results(mavlink.MAV_CMD_GET_HOME_POSITION, run_s=3.0) == [ACCEPTED]
    assert client.since(seen, "HOME_POSITION") == []


@mode("landed-unknown")
def _(client: ChaosClient) -> None:
    client.run(1.1)
    assert client.last("EXTENDED_SYS_STATE").landed_state == mavlink.MAV_LANDED_STATE_UNDEFINED


@mode("text-flood:100")
def _(client: ChaosClient) -> None:
    assert counted(client, 2.0, "STATUSTEXT") == 200


@mode("text-chunk-lost")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    client.vehicle.autopilot.queue_text(4, "x" * 120)
    client.run(0.1)
    assert [(message.chunk_seq, len(message.text)) for message in client.since(seen, "STATUSTEXT")] == [
        (0, 50),
        (2, 20),
    ]


@mode("telemetry-stopped")
def _(client: ChaosClient) -> None:
    seen = len(client.inbox)
    client.run(3.0)
    assert {message.get_type() for _, _, message in client.inbox[seen:]} == {"HEARTBEAT"}
    assert client.results(LAND) == [ACCEPTED]
    assert len(client.read(NAME)) == 1


@mode("telemetry-frozen")
def _(client: ChaosClient) -> None:
    client.tick()
    seen = len(client.inbox)
    client.run(3.0)
    attitudes = client.since(seen, "ATTITUDE")
    assert len(attitudes) == 300
    assert len({message.time_boot_ms for message in attitudes}) == 1
    assert client.results(SET_MODE, 1, 1) == [ACCEPTED]
    assert client.flight_mode == (1, 0)  # by HEARTBEAT


# --- frames ----------------------------------------------------------------------------------------------------------


def steps(client: ChaosClient, seconds: float) -> list[int]:
    """From each off-board frame's sequence number to the next one's."""
    seen = len(client.frames)
    client.run(seconds)
    numbers = [frame.sequence for _, port, frame in client.frames[seen:] if port == OFFBOARD]
    return [(after - before) & 0xFF for before, after in pairwise(numbers)]


@mode("sequence-gaps:10")
def _(client: ChaosClient) -> None:
    found = steps(client, 1.0)
    assert set(found) == {1, 2}
    assert found.count(2) == pytest.approx(len(found) / 10, abs=1)
    client.vehicle.chaos.clear()
    assert set(steps(client, 1.0)) == {1}


@mode("crc-wrong:10@offboard")
def _(client: ChaosClient) -> None:
    before = len(client.wire[OFFBOARD])
    client.run(1.0)
    sent = len(client.wire[OFFBOARD]) - before
    assert len(client.bad) == sent // 10
    assert all(datagram[0] == 0xFD and len(datagram) == datagram[1] + 12 for datagram in client.bad)


@mode("frame-cut:10@offboard")
def _(client: ChaosClient) -> None:
    before = len(client.wire[OFFBOARD])
    client.run(1.0)
    sent = len(client.wire[OFFBOARD]) - before
    assert len(client.bad) == sent // 10
    assert all(len(datagram) < datagram[1] + 12 for datagram in client.bad)


@mode("frame-unknown:10@offboard")
def _(client: ChaosClient) -> None:
    before = len(client.wire[OFFBOARD])
    client.run(1.0)
    assert len(client.bad) == (len(client.wire[OFFBOARD]) - before) // 11
    assert {datagram[7:10] for datagram in client.bad} == {b"\xf0\xff\xff"}
    assert set(steps(client, 0.5)) == {1}
