"""A client for the score board, by MAVSDK: `mavsitl bench --program "python bench_mavsdk.py {url} {reference}"`.

It sends each row of the reference when its time has come, as position, velocity and acceleration. Put your own law
where `send` is called: the state of the vehicle is in `now`.
"""

import csv
import queue
import sys
from pathlib import Path

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.offboard import AccelerationNed, Offboard, PositionNedYaw, VelocityNedYaw
from mavsdk.plugins.telemetry import LandedState, Telemetry

RATE_HZ = 50.0

url, reference = sys.argv[1:]
with Path(reference).open(newline="") as file:
    rows = [tuple(map(float, row)) for row in list(csv.reader(file))[1:]]

mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
mavsdk.add_any_connection(url)
vehicle = mavsdk.first_autopilot(30.0)
if vehicle is None:
    sys.exit(f"no vehicle at {url}")
action, telemetry, offboard = Action(vehicle), Telemetry(vehicle), Offboard(vehicle)


def send(row, above_m=0.0):
    _, north, east, down, *rest, yaw = row
    velocity, acceleration = rest[:3], rest[3:]
    offboard.set_position_velocity_acceleration_ned(
        PositionNedYaw(north, east, down - above_m, yaw),
        VelocityNedYaw(*velocity, yaw),
        AccelerationNed(*acceleration),
    )


# MAVSDK calls back from threads of its own, in which it must not be called: what it tells is put into a queue.
told = queue.SimpleQueue()
telemetry.subscribe_odometry(lambda now, _: told.put(now))
telemetry.subscribe_landed_state(lambda state, _: told.put(state))
telemetry.set_rate_odometry(RATE_HZ)
telemetry.set_rate_landed_state(10.0)

send(rows[0], above_m=1.0)  # a vehicle at rest rises where it is asked to
offboard.start()
action.arm()

began_us, now_us = None, 0
while True:  # until the bench ends it
    now = told.get(timeout=30.0)
    if isinstance(now, LandedState):
        if began_us is None and now in (LandedState.TAKING_OFF, LandedState.IN_AIR):
            began_us = now_us
            print("in the air", flush=True)
        continue
    now_us = now.time_usec  # the vehicle's clock, not ours: it may be faster (--speed)
    if began_us is not None:
        send(rows[min(round((now_us - began_us) * 1e-6 * RATE_HZ), len(rows) - 1)])
