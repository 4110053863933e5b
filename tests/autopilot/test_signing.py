"""Signing as the vehicle wires it: the key by SETUP_SIGNING, the demand by MAV_SIGN_CFG, both across a restart."""

from __future__ import annotations

import stat
from pathlib import Path

from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.keep import carry_out
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.signing import EPOCH_UNIX_US, Key, setup_signing
from tests.autopilot.conftest import flight

KEY = Key(bytes(range(32)))
ALWAYS = 2
GROUND = (255, 190)
START_UNIX_US = 1_790_000_000_000_000


class Signer:
    """A vehicle whose wall clock is the test's, and a ground station with a key."""

    def __init__(self, folder: Path, *, trusted: bool = True, begin_us: int = 0) -> None:
        self.clock_us = START_UNIX_US + begin_us
        self.vehicle = Vehicle(
            flight(), MemoryRecorder(), seed=1, ports=("offboard", "gcs"), state=folder,
            unix_us=lambda: self.clock_us, trusted=trusted,
        )  # fmt: skip
        self.now_us = 0
        self.vehicle.step(0)
        self._collect()

    @property
    def stamp(self) -> int:
        return (self.clock_us - EPOCH_UNIX_US) // 10

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 250)):
            self.now_us += 4000
            self.clock_us += 4000
            self.vehicle.step(self.now_us)
            self._collect()
        carry_out(self.vehicle)

    def _collect(self) -> None:
        self.frames = [frame for data in self.vehicle.datagrams(0, combine=False) for frame in parse(data)]
        self.vehicle.datagrams(1, combine=False)

    def set_up(self) -> None:
        self.vehicle.receive(0, encode(setup_signing((1, 1), KEY, self.stamp), 0, *GROUND))

    def command(self, *, signed: bool) -> int:
        """The number of frames the vehicle believed."""
        message = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_GET_HOME_POSITION, 0, *[0.0] * 7)
        frame = encode(message, 1, *GROUND)
        if signed:
            self.clock_us += 1000
            frame = KEY.sign(frame, 1, self.stamp)
        return self.vehicle.receive(0, frame)

    def all_signed(self) -> bool:
        while not self.frames:
            self.run(0.004)
        return all(frame.signed for frame in self.frames)


def test_key_and_demand_hold_and_survive_a_restart(tmp_path: Path) -> None:
    ground = Signer(tmp_path)
    assert not ground.all_signed()
    ground.set_up()
    assert ground.command(signed=False) == 1  # MAV_SIGN_CFG 0: a key alone demands nothing
    assert ground.vehicle.parameters.set("MAV_SIGN_CFG", ALWAYS) is None
    ground.run(1.5)
    assert ground.all_signed()
    assert ground.command(signed=False) == 0
    assert ground.command(signed=True) == 1
    kept = tmp_path / "signing.json"
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    ground.vehicle.close()
    carry_out(ground.vehicle)

    again = Signer(tmp_path, begin_us=5_000_000)
    assert again.all_signed()
    assert again.command(signed=False) == 0
    again.clock_us += 2_000_000
    assert again.command(signed=True) == 1


def test_the_first_key_is_not_taken_from_a_network(tmp_path: Path) -> None:
    ground = Signer(tmp_path, trusted=False)
    ground.set_up()
    assert ground.vehicle.parameters.set("MAV_SIGN_CFG", ALWAYS) is None
    ground.run(1.5)
    assert not ground.all_signed()
    assert ground.command(signed=False) == 1


def test_an_armed_vehicle_keeps_its_key(tmp_path: Path) -> None:
    ground = Signer(tmp_path)
    ground.vehicle.autopilot.commander.request_arm(True, False, 0)
    ground.run(0.1)
    ground.set_up()
    assert ground.vehicle.parameters.set("MAV_SIGN_CFG", ALWAYS) is None
    ground.run(0.1)
    assert not ground.all_signed()


def test_a_damaged_key_file_still_boots(tmp_path: Path) -> None:
    (tmp_path / "signing.json").write_text('{"schema": 1, "content": {"state": "00"}}')
    ground = Signer(tmp_path)
    ground.run(0.1)
    assert not ground.all_signed()


def test_the_key_is_in_no_parameter_log_or_file_that_is_served(tmp_path: Path) -> None:
    ground = Signer(tmp_path)
    ground.set_up()
    ground.run(1.5)
    ground.vehicle.close()
    carry_out(ground.vehicle)
    secret = bytes(range(32))
    served = [path for path in (tmp_path / "card").rglob("*") if path.is_file()]
    others = [path for path in tmp_path.iterdir() if path.is_file() and path.name != "signing.json"]
    for path in (*served, *others):
        data = path.read_bytes()
        assert secret not in data
        assert secret.hex().encode() not in data
    assert secret.hex() not in repr(ground.vehicle.__dict__)
