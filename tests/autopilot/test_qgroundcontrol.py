"""QGroundControl's side of the wire: what it asks of a PX4 vehicle when it connects, and its guided actions.

A model written from its behaviour (5.x, PX4 plug-in): its order, time-outs and numbers of tries. With nothing lost no
step may end by a time-out; what the vehicle refuses it has to refuse at once.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from math import nan
from random import Random
from typing import Any

import pytest
from mavsitl_vehicle.autopilot import metadata

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, Client

STATION = (255, 190)
AT_ONCE_S = 0.25
"""No answer takes longer when nothing is lost: PlanManager asks again after that, everything else much later."""
COMMAND_S, COMMAND_TRIES = 1.2, 3
HASH_S = 1.0
LIST_S, LIST_TRIES = 5.0, 5
IDLE_S = 3.0
"""Parameters that have not come when the list has been silent for so long are asked for one by one."""
BATCH = 10
PLAN_S, ITEM_S, PLAN_TRIES = 1.5, 0.25, 5
FTP_S, FTP_TRIES = 1.0, 3
WHOLE_S = 3.0
"""All of it with nothing lost: a HEARTBEAT that is up to 1 s away, and the parameters, which are paced."""
MODE_S, ARM_S = 1.3, 1.5
"""Within that the HEARTBEAT has to show what was asked for."""
MOST_MESSAGES_HZ = 150.0
LINK_SETTINGS = ("BURST", "BW", "CORR", "DIR", "DOWN", "DUP", "GOOD", "JIT", "LAT", "LOSS", "REORD")
VOLATILE = (
    "COM_FLIGHT_UUID", "SIM_CPU_STALL", "SIM_CLK_JUMP", "SIM_GUST_TRIG", "SIM_FAIL_GYRO", "SIM_FAIL_ACC",
    "SIM_FAIL_MAG", "SIM_FAIL_BARO", "SIM_FAIL_GPS", "SIM_FAIL_BAT", "SIM_FAIL_RC", "SIM_FAIL_LINK1", "SIM_FAIL_LINK2",
    *(f"SIM_FAIL_MOT{motor}" for motor in range(1, 5)), *(f"SIM_MOT{motor}_EFF" for motor in range(1, 5)),
    *(f"SIM_{link}_{name}" for link in ("LINK", "GLINK") for name in LINK_SETTINGS),
)  # fmt: skip
"""In the list and not in the hash."""

LOITER, TAKEOFF, RTL, LAND = 3, 2, 5, 6

COMPONENT_METADATA, COMPONENT_INFORMATION, GIMBAL_MANAGER_INFORMATION = 397, 395, 280


class Lost(AssertionError):
    """Every try went unanswered."""


class Station(Client):
    """QGroundControl at the ground-station port; both ways lose a share `loss` of the datagrams."""

    def __init__(self, loss: float = 0.0, seed: int = 1) -> None:
        self._loss = loss
        self._draw = Random(seed)
        self._read = 0
        self._next_beat_us = 0
        self.slowest_s = 0.0
        """The longest that any answer took."""
        self.tries = 0
        """Questions asked again."""
        self._number = 0
        self._ftp_sequence = 0
        super().__init__()

    # --- the wire

    def tell(self, message: Any) -> None:
        datagram = encode(message, self._number & 0xFF, *STATION)
        self._number += 1
        if self._draw.random() >= self._loss:
            self.vehicle.receive(GCS, datagram)

    def _collect(self) -> None:
        for datagram in self.vehicle.datagrams(GCS, combine=False):
            if self._draw.random() >= self._loss:
                (frame,) = parse(datagram)
                self.inbox.append((self.now_us, GCS, frame.message))
        self.vehicle.datagrams(0, combine=False)

    def beat(self) -> None:
        if self.now_us >= self._next_beat_us:
            self._next_beat_us = self.now_us + 1_000_000
            gcs, invalid = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
            self.tell(mavlink.MAVLink_heartbeat_message(gcs, invalid, 192, 0, mavlink.MAV_STATE_ACTIVE, 3))

    def news(self) -> Iterator[Any]:
        """Messages not looked at yet."""
        while self._read < len(self.inbox):
            self._read += 1
            yield self.inbox[self._read - 1][2]

    def hear(self, wanted: Callable[[Any], bool], limit_s: float) -> Any | None:
        """The next message that is wanted, None after `limit_s`."""
        begin_us = self.now_us
        while True:
            self._collect()
            for message in self.news():
                if wanted(message):
                    self.slowest_s = max(self.slowest_s, (self.now_us - begin_us) / 1e6)
                    return message
            if self.now_us - begin_us >= limit_s * 1e6:
                return None
            self.beat()
            self.tick()

    def ask(self, message: Any, wanted: Callable[[Any], bool], limit_s: float, tries: int) -> Any:
        for attempt in range(tries):
            self.tries += attempt > 0
            self.tell(message)
            answer = self.hear(wanted, limit_s)
            if answer is not None:
                return answer
        raise Lost(f"{message.get_type()} was not answered in {tries} tries")

    # --- commands

    def long(self, command: int, *params: float, tries: int = 1) -> int:
        """The result of a COMMAND_LONG; unused parameters are 0."""
        filled = (*params, *([0.0] * (7 - len(params))))
        message = mavlink.MAVLink_command_long_message(1, 1, command, 0, *filled)
        return int(self.ask(message, _ack_of(command), COMMAND_S, tries).result)

    def request(self, message_id: int, index: int = 0, *, tries: int = COMMAND_TRIES) -> Any | None:
        """REQUEST_MESSAGE: the message, in whichever order it comes with the acknowledgement; None where refused."""
        command = mavlink.MAV_CMD_REQUEST_MESSAGE
        question = mavlink.MAVLink_command_long_message(1, 1, command, 0, message_id, index, 0, 0, 0, 0, 0)

        def either(m: Any) -> bool:
            return _ack_of(command)(m) or type(m).id == message_id

        for attempt in range(tries):
            self.tries += attempt > 0
            self.tell(question)
            found: Any | None = None
            acknowledged = False
            while found is None or not acknowledged:
                message = self.hear(either, COMMAND_S)
                if message is None:
                    break
                if type(message).id == message_id:
                    found = message if not index or message.mode_index == index else found
                elif message.result != mavlink.MAV_RESULT_ACCEPTED:
                    return None
                else:
                    acknowledged = True
            if found is not None:
                return found
        raise Lost(f"REQUEST_MESSAGE of {message_id} was not answered in {tries} tries")

    # --- the steps of the connection

    def standard_modes(self, tries: int) -> list[Any]:
        modes: list[Any] = []
        while not modes or modes[-1].mode_index < modes[-1].number_modes:
            mode = self.request(mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, len(modes) + 1, tries=tries)
            assert mode is not None
            assert mode.mode_index == len(modes) + 1
            modes.append(mode)
        return modes

    def component_information(self, tries: int) -> bytes | None:
        """The general metadata file by MAVLink FTP; None where both messages are refused."""
        for message_id in (COMPONENT_METADATA, COMPONENT_INFORMATION):
            message = self.request(message_id, tries=tries)
            if message is not None:
                uri = message.uri if message_id == COMPONENT_METADATA else message.general_metadata_uri
                assert uri.startswith("mftp://")
                return self.download(uri.removeprefix("mftp://").encode())
        return None

    def download(self, path: bytes) -> bytes:
        """A file by MAVLink FTP: reset, open, read piece by piece, terminate."""
        self._ftp(2)
        opened = self._ftp(4, data=path)
        session, size = opened[2], int.from_bytes(opened[12:16], "little")
        content = b""
        while len(content) < size:
            answer = self._ftp(5, session=session, offset=len(content), size=239)
            assert answer[3] == 128, "NAK"
            content += answer[12 : 12 + answer[4]]
        self._ftp(1, session=session)
        return content

    def _ftp(self, opcode: int, *, session: int = 0, offset: int = 0, size: int = 0, data: bytes = b"") -> bytes:
        self._ftp_sequence = (self._ftp_sequence + 2) & 0xFFFF
        head = self._ftp_sequence.to_bytes(2, "little")
        head += bytes((session, opcode, len(data) or size, 0, 0, 0)) + offset.to_bytes(4, "little")
        expected = (self._ftp_sequence + 1) & 0xFFFF

        def answers(m: Any) -> bool:
            if m.get_type() != "FILE_TRANSFER_PROTOCOL":
                return False
            return int.from_bytes(bytes(m.payload[:2]), "little") == expected

        payload = list((head + data).ljust(251, b"\0"))
        question = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, payload)
        return bytes(self.ask(question, answers, FTP_S, FTP_TRIES).payload)

    def parameters(self, tries: int) -> tuple[int | None, dict[str, Any]]:
        """The hash asked for by name first, then the list, then what is missing in it. (hash, values by name)."""
        read = mavlink.MAVLink_param_request_read_message(1, 1, b"_HASH_CHECK", -1)
        checked = self.ask(read, lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == "_HASH_CHECK", HASH_S, tries)
        found: dict[int, Any] = {}

        def take(limit_s: float) -> bool:
            value = self.hear(lambda m: m.get_type() == "PARAM_VALUE" and m.param_index < m.param_count, limit_s)
            if value is not None:
                found[value.param_index] = value
            return value is not None

        for attempt in range(LIST_TRIES):
            self.tries += attempt > 0
            self.tell(mavlink.MAVLink_param_request_list_message(1, 1))
            if take(LIST_S):
                break
        else:
            raise Lost("the list of parameters did not begin")
        count = next(iter(found.values())).param_count
        while len(found) < count and take(IDLE_S):
            pass
        rounds = 0
        while missing := [index for index in range(count) if index not in found]:
            rounds += 1
            assert rounds < 100, f"{len(missing)} parameters never came"
            self.tries += 1
            for index in missing[:BATCH]:
                self.tell(mavlink.MAVLink_param_request_read_message(1, 1, b"", index))
            while take(AT_ONCE_S):
                pass
        return _bits(checked), {value.param_id: value for value in found.values()}

    def plan(self, mission_type: int) -> list[Any]:
        """Download of one of the three lists."""
        listing = mavlink.MAVLink_mission_request_list_message(1, 1, mission_type)
        count = self.ask(listing, _of_type("MISSION_COUNT", mission_type), PLAN_S, 2 * PLAN_TRIES).count
        items: list[Any] = []
        while len(items) < count:
            wanted = len(items)
            question = mavlink.MAVLink_mission_request_int_message(1, 1, wanted, mission_type)
            items.append(self.ask(question, _of_type("MISSION_ITEM_INT", mission_type, wanted), ITEM_S, 2 * PLAN_TRIES))
        self.tell(mavlink.MAVLink_mission_ack_message(1, 1, mavlink.MAV_MISSION_ACCEPTED, mission_type))
        return items

    def upload(self, mission_type: int, items: list[Any]) -> int:
        """Upload of one of the three lists; the acknowledgement's type."""
        kinds = ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK")

        def answers(m: Any) -> bool:
            return m.get_type() in kinds and m.mission_type == mission_type

        answer = self.ask(
            mavlink.MAVLink_mission_count_message(1, 1, len(items), mission_type), answers, PLAN_S, PLAN_TRIES
        )
        while answer.get_type() != "MISSION_ACK":
            answer = self.ask(items[answer.seq], answers, PLAN_S, PLAN_TRIES)
        return int(answer.type)

    def connect(self, tries: int = COMMAND_TRIES) -> dict[str, Any]:
        """InitialConnectStateMachine, from the first HEARTBEAT to the last rally point; what it learned."""
        heard = self.hear(lambda m: m.get_type() == "HEARTBEAT", IDLE_S)
        assert heard is not None
        self.slowest_s = 0.0
        learned: dict[str, Any] = {"heartbeat": heard}
        learned["version"] = self.request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, tries=tries)
        learned["modes"] = self.standard_modes(tries)
        learned["metadata"] = self.component_information(tries)
        learned["hash"], learned["parameters"] = self.parameters(tries)
        self.tell(mavlink.MAVLink_system_time_message(1_790_000_000_000_000, 0))
        learned["gimbal"] = self.request(GIMBAL_MANAGER_INFORMATION, tries=tries)
        learned["plans"] = [self.plan(mission_type) for mission_type in range(3)]
        return learned

    # --- guided actions

    def shows_armed(self) -> bool:
        return bool(self.last("HEARTBEAT").base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def shows_auto(self, sub_mode: int) -> bool:
        return bool(self.last("HEARTBEAT").custom_mode == 4 << 16 | sub_mode << 24)

    def set_mode(self, sub_mode: int) -> None:
        """The message SET_MODE, which has no acknowledgement; the HEARTBEAT has to follow."""
        base = self.last("HEARTBEAT").base_mode | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self.tell(mavlink.MAVLink_set_mode_message(1, base, 4 << 16 | sub_mode << 24))
        self.run_until(lambda: self.shows_auto(sub_mode), MODE_S, self.beat)

    def fly(self, seconds: float) -> None:
        self.run(seconds, self.beat)

    @property
    def altitude_amsl_m(self) -> float:
        return float(self.last("GLOBAL_POSITION_INT").alt * 1e-3)

    @property
    def height_m(self) -> float:
        return float(self.last("GLOBAL_POSITION_INT").relative_alt * 1e-3)

    def take_off(self, height_m: float) -> None:
        """AMSL, while disarmed; when that is accepted it arms, once."""
        target = self.altitude_amsl_m + height_m
        assert self.long(mavlink.MAV_CMD_NAV_TAKEOFF, -1, 0, 0, nan, nan, nan, target) == 0
        assert not self.shows_armed()
        assert self.long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0
        self.run_until(self.shows_armed, ARM_S, self.beat)
        self.run_until(lambda: self.height_m > 0.95 * height_m, 20.0, self.beat)
        self.run_until(lambda: self.shows_auto(LOITER), 5.0, self.beat)


def _ack_of(command: int) -> Callable[[Any], bool]:
    def is_it(m: Any) -> bool:
        return bool(m.get_type() == "COMMAND_ACK" and m.command == command)

    return is_it


def _of_type(name: str, mission_type: int, sequence: int | None = None) -> Callable[[Any], bool]:
    def is_it(m: Any) -> bool:
        return m.get_type() == name and m.mission_type == mission_type and sequence in (None, getattr(m, "seq", None))

    return is_it


def _bits(value: Any) -> int:
    """The number that a PARAM_VALUE carries byte by byte."""
    return int.from_bytes(struct.pack("<f", value.param_value), "little")


def _item(sequence: int, command: int, mission_type: int, *, frame: int, params: tuple[float, ...], at: Any) -> Any:
    return mavlink.MAVLink_mission_item_int_message(
        1, 1, sequence, frame, command, int(sequence == 0), 1, *params, *at, mission_type
    )


def _plans(station: Station) -> list[list[Any]]:
    """A take-off and two waypoints; an inclusion polygon; two rally points. Frames as QGroundControl's."""
    here = station.last("GLOBAL_POSITION_INT")

    def at(north: int, east: int, height_m: float) -> tuple[int, int, float]:
        return here.lat + north, here.lon + east, height_m

    relative = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
    still = (0.0, 0.0, 0.0, 0.0)
    mission = [
        _item(0, mavlink.MAV_CMD_NAV_TAKEOFF, 0, frame=relative, params=still, at=at(0, 0, 10.0)),
        _item(1, mavlink.MAV_CMD_NAV_WAYPOINT, 0, frame=relative, params=still, at=at(1000, 0, 10.0)),
        _item(2, mavlink.MAV_CMD_NAV_WAYPOINT, 0, frame=relative, params=still, at=at(1000, 1000, 12.0)),
    ]
    corners = ((-20_000, -20_000), (20_000, -20_000), (20_000, 20_000), (-20_000, 20_000))
    inclusion = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
    fence = [
        _item(i, inclusion, 1, frame=mavlink.MAV_FRAME_GLOBAL, params=(4.0, 0.0, 0.0, 0.0), at=at(*corner, 0.0))
        for i, corner in enumerate(corners)
    ]
    rally = [
        _item(i, mavlink.MAV_CMD_NAV_RALLY_POINT, 2, frame=relative, params=still, at=at(500 * i, -500, 15.0))
        for i in range(2)
    ]
    return [mission, fence, rally]


def _places(items: list[Any]) -> list[tuple[int, int, int, float]]:
    return [(item.command, item.x, item.y, item.z) for item in items]


def _with_plans(loss: float, seed: int) -> tuple[Station, list[list[Any]]]:
    station = Station(loss, seed)
    station.hear(lambda m: m.get_type() == "GLOBAL_POSITION_INT", 5.0)
    plans = _plans(station)
    for mission_type, items in enumerate(plans):
        assert station.upload(mission_type, items) == mavlink.MAV_MISSION_ACCEPTED
    return station, plans


def _check(station: Station, learned: dict[str, Any], plans: list[list[Any]]) -> None:
    heartbeat, version = learned["heartbeat"], learned["version"]
    assert (heartbeat.autopilot, heartbeat.type) == (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_TYPE_QUADROTOR)
    for bit in ("MISSION_INT", "COMMAND_INT", "MISSION_FENCE", "MISSION_RALLY", "FTP"):
        assert version.capabilities & getattr(mavlink, f"MAV_PROTOCOL_CAPABILITY_{bit}")
    assert version.flight_sw_version >> 24 >= 1
    modes = learned["modes"]
    assert len({mode.custom_mode for mode in modes}) == modes[0].number_modes == len(modes)
    assert learned["gimbal"] is None
    parameters = learned["parameters"]
    assert len(parameters) == next(iter(parameters.values())).param_count
    for name in ("SYS_AUTOSTART", "CAL_ACC0_ID", "CAL_GYRO0_ID", "CAL_MAG0_ID", "COM_RC_IN_MODE"):
        assert _bits(parameters[name]), f"{name}: set-up would be called incomplete"
    assert [_places(plan) for plan in learned["plans"]] == [_places(plan) for plan in plans]


def test_the_connect_sequence_never_waits_for_a_time_out() -> None:
    station, plans = _with_plans(0.0, 1)
    begin_us = station.now_us
    learned = station.connect(tries=1)
    _check(station, learned, plans)
    assert station.tries == 0
    assert station.slowest_s <= AT_ONCE_S
    assert (station.now_us - begin_us) / 1e6 < WHOLE_S


@pytest.mark.parametrize("message_id", [COMPONENT_INFORMATION, GIMBAL_MANAGER_INFORMATION, 259, 9999])
def test_what_there_is_not_is_refused_at_once(message_id: int) -> None:
    station = Station()
    assert station.request(message_id, tries=1) is None
    assert station.slowest_s <= AT_ONCE_S


@pytest.mark.parametrize("seed", range(3))
def test_the_connect_sequence_gets_through_a_lossy_link(seed: int) -> None:
    """More tries of a command than QGroundControl's three, with which it goes on without the answer."""
    station, plans = _with_plans(0.2, seed)
    learned = station.connect(tries=10)
    _check(station, learned, plans)
    assert station.tries > 0


def test_the_hash_is_that_of_the_list() -> None:
    """A wrong one would show a stale cache: CRC-32 over names in order and the four raw bytes of each value."""
    station = Station()
    checked, values = station.parameters(1)
    steady = {name: _bits(value) for name, value in values.items() if name not in VOLATILE}
    assert len(steady) == len(values) - len(VOLATILE)
    assert checked == _crc32(b"".join(name.encode() + steady[name].to_bytes(4, "little") for name in sorted(steady)))


def _crc32(octets: bytes) -> int:
    """PX4's: the polynomial 0xEDB88320 without zlib's initial and final inversion, bit by bit."""
    crc = 0
    for octet in octets:
        crc ^= octet
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc


def test_the_metadata_is_there_with_the_checksums_that_are_announced() -> None:
    """COMPONENT_METADATA itself is refused as long as the dialect lacks it; by its usual name the file can be had."""
    station = Station()
    general = station.download(metadata.GENERAL_URI.removeprefix("mftp://").encode())
    (entry,) = json.loads(general)["metadataTypes"]
    for uri, crc in (("uri", "fileCrc"), ("uriFallback", "fileCrcFallback")):
        content = station.download(entry[uri].removeprefix("mftp://").encode())
        assert _crc32(content) == entry[crc]
    assert {row["name"] for row in json.loads(content)["parameters"]} == set(station.parameters(1)[1])
    message = station.request(COMPONENT_METADATA, tries=1)
    assert (message is None) is not hasattr(mavlink, "MAVLINK_MSG_ID_COMPONENT_METADATA")
    if message is not None:
        assert message.file_crc == _crc32(general)
    assert station.tries == 0
    assert station.slowest_s <= AT_ONCE_S


def test_the_link_carries_no_more_than_a_python_station_can_take() -> None:
    station = Station()
    station.fly(2.0)
    for phase in ("standing", "flying"):
        before = len(station.inbox)
        station.fly(10.0)
        assert (len(station.inbox) - before) / 10.0 <= MOST_MESSAGES_HZ, phase
        if phase == "standing":
            station.take_off(3.0)


def test_guided_actions() -> None:
    station = Station()
    station.fly(1.0)
    ground = station.altitude_amsl_m
    station.take_off(10.0)
    home = station.last("GLOBAL_POSITION_INT")
    # goto: COMMAND_INT in the frame MAV_FRAME_GLOBAL, although x and y are in 1e-7 degrees
    goto = mavlink.MAVLink_command_int_message(
        1, 1, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, nan,
        home.lat + 1000, home.lon + 500, station.altitude_amsl_m,
    )  # fmt: skip
    assert station.ask(goto, _ack_of(mavlink.MAV_CMD_DO_REPOSITION), COMMAND_S, 1).result == 0

    def there() -> bool:
        position = station.last("GLOBAL_POSITION_INT")
        return bool(abs(position.lat - home.lat - 1000) < 50 and abs(position.lon - home.lon - 500) < 50)

    station.run_until(there, 30.0, station.beat)
    assert station.shows_auto(LOITER)
    # change altitude
    assert station.long(mavlink.MAV_CMD_DO_REPOSITION, -1, 1, 0, nan, nan, nan, ground + 15.0) == 0
    station.run_until(lambda: abs(station.height_m - 15.0) < 0.5, 20.0, station.beat)
    assert there()
    # pause, on the way to somewhere
    far = mavlink.MAVLink_command_int_message(
        1, 1, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, nan,
        home.lat + 9000, home.lon + 500, ground + 15.0,
    )  # fmt: skip
    assert station.ask(far, _ack_of(mavlink.MAV_CMD_DO_REPOSITION), COMMAND_S, 1).result == 0
    station.fly(4.0)
    assert station.last("VFR_HUD").groundspeed > 1.0
    assert station.long(mavlink.MAV_CMD_DO_REPOSITION, -1, 1, 0, nan, nan, nan, nan) == 0
    station.run_until(lambda: station.last("VFR_HUD").groundspeed < 0.1, 10.0, station.beat)
    assert station.last("GLOBAL_POSITION_INT").lat < home.lat + 8000
    # return, and land from there
    station.set_mode(RTL)
    station.fly(3.0)
    station.set_mode(LAND)
    station.run_until(lambda: not station.shows_armed(), 60.0, station.beat)
    assert station.shows_auto(LOITER)
    assert station.last("EXTENDED_SYS_STATE").landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND


def test_emergency_stop() -> None:
    station = Station()
    station.fly(1.0)
    station.take_off(3.0)
    assert station.long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == 0
    station.run_until(lambda: not station.shows_armed(), ARM_S, station.beat)
    station.fly(2.0)
    assert station.height_m < 0.3
