"""Fly along waypoints by MAVSDK: take off, go to each off-board, land."""

import queue
import time
from math import dist

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.offboard import Offboard, PositionNedYaw
from mavsdk.plugins.telemetry import Telemetry

PATIENCE_S = 30.0


class NoVehicle(Exception):
    """Nobody answers at this address."""


class Survey:
    """`url` as MAVSDK writes it, udpin://127.0.0.1:14540 of PX4 SITL. In a `with` block, which ends the connection."""

    def __init__(self, url, height_m=3.0):
        self._mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
        self._mavsdk.add_any_connection(url)
        self._vehicle = self._mavsdk.first_autopilot(PATIENCE_S)
        if self._vehicle is None:
            self._mavsdk.destroy()
            raise NoVehicle(url)
        self._action, self._telemetry = Action(self._vehicle), Telemetry(self._vehicle)
        self._offboard = Offboard(self._vehicle)
        self.height_m = height_m

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._mavsdk.destroy()

    def fly(self, waypoints, within_m=0.4):
        """`waypoints` are (north, east) in metres from where it took off; gives those that it has reached."""
        self._wait(self._telemetry.subscribe_health_all_ok, bool)
        self._action.set_takeoff_altitude(self.height_m)
        self._action.arm()
        self._action.takeoff()
        self._wait(self._telemetry.subscribe_position, lambda now: now.relative_altitude_m > 0.9 * self.height_m)
        reached = []
        for north_m, east_m in waypoints:
            there = north_m, east_m, -self.height_m
            self._offboard.set_position_ned(PositionNedYaw(*there, 0.0))
            if not reached:
                self._offboard.start()  # an autopilot wants a setpoint before it goes off-board
            self._wait(
                self._telemetry.subscribe_position_velocity_ned,
                lambda now, there=there: dist(there, _ned(now.position)) < within_m,
            )
            reached.append((north_m, east_m))
        self._offboard.stop()
        self._action.land()
        self._wait(self._telemetry.subscribe_armed, lambda armed: not armed)
        return reached

    def _wait(self, subscribe, condition):
        """The first value of a subscription that fulfils the condition. Raises `TimeoutError`."""
        values = queue.SimpleQueue()
        subscribe(lambda value, _: values.put(value))
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            try:
                value = values.get(timeout=1.0)
            except queue.Empty:
                continue
            if condition(value):
                return value
        raise TimeoutError(f"{subscribe.__name__}: not within {PATIENCE_S:g} s")


def _ned(position):
    return position.north_m, position.east_m, position.down_m
