"""MAVSDK, as it comes from the package index, connects to the vehicle, configures, flies and debugs it."""

from __future__ import annotations

import asyncio
import json
import queue
from collections.abc import Callable, Iterator
from math import hypot, isnan, nan
from pathlib import Path
from typing import Any

import pytest

from mavsitl import __version__
from mavsitl.dialect import mavlink
from tests.interop.conftest import PATIENCE_S, Sitl, sitl
from tests.interop.mavsdk_client import METRES_PER_DEGREE, Pilot, connected, first

pytest.importorskip("mavsdk.plugins", reason="MAVSDK 4 is not installed")

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

SPEED = 10.0
"""Of the simulation; MAVSDK's 20 Hz of setpoints are then one in 0.25 s, and a second is allowed."""

QUIET_S = 10.0
"""Longer than any of MAVSDK's own time-outs for one command (1.5 s): an answer, whatever it is, comes before."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("vehicle")


@pytest.fixture(scope="module")
def vehicle(folder: Path) -> Iterator[Sitl]:
    with sitl(speed=SPEED, run_dir=folder / "run", state_dir=folder / "state") as running:
        yield running


@pytest.fixture(scope="module")
def client(vehicle: Sitl) -> Iterator[Pilot]:
    with connected(vehicle) as pilot:
        pilot.wait("health_all_ok", bool)
        yield pilot


@pytest.fixture
def pilot(client: Pilot) -> Pilot:
    client.reset()
    return client


@pytest.fixture
def flying(pilot: Pilot) -> Iterator[Pilot]:
    """Hovering 3 m above home."""
    pilot.fly()
    yield pilot
    if pilot.offboard.is_active():
        pilot.offboard.stop()


def refused(call: Callable[..., Any], *arguments: Any) -> str:
    """The result with which a plugin's call fails."""
    with pytest.raises(Exception, match="origin") as failure:
        call(*arguments)
    return str(failure.value.result.name)  # type: ignore[attr-defined]


def finished(start: Callable[..., None], *arguments: Any, limit_s: float = PATIENCE_S) -> str:
    """The last result of a call that reports its progress, and then its end."""
    results: queue.SimpleQueue[Any] = queue.SimpleQueue()
    start(*arguments, lambda result, *_: results.put(result))
    last = first(results, lambda result: result.name not in ("NEXT", "IN_PROGRESS"), limit_s, start.__name__)
    return str(last.name)


# --- who it is -------------------------------------------------------------------------------------------------------


def _own_version() -> tuple[int, ...]:
    return tuple(int(part) for part in __version__.split("."))[:2]


def test_identification(client: Pilot) -> None:
    version, product = client.info.get_version(), client.info.get_product()
    assert (version.flight_sw_major, version.flight_sw_minor, version.flight_sw_patch) == (1, 17, 0)
    assert version.flight_sw_version_type.name == "RELEASE"
    assert (version.flight_sw_vendor_major, version.flight_sw_vendor_minor) == _own_version()
    assert client.info.get_identification().legacy_uid != 0
    assert (product.vendor_id, product.product_id) == (0, 0)


def test_all_health_flags(client: Pilot) -> None:
    assert client.telemetry.health_all_ok()
    health = client.telemetry.health()
    assert health.is_global_position_ok
    assert health.is_home_position_ok
    assert health.is_armable


def test_speed_factor_is_the_simulations(client: Pilot) -> None:
    with client.values("attitude_euler") as values:
        for _ in range(400):
            values.get(timeout=PATIENCE_S)
    factor = client.info.get_speed_factor()
    assert 1.0 < factor < 2.0 * SPEED


def test_asyncio_sees_the_same(folder: Path) -> None:
    from mavsdk import ComponentType, Configuration
    from mavsdk.asyncio import Mavsdk
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    async def fly(port: int) -> float:
        configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
        async with Mavsdk(configuration) as mavsdk:
            await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            system = await mavsdk.first_autopilot(timeout_s=PATIENCE_S)
            action, telemetry = ActionAsync(system), TelemetryAsync(system)
            async for fine in telemetry.subscribe_health_all_ok():
                if fine:
                    break
            await action.arm()
            await action.takeoff()
            async for position in telemetry.subscribe_position():
                if position.relative_altitude_m > 0.95 * 2.5:
                    return float(position.relative_altitude_m)
        raise AssertionError("the stream of positions ended")

    with sitl(speed=SPEED) as own:
        assert asyncio.run(asyncio.wait_for(fly(own.gcs_port), PATIENCE_S)) < 3.0


# --- parameters ------------------------------------------------------------------------------------------------------


def test_parameters_are_read_and_set(pilot: Pilot) -> None:
    param = pilot.param
    assert param.get_param_int("MAV_SYS_ID") == 1
    assert param.get_param_float("MIS_TAKEOFF_ALT") == pytest.approx(2.5)
    param.set_param_float("MPC_XY_CRUISE", 3.25)
    param.set_param_int("NAV_DLL_ACT", 2)
    assert param.get_param_float("MPC_XY_CRUISE") == pytest.approx(3.25)
    assert param.get_param_int("NAV_DLL_ACT") == 2


def test_all_parameters_arrive(pilot: Pilot) -> None:
    everything = pilot.param.get_all_params()
    integers = {each.name: each.value for each in everything.int_params}
    floats = {each.name: each.value for each in everything.float_params}
    assert len(integers) + len(floats) > 100
    assert integers["MAV_SYS_ID"] == 1
    assert floats["MIS_TAKEOFF_ALT"] == pytest.approx(2.5)


def test_parameters_that_are_wrong_are_refused_at_once(pilot: Pilot) -> None:
    assert refused(pilot.param.get_param_int, "MIS_TAKEOFF_ALT") == "WRONG_TYPE"
    assert refused(pilot.param.set_param_int, "MIS_TAKEOFF_ALT", 3) in ("WRONG_TYPE", "TYPE_MISMATCH")
    assert refused(pilot.param.get_param_int, "NO_SUCH_THING") == "DOES_NOT_EXIST"
    assert refused(pilot.param.set_param_float, "NO_SUCH_THING", 1.0) == "DOES_NOT_EXIST"
    # Another name: MAVSDK may take the PARAM_ERROR that followed the PARAM_VALUE above for this one's.
    assert refused(pilot.param.set_param_float, "MPC_XY_CRUISE", 1e9) == "VALUE_OUT_OF_RANGE"
    assert pilot.param.get_param_float("MIS_TAKEOFF_ALT") == pytest.approx(2.5)


# --- simple flights --------------------------------------------------------------------------------------------------


def test_arms_and_disarms(pilot: Pilot) -> None:
    pilot.action.arm()
    pilot.wait("armed", bool)
    pilot.action.disarm()
    pilot.wait("armed", lambda armed: not armed)


def test_disarms_by_itself_where_nobody_takes_off(pilot: Pilot) -> None:
    pilot.action.arm()
    pilot.wait("armed", bool)
    pilot.wait("armed", lambda armed: not armed)


def test_takes_off_to_the_altitude_set(pilot: Pilot) -> None:
    pilot.action.set_takeoff_altitude(4.0)
    assert pilot.action.get_takeoff_altitude() == pytest.approx(4.0)
    pilot.action.arm()
    pilot.action.takeoff()
    pilot.mode("TAKEOFF")
    pilot.height(0.95 * 4.0)
    pilot.mode("HOLD")
    assert pilot.telemetry.in_air()
    pilot.wait("landed_state", lambda state: bool(state.name == "IN_AIR"))
    assert pilot.height(3.8, 4.2) == pytest.approx(4.0, abs=0.2)


def test_lands_and_disarms(flying: Pilot) -> None:
    flying.action.land()
    flying.mode("LAND")
    flying.wait("landed_state", lambda state: bool(state.name == "LANDING"))
    flying.wait("armed", lambda armed: not armed)
    assert flying.telemetry.landed_state().name == "ON_GROUND"
    flying.mode("HOLD")
    flying.action.arm()


def test_kill_stops_the_rotors_in_the_air(flying: Pilot) -> None:
    assert refused(flying.action.disarm) == "COMMAND_DENIED"
    flying.action.kill()
    flying.wait("armed", lambda armed: not armed)


def test_terminate(flying: Pilot) -> None:
    flying.action.terminate()
    flying.wait("landed_state", lambda state: bool(state.name == "ON_GROUND"))
    flying.wait("armed", lambda armed: not armed)
    flying.wait("health", lambda health: not health.is_armable)
    flying.action.reboot()  # nothing less ends it
    flying.wait("health", lambda health: bool(health.is_armable))


def test_goes_to_a_place(flying: Pilot) -> None:
    here = flying.telemetry.position()
    there = here.latitude_deg + 8.0 / METRES_PER_DEGREE
    flying.action.goto_location(there, here.longitude_deg, here.absolute_altitude_m + 2.0, 90.0)
    reached = flying.wait(
        "position",
        lambda p: (
            abs(p.latitude_deg - there) * METRES_PER_DEGREE < 0.3
            and abs(p.absolute_altitude_m - here.absolute_altitude_m - 2.0) < 0.3
        ),
    )
    assert abs(reached.longitude_deg - here.longitude_deg) * METRES_PER_DEGREE < 1.0
    flying.wait("heading", lambda heading: abs(heading.heading_deg - 90.0) < 5.0)
    flying.mode("HOLD")


def test_hold_stops_a_goto(flying: Pilot) -> None:
    here = flying.telemetry.position()
    flying.action.goto_location(
        here.latitude_deg + 200.0 / METRES_PER_DEGREE, here.longitude_deg, here.absolute_altitude_m, nan
    )
    flying.wait("velocity_ned", lambda v: v.north_m_s > 3.0)
    flying.action.hold()
    flying.wait("velocity_ned", lambda v: hypot(v.north_m_s, v.east_m_s) < 0.2)
    assert abs(flying.telemetry.position().latitude_deg - here.latitude_deg) * METRES_PER_DEGREE < 50.0


def test_speed_is_changed(flying: Pilot) -> None:
    flying.action.set_current_speed(1.5)
    here = flying.telemetry.position()
    flying.action.goto_location(
        here.latitude_deg + 12.0 / METRES_PER_DEGREE, here.longitude_deg, here.absolute_altitude_m, nan
    )
    with flying.values("velocity_ned") as values:
        speeds = []
        first(values, lambda v: speeds.append(v.north_m_s) or v.north_m_s > 1.3, PATIENCE_S, "1.3 m/s")  # type: ignore[func-returns-value]
        first(values, lambda v: speeds.append(v.north_m_s) or v.north_m_s < 0.2, PATIENCE_S, "standstill")  # type: ignore[func-returns-value]
    assert max(speeds) < 1.5 + 0.5


def test_altitude_is_changed(flying: Pilot) -> None:
    assert flying.command(mavlink.MAV_CMD_DO_CHANGE_ALTITUDE, 6.0, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT) == 0
    flying.height(5.8, 6.2)


def test_orbit(flying: Pilot) -> None:
    from mavsdk.plugins.action import OrbitYawBehavior

    here = flying.telemetry.position()
    front = OrbitYawBehavior.HOLD_FRONT_TO_CIRCLE_CENTER
    flying.action.do_orbit(5.0, 3.0, front, here.latitude_deg, here.longitude_deg, here.absolute_altitude_m)

    def outside(sign: float) -> None:
        def there(p: Any) -> bool:
            return bool(sign * (p.position.north_m - centre.north_m) > 4.0)

        state = flying.wait("position_velocity_ned", there)
        offset = state.position.north_m - centre.north_m, state.position.east_m - centre.east_m
        assert hypot(*offset) < 6.5

    centre = flying.telemetry.position_velocity_ned().position
    for sign in (1.0, -1.0, 1.0):
        outside(sign)
    flying.action.hold()
    flying.mode("HOLD")


def test_returns_home_and_lands(flying: Pilot) -> None:
    flying.action.set_return_to_launch_altitude(6.0)
    assert flying.action.get_return_to_launch_altitude() == pytest.approx(6.0)
    home = flying.telemetry.home()
    flying.action.goto_location(
        home.latitude_deg + 15.0 / METRES_PER_DEGREE, home.longitude_deg, home.absolute_altitude_m + 3.0, nan
    )
    flying.wait("position", lambda p: (p.latitude_deg - home.latitude_deg) * METRES_PER_DEGREE > 14.0)
    flying.action.return_to_launch()
    flying.mode("RETURN_TO_LAUNCH")
    flying.height(5.7)
    flying.wait("armed", lambda armed: not armed, 60.0)
    landed = flying.telemetry.position()
    assert abs(landed.latitude_deg - home.latitude_deg) * METRES_PER_DEGREE < 0.5


def test_home_is_set(pilot: Pilot) -> None:
    here = pilot.telemetry.position()
    north = here.latitude_deg + 30.0 / METRES_PER_DEGREE
    pilot.action.set_home(False, north, here.longitude_deg, here.absolute_altitude_m)
    pilot.wait("home", lambda home: abs(home.latitude_deg - north) < 1e-6)
    pilot.action.set_home(True, nan, nan, nan)
    pilot.wait("home", lambda home: abs(home.latitude_deg - here.latitude_deg) < 1e-6)


def test_arming_is_refused_with_the_reason(pilot: Pilot) -> None:
    pilot.param.set_param_int("NAV_DLL_ACT", 2)
    pilot.param.set_param_int("GF_ACTION", 3)
    pilot.geofence.upload_geofence(_circle(pilot, north_m=500.0, radius_m=20.0))
    pilot.wait("health", lambda health: not health.is_armable)
    assert refused(pilot.action.arm) == "COMMAND_DENIED"
    assert "fence" in pilot.text("Arming denied").lower()


def test_vtol_and_shutdown_are_refused(pilot: Pilot) -> None:
    assert refused(pilot.action.transition_to_fixedwing) == "NO_VTOL_TRANSITION_SUPPORT"
    assert refused(pilot.action.shutdown) in ("COMMAND_DENIED", "UNSUPPORTED")


def test_reboot(pilot: Pilot) -> None:
    with pilot.messages("SYSTEM_TIME") as times:
        before = times.get(timeout=PATIENCE_S)["time_boot_ms"]
        pilot.action.reboot()
        first(times, lambda fields: fields["time_boot_ms"] < before, PATIENCE_S, "a clock that begins anew")
    pilot.wait("health_all_ok", bool)
    pilot.action.arm()
    pilot.wait("armed", bool)


# --- off-board -------------------------------------------------------------------------------------------------------


def test_offboard_needs_a_setpoint(flying: Pilot) -> None:
    fresh = type(flying.offboard)(flying.system)
    assert refused(fresh.start) == "NO_SETPOINT_SET"
    assert flying.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6, 0) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    flying.text("OFFBOARD refused: ")
    flying.mode("HOLD")


def test_offboard_by_position(flying: Pilot) -> None:
    from mavsdk.plugins.offboard import PositionNedYaw

    start = flying.telemetry.position_velocity_ned().position
    flying.offboard.set_position_ned(PositionNedYaw(start.north_m + 3.0, start.east_m - 2.0, start.down_m - 1.0, 45.0))
    flying.offboard.start()
    flying.mode("OFFBOARD")
    assert flying.offboard.is_active()
    flying.near(start.north_m + 3.0, start.east_m - 2.0, start.down_m - 1.0, 0.2)
    flying.wait("heading", lambda heading: abs(heading.heading_deg - 45.0) < 3.0)
    flying.offboard.stop()
    flying.mode("HOLD")


def test_offboard_by_velocity(flying: Pilot) -> None:
    from mavsdk.plugins.offboard import VelocityNedYaw

    flying.offboard.set_velocity_ned(VelocityNedYaw(1.0, -2.0, -0.5, 0.0))
    flying.offboard.start()
    flying.wait(
        "velocity_ned", lambda v: hypot(v.north_m_s - 1.0, v.east_m_s + 2.0) < 0.15 and abs(v.down_m_s + 0.5) < 0.15
    )
    flying.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    flying.wait("velocity_ned", lambda v: hypot(v.north_m_s, v.east_m_s, v.down_m_s) < 0.1)


def test_offboard_by_velocity_of_the_body(flying: Pilot) -> None:
    from mavsdk.plugins.offboard import VelocityBodyYawspeed, VelocityNedYaw

    flying.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 90.0))
    flying.offboard.start()
    flying.wait("heading", lambda heading: abs(heading.heading_deg - 90.0) < 3.0)
    flying.offboard.set_velocity_body(VelocityBodyYawspeed(2.0, 1.0, 0.0, 0.0))
    flying.wait("velocity_ned", lambda v: hypot(v.north_m_s + 1.0, v.east_m_s - 2.0) < 0.2)  # looks east
    flying.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 30.0))
    flying.wait("attitude_angular_velocity_body", lambda rate: abs(rate.yaw_rad_s - 0.5236) < 0.05)


def test_offboard_by_acceleration(flying: Pilot) -> None:
    from mavsdk.plugins.offboard import AccelerationNed

    flying.offboard.set_acceleration_ned(AccelerationNed(1.0, 0.0, 0.0))
    flying.offboard.start()
    flying.wait("velocity_ned", lambda v: v.north_m_s > 1.5)
    flying.offboard.set_acceleration_ned(AccelerationNed(-1.0, 0.0, 0.0))
    flying.wait("velocity_ned", lambda v: v.north_m_s < 0.0)


@pytest.mark.parametrize("altitude_type", ["REL_HOME", "AMSL", "AGL"])
def test_offboard_by_global_position(flying: Pilot, altitude_type: str) -> None:
    from mavsdk.plugins.offboard import PositionGlobalYaw

    here, start = flying.telemetry.position(), flying.telemetry.position_velocity_ned().position
    height = here.relative_altitude_m + 1.0
    altitude = here.absolute_altitude_m + 1.0 if altitude_type == "AMSL" else height
    flying.offboard.set_position_global(
        PositionGlobalYaw(
            here.latitude_deg + 3.0 / METRES_PER_DEGREE,
            here.longitude_deg,
            altitude,
            0.0,
            PositionGlobalYaw.AltitudeType[altitude_type],
        )
    )
    flying.offboard.start()
    flying.near(start.north_m + 3.0, start.east_m, start.down_m - 1.0, 0.3)


@pytest.mark.parametrize("accelerated", [False, True])
def test_offboard_by_position_and_its_derivatives(flying: Pilot, accelerated: bool) -> None:
    from mavsdk.plugins.offboard import AccelerationNed, PositionNedYaw, VelocityNedYaw

    start = flying.telemetry.position_velocity_ned().position
    position = PositionNedYaw(start.north_m + 2.0, start.east_m, start.down_m, 0.0)
    velocity, acceleration = VelocityNedYaw(0.0, 0.0, 0.0, 0.0), AccelerationNed(0.0, 0.0, 0.0)
    if accelerated:
        flying.offboard.set_position_velocity_acceleration_ned(position, velocity, acceleration)
    else:
        flying.offboard.set_position_velocity_ned(position, velocity)
    flying.offboard.start()
    flying.near(start.north_m + 2.0, start.east_m, start.down_m, 0.2)


def test_offboard_by_attitude(flying: Pilot) -> None:
    from mavsdk.plugins.offboard import Attitude

    flying.offboard.set_attitude(Attitude(10.0, 0.0, 0.0, 0.5))
    flying.offboard.start()
    flying.wait("attitude_euler", lambda angle: abs(angle.roll_deg - 10.0) < 2.0 and abs(angle.pitch_deg) < 2.0)
    flying.offboard.set_attitude(Attitude(0.0, -8.0, 0.0, 0.5))
    flying.wait("attitude_euler", lambda angle: abs(angle.pitch_deg + 8.0) < 2.0 and abs(angle.roll_deg) < 2.0)


def test_offboard_by_attitude_rates(flying: Pilot) -> None:
    from mavsdk.plugins.offboard import AttitudeRate

    flying.offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, 60.0, 0.5))
    flying.offboard.start()
    flying.wait("attitude_angular_velocity_body", lambda rate: abs(rate.yaw_rad_s - 1.047) < 0.1)
    flying.offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, -30.0, 0.5))
    flying.wait("attitude_angular_velocity_body", lambda rate: abs(rate.yaw_rad_s + 0.524) < 0.1)


def test_offboard_by_actuators_is_ignored_like_by_px4(flying: Pilot) -> None:
    assert flying.command(mavlink.MAV_CMD_DO_SET_ACTUATOR, 0.5) == mavlink.MAV_RESULT_UNSUPPORTED
    assert refused(flying.action.set_actuator, 1, 0.5) in ("UNSUPPORTED", "COMMAND_DENIED")


# --- missions --------------------------------------------------------------------------------------------------------


def _plan(pilot: Pilot, *north_m: float) -> Any:
    """Through points north of here, 4 m up."""
    from mavsdk.plugins.mission import MissionItem, MissionPlan

    here = pilot.telemetry.position()
    return MissionPlan(
        [
            MissionItem(
                here.latitude_deg + north / METRES_PER_DEGREE,
                here.longitude_deg,
                4.0,
                5.0,
                True,
                acceptance_radius_m=1.0,
            )
            for north in north_m
        ]
    )


def test_a_mission_comes_back_as_it_was_sent_and_is_cleared(pilot: Pilot) -> None:
    plan = _plan(pilot, 5.0, 10.0, 15.0)
    pilot.mission.set_return_to_launch_after_mission(False)
    pilot.mission.upload_mission(plan)
    back = pilot.mission.download_mission()
    assert [item.latitude_deg for item in back.mission_items] == pytest.approx(
        [item.latitude_deg for item in plan.mission_items], abs=1e-7
    )
    assert [(item.relative_altitude_m, item.speed_m_s, item.is_fly_through) for item in back.mission_items] == [
        (4.0, 5.0, True)
    ] * 3
    pilot.mission.clear_mission()
    assert pilot.mission.download_mission().mission_items == []


def test_a_mission_is_flown_paused_and_continued(pilot: Pilot) -> None:
    pilot.mission.set_return_to_launch_after_mission(True)
    pilot.action.set_return_to_launch_altitude(4.0)
    pilot.mission.upload_mission(_plan(pilot, 5.0, 15.0, 5.0))
    pilot.action.arm()
    with pilot.values("mission_progress", "mission") as progress:
        pilot.mission.start_mission()
        pilot.mode("MISSION")
        first(progress, lambda p: p.current >= 1, PATIENCE_S, "the first waypoint")
        pilot.mission.pause_mission()
        pilot.mode("HOLD")
        pilot.wait("velocity_ned", lambda v: hypot(v.north_m_s, v.east_m_s, v.down_m_s) < 0.2)
        assert not pilot.mission.is_mission_finished()
        pilot.mission.start_mission()
        pilot.mode("MISSION")
        last = first(progress, lambda p: p.current == p.total, PATIENCE_S, "the last waypoint")
    assert last.total == 3
    pilot.wait("armed", lambda armed: not armed, 60.0)
    assert pilot.mission.is_mission_finished()


def test_a_mission_jumps_to_an_item(pilot: Pilot) -> None:
    pilot.mission.set_return_to_launch_after_mission(False)
    pilot.mission.upload_mission(_plan(pilot, 3.0, 6.0, 9.0))
    pilot.mission.set_current_mission_item(2)
    pilot.wait("mission_progress", lambda p: (p.current, p.total) == (2, 3), plugin="mission")
    assert refused(pilot.mission.set_current_mission_item, 9) in ("INVALID_ARGUMENT", "ERROR")


def test_an_empty_mission_is_not_started(flying: Pilot) -> None:
    assert refused(flying.mission.start_mission) == "DENIED"
    flying.text("MISSION refused: ")
    flying.mode("HOLD")


def _raw(here: Any, *rows: tuple[int, float, float], mission_type: int = 0, param1: float = 0.0) -> list[Any]:
    """Items of (command, north of here in m, height in m), in the frame relative to home."""
    from mavsdk.plugins.mission_raw import MissionItem

    return [
        MissionItem(
            k,
            6,
            command,
            int(k == 0 and mission_type == 0),
            1,
            param1,
            0.0,
            0.0,
            nan if mission_type == 0 else 0.0,
            round((here.latitude_deg + north / METRES_PER_DEGREE) * 1e7),
            round(here.longitude_deg * 1e7),
            height,
            mission_type,
        )
        for k, (command, north, height) in enumerate(rows)
    ]


def _same(a: Any, b: Any) -> bool:
    """Frames 0 and 5, 3 and 6 are the same in MISSION_ITEM_INT."""
    names = ("seq", "command", "autocontinue", "param1", "param2", "param3", "param4", "x", "y", "z", "mission_type")
    pairs = [(getattr(a, name), getattr(b, name)) for name in names]
    same_frame = any({a.frame, b.frame} <= kind for kind in ({0, 5}, {3, 6}))
    return same_frame and all(x == y or (isnan(x) and isnan(y)) for x, y in pairs)


def test_raw_missions_come_back_bit_for_bit_and_fly(pilot: Pilot) -> None:
    raw = pilot.mission_raw
    takeoff, waypoint, land = mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_NAV_LAND
    items = _raw(pilot.telemetry.position(), (takeoff, 0.0, 3.0), (waypoint, 6.0, 3.0), (land, 6.0, 0.0))
    raw.upload_mission(items)
    back = raw.download_mission()
    assert len(back) == 3
    assert all(map(_same, items, back))
    pilot.action.arm()
    raw.start_mission()
    pilot.mode("MISSION")
    start = pilot.telemetry.position()
    pilot.wait("armed", lambda armed: not armed, 60.0)
    landed = pilot.telemetry.position()
    assert (landed.latitude_deg - start.latitude_deg) * METRES_PER_DEGREE == pytest.approx(6.0, abs=0.5)
    raw.clear_mission()
    assert raw.download_mission() == []


def test_a_mission_of_hundreds_of_items(pilot: Pilot) -> None:
    here = pilot.telemetry.position()
    items = _raw(here, *((mavlink.MAV_CMD_NAV_WAYPOINT, 0.1 * k, 3.0) for k in range(300)))
    pilot.mission_raw.upload_mission(items)
    back = pilot.mission_raw.download_mission()
    assert len(back) == 300
    assert all(map(_same, items, back))


def test_a_plan_of_qgroundcontrol_is_flown(pilot: Pilot) -> None:
    here = pilot.telemetry.position()
    lat, lon = here.latitude_deg, here.longitude_deg
    north = lat + 6.0 / METRES_PER_DEGREE

    def item(k: int, command: int, latitude: float, height: float) -> dict[str, Any]:
        return {
            "AMSLAltAboveTerrain": None, "Altitude": height, "AltitudeMode": 1, "autoContinue": True,
            "command": command, "doJumpId": k, "frame": 3, "params": [0, 0, 0, None, latitude, lon, height],
            "type": "SimpleItem",
        }  # fmt: skip

    far = 100.0 / METRES_PER_DEGREE
    square = [[lat + far, lon - far], [lat + far, lon + far], [lat - far, lon + far], [lat - far, lon - far]]
    plan = {
        "fileType": "Plan", "groundStation": "QGroundControl", "version": 1,
        "geoFence": {
            "circles": [{"circle": {"center": [lat, lon], "radius": 80.0}, "inclusion": True, "version": 1}],
            "polygons": [{"polygon": square, "inclusion": True, "version": 1}],
            "version": 2,
        },
        "rallyPoints": {"points": [[north, lon, 5.0]], "version": 2},
        "mission": {
            "cruiseSpeed": 5, "firmwareType": 12, "globalPlanAltitudeMode": 1, "hoverSpeed": 5,
            "items": [item(1, 22, lat, 3.0), item(2, 16, north, 3.0), item(3, 20, 0.0, 0.0)],
            "plannedHomePosition": [lat, lon, here.absolute_altitude_m], "vehicleType": 2, "version": 2,
        },
    }  # fmt: skip
    imported = pilot.mission_raw.import_qgroundcontrol_mission_from_string(json.dumps(plan))
    assert [len(imported.mission_items), len(imported.geofence_items), len(imported.rally_items)] == [3, 5, 1]
    pilot.mission_raw.upload_geofence(imported.geofence_items)
    pilot.mission_raw.upload_rally_points(imported.rally_items)
    pilot.mission_raw.upload_mission(imported.mission_items)
    assert all(map(_same, imported.geofence_items, pilot.mission_raw.download_geofence()))
    assert all(map(_same, imported.rally_items, pilot.mission_raw.download_rallypoints()))
    pilot.action.set_return_to_launch_altitude(4.0)
    pilot.action.arm()
    pilot.mission_raw.start_mission()
    pilot.wait("position", lambda p: (p.latitude_deg - lat) * METRES_PER_DEGREE > 4.0)
    pilot.wait("armed", lambda armed: not armed, 60.0)
    landed = pilot.telemetry.position()
    assert (landed.latitude_deg - lat) * METRES_PER_DEGREE == pytest.approx(6.0, abs=0.5), "not at the rally point"


def test_rally_points(pilot: Pilot) -> None:
    items = _raw(pilot.telemetry.position(), (5100, 20.0, 5.0), (5100, -20.0, 5.0), mission_type=2)
    pilot.mission_raw.upload_rally_points(items)
    back = pilot.mission_raw.download_rallypoints()
    assert len(back) == 2
    assert all(map(_same, items, back))


# --- geofence --------------------------------------------------------------------------------------------------------


def _circle(pilot: Pilot, *, north_m: float = 0.0, radius_m: float) -> Any:
    from mavsdk.plugins.geofence import Circle, FenceType, GeofenceData, Point

    here = pilot.telemetry.position()
    centre = Point(here.latitude_deg + north_m / METRES_PER_DEGREE, here.longitude_deg)
    return GeofenceData([], [Circle(centre, radius_m, FenceType.INCLUSION)])


def test_a_fence_comes_back_as_it_was_sent_and_is_cleared(pilot: Pilot) -> None:
    from mavsdk.plugins.geofence import Circle, FenceType, GeofenceData, Point, Polygon

    here = pilot.telemetry.position()

    def point(north: float, east: float) -> Any:
        return Point(here.latitude_deg + north / METRES_PER_DEGREE, here.longitude_deg + east / METRES_PER_DEGREE)

    square = Polygon([point(30, -30), point(30, 30), point(-30, 30), point(-30, -30)], FenceType.INCLUSION)
    pilot.geofence.upload_geofence(GeofenceData([square], [Circle(point(10, 0), 3.0, FenceType.EXCLUSION)]))
    back = pilot.geofence.download_geofence()
    assert [(len(each.points), each.fence_type) for each in back.polygons] == [(4, FenceType.INCLUSION)]
    assert [(each.radius, each.fence_type) for each in back.circles] == [(3.0, FenceType.EXCLUSION)]
    assert back.polygons[0].points[1].latitude_deg == pytest.approx(square.points[1].latitude_deg, abs=1e-7)
    pilot.geofence.clear_geofence()
    assert pilot.mission_raw.download_geofence() == []


@pytest.mark.parametrize(("action", "mode"), [(2, "HOLD"), (3, "RETURN_TO_LAUNCH"), (5, "LAND")])
def test_leaving_the_fence(flying: Pilot, action: int, mode: str) -> None:
    from mavsdk.plugins.offboard import VelocityNedYaw

    flying.param.set_param_int("GF_ACTION", action)
    flying.geofence.upload_geofence(_circle(flying, radius_m=6.0))
    flying.offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 0.0))
    flying.offboard.start()
    flying.mode("OFFBOARD")
    flying.mode(mode)
    assert "fence" in flying.text("ence").lower()


def test_a_goto_out_of_the_fence_is_refused(flying: Pilot) -> None:
    flying.geofence.upload_geofence(_circle(flying, radius_m=20.0))
    here = flying.telemetry.position()
    out = here.latitude_deg + 50.0 / METRES_PER_DEGREE
    assert refused(flying.action.goto_location, out, here.longitude_deg, here.absolute_altitude_m, nan) == (
        "COMMAND_DENIED"
    )


# --- files -----------------------------------------------------------------------------------------------------------


def test_the_log_is_downloaded_while_it_grows(tmp_path: Path) -> None:
    target = tmp_path / "downloaded.ulg"
    with sitl(speed=SPEED, run_dir=tmp_path / "run") as own, connected(own) as pilot:
        pilot.wait("health_all_ok", bool)
        pilot.fly()
        (entry,) = pilot.log_files.get_entries()
        (source,) = (tmp_path / "run").glob("**/*.ulg")
        assert finished(pilot.log_files.download_log_file_async, entry, str(target)) == "SUCCESS"
        assert len(target.read_bytes()) == entry.size_bytes > 10_000
        assert target.read_bytes() == source.read_bytes()[: entry.size_bytes]


def test_files_go_to_the_card_and_come_back(pilot: Pilot, folder: Path, tmp_path: Path) -> None:
    ftp, card = pilot.ftp, "/fs/microsd"
    source = tmp_path / "letter.bin"
    source.write_bytes(bytes(range(256)) * 20)
    ftp.create_directory(f"{card}/post")
    assert finished(ftp.upload_async, str(source), f"{card}/post") == "SUCCESS"
    assert (folder / "state" / "card" / "post" / "letter.bin").read_bytes() == source.read_bytes()
    entries = ftp.list_directory(f"{card}/post").entries
    assert [(entry.name, entry.entry_type.name, entry.size_bytes) for entry in entries] == [
        ("letter.bin", "FILE", 5120)
    ]
    assert ftp.are_files_identical(str(source), f"{card}/post/letter.bin")
    for burst in (False, True):
        back = tmp_path / f"burst-{burst}"
        back.mkdir()
        assert finished(ftp.download_async, f"{card}/post/letter.bin", str(back), burst) == "SUCCESS"
        assert (back / "letter.bin").read_bytes() == source.read_bytes()
    ftp.rename(f"{card}/post/letter.bin", f"{card}/post/old.bin")
    ftp.remove_file(f"{card}/post/old.bin")
    ftp.remove_directory(f"{card}/post")
    assert not (folder / "state" / "card" / "post").exists()


def test_ftp_keeps_to_its_root(pilot: Pilot, tmp_path: Path) -> None:
    assert refused(pilot.ftp.list_directory, "/fs/microsd/../../../../..") not in ("SUCCESS", "TIMEOUT")
    assert refused(pilot.ftp.remove_file, "/fs/microsd/none") == "FILE_DOES_NOT_EXIST"
    assert finished(pilot.ftp.download_async, "/etc/passwd", str(tmp_path), False) == "FILE_DOES_NOT_EXIST"


def test_component_metadata_that_the_dialect_lacks_is_refused_at_once(pilot: Pilot) -> None:
    from mavsdk.plugins.component_metadata import MetadataType

    pilot.component_metadata.request_autopilot_component()
    pilot.text("Request refused: message 397 is not served")
    assert refused(pilot.component_metadata.get_metadata, 1, MetadataType.PARAMETER) == "NOT_AVAILABLE"


# --- telemetry -------------------------------------------------------------------------------------------------------

RATES = {
    "position": 20.0, "home": 2.0, "in_air": 4.0, "landed_state": 4.0, "vtol_state": 4.0, "attitude_quaternion": 20.0,
    "attitude_euler": 20.0, "velocity_ned": 10.0, "gps_info": 5.0, "raw_gps": 5.0, "battery": 2.0, "odometry": 10.0,
    "position_velocity_ned": 20.0, "fixedwing_metrics": 10.0, "imu": 20.0, "unix_epoch_time": 4.0, "altitude": 10.0,
    "ground_truth": 15.0, "rc_status": 5.0, "health": 2.0,
}  # fmt: skip
ABSENT = ("actuator_control_target", "distance_sensor", "scaled_imu", "raw_imu")


def test_every_rate_is_set(client: Pilot) -> None:
    for name, rate in RATES.items():
        getattr(client.telemetry, f"set_rate_{name}")(rate)
    for name in ABSENT:
        assert refused(getattr(client.telemetry, f"set_rate_{name}"), 1.0) in ("COMMAND_DENIED", "UNSUPPORTED"), name


@pytest.mark.parametrize("rate_hz", [30.0, 7.0])
def test_rates_are_kept(client: Pilot, rate_hz: float) -> None:
    """By the vehicle's own clock."""
    client.telemetry.set_rate_attitude_euler(rate_hz)
    with client.values("attitude_euler") as values:
        for _ in range(5):
            values.get(timeout=PATIENCE_S)
        stamps_us = [values.get(timeout=PATIENCE_S).timestamp_us for _ in range(int(2 * rate_hz) + 1)]
    assert 1e6 * (len(stamps_us) - 1) / (stamps_us[-1] - stamps_us[0]) == pytest.approx(rate_hz, rel=0.02)


def test_what_is_shown_is_there(client: Pilot) -> None:
    gps, battery = client.wait("gps_info", lambda _: True), client.wait("battery", lambda _: True)
    assert gps.num_satellites >= 6
    assert gps.fix_type.name in ("FIX_3D", "FIX_DGPS", "RTK_FLOAT", "RTK_FIXED")
    assert battery.voltage_v > 10.0
    assert 0.0 < battery.remaining_percent <= 100.0
    for stream in ("imu", "odometry", "unix_epoch_time", "altitude", "scaled_pressure", "fixedwing_metrics"):
        client.wait(stream, lambda _: True)
    imu = client.telemetry.imu()
    assert imu.acceleration_frd.down_m_s2 == pytest.approx(-9.8, abs=0.5)
    origin = client.telemetry.get_gps_global_origin()
    assert hypot(origin.latitude_deg - client.telemetry.home().latitude_deg, 0.0) < 0.01


# --- sticks ----------------------------------------------------------------------------------------------------------


class _Sticks:
    """Someone who holds the sticks: sends their position each time the vehicle reports an attitude."""

    def __init__(self, pilot: Pilot) -> None:
        self.axes = (0.0, 0.0, 0.5, 0.0)
        self._pilot = pilot

    def __enter__(self) -> _Sticks:
        control, telemetry = self._pilot.manual_control, self._pilot.telemetry
        control.set_manual_control_input(*self.axes)
        self._handle = telemetry.subscribe_position_velocity_ned(
            lambda *_: control.set_manual_control_input(*self.axes)
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._pilot.telemetry.unsubscribe_position_velocity_ned(self._handle)


def test_flies_by_sticks(flying: Pilot) -> None:
    with _Sticks(flying) as sticks:
        flying.manual_control.start_position_control()
        flying.mode("POSCTL")
        sticks.axes = (0.5, 0.0, 0.5, 0.0)  # forward
        flying.wait("velocity_ned", lambda v: hypot(v.north_m_s, v.east_m_s) > 1.0)
        sticks.axes = (0.0, 0.0, 0.5, 0.0)
        flying.wait("velocity_ned", lambda v: hypot(v.north_m_s, v.east_m_s) < 0.2)
        sticks.axes = (0.0, 0.0, 1.0, 0.0)
        flying.wait("velocity_ned", lambda v: v.down_m_s < -1.0)
        sticks.axes = (0.0, 0.0, 0.5, 0.0)
        flying.manual_control.start_altitude_control()
        flying.mode("ALTCTL")
        flying.action.hold()
        flying.mode("HOLD")


def test_sticks_are_needed(pilot: Pilot) -> None:
    fresh = type(pilot.manual_control)(pilot.system)
    assert refused(fresh.start_position_control) == "INPUT_NOT_SET"


# --- what there is not -----------------------------------------------------------------------------------------------


def test_there_is_no_gimbal_to_calibrate(pilot: Pilot) -> None:
    """Asked of a component that is not there: nobody answers, MAVSDK gives up by itself."""
    assert finished(pilot.calibration.calibrate_gimbal_accelerometer_async, limit_s=QUIET_S) == "TIMEOUT"


@pytest.mark.parametrize("sensor", ["gyro", "accelerometer", "magnetometer", "level_horizon"])
def test_calibration_is_refused_at_once(pilot: Pilot, sensor: str) -> None:
    start = getattr(pilot.calibration, f"calibrate_{sensor}_async")
    assert finished(start, limit_s=QUIET_S) in ("COMMAND_DENIED", "UNSUPPORTED", "FAILED")


def test_there_is_no_shell(pilot: Pilot) -> None:
    from mavsdk.plugins.shell import Device

    pilot.shell.send("ver all\n", Device.SHELL)  # MAVSDK does not wait for an answer
    with pilot.values("receive", "shell") as values:
        pilot.wait("position", lambda _: True)
        assert values.empty()


def test_failures_are_not_injected_unless_enabled(pilot: Pilot) -> None:
    from mavsdk.plugins.failure import FailureType, FailureUnit

    assert refused(pilot.failure.inject, FailureUnit.SENSOR_GPS, FailureType.OFF, 0) in ("DISABLED", "DENIED")
    pilot.param.set_param_int("SYS_FAILURE_EN", 1)
    unit, off = mavlink.FAILURE_UNIT_SYSTEM_SERVO, mavlink.FAILURE_TYPE_OFF  # MAVSDK remembers the parameter
    assert pilot.command(mavlink.MAV_CMD_INJECT_FAILURE, unit, off) == mavlink.MAV_RESULT_UNSUPPORTED


def test_there_is_no_camera_and_no_gimbal(pilot: Pilot) -> None:
    assert pilot.camera.camera_list().cameras == []
    assert pilot.gimbal.gimbal_list().gimbals == []
    assert not pilot.system.has_camera()
    assert not pilot.system.has_gimbal()


def test_no_events_no_hang(pilot: Pilot) -> None:
    with pilot.values("events", "events") as values:
        assert refused(pilot.events.get_health_and_arming_checks_report) == "NOT_AVAILABLE"
        pilot.wait("position", lambda _: True)
        assert values.empty()


def test_log_streaming_is_refused(pilot: Pilot) -> None:
    assert refused(pilot.log_streaming.start_log_streaming) in ("UNSUPPORTED", "COMMAND_DENIED")


def test_a_tune_is_ignored(pilot: Pilot) -> None:
    pilot.send("PLAY_TUNE", tune="MFT200L4CDEFG", tune2="")  # MAVSDK 4.1's own tune plugin cannot encode a tune
    pilot.wait("position", lambda _: True)
    assert pilot.texts == []


def test_a_text_from_a_ground_station_harms_nothing(pilot: Pilot) -> None:
    from mavsdk.plugins.server_utility import StatusTextType

    pilot.server_utility.send_status_text(StatusTextType.INFO, "hello")
    pilot.wait("position", lambda _: True)
