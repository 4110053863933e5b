"""Messages to a vehicle whose time passes when the test says so."""

from pymavlink.dialects.v20 import common as mavlink

POSITION_AND_YAW = 0b100111111000


def setpoint(north_m, east_m, down_m):
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, POSITION_AND_YAW, north_m, east_m, down_m, 0, 0, 0, 0, 0, 0, 0, 0
    )


def test_it_goes_where_it_is_told_and_home_when_nobody_tells(vehicle, faults, assert_flight):
    vehicle.takeoff(3.0)
    faults.link(loss=0.1, latency_ms=40)
    with vehicle.stream(setpoint(5.0, 0.0, -3.0), hz=20):
        vehicle.run(0.5)  # PX4 wants to see setpoints before it goes OFFBOARD
        assert vehicle.set_mode("OFFBOARD") == "ACCEPTED"
        vehicle.run(15.0)
    assert_flight(vehicle).reaches((5.0, 0.0, -3.0), within_m=0.3).never_failsafe()
    vehicle.run_until(lambda state: not state.armed, within_s=90)
    assert_flight(vehicle).had_failsafe("off-board signal lost").entered("AUTO.RTL").lands()


def test_an_acknowledgement_that_is_lost(vehicle, faults):
    with faults.chaos("ack-lost"):
        vehicle.send(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))
        vehicle.run(1.0)
        assert vehicle.messages("COMMAND_ACK") == []
    assert vehicle.now.armed  # it did what it was told
