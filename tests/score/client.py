"""A small client by pymavlink alone: `python client.py ENDPOINT REFERENCE [--quit-after S]`.

It knows nothing of mavsitl: it waits for a vehicle, streams position setpoints out of the CSV file, takes OFFBOARD,
arms, and goes by the vehicle's clock from the moment that it is in the air.
"""

import csv
import sys
import time

from pymavlink import mavutil

OFFBOARD = 6
MASK = 0b100_000_000_000  # all but the yaw rate
IN_AIR = (mavutil.mavlink.MAV_LANDED_STATE_IN_AIR, mavutil.mavlink.MAV_LANDED_STATE_TAKEOFF)


def main() -> None:
    endpoint, reference, *rest = sys.argv[1:]
    quit_after_s = float(rest[1]) if rest else float("inf")
    with open(reference, newline="") as file:  # noqa: PTH123
        rows = [[float(cell) for cell in row] for row in list(csv.reader(file))[1:]]
    link = mavutil.mavlink_connection(endpoint, source_system=250, source_component=191)
    link.wait_heartbeat()
    print("vehicle", link.target_system, flush=True)
    interval = mavutil.mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    for message, interval_us in ((245, 100_000), (32, 20_000)):
        link.mav.command_long_send(1, 1, interval, 0, message, interval_us, 0, 0, 0, 0, 0)
    began_ms = None
    now_ms, asked_s, armed, offboard = 0, 0.0, 0, False
    while True:
        message = link.recv_match(
            type=["HEARTBEAT", "EXTENDED_SYS_STATE", "LOCAL_POSITION_NED"], blocking=True, timeout=1.0
        )
        if message is None:
            continue
        kind = message.get_type()
        if kind == "HEARTBEAT":
            offboard = message.custom_mode >> 16 & 0xFF == OFFBOARD
            armed = message.base_mode & mavutil.mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        elif kind == "EXTENDED_SYS_STATE" and began_ms is None and message.landed_state in IN_AIR:
            began_ms = now_ms
            print("in the air", flush=True)
        elif kind == "LOCAL_POSITION_NED":
            now_ms = message.time_boot_ms
            time_s = 0.0 if began_ms is None else (now_ms - began_ms) / 1000.0
            if time_s > quit_after_s:
                print("enough", flush=True)
                sys.exit(3)
            row = list(rows[min(int(time_s * 50.0), len(rows) - 1)])
            if began_ms is None:
                row[3] -= 1.0  # a metre higher: it rises only where it is asked to
            link.mav.set_position_target_local_ned_send(
                now_ms, 1, 1, mavutil.mavlink.MAV_FRAME_LOCAL_NED, MASK, *row[1:10], row[10] * 0.0174532925, 0.0
            )
        if began_ms is None and time.monotonic() - asked_s > 0.5:
            asked_s = time.monotonic()
            if not offboard:
                link.mav.command_long_send(1, 1, mavutil.mavlink.MAV_CMD_DO_SET_MODE, 0, 1, OFFBOARD, 0, 0, 0, 0, 0)
            elif not armed:
                link.mav.command_long_send(1, 1, mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)


if __name__ == "__main__":
    main()
