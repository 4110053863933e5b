"""pymavlink's own clients, over UDP: mavutil flies, mavparm sets, mavwp moves plans; several of them at one link."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from mavsitl_vehicle.autopilot.parameters import TABLE

from mavsitl.clock import monotonic_us, unix_us
from mavsitl.link.udp import LOOPBACK
from mavsitl.signing import EPOCH_UNIX_US
from tests.interop.conftest import PATIENCE_S, Sitl, sitl

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

OFFBOARD_MAIN_MODE = 6
REQUEST_MESSAGE, ARM, SET_MODE = 512, 400, 176
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = range(4)

HOME = 47.397742, 8.545594

PLANS = {
    0: f"""QGC WPL 110
0	1	3	22	0	0	0	0	{HOME[0]}	{HOME[1]}	4	1
1	0	3	16	0	2	0	0	{HOME[0] + 1e-4}	{HOME[1]}	5	1
2	0	3	19	7	0	0	0	{HOME[0] + 1e-4}	{HOME[1] + 1e-4}	5.5	1
3	0	3	20	0	0	0	0	0	0	0	1
""",
    1: """QGC WPL 110
0	1	3	5001	3	0	0	0	47.399	8.544	0	1
1	0	3	5001	3	0	0	0	47.399	8.547	0	1
2	0	3	5001	3	0	0	0	47.396	8.547	0	1
3	0	3	5003	500	0	0	0	47.3977	8.5456	0	1
""",
    2: """QGC WPL 110
0	1	3	5100	0	0	0	0	47.398	8.546	12	1
1	0	3	5100	0	0	0	0	47.397	8.545	15	1
""",
}


@contextmanager
def connection(endpoint: str, system_id: int = 255, component_id: int = 0) -> Iterator[Any]:
    from pymavlink import mavutil

    made = mavutil.mavlink_connection(
        endpoint, dialect="development", source_system=system_id, source_component=component_id
    )
    try:
        yield made
    finally:
        made.close()


@contextmanager
def listener(vehicle: Sitl) -> Iterator[Any]:
    """Where the vehicle's off-board link sends."""
    with connection(f"udpin:{LOOPBACK}:{vehicle.offboard_port}") as client:
        heartbeat(client)
        yield client


@contextmanager
def caller(vehicle: Sitl, system_id: int, component_id: int = 0) -> Iterator[Any]:
    """From a port of its own to the one of the vehicle's off-board link; it has to speak first."""
    with connection(f"udpout:{LOOPBACK}:{vehicle.offboard_own}", system_id, component_id) as client:
        say_hello(client)
        heartbeat(client)
        yield client


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Sitl]:
    with sitl() as running:
        yield running


def say_hello(client: Any) -> None:
    from pymavlink import mavutil

    client.mav.heartbeat_send(mavutil.mavlink.MAV_TYPE_GCS, mavutil.mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)


def message(client: Any, name: str | list[str], **fields: Any) -> Any:
    """The next message of one name or of several, with these fields."""
    until_us = monotonic_us() + round(PATIENCE_S * 1e6)
    while monotonic_us() < until_us:
        found = client.recv_match(type=name, blocking=True, timeout=PATIENCE_S)
        if found is not None and all(getattr(found, field) == value for field, value in fields.items()):
            return found
    raise AssertionError(f"waited {PATIENCE_S:g} s for {name} {fields}")


def heartbeat(client: Any) -> Any:
    found = message(client, "HEARTBEAT", autopilot=12)
    client.target_system, client.target_component = found.get_srcSystem(), found.get_srcComponent()
    return found


def answer(client: Any, command: int, *params: float) -> int:
    """The MAV_RESULT of a COMMAND_LONG. What came before is forgotten: it may have filled the socket."""
    drain(client)
    client.mav.command_long_send(1, 1, command, 0, *params, *([0.0] * (7 - len(params))))
    own = {"target_system": client.mav.srcSystem, "target_component": client.mav.srcComponent}
    return int(message(client, "COMMAND_ACK", command=command, **own).result)


def drain(client: Any) -> None:
    """Forget what has arrived."""
    while client.recv_match(blocking=False) is not None:
        pass


def loses_nothing(client: Any) -> None:
    """From now on every frame comes, for a second."""
    drain(client)
    message(client, "ATTITUDE")  # behind the gap that was left while nobody read
    client.mav_loss = 0
    for name in ("HEARTBEAT", "ATTITUDE", "LOCAL_POSITION_NED", "HEARTBEAT"):
        message(client, name)
    assert client.mav_loss == 0


# --- mavutil ---------------------------------------------------------------------------------------------------------


def test_mavutil_sees_a_px4_and_flies_it_off_board() -> None:
    """From the clamp of a scenario of the paper's."""
    from pymavlink import mavutil

    link = mavutil.mavlink
    with sitl("hover-calm") as vehicle, connection(f"udpin:{LOOPBACK}:{vehicle.offboard_port}") as client:
        first = heartbeat(client)
        assert (first.type, first.autopilot) == (link.MAV_TYPE_QUADROTOR, link.MAV_AUTOPILOT_PX4)
        assert client.flightmode == "LOITER"

        assert answer(client, REQUEST_MESSAGE, link.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == ACCEPTED
        assert client.messages["AUTOPILOT_VERSION"].flight_sw_version >> 24 == 1
        assert answer(client, link.MAV_CMD_USER_1) == UNSUPPORTED

        assert answer(client, SET_MODE, 1, OFFBOARD_MAIN_MODE) == ACCEPTED
        assert answer(client, ARM, 1) == TEMPORARILY_REJECTED

        def stream(thrust: float) -> None:
            client.mav.set_attitude_target_send(0, 1, 1, 0b00000111, [1, 0, 0, 0], 0, 0, 0, thrust)

        stream(0.5)
        assert answer(client, ARM, 1) == ACCEPTED
        heights: list[float] = []
        while not heights or heights[-1] > -1.5:  # NED: the clamp is at -1, the vehicle rises
            stream(0.6)
            heights.append(message(client, "LOCAL_POSITION_NED").z)
            assert len(heights) < 500, "ten seconds of 0.6 thrust did not lift it half a metre"
        assert client.motors_armed()
        assert client.flightmode == "OFFBOARD"
        assert answer(client, ARM, 0) == DENIED
        assert answer(client, ARM, 0, 21196) == ACCEPTED


def test_mavutil_sets_every_mode_by_its_name(vehicle: Sitl) -> None:
    """`set_mode_px4` with a name. What is missing for a mode keeps from arming, not from choosing it."""
    with listener(vehicle) as client:
        for name, result in (
            ("OFFBOARD", ACCEPTED), ("POSCTL", ACCEPTED), ("ALTCTL", ACCEPTED), ("STABILIZED", ACCEPTED),
            ("ACRO", ACCEPTED), ("MANUAL", ACCEPTED), ("MISSION", ACCEPTED), ("FOLLOWME", DENIED),
            ("TAKEOFF", ACCEPTED), ("LOITER", ACCEPTED),
        ):  # fmt: skip
            drain(client)
            before = client.flightmode
            client.set_mode(name)
            assert message(client, "COMMAND_ACK", command=SET_MODE).result == result, name
            heartbeat(client)
            assert client.flightmode == (name if result == ACCEPTED else before)


# --- mavparm ---------------------------------------------------------------------------------------------------------


def test_mavutil_fetches_and_mavparm_sets_parameters(vehicle: Sitl, tmp_path: Path) -> None:
    from pymavlink import mavparm, mavutil

    real, integer = mavutil.mavlink.MAV_PARAM_TYPE_REAL32, mavutil.mavlink.MAV_PARAM_TYPE_INT32
    with listener(vehicle) as client:
        client.param_fetch_all()
        values: dict[str, float] = {}
        while len(values.keys() & TABLE.keys()) < len(TABLE):
            value = message(client, "PARAM_VALUE")
            assert value.param_count == len(TABLE)
            values[value.param_id] = value.param_value
        parameters = mavparm.MAVParmDict()
        assert parameters.mavset(client, "MIS_TAKEOFF_ALT", 3.25, parm_type=real)
        client.param_fetch_one("MIS_TAKEOFF_ALT")
        assert message(client, "PARAM_VALUE", param_id="MIS_TAKEOFF_ALT").param_value == 3.25
        assert parameters.mavset(client, "COM_RC_IN_MODE", 3, parm_type=integer)
        client.param_fetch_one("COM_RC_IN_MODE")
        fetched = message(client, "PARAM_VALUE", param_id="COM_RC_IN_MODE")
        assert fetched.param_type == integer
        kept = tmp_path / "kept.parm"
        parameters.save(str(kept))
        assert parameters.mavset(client, "MIS_TAKEOFF_ALT", 2.5, parm_type=real)
        reloaded = mavparm.MAVParmDict()
        assert reloaded.load(str(kept), wildcard="MIS_TAKEOFF_ALT", mav=client, check=False)
        client.param_fetch_one(TABLE_NAMES.index("MIS_TAKEOFF_ALT"))
        assert message(client, "PARAM_VALUE", param_id="MIS_TAKEOFF_ALT").param_value == 3.25


TABLE_NAMES = sorted(TABLE)
"""In the order of the wire's indices."""


# --- mavwp -----------------------------------------------------------------------------------------------------------


def plan(mission_type: int) -> Any:
    from pymavlink import mavwp

    loaders = (mavwp.MAVWPLoader, mavwp.MissionItemProtocol_Fence, mavwp.MissionItemProtocol_Rally)
    return loaders[mission_type](1, 1)


@pytest.mark.parametrize("as_integers", [False, True], ids=["MISSION_REQUEST", "MISSION_REQUEST_INT"])
@pytest.mark.parametrize("mission_type", PLANS, ids=["mission", "fence", "rally"])
def test_mavwp_moves_a_plan_to_and_fro(vehicle: Sitl, mission_type: int, as_integers: bool, tmp_path: Path) -> None:
    path, copy = tmp_path / "plan.txt", tmp_path / "copy.txt"
    path.write_text(PLANS[mission_type], "utf-8")
    sent, got = plan(mission_type), plan(mission_type)
    count = sent.load(str(path))
    assert count == PLANS[mission_type].count("\n") - 1
    with listener(vehicle) as client:
        client.mav.mission_count_send(1, 1, count, mission_type)
        for n in range(count):
            message(client, ["MISSION_REQUEST", "MISSION_REQUEST_INT"], seq=n, mission_type=mission_type)
            item = sent.item(n)
            item.target_system = item.target_component = item.mission_type = 1
            item.mission_type = mission_type
            client.mav.send(item)
        assert message(client, "MISSION_ACK", mission_type=mission_type).type == 0

        client.mav.mission_request_list_send(1, 1, mission_type)
        assert message(client, "MISSION_COUNT", mission_type=mission_type).count == count
        for n in range(count):
            if as_integers:
                client.mav.mission_request_int_send(1, 1, n, mission_type)
            else:
                client.mav.mission_request_send(1, 1, n, mission_type)
            got.add(message(client, "MISSION_ITEM_INT" if as_integers else "MISSION_ITEM", seq=n))
        client.mav.mission_ack_send(1, 1, 0, mission_type)
        got.save(str(copy))
        assert rows(copy, as_integers) == [pytest.approx(row, abs=5e-6) for row in rows(path)]

        client.mav.mission_clear_all_send(1, 1, mission_type)
        assert message(client, "MISSION_ACK", mission_type=mission_type).type == 0


def rows(path: Path, as_integers: bool = False) -> list[list[float]]:
    """Command, parameters and place of each item; an integer item's latitude and longitude are saved as integers."""
    found = [[float(field) for field in line.split()[3:11]] for line in path.read_text("utf-8").splitlines()[1:]]
    if as_integers:
        for row in found:
            row[5:7] = [value * 1e-7 if abs(value) > 360.0 else value for value in row[5:7]]
    return found


# --- several clients at one link -------------------------------------------------------------------------------------


def test_every_client_of_a_link_is_served(vehicle: Sitl) -> None:
    with listener(vehicle) as first, caller(vehicle, 254) as second, caller(vehicle, 253, 191) as third:
        for client in (first, second, third):
            assert answer(client, REQUEST_MESSAGE, 148) == ACCEPTED
            assert client.messages["AUTOPILOT_VERSION"].flight_sw_version
            loses_nothing(client)


def test_a_client_that_comes_back_from_another_port_is_served(vehicle: Sitl) -> None:
    for _ in range(3):
        with caller(vehicle, 252) as client:
            assert answer(client, REQUEST_MESSAGE, 148) == ACCEPTED
            assert client.messages["AUTOPILOT_VERSION"].flight_sw_version


def test_nobody_redirects_the_stream_of_another(vehicle: Sitl) -> None:
    """Neither by speaking with the same address, nor with junk; and who sends only junk is sent nothing."""
    with listener(vehicle) as client, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as junk:
        junk.bind((LOOPBACK, 0))
        junk.setblocking(False)
        for n in range(50):
            junk.sendto(b"\xfd" * n, (LOOPBACK, vehicle.offboard_own))
        with caller(vehicle, client.mav.srcSystem, client.mav.srcComponent) as twin:
            assert answer(twin, REQUEST_MESSAGE, 148) == ACCEPTED
            loses_nothing(client)
        loses_nothing(client)
        with pytest.raises(BlockingIOError):
            junk.recv(1500)


# --- signing ---------------------------------------------------------------------------------------------------------


def test_mavutil_signs(tmp_path: Path) -> None:
    """With a key on all links, the signed client is obeyed and hears signed frames; the unsigned one is not heard."""
    from pymavlink import mavparm, mavutil

    key = sha256(b"a passphrase").digest()
    integer = mavutil.mavlink.MAV_PARAM_TYPE_INT32
    with sitl(state_dir=tmp_path) as vehicle, listener(vehicle) as client, caller(vehicle, 254) as stranger:
        client.mav.setup_signing_send(1, 1, list(key), (unix_us() - EPOCH_UNIX_US) // 10)
        client.setup_signing(key, sign_outgoing=True, allow_unsigned_callback=lambda mav, message_id: True)
        assert answer(client, REQUEST_MESSAGE, 148) == ACCEPTED
        assert mavparm.MAVParmDict().mavset(client, "MAV_SIGN_CFG", 2, parm_type=integer)
        drain(client)
        client.setup_signing(key, sign_outgoing=True, allow_unsigned_callback=lambda mav, message_id: False)
        assert heartbeat(client).get_signed()
        assert answer(client, REQUEST_MESSAGE, 148) == ACCEPTED
        assert client.mav.signing.badsig_count == 0

        stranger.mav.command_long_send(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0)
        assert answer(client, REQUEST_MESSAGE, 148) == ACCEPTED  # it came later, so the other has been looked at
        heartbeat(client)
        assert not client.motors_armed()
        assert answer(client, ARM, 1) == ACCEPTED
        assert answer(client, ARM, 0) == ACCEPTED
