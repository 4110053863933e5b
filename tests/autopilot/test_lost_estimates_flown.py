"""What is flown without parts of the estimate, and how the rotors are stopped: all over the datagrams."""

from __future__ import annotations

from math import degrees, hypot, inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.failure_detector import AltitudeLoss
from mavsitl_vehicle.autopilot.health import Validity

from mavsitl.dialect import mavlink
from mavsitl.quaternion import up_vector
from tests.autopilot.conftest import GCS, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    ALTCTL,
    HOLD,
    LAND,
    OFFBOARD_MODE,
    POSCTL,
    REJECTED,
    RETURN,
    STABILIZED,
    TERMINATION,
    flying,
    set_parameter,
    sticks,
)

REBOOT = mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
TERMINATE = mavlink.MAV_CMD_DO_FLIGHTTERMINATION


def lose(client: Client, **parts: bool) -> None:
    client.vehicle.autopilot.valid = Validity(**parts)


def tilt_deg(client: Client) -> float:
    w, x, y, z = client.truth[6:10]
    bx, by, _ = up_vector((w, x, y, z))
    return degrees(hypot(bx, by))


# --- descending


@pytest.mark.parametrize("wind_m_s", [0.0, 4.0])
def test_a_lost_position_descends_level_lands_and_disarms(wind_m_s: float) -> None:
    client = flying(6.0, parameters={"SIM_WIND_SPD": wind_m_s, "SIM_WIND_DIR": 180})
    lose(client, position=False, velocity=False)
    client.run(1.5)
    assert (client.flight_mode, client.critical) == (LAND, True)  # AUTO.DESCEND has AUTO.LAND's numbers
    assert client.texts()[-1] == "Failsafe activated: position estimate lost, descend"
    assert client.last("EXTENDED_SYS_STATE", GCS).landed_state == mavlink.MAV_LANDED_STATE_LANDING
    tilts: list[float] = []
    client.run(3.0, lambda: tilts.append(tilt_deg(client)))
    assert max(tilts) < 1.0
    assert client.truth[5] == pytest.approx(-0.9, abs=0.25)
    drift_m = client.truth[0]
    assert (drift_m > 0.5) == (wind_m_s > 0.0)  # a wind from the south carries it north
    client.run_until(lambda: not client.armed, 15.0)
    assert client.landed
    assert client.texts()[-1] == "Disarmed by landing"


def test_without_a_height_it_sinks_by_less_thrust_than_hovers() -> None:
    client = flying(6.0)
    lose(client, position=False, velocity=False, height=False)
    client.run(2.0)
    assert client.flight_mode == LAND
    first = client.truth[5]
    client.run(1.0)
    assert client.truth[5] - first == pytest.approx(-0.3, abs=0.1)  # a tenth of a second's blending included
    client.run_until(lambda: not client.armed, 15.0)
    assert client.truth[2] < 0.1


def test_a_landing_goes_on_when_the_position_is_back() -> None:
    client = flying(8.0)
    assert client.land() == ACCEPTED
    client.run(1.0)
    lose(client, position=False)
    client.run(0.5)
    assert client.critical
    lose(client)
    client.run(0.5)
    assert (client.flight_mode, client.critical) == (LAND, False)


def test_a_landing_without_position_is_not_refused() -> None:
    client = flying(6.0)
    lose(client, position=False)
    client.run(0.2)
    assert client.hold() == REJECTED
    client.tick()
    assert client.texts()[-1] == "AUTO.LOITER refused: position estimate invalid"
    assert client.land() == ACCEPTED
    client.run(0.3)
    assert (client.flight_mode, client.critical) == (LAND, True)


def test_nothing_arms_without_the_estimate_that_its_mode_needs() -> None:
    client = Client(flight())
    lose(client, position=False)
    client.run(0.3)
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[-1] == "Arming denied: no valid position estimate"
    assert client.mode(*STABILIZED) == ACCEPTED
    client.run(0.2)
    assert client.arm() == ACCEPTED


# --- falling back


def test_a_pilot_keeps_the_best_mode_there_is() -> None:
    client = flying(5.0)
    stick = sticks(client)
    client.run(0.3, stick)
    assert client.mode(*POSCTL) == ACCEPTED
    client.run(1.0, stick)
    lose(client, position=False, velocity=False)
    client.run(2.0, stick)
    assert (client.flight_mode, client.critical) == (ALTCTL, True)
    assert client.truth[2] == pytest.approx(5.0, abs=0.2)
    lose(client, position=False, velocity=False, height=False)
    client.run(0.5, stick)
    assert client.flight_mode == STABILIZED
    lose(client)
    client.run(0.2, stick)
    assert (client.flight_mode, client.critical) == (POSCTL, False)


@pytest.mark.parametrize("level", ["position", "attitude"])
def test_offboard_without_position(level: str) -> None:
    """Attitude setpoints fly on; for position setpoints it is as if the stream were lost."""
    client = flying(4.0, parameters={"COM_OBL_RC_ACT": 4})

    def send() -> None:
        if level == "attitude":
            client.attitude()
        else:
            client.send(
                mavlink.MAVLink_set_position_target_local_ned_message(
                    0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, 0b110111111000, 0, 0, -4, 0, 0, 0, 0, 0, 0, 0, 0
                )
            )

    client.run(0.1, send)
    assert client.offboard() == ACCEPTED
    client.run(0.5, send)
    lose(client, position=False)
    client.run(0.1, send)
    assert client.flight_mode == (OFFBOARD_MODE if level == "attitude" else LAND)
    lose(client)
    client.run(0.1, send)
    assert client.flight_mode == OFFBOARD_MODE


# --- taking over by sticks


@pytest.mark.parametrize(("deflection", "taken"), [(0.2, False), (0.45, True)])
def test_moved_sticks_take_a_return_over(deflection: float, taken: bool) -> None:
    client = flying(5.0)
    client.run(1.0, sticks(client))
    assert client.result(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH) == ACCEPTED
    client.run(1.0, sticks(client))
    assert client.flight_mode == RETURN
    client.run(0.3, sticks(client, pitch=deflection))
    assert client.flight_mode == (POSCTL if taken else RETURN)
    assert ("Pilot took over using sticks" in client.texts()) == taken
    assert not client.critical


def test_sticks_that_lie_somewhere_do_not_take_over() -> None:
    client = flying(5.0)
    client.run(3.0, sticks(client, pitch=0.9, throttle=0.1))
    assert client.flight_mode == HOLD


def test_without_manual_control_allowed_sticks_are_nothing() -> None:
    client = flying(5.0, parameters={"COM_RC_IN_MODE": 4})
    client.run(1.0, sticks(client))
    client.run(0.5, sticks(client, pitch=1.0))
    assert client.flight_mode == HOLD
    assert client.mode(*POSCTL) == REJECTED


# --- rotors stopped


def test_a_kill_that_is_released_gives_the_vehicle_back() -> None:
    client = flying(20.0)
    assert client.result(TERMINATE, 2) == ACCEPTED
    client.run(0.4)
    assert client.truth[13:] == [0.0] * 4
    assert client.armed
    assert client.flight_mode == HOLD
    assert client.result(TERMINATE, 0) == ACCEPTED
    client.run(6.0)
    assert client.armed
    assert client.truth[2] > 8.0
    assert abs(client.truth[5]) < 0.1
    assert [text for text in client.texts() if text.startswith("Kill")] == ["Kill engaged", "Kill disengaged"]


def test_both_sticks_in_their_outer_corners_kill_for_good() -> None:
    client = flying(20.0, parameters={"MAN_KILL_GEST_T": 0.5, "COM_KILL_DISARM": 1.0})
    client.run(0.5, sticks(client))
    corners = sticks(client, pitch=-1.0, roll=1.0, yaw=-1.0, throttle=0.0)
    client.run(0.45, corners)
    assert "Kill engaged" not in client.texts()
    client.run(0.1, corners)
    assert "Kill engaged" in client.texts()
    assert client.result(TERMINATE, 0) == REJECTED
    client.run_until(lambda: not client.armed, 1.2)
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[-1] == "Arming denied: kill switch engaged"


def test_a_terminated_flight_ends_with_a_reboot() -> None:
    client = flying(1.5)
    assert client.result(TERMINATE, 1) == ACCEPTED
    client.run_until(lambda: not client.armed, 6.0)  # fallen, and COM_DISARM_LAND
    client.run(1.1)
    assert client.flight_mode == TERMINATION
    assert client.arm() == REJECTED
    assert client.mode(*HOLD) == REJECTED
    client.tick()
    assert client.texts()[-2] == "Arming denied: flight termination active, a reboot ends it"
    assert client.result(REBOOT, 1) == ACCEPTED
    client.run(0.5)
    assert client.flight_mode == HOLD


def test_high_throttle_does_not_arm() -> None:
    client = Client(flight())
    assert client.mode(*STABILIZED) == ACCEPTED
    client.run(0.2, sticks(client, throttle=0.5))
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[-1] == "Arming denied: high throttle"
    client.run(0.2, sticks(client, throttle=0.0))
    assert client.arm() == ACCEPTED


def test_parameters_that_keep_it_on_the_ground() -> None:
    client = Client(flight())
    client.run(0.3)
    set_parameter(client, "COM_ARMABLE", 0)
    assert client.arm() == REJECTED
    client.run(1.1)
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    set_parameter(client, "COM_ARMABLE", 1)
    set_parameter(client, "COM_ARM_MIS_REQ", 1)
    assert client.arm() == REJECTED
    set_parameter(client, "COM_ARM_MIS_REQ", 0)
    assert client.arm() == ACCEPTED


# --- the altitude that is lost


def test_a_fall_below_the_setpoint_counts_from_the_highest_point() -> None:
    loss = AltitudeLoss()
    heights = [(10.0, 0.0), (9.0, 1.0), (9.5, 0.5), (8.0, 2.0), (11.0, 0.0), (10.5, 0.0)]
    for height, lost in heights[:4]:
        assert loss.update(height, 10.0, nan, 0.1) == pytest.approx(lost)
    assert loss.update(11.0, 10.0, nan, 0.1) == 0.0
    assert loss.update(10.5, 10.0, nan, 0.1) == 0.0


def test_a_setpoint_that_sinks_takes_the_reference_along() -> None:
    loss = AltitudeLoss()
    loss.update(10.0, 10.0, nan, 0.1)
    assert loss.update(6.0, 6.5, nan, 0.1) == pytest.approx(0.5)


def test_a_descent_that_was_asked_for_is_no_loss() -> None:
    loss = AltitudeLoss()
    height, worst = 20.0, 0.0
    for _ in range(100):
        worst = max(worst, loss.update(height, nan, -1.0, 0.1))
        height -= 0.1
    assert worst == pytest.approx(0.0, abs=1e-9)
    assert loss.update(height - 5.0, nan, -1.0, 0.1) == pytest.approx(4.9, abs=0.2)


@given(st.lists(st.tuples(st.floats(), st.floats(), st.floats(), st.floats(0.0, 1.0)), max_size=30))
def test_whatever_it_is_given_it_loses_nothing_it_never_had(steps: list[tuple[float, float, float, float]]) -> None:
    loss, highest, lowest = AltitudeLoss(), -inf, inf
    for height, setpoint, climb, elapsed in steps:
        lost = loss.update(height, setpoint, climb, elapsed)
        assert lost >= 0.0
        if -inf < height < inf:
            highest, lowest = max(highest, height), min(lowest, height)
            assert lost <= highest - lowest or lost == 0.0
