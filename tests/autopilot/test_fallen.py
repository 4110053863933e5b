"""A vehicle on its back: it says so instead of spinning its rotors in the grass, and a reboot sets it upright."""

from __future__ import annotations

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import Client

KILL = 21196


def test_fallen_over_it_refuses_to_arm_until_a_reboot_sets_it_upright(client: Client) -> None:
    client.climb(6.0)
    client.run(0.5, lambda: client.rates((4.0, 0.0, 0.0)))
    assert client.disarm(KILL) == mavlink.MAV_RESULT_ACCEPTED
    client.run_until(lambda: client.landed, 5.0)
    client.run(1.0)
    tilt = client.truth[7] ** 2 + client.truth[8] ** 2
    assert tilt > 0.25, "the fall did not turn it over"
    where = client.truth[:2]

    client.hold()
    assert client.arm() == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    client.tick()
    assert client.texts()[-1] == "Arming denied: fallen over, a reboot sets it upright"
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK

    assert client.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == mavlink.MAV_RESULT_ACCEPTED
    client.run(0.3)
    assert client.truth[:2] == where
    assert client.arm() == mavlink.MAV_RESULT_ACCEPTED
    assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF) == mavlink.MAV_RESULT_ACCEPTED
    client.run_until(lambda: client.truth[2] > 2.3, 6.0)


def test_hold_asked_for_again_ends_a_reposition(client: Client) -> None:
    client.hold()
    assert client.arm() == mavlink.MAV_RESULT_ACCEPTED
    assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF) == mavlink.MAV_RESULT_ACCEPTED
    client.run(5.0)
    here = client.last("GLOBAL_POSITION_INT")
    far = here.lat / 1e7 + 100.0 / 111_319.5
    go = mavlink.MAV_CMD_DO_REPOSITION
    assert client.result(go, -1, 1, 0, float("nan"), far, here.lon / 1e7, here.alt / 1e3) == mavlink.MAV_RESULT_ACCEPTED
    client.run(3.0)
    assert client.truth[3] > 2.0
    assert client.hold() == mavlink.MAV_RESULT_ACCEPTED
    client.run(5.0)
    assert abs(client.truth[3]) < 0.1
    assert client.truth[0] < 25.0
