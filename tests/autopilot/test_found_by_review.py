"""What a hostile or unlucky client could do to the vehicle once, and can no more."""

from __future__ import annotations

import gc
from math import nan
from pathlib import Path

import pytest
from mavsitl_vehicle.autopilot.autopilot import MAX_TEXTS, Autopilot
from mavsitl_vehicle.autopilot.position import PositionControl
from mavsitl_vehicle.autopilot.setpoints import PositionSetpoint, State
from mavsitl_vehicle.autopilot.sticks import Axes, PositionHold

from mavsitl.codec import encode
from mavsitl.dialect import mavlink
from mavsitl.drivers import Tap
from mavsitl.log.tlog import Direction, TlogWriter
from mavsitl.services.mission import RALLY, MissionItem
from mavsitl.signing import Key, setup_signing
from tests.autopilot.conftest import Client
from tests.autopilot.copter import flying, item, upload, waypoint
from tests.autopilot.test_signing import Signer

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
HOLD, RETURN = (4, 3), (4, 5)


def finite(client: Client) -> bool:
    return all(abs(value) < 1e6 for value in client.truth)


@pytest.mark.parametrize("name", ["MPC_THR_MAX", "MPC_XY_VEL_MAX"])
def test_a_limit_of_nothing_is_flown(name: str) -> None:
    client = flying(3.0)
    assert client.vehicle.parameters.set(name, 0.0) is None

    def fast() -> None:
        mask = 0b0000_1101_1100_0111
        client.send(
            mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, mask, 0, 0, 0, 5, 5, 0, 0, 0, 0, 0, 0)
        )

    fast()
    assert client.offboard() == ACCEPTED
    client.run(1.0, fast)
    assert finite(client)


def test_no_thrust_at_all_still_has_a_direction() -> None:
    values = dict(Client().vehicle.parameters.as_dict(), MPC_THR_MAX=0.0, MPC_THR_MIN=0.0)
    control = PositionControl(values, 9.81, 0.5, 0.004)
    state = State((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    setpoint = control.update(PositionSetpoint((5.0, 0.0, -9.0)), state)
    assert setpoint.thrust == 0.0
    assert sum(part * part for part in setpoint.attitude) == pytest.approx(1.0)


def test_a_dead_zone_of_everything_is_flown() -> None:
    values = dict(Client().vehicle.parameters.as_dict(), MAN_DEADZONE=1.0)
    law = PositionHold(values, 0.004)
    state = State((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    law.engage(state)
    assert law.update(Axes(0.01, 1.0, 1.0, 1.0), state).velocity_nwu_m_s[0] == 0.0


def test_a_key_is_in_no_log(tmp_path: Path) -> None:
    key = Key(bytes(range(32)))
    heartbeat = encode(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), 1, 255, 190)
    secret = encode(setup_signing((1, 1), key, 5), 0, 255, 190)
    tap = Tap(TlogWriter(tmp_path / "link.tlog"))
    for datagram in (secret, heartbeat, secret + heartbeat):
        tap.hear(Direction.FROM_GROUND, 4000, datagram)
    tap.close()
    written = (tmp_path / "link.tlog").read_bytes()
    assert bytes(range(32)) not in written
    assert written.count(heartbeat) == 2


def test_clearing_what_is_empty_writes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    client = Client()
    made: list[str] = []

    def to_document() -> dict[str, object]:
        made.append("once more")
        return {}

    monkeypatch.setattr(client.vehicle.plan, "to_document", to_document)
    for _ in range(50):
        client.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 255))
    client.run(1.0)
    client.vehicle.unsaved(0)
    assert made == []


def test_a_reboot_ends_a_transfer() -> None:
    client = Client()
    client.run(30.0)
    client.send(mavlink.MAVLink_mission_count_message(1, 1, 5, 0))
    assert client.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
    client.run(0.5)
    since_us = client.now_us
    client.send(mavlink.MAVLink_mission_request_list_message(1, 1, 0), sender=(255, 190))
    client.run(0.1)
    assert [message.count for message in client.all("MISSION_COUNT", 0, since_us - 1)] == [0]


def test_a_reboot_in_the_air_is_refused() -> None:
    client = flying(5.0)
    assert client.disarm(21196.0) == ACCEPTED
    assert client.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == DENIED


def test_reboots_leave_nothing_behind() -> None:
    client = Client()
    for _ in range(5):
        assert client.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
        client.run(0.05)
    gc.collect()
    mine = [each for each in gc.get_objects() if isinstance(each, Autopilot) and each.plan is client.vehicle.plan]
    assert len(mine) == 1


def test_a_later_hold_does_not_stop_a_return() -> None:
    """The ground station is lost and found; the fence, met on the way home, asks for less than what holds."""
    client = flying(5.0)
    client.vehicle.parameters.set("COM_FAIL_ACT_T", 0.0)
    client.vehicle.parameters.set("COM_DL_LOSS_T", 5.0)
    gcs = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    client.send(gcs)
    client.vehicle.parameters.set("NAV_DLL_ACT", 2)
    client.run_until(lambda: client.flight_mode == RETURN, 7.0)
    client.run(0.5, lambda: client.send(gcs))
    assert client.flight_mode == RETURN
    client.vehicle.parameters.set("GF_ACTION", 2)
    client.vehicle.parameters.set("GF_MAX_VER_DIST", 1.0)
    client.run(1.0, lambda: client.send(gcs))
    assert client.flight_mode == RETURN


def test_an_unsigned_report_makes_nobody_a_peer(tmp_path: Path) -> None:
    ground = Signer(tmp_path)
    ground.set_up()
    ground.vehicle.parameters.set("MAV_SIGN_CFG", 2)
    ground.run(0.1)
    report = mavlink.MAVLink_radio_status_message(1, 1, 1, 1, 1, 1, 1)
    assert ground.vehicle.receive(0, encode(report, 0, 51, 68)) == 0
    assert ground.command(signed=True) == 1


def test_many_instantaneous_items_are_passed() -> None:
    client = flying(3.0)
    speed = item(client, mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, 5.0, frame=2)
    upload(client, [*[speed] * 40, waypoint(client, 5.0, 0.0, 3.0)])
    assert client.mode(4, 4) == ACCEPTED
    client.run(2.0)
    assert client.vehicle.plan.status().seq == 40


def test_a_loop_without_time_floods_nobody() -> None:
    client = flying(3.0)
    delay = item(client, mavlink.MAV_CMD_NAV_DELAY, 0.0, frame=2)
    jump = item(client, mavlink.MAV_CMD_DO_JUMP, 0.0, -1.0, frame=2)
    upload(client, [delay, jump])
    assert client.mode(4, 4) == ACCEPTED
    since_us = client.now_us
    client.run(2.0)
    assert len(client.all("MISSION_ITEM_REACHED", 0, since_us)) < 60


def test_unknown_commands_are_told_of_at_a_bounded_rate() -> None:
    client = Client()
    since_us = client.now_us
    for command in range(40_000, 40_500):
        client.command(command)
    client.run(1.0)
    assert len(client.all("STATUSTEXT", 0, since_us)) <= 4
    for number in range(2 * MAX_TEXTS):
        client.vehicle.autopilot.queue_text(6, f"text {number}")
    client.run(0.1)
    assert len(client.all("STATUSTEXT", 0, since_us)) <= MAX_TEXTS + 4


def test_a_rally_point_in_space_is_refused() -> None:
    client = Client()
    point = MissionItem(mavlink.MAV_CMD_NAV_RALLY_POINT, 6, 0.0, 0.0, 0.0, 0.0, 10, 10, 3e38, 0)
    check = client.vehicle.plan.stores.check
    assert check(RALLY, 0, point) == mavlink.MAV_MISSION_INVALID_PARAM7
    assert check(RALLY, 0, point._replace(z=50.0)) == mavlink.MAV_MISSION_ACCEPTED


def test_a_take_off_that_a_failsafe_broke_off_goes_on_to_its_height() -> None:
    client = Client()
    gcs = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    client.vehicle.parameters.set("COM_DL_LOSS_T", 5.0)
    client.vehicle.parameters.set("NAV_DLL_ACT", 1)
    client.run(0.2, lambda: client.send(gcs))
    assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF, -1, nan, nan, nan, nan, nan, 488.0 + 20.0) == ACCEPTED
    assert client.arm() == ACCEPTED
    client.run_until(lambda: client.flight_mode == HOLD, 9.0)
    assert client.truth[2] < 19.0
    client.run(15.0, lambda: client.send(gcs))
    assert client.truth[2] == pytest.approx(20.0, abs=0.4)
    assert not any("Already higher" in text for text in client.texts())


def test_disarming_and_arming_at_once_is_two_flights() -> None:
    client = flying(4.0)
    number = client.vehicle.autopilot.flight_times.number
    assert client.disarm(21196.0) == ACCEPTED
    client.arm()
    client.run(0.1)
    times = client.vehicle.autopilot.flight_times
    assert times.number == number + (1 if client.armed else 0)
    assert client.vehicle.autopilot.home is not None
