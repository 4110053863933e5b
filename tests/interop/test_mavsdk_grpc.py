"""MAVSDK's gRPC line: its server program on the off-board link, and the asynchronous Python classes that talk to it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from math import nan
from pathlib import Path
from typing import Any

import pytest
from mavsitl_vehicle.autopilot.parameters import TABLE

from mavsitl.link.udp import LOOPBACK
from mavsitl.pair import free_ports
from tests.interop.conftest import PATIENCE_S, Sitl, sitl
from tests.interop.process import server

mavsdk_grpc = pytest.importorskip("mavsdk_grpc", reason="the gRPC MAVSDK is not installed")

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

SPEED = 3.0

HOME = 47.397742, 8.545594
NORTH_DEG = 5e-5  # 5.6 m


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Sitl]:
    with sitl(speed=SPEED) as running:
        yield running


@pytest.fixture(scope="module")
def address(vehicle: Sitl, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port at which mavsdk_server serves; the Python package would start it with a call that Python deprecates."""
    program = Path(mavsdk_grpc.__file__).parent / "bin" / "mavsdk_server"
    if not program.exists():
        pytest.skip("this platform's package has no mavsdk_server")
    (port,) = free_ports(1)
    command = [str(program), "-p", str(port), f"udpin://{LOOPBACK}:{vehicle.offboard_port}"]
    with server(command, tmp_path_factory.mktemp("grpc") / "server.log"):
        yield port


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[Any]:
    system = mavsdk_grpc.System(LOOPBACK, port)
    await system.connect()
    await first(system.core.connection_state(), lambda state: state.is_connected)
    yield system


async def first(stream: Any, condition: Callable[[Any], bool], limit_s: float = PATIENCE_S) -> Any:
    """The first value of a stream that fulfils `condition`."""
    async with asyncio.timeout(limit_s):
        async for value in stream:
            if condition(value):
                return value
    raise AssertionError("the stream has ended")


def run(port: int, test: Callable[[Any], Awaitable[None]]) -> None:
    async def whole() -> None:
        async with connected(port) as system:
            await test(system)

    asyncio.run(whole())


def test_it_knows_the_vehicle_and_its_parameters(address: int) -> None:
    async def test(system: Any) -> None:
        await first(system.telemetry.health_all_ok(), bool)
        version = await system.info.get_version()
        assert (version.flight_sw_major, version.flight_sw_minor) == (1, 17)
        everything = await system.param.get_all_params()
        named = {each.name: each.value for each in (*everything.int_params, *everything.float_params)}
        assert named.keys() - {"_HASH_CHECK"} == TABLE.keys()
        assert await system.param.get_param_int("SYS_AUTOSTART") == TABLE["SYS_AUTOSTART"].default
        await system.param.set_param_float("MIS_TAKEOFF_ALT", 3.0)
        assert await system.param.get_param_float("MIS_TAKEOFF_ALT") == 3.0
        await system.param.set_param_int("COM_RC_IN_MODE", 3)
        assert await system.param.get_param_int("COM_RC_IN_MODE") == 3
        with pytest.raises(mavsdk_grpc.param.ParamError, match="DOES_NOT_EXIST"):
            await system.param.get_param_float("NO_SUCH_THING")

    run(address, test)


def test_it_moves_a_mission_to_and_fro(address: int) -> None:
    from mavsdk_grpc.mission import MissionItem, MissionPlan

    def item(n: int) -> Any:
        return MissionItem(
            HOME[0] + n * NORTH_DEG, HOME[1], 3.0 + n, 5.0, True, nan, nan, MissionItem.CameraAction.NONE, nan, nan,
            1.0, nan, nan, MissionItem.VehicleAction.NONE,
        )  # fmt: skip

    async def test(system: Any) -> None:
        await system.mission.upload_mission(MissionPlan([item(n) for n in range(4)]))
        got = (await system.mission.download_mission()).mission_items
        assert [(at.latitude_deg, at.relative_altitude_m, at.speed_m_s, at.is_fly_through) for at in got] == [
            (pytest.approx(HOME[0] + n * NORTH_DEG, abs=1e-7), 3.0 + n, 5.0, True) for n in range(4)
        ]
        await system.mission.clear_mission()
        assert not (await system.mission.download_mission()).mission_items

    run(address, test)


def test_it_flies_off_board(address: int) -> None:
    from mavsdk_grpc.offboard import OffboardError, VelocityNedYaw

    async def test(system: Any) -> None:
        await first(system.telemetry.health_all_ok(), bool)
        await system.action.set_takeoff_altitude(3.0)
        await system.action.arm()
        await system.action.takeoff()
        await first(system.telemetry.position(), lambda position: position.relative_altitude_m > 2.85)
        with pytest.raises(OffboardError, match="NO_SETPOINT_SET"):
            await system.offboard.start()
        await system.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
        await system.offboard.start()
        await first(system.telemetry.flight_mode(), lambda mode: mode.name == "OFFBOARD")
        await system.offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 0.0))
        await first(system.telemetry.velocity_ned(), lambda v: v.north_m_s > 1.9 and abs(v.east_m_s) < 0.2)
        await system.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
        await first(system.telemetry.velocity_ned(), lambda v: abs(v.north_m_s) < 0.1)
        await system.offboard.stop()
        await first(system.telemetry.flight_mode(), lambda mode: mode.name == "HOLD")
        await system.action.land()
        await first(system.telemetry.landed_state(), lambda state: state.name == "ON_GROUND")
        await first(system.telemetry.armed(), lambda armed: not armed)

    run(address, test)
