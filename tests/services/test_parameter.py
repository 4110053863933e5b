"""The parameter service: server and client on a lossy link, what hostile clients send, and pymavlink's own client."""

from __future__ import annotations

import struct
from collections.abc import Callable
from math import inf, isnan, nan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.parameters import TABLE, Parameters

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.parameter import (
    HASH_CHECK,
    ParameterClient,
    ParameterServer,
    ParameterTable,
    Refused,
    decode_value,
    encode_value,
)
from tests.services.lossy import CLIENT, SERVER, LossyLink

INT32, UINT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_UINT32, mavlink.MAV_PARAM_TYPE_REAL32
VALUE, ERROR = "PARAM_VALUE", "PARAM_ERROR"

SIGNALLING = [0x7F800001, 0x7FBFFFFF, -0x7FFFFF, -0x400001]
"""INT32 whose bytes are signalling NaNs as a float."""


class FreeTable:
    """A table of one unlimited INT32 and one unlimited REAL32, with a hash to order."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {"A_INT": 0, "B_REAL": 0.0}
        self.names = tuple(self.values)
        self.crc = 0

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def index(self, name: str) -> int | None:
        return self.names.index(name) if name in self.values else None

    def is_integer(self, name: str) -> bool:
        return name == "A_INT"

    def set(self, name: str, value: float) -> Refused | None:
        self.values[name] = value
        return None

    def hash(self) -> int:
        return self.crc

    def subscribe(self, listener: Callable[[str, float], None], /) -> Callable[[], None]:
        return lambda: None


def wire(message: Any) -> Any:
    (frame,) = parse(encode(message, 0, *CLIENT))
    return frame.message


class Asker:
    """Sends single messages to a server; answers come back as on the wire."""

    def __init__(self, table: ParameterTable | None = None) -> None:
        self.table = table or Parameters()
        self.texts: list[str] = []
        self.server = ParameterServer(self.table, self.texts.append)
        self.now_us = 0

    def tell(self, message: Any) -> list[Any]:
        return [wire(answer) for answer in self.server.receive(wire(message), CLIENT, self.now_us)]

    def set(self, name: str, data: bytes, param_type: int) -> list[Any]:
        number = struct.unpack("<f", data)[0]
        return self.tell(mavlink.MAVLink_param_set_message(*SERVER, name.encode(), number, param_type))

    def set_real(self, name: str, value: float) -> list[Any]:
        return self.set(name, struct.pack("<f", value), REAL32)

    def set_int(self, name: str, value: int) -> list[Any]:
        return self.set(name, struct.pack("<i", value), INT32)

    def read(self, name: str, index: int = -1) -> list[Any]:
        return self.tell(mavlink.MAVLink_param_request_read_message(*SERVER, name.encode(), index))

    def request_list(self) -> list[Any]:
        return self.tell(mavlink.MAVLink_param_request_list_message(*SERVER))

    def run(self, seconds: float, period_us: int = 4_000) -> list[tuple[int, Any]]:
        """(time us, message) of what the server sends by itself."""
        sent = []
        for _ in range(round(seconds * 1e6 / period_us)):
            sent += [(self.now_us, wire(message)) for message in self.server.step(self.now_us)]
            self.now_us += period_us
        return sent


def number(message: Any) -> float:
    value = decode_value(message.get_payload()[:4].ljust(4, b"\0"), message.param_type)
    assert value is not None
    return value


def kinds(messages: list[Any]) -> list[str]:
    return [message.get_type() for message in messages]


# --- bytes


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_go_through_byte_by_byte(value: int) -> None:
    data = encode_value(value, INT32)
    assert data == struct.pack("<i", value)
    assert decode_value(data, INT32) == value


@given(st.binary(min_size=4, max_size=4), st.integers(0, 255))
def test_any_bytes_are_a_value_or_of_no_type(data: bytes, param_type: int) -> None:
    value = decode_value(data, param_type)
    assert (value is None) == (param_type not in {1, 2, 3, 4, 5, 6, 9})
    if value is not None and not isnan(value):
        back = encode_value(value, param_type)
        assert back is not None
        assert decode_value(back, param_type) == value


@given(st.one_of(st.floats(), st.integers()), st.integers(0, 255))
def test_what_does_not_fit_is_not_encoded(value: float, param_type: int) -> None:
    data = encode_value(value, param_type)
    if data is not None and param_type != REAL32:
        assert decode_value(data, param_type) == value


@pytest.mark.parametrize("value", [1.5, nan, inf, 2**31, -(2**31) - 1, 2**400])
def test_no_integer(value: float) -> None:
    assert encode_value(value, INT32) is None


@given(st.integers(-(2**31), 2**31 - 1))
def test_every_integer_survives_both_ways(value: int) -> None:
    carry(value)


@pytest.mark.parametrize("value", SIGNALLING)
def test_signalling_nans_survive_both_ways(value: int) -> None:
    assert struct.pack("<f", 1.0) != struct.pack("<i", value)
    carry(value)


def carry(value: int) -> None:
    """Set by a client, echoed, and read again: the same four bytes on the wire each time."""
    table = FreeTable()
    link = LossyLink(ParameterServer(table), ParameterClient(SERVER))
    client = link.client
    assert isinstance(client, ParameterClient)
    request = client.set("A_INT", value)
    link.run(lambda: request.outcome != "open", 5.0)
    assert (request.outcome, table.values["A_INT"], client.values["A_INT"]) == ("done", value, value)
    assert isinstance(table.values["A_INT"], int)


@pytest.mark.parametrize("crc", [0, 1, 0xFFFFFFFF, 0x7F800001, 0xFFBFFFFF])
def test_every_hash_survives(crc: int) -> None:
    table = FreeTable()
    table.crc = crc
    (answer,) = Asker(table).read(HASH_CHECK)
    assert (answer.param_id, answer.param_type, answer.param_index, answer.param_count) == (
        HASH_CHECK,
        UINT32,
        65535,
        2,
    )
    assert number(answer) == crc


# --- reading


def test_read_by_name_and_by_index() -> None:
    asker = Asker()
    index = asker.table.index("COM_OBL_RC_ACT")
    assert index is not None
    for answers in (asker.read("COM_OBL_RC_ACT"), asker.read("ignored", index)):
        (answer,) = answers
        assert answer.get_type() == VALUE
        assert (answer.param_id, answer.param_index, answer.param_count) == ("COM_OBL_RC_ACT", index, len(TABLE))
        assert (answer.param_type, number(answer)) == (INT32, 0)


def test_a_name_of_sixteen_characters_has_no_terminator() -> None:
    assert len("MPC_XY_VEL_P_ACC") == 16
    (answer,) = Asker().read("MPC_XY_VEL_P_ACC")
    assert answer.param_id == "MPC_XY_VEL_P_ACC"


@pytest.mark.parametrize(
    ("name", "index"), [("MC_ROL_P", -1), ("", -1), ("", len(TABLE)), ("MC_ROLL_P", 32767), ("mc_roll_p", -1)]
)
def test_reading_what_is_not_there(name: str, index: int) -> None:
    (answer,) = Asker().read(name, index)
    assert answer.get_type() == ERROR
    assert (answer.target_system, answer.target_component) == CLIENT
    assert (answer.param_id, answer.param_index) == (name, index)
    assert answer.error == mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST


# --- setting


def test_set_is_echoed_with_what_is_stored() -> None:
    asker = Asker()
    (answer,) = asker.set_real("MC_ROLL_P", 7.1)
    assert (answer.param_id, answer.param_type) == ("MC_ROLL_P", REAL32)
    assert answer.param_index == asker.table.index("MC_ROLL_P")
    assert number(answer) == asker.table["MC_ROLL_P"] == struct.unpack("<f", struct.pack("<f", 7.1))[0]
    (answer,) = asker.set_int("GF_ACTION", 3)
    assert (number(answer), asker.table["GF_ACTION"]) == (3, 3)
    assert asker.run(1.0) == []
    assert asker.texts == []


@pytest.mark.parametrize("value", [nan, inf, -inf, 3e38, -3e38, 31.0, -1e-3])
def test_a_value_that_is_not_allowed_is_refused(value: float) -> None:
    asker = Asker()
    echo, error = asker.set_real("MC_ROLL_P", value)
    assert (echo.get_type(), number(echo), asker.table["MC_ROLL_P"]) == (VALUE, 6.5, 6.5)
    assert (error.get_type(), error.param_id, error.param_index) == (ERROR, "MC_ROLL_P", -1)
    assert error.error == mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    (text,) = asker.texts
    assert text.startswith("MC_ROLL_P: ")
    assert text.endswith("not allowed; allowed: 0 to 30 1/s")


@pytest.mark.parametrize("value", [6, -1, 2**31 - 1, -(2**31)])
def test_an_integer_that_is_not_allowed_is_refused(value: int) -> None:
    asker = Asker()
    echo, error = asker.set_int("GF_ACTION", value)
    assert (number(echo), error.error) == (2, mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE)
    assert asker.table["GF_ACTION"] == 2


@pytest.mark.parametrize(
    ("name", "param_type", "code"),
    [("MC_ROLL_P", INT32, 7), ("GF_ACTION", REAL32, 7), ("GF_ACTION", UINT32, 6), ("MC_ROLL_P", 10, 6),
     ("MC_ROLL_P", 0, 6), ("MC_ROLL_P", 255, 6)],
)  # fmt: skip
def test_another_type_is_refused(name: str, param_type: int, code: int) -> None:
    asker = Asker()
    old = asker.table[name]
    echo, error = asker.set(name, struct.pack("<i", 3), param_type)
    assert (number(echo), asker.table[name], error.error) == (old, old, code)


def test_refusals_of_names() -> None:
    asker = Asker()
    (error,) = asker.set_real("MC_ROL_P", 1.0)
    assert (error.get_type(), error.error) == (ERROR, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)
    echo, error = asker.set_int("COM_FLIGHT_UUID", 4)
    assert (number(echo), error.error) == (0, mavlink.MAV_PARAM_ERROR_READ_ONLY)


def test_texts_are_not_a_flood() -> None:
    asker = Asker()
    for _ in range(50):
        asker.set_real("MC_ROLL_P", nan)
        asker.now_us += 50_000
    assert len(asker.texts) == 3


def test_a_change_is_told_on_every_link() -> None:
    asker = Asker()
    other = ParameterServer(asker.table)
    asker.set_real("MC_ROLL_P", 7.0)
    asker.set_real("MC_ROLL_P", 8.0)
    asker.set_real("MC_PITCH_P", nan)
    (told,) = other.step(0)
    assert (told.get_type(), told.param_id, told.param_value) == (VALUE, "MC_ROLL_P", 8.0)
    assert list(other.step(1_000_000)) == []
    assert asker.run(1.0) == []  # here it was answered
    asker.table.set("MC_YAW_P", 1.0)  # by nobody on a link
    assert [message.param_id for _, message in asker.run(1.0)] == ["MC_YAW_P"]
    assert [message.param_id for message in other.step(2_000_000)] == ["MC_YAW_P"]


def test_a_flood_of_reads_is_answered_in_part() -> None:
    asker = Asker()
    answers = sum(len(asker.read("MC_ROLL_P")) for _ in range(1000))
    assert answers == 200
    assert asker.server.dropped == 800
    asker.now_us += 100_000
    assert sum(len(asker.read("MC_ROLL_P")) for _ in range(1000)) == 100


# --- the list


@pytest.mark.parametrize("period_us", [1_000, 4_000, 20_000])
def test_the_list_is_paced_and_whole(period_us: int) -> None:
    asker = Asker()
    asker.run(1.0, period_us)
    assert asker.request_list() == []
    sent = asker.run(2.0, period_us)
    first, *rest = [message for _, message in sent]
    assert (first.param_id, first.param_type, first.param_index) == (HASH_CHECK, UINT32, 65535)
    assert number(first) == asker.table.hash()
    assert [message.param_id for message in rest] == sorted(TABLE)
    assert [message.param_index for message in rest] == list(range(len(TABLE)))
    assert {message.param_count for message in rest} == {len(TABLE)}
    assert {message.param_id: number(message) for message in rest} == pytest.approx(Parameters().as_dict(), rel=1e-6)
    begin_us, end_us = sent[0][0], sent[-1][0]
    assert (len(sent) - 1) / (end_us - begin_us + period_us) * 1e6 <= 400.0
    assert end_us - begin_us == pytest.approx((len(sent) - 1) * 2_500, abs=2 * period_us)


def test_a_step_that_comes_late_sends_no_flood() -> None:
    asker = Asker()
    asker.request_list()
    asker.server.step(0)
    assert len(asker.server.step(10_000_000)) == 21


def test_a_repeated_request_goes_once_round_from_where_it_is_without_the_hash() -> None:
    asker = Asker()
    asker.request_list()
    before = len(asker.run(0.1)) - 1
    asker.request_list()
    names = [message.param_id for _, message in asker.run(2.0)]
    table = sorted(TABLE)
    assert names == table[before:] + table[:before]
    asker.request_list()
    assert next(message.param_id for _, message in asker.run(1.0)) == HASH_CHECK


def test_a_storm_of_requests_is_one_list_and_a_steady_one_gets_to_its_end() -> None:
    asker = Asker()
    for _ in range(100):
        asker.request_list()
    assert len(asker.run(10.0)) == len(TABLE)  # the second request took the hash away
    heard: set[str] = set()
    for _ in range(20):
        asker.request_list()
        heard.update(message.param_id for _, message in asker.run(0.1))
    assert heard >= set(TABLE)


def test_a_ground_station_with_a_cache_stops_the_list() -> None:
    asker = Asker()
    asker.request_list()
    asker.run(0.1)
    before = dict(asker.table.as_dict()) if isinstance(asker.table, Parameters) else {}
    assert asker.set(HASH_CHECK, struct.pack("<I", 5), UINT32) == []
    assert asker.run(1.0) == []
    assert isinstance(asker.table, Parameters)
    assert asker.table.as_dict() == before


def test_changes_go_before_the_list() -> None:
    asker = Asker()
    asker.request_list()
    asker.run(0.05)
    asker.table.set("MPC_Z_P", 0.5)
    assert asker.run(0.05)[0][1].param_id == "MPC_Z_P"


hostile = st.one_of(
    st.builds(
        lambda name, data, kind: mavlink.MAVLink_param_set_message(
            *SERVER, name, struct.unpack("<f", data)[0], kind
        ),
        st.one_of(st.binary(max_size=16), st.sampled_from([name.encode() for name in (*TABLE, HASH_CHECK)])),
        st.binary(min_size=4, max_size=4), st.integers(0, 255),
    ),
    st.builds(
        lambda name, index: mavlink.MAVLink_param_request_read_message(*SERVER, name, index),
        st.binary(max_size=16), st.integers(-32768, 32767),
    ),
    st.just(mavlink.MAVLink_param_request_list_message(*SERVER)),
    st.just(mavlink.MAVLink_statustext_message(6, b"")),
)  # fmt: skip


@given(st.lists(hostile, max_size=20))
def test_hostile_messages_leave_a_sound_table(messages: list[Any]) -> None:
    asker = Asker()
    for message in messages:
        for answer in asker.tell(message):
            assert answer.get_type() in (VALUE, ERROR)
        asker.run(0.01)
    assert isinstance(asker.table, Parameters)
    assert [name for name, value in asker.table.as_dict().items() if TABLE[name].problem(value)] == []
    assert len(asker.server._changed) <= len(TABLE)


@given(
    st.lists(
        st.builds(
            lambda name, data, kind, count, index: mavlink.MAVLink_param_value_message(
                name, struct.unpack("<f", data)[0], kind, count, index
            ),
            st.binary(max_size=16), st.binary(min_size=4, max_size=4), st.integers(0, 255),
            st.integers(0, 65535), st.integers(0, 65535),
        ),
        max_size=10,
    )
)  # fmt: skip
def test_a_client_bears_a_hostile_vehicle(messages: list[Any]) -> None:
    client = ParameterClient(SERVER)
    client.request_list()
    request = client.set("MC_ROLL_P", 1.0)
    now_us = 0
    for message in messages:
        client.receive(wire(message), SERVER, now_us)
    for now_us in range(0, 20_000_000, 100_000):
        assert len(client.step(now_us)) <= ParameterClient.CHUNK + 1
    assert client.list_state != "running"
    assert request.outcome != "open"


# --- server and client


def link_of(loss: float, seed: int = 1) -> tuple[LossyLink, Parameters, ParameterClient]:
    table, client = Parameters(), ParameterClient(SERVER)
    return LossyLink(ParameterServer(table), client, loss=loss, seed=seed), table, client


@pytest.mark.parametrize(("loss", "seed", "limit_s"), [(0.0, 1, 0.1), (0.2, 1, 3.0), (0.2, 2, 3.0), (0.4, 3, 15.0)])
def test_the_list_arrives_whole(loss: float, seed: int, limit_s: float) -> None:
    link, table, client = link_of(loss, seed)
    client.request_list()
    link.run(lambda: not client.busy, limit_s + len(TABLE) / 400)
    assert client.list_state == "complete"
    assert client.count == len(TABLE)
    assert {name: encode_value(value, client.types[name]) for name, value in client.values.items()} == {
        name: encode_value(value, INT32 if TABLE[name].is_integer else REAL32)
        for name, value in table.as_dict().items()
    }
    if loss == 0.0:
        assert client.hash == table.hash()
        assert sum(who == "client" for who, _ in link.sent) == 1
    else:
        assert link.lost > 10


@pytest.mark.parametrize(("loss", "seed"), [(0.0, 1), (0.2, 1), (0.2, 2)])
def test_sets_are_verified(loss: float, seed: int) -> None:
    link, table, client = link_of(loss, seed)
    wanted: dict[str, float] = {"MC_ROLL_P": 7.3, "GF_ACTION": 5, "NAV_RCL_ACT": 3, "MPC_XY_P": 1.1, "MIS_YAW_ERR": 3.0}
    requests = [client.set(name, value) for name, value in wanted.items()]
    refused = [client.set("GF_ACTION", 9), client.set("MC_YAW_P", nan), client.set("NO_SUCH", 1.0)]
    mismatch = client.set("GF_ACTION", 1.5)
    read = client.read("MC_ROLL_P")
    link.run(lambda: not client.busy, 30.0)
    assert [request.outcome for request in requests] == ["done"] * len(wanted)
    assert {name: table[name] for name in wanted} == pytest.approx(wanted, rel=1e-6)
    assert [request.outcome for request in refused] == ["refused"] * 3
    assert [request.error for request in refused] == [
        mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE,
        mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE,
        mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST,
    ]
    assert (mismatch.outcome, mismatch.value) == ("refused", 5)
    assert (read.outcome, read.value) == ("done", table["MC_ROLL_P"])


def test_reading_the_hash() -> None:
    link, table, client = link_of(0.2, 4)
    request = client.read(HASH_CHECK)
    link.run(lambda: not client.busy, 10.0)
    assert (request.outcome, client.hash) == ("done", table.hash())


def test_a_client_gives_up() -> None:
    client = ParameterClient(SERVER, timeout_us=100_000, tries=3)
    client.request_list()
    request = client.read("MC_ROLL_P")
    sent = [len(client.step(now_us)) for now_us in range(0, 1_000_000, 50_000)]
    assert sum(sent) == 6
    assert (client.list_state, request.outcome, client.busy) == ("failed", "silent", False)


def test_a_vehicle_without_param_error_refuses_by_its_old_value() -> None:
    client = ParameterClient(SERVER, timeout_us=100_000, tries=3)
    old = wire(mavlink.MAVLink_param_value_message(b"MC_ROLL_P", 6.5, REAL32, 1, 0))
    request = client.set("MC_ROLL_P", 99.0)
    for now_us in range(0, 1_000_000, 50_000):
        for _ in client.step(now_us):
            client.receive(old, SERVER, now_us)
    assert (request.outcome, request.value, request.error) == ("refused", 6.5, None)


def test_others_are_not_listened_to() -> None:
    client = ParameterClient(SERVER)
    request = client.read("MC_ROLL_P")
    client.step(0)
    answer = wire(mavlink.MAVLink_param_value_message(b"MC_ROLL_P", 6.5, REAL32, 1, 0))
    client.receive(answer, (2, 1), 0)
    assert request.outcome == "open"
    client.receive(answer, SERVER, 0)
    assert (request.outcome, request.value) == ("done", 6.5)


@pytest.mark.parametrize("name", ["", "A" * 17, "GRÖSSE"])
def test_names_that_do_not_fit(name: str) -> None:
    with pytest.raises(ValueError, match="1 to 16 ASCII characters"):
        ParameterClient(SERVER).read(name)


# --- pymavlink's own client


class Mav:
    """What pymavlink's `MAVParmDict` uses of a mavutil connection; answers are there at once."""

    def __init__(self) -> None:
        self.asker = Asker()
        self.inbox: list[Any] = []

    def param_set_send(self, name: str, value: float, parm_type: int | None = None) -> None:
        kind = REAL32 if parm_type is None else parm_type
        message = mavlink.MAVLink_param_set_message(*SERVER, name.encode(), value, kind)
        self.inbox += self.asker.tell(message)

    def recv_match(self, **_: Any) -> Any:
        return next((message for message in iter(self._pop, None) if message.get_type() == VALUE), None)

    def _pop(self) -> Any:
        return self.inbox.pop(0) if self.inbox else None


def test_pymavlink_s_mavparm() -> None:
    mavparm = pytest.importorskip("pymavlink.mavparm")
    mav, values = Mav(), mavparm.MAVParmDict()
    assert values.mavset(mav, "mc_roll_p", 7.25)
    assert values.mavset(mav, "GF_ACTION", 5, parm_type=INT32)
    assert values.mavset(mav, "NAV_MC_ALT_RAD", "0.5", parm_type=REAL32)
    table = mav.asker.table
    assert (table["MC_ROLL_P"], table["GF_ACTION"], table["NAV_MC_ALT_RAD"]) == (7.25, 5, 0.5)
    # Without a type it sends a float: the integer parameter keeps its value, and answers all the same.
    assert values.mavset(mav, "GF_ACTION", 1)
    assert table["GF_ACTION"] == 5
