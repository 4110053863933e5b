"""Signing as the vehicle wires it: the key by SETUP_SIGNING, the demand by MAV_SIGN_CFG, both across a restart."""

from __future__ import annotations

import stat
from pathlib import Path

from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import Frame, encode, parse
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


def test_no_replay_after_a_kill_and_who_hears_the_vehicle_is_let_in(tmp_path: Path) -> None:
    """Killed, not closed: what was heard before is old afterwards, and so is what was signed meanwhile."""
    ground = Signer(tmp_path)
    ground.set_up()
    assert ground.vehicle.parameters.set("MAV_SIGN_CFG", ALWAYS) is None
    ground.run(2.0)
    message = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_GET_HOME_POSITION, 0, *[0.0] * 7)
    recorded = [KEY.sign(encode(message, n, *GROUND), link, ground.stamp + n) for n, link in enumerate((1, 1, 2))]
    assert [ground.vehicle.receive(0, frame) for frame in recorded[:2]] == [1, 1]
    ground.run(0.3)

    again = Signer(tmp_path, begin_us=ground.clock_us - START_UNIX_US + 100_000)
    assert [again.vehicle.receive(0, frame) for frame in recorded] == [0, 0, 0]
    assert again.command(signed=True) == 0  # its clock has not heard of ours
    assert again.all_signed()
    heard = max(int.from_bytes(frame.raw[-12:-6], "little") for frame in again.frames)
    frame = KEY.sign(encode(message, 3, *GROUND), 1, max(heard, again.stamp) + 1)
    assert again.vehicle.receive(0, frame) == 1
    assert again.vehicle.receive(0, frame) == 0


def test_a_killed_vehicle_does_not_sign_a_stamp_twice(tmp_path: Path) -> None:
    ground = Signer(tmp_path)
    ground.set_up()
    assert ground.vehicle.parameters.set("MAV_SIGN_CFG", ALWAYS) is None
    ground.run(2.0)
    last = max(int.from_bytes(f.raw[-12:-6], "little") for f in ground.frames or _some(ground))
    again = Signer(tmp_path, begin_us=0)  # the system's clock was set back, too
    first = min(int.from_bytes(f.raw[-12:-6], "little") for f in again.frames or _some(again))
    assert first > last


def _some(ground: Signer) -> list[Frame]:
    assert ground.all_signed()
    return ground.frames


def test_the_key_s_file_is_its_owner_s_and_so_is_a_folder_made_for_it(tmp_path: Path) -> None:
    state = tmp_path / "deep" / "state"
    ground = Signer(state)
    ground.set_up()
    ground.run(1.5)
    assert stat.S_IMODE((state / "signing.json").stat().st_mode) == 0o600
    assert stat.S_IMODE(state.stat().st_mode) == 0o700
    ground.vehicle.close()


def test_a_flood_of_forged_frames_locks_nobody_out_and_fills_no_table(tmp_path: Path) -> None:
    ground = Signer(tmp_path)
    ground.set_up()
    assert ground.vehicle.parameters.set("MAV_SIGN_CFG", ALWAYS) is None
    ground.run(1.5)
    forger = Key(bytes(range(1, 33)))
    message = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    believed = 0
    for number in range(3000):
        sender = GROUND if number % 2 else (1 + number % 250, number % 256)
        forged = forger.sign(encode(message, number & 0xFF, *sender), number & 0xFF, 2**48 - 16)
        believed += ground.vehicle.receive(0, forged)
    assert believed == 0
    signing = ground.vehicle._signing
    assert signing is not None
    assert signing.streams <= 1
    assert ground.command(signed=True) == 1
