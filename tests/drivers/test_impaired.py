"""Lock-step over an impaired link: the same bytes from one process and from two, late news, and an end in any case."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers, ends, pair
from mavsitl.drivers import LockstepError, Tap
from mavsitl.ends import NullRecorder
from mavsitl.link.base import LinkError, LinkSilent
from mavsitl.link.exchange import HELLO, pack
from mavsitl.link.impaired import Channels, channels_for
from mavsitl.log import topics
from mavsitl.log.tlog import Direction, WireHash
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import Flight, Impairment, LinkModel
from tests.drivers.exercise import fly_in_memory, hash_in_memory, shortened
from tests.drivers.test_lockstep import Counter, Scripted

BAD: dict[str, Any] = {
    "latency_ms": 12.0, "jitter_ms": 6.0, "distribution": "gamma", "loss": 0.1, "bursts.bad_ms": 50.0,
    "bursts.good_ms": 400.0, "reorder": 0.02, "duplicate": 0.05, "corrupt": 0.05, "bandwidth_kbit_s": 2000.0,
}  # fmt: skip


def both(settings: dict[str, Any]) -> dict[str, Any]:
    return {f"link.{way}.{key}": value for way in ("to_ground", "to_vehicle") for key, value in settings.items()}


def impaired(name: str, duration_s: float, settings: dict[str, Any], **more: Any) -> Flight:
    return shortened(name, duration_s, **both(settings), **more)


def channels(**settings: Any) -> Channels:
    """Both ways the same; the queue is not the default, so that there are channels in any case."""
    made = Impairment(queue_bytes=9000, **settings)
    found = channels_for(LinkModel(to_ground=made, to_vehicle=made), 1)
    assert found is not None
    return found


@pytest.mark.sockets
def test_two_processes_over_a_bad_link_put_the_same_bytes_on_the_wire(tmp_path: Path) -> None:
    flight = impaired("hover-wind", 2.0, BAD, controller__level="attitude")
    in_memory = hash_in_memory(flight)
    assert hash_in_memory(flight) == in_memory
    settings = ["duration_s=2.0", "controller.level=attitude"]
    settings += [f'{key}="{value}"' if isinstance(value, str) else f"{key}={value}" for key, value in both(BAD).items()]
    result = pair.fly("hover-wind", settings, tmp_path, lambda end, event: None)
    assert result.vehicle["finished"] is True
    assert result.ground["finished"] is True
    assert result.vehicle["wire_hash"] == result.ground["wire_hash"] == in_memory
    statistics = result.vehicle["link"]
    same = ends.in_memory(flight, None, report=lambda text: None, progress=None)
    assert {"link": statistics} == same.links
    for way in ("to_ground", "to_vehicle"):
        counts = statistics[way]
        assert counts["sent"] > 500
        assert all(counts[name] > 0 for name in ("lost", "corrupted", "duplicated", "reordered", "late"))
    assert "link" not in result.ground


def test_another_seed_is_another_fate() -> None:
    quiet = {f"noise__{key}": 0.0 for key in ("position_m", "velocity_m_s", "attitude_deg", "rate_deg_s")}
    flights = [impaired("hover-calm", 1.0, {"loss": 0.2}, seed=seed, **quiet) for seed in (1, 2)]
    assert len({hash_in_memory(flight) for flight in flights}) == 2


def test_a_link_that_is_spelt_out_and_perfect_is_the_perfect_one() -> None:
    spelt = impaired("hover-wind", 1.0, {"latency_ms": 0.0, "loss": 0.0, "bursts.bad_ms": 0.0, "outages": []})
    assert hash_in_memory(spelt) == hash_in_memory(shortened("hover-wind", 1.0))


def test_channels_that_do_nothing_fly_the_same_flight() -> None:
    """The ground counts exchanges instead of reading the vehicle's clock, and messages come one by one: no more."""
    perfect = fly_in_memory(shortened("hover-wind", 2.0)).data
    through = fly_in_memory(impaired("hover-wind", 2.0, {"queue_bytes": 9000})).data
    for name in ("time_s", "position_nwu_m", "attitude_deg", "attitude_reference_deg"):
        assert np.array_equal(getattr(perfect, name), getattr(through, name)), name


def test_the_air_does_not_depend_on_the_link() -> None:
    """Wind and noise have generators of their own: tick for tick the air is the same."""
    winds = []
    for loss in (0.0, 0.1):
        flight, log = impaired("hover-wind", 1.0, {"loss": loss}), MemoryRecorder()
        vehicle = Vehicle(flight, log, seed=1, lockstep=True)
        drivers.fly_in_memory(vehicle, Ground(flight, NullRecorder()), channels=channels_for(flight.scenario.link, 1))
        table = log.tables()[topics.WIND_TRUTH.name]
        winds.append(np.column_stack([table[key] for key in ("timestamp", "windspeed_north", "windspeed_east")]))
    count = min(map(len, winds))
    assert count > 300
    assert np.array_equal(winds[0][:count], winds[1][:count])


@pytest.mark.parametrize("level", ["attitude", "body_rate", "torque"])
@pytest.mark.parametrize("name", ["hover-calm", "takeoff-hover"])
def test_handshake_commands_and_end_come_through_a_quarter_lost(name: str, level: str) -> None:
    flown = fly_in_memory(
        impaired(name, 4.0, {"loss": 0.25, "duplicate": 0.1, "corrupt": 0.02}, controller__level=level)
    )
    assert flown.phase == "DONE"
    assert flown.data.time_s[-1] > 3.9
    error_m = np.linalg.norm(flown.data.position_error_nwu_m(), axis=1)
    assert error_m[-100:].max() < 0.3


def test_an_outage_in_flight_is_seen_by_the_vehicle_and_flown_on() -> None:
    """Half a second of silence both ways: shorter than COM_OF_LOSS_T, so the vehicle stays in OFFBOARD."""
    outage = [{"start_s": 1.0, "duration_s": 0.5}]
    flight = impaired("hover-calm", 3.0, {"outages": outage}, controller__level="attitude")
    flown = fly_in_memory(flight)
    assert flown.phase == "DONE"
    gaps_s = np.diff(flown.data.time_s)
    assert gaps_s.max() == pytest.approx(0.5, abs=0.01)
    assert flown.data.time_s[np.argmax(gaps_s)] == pytest.approx(1.0, abs=0.01)


class Diary(Counter):
    """Says its clock, and notes on its clock what it hears."""

    def __init__(self, ticks: int) -> None:
        super().__init__(ticks)
        self.heard: list[tuple[int, bytes]] = []

    def receive(self, port: int, datagram: bytes) -> int:
        self.heard.append((self._now_us, datagram))
        return 1


@pytest.mark.parametrize(("latency_ms", "ticks"), [(0.0, 0), (4.0, 1), (10.0, 3)])
def test_the_ground_acts_on_late_news_and_is_heard_late(latency_ms: float, ticks: int) -> None:
    """A latency of 10 ms is three ticks of 4 ms. The clocks of both go on without news."""
    vehicle, ground = Diary(10), Diary(20)
    assert drivers.fly_in_memory(vehicle, ground, channels=channels(latency_ms=latency_ms)) == 80_000
    late_us = 4000 * ticks
    stamps = range(0, 80_001 - late_us, 4000)
    assert vehicle.heard == [(stamp + late_us, b"%d" % stamp) for stamp in stamps]
    # It reads before it steps, so that its clock is still that of the exchange before.
    assert ground.heard == [(stamp + late_us - 4000 if stamp + late_us else -1, b"%d" % stamp) for stamp in stamps]


def test_an_end_that_never_comes_is_an_error() -> None:
    with pytest.raises(LockstepError, match=r"did not end within 0.5 s"):
        drivers.fly_in_memory(Counter(10**6), Counter(10**6), max_time_s=0.5, channels=channels(loss=1.0))


def test_a_ground_that_ends_before_the_vehicle_is_an_error() -> None:
    with pytest.raises(LockstepError, match=r"the ground ended at t = 0.02 s and the vehicle has not disarmed"):
        drivers.fly_in_memory(Counter(50), Counter(5), channels=channels())


def test_the_vehicle_says_hello_until_it_is_answered_and_then_takes_turns() -> None:
    """Answers to repeated hellos come later and count for nothing."""
    link = Scripted(None, None, HELLO, HELLO, pack([b"0"]), HELLO, pack([]), pack([b"8000"]), pack([], last=True))
    vehicle, tap = Counter(2), Tap()
    assert drivers.run_lockstep_vehicle(vehicle, link.udp(), tap, channels=channels()) == 12_000
    turns = [pack([b"%d" % (4000 * k)]) for k in range(4)]
    assert link.sent == [HELLO, HELLO, HELLO, *turns]
    assert vehicle.received == [b"0", b"8000"]
    expected = WireHash()
    for stamp, answer in ((b"0", b"0"), (b"4000", b""), (b"8000", b"8000"), (b"12000", b"")):
        expected.update([(Direction.FROM_VEHICLE, 0, stamp)])
        if answer:
            expected.update([(Direction.FROM_GROUND, 0, answer)])
    assert tap.wire.hexdigest() == expected.hexdigest()


def test_the_ground_answers_every_hello_and_every_exchange_also_an_empty_one() -> None:
    """Two equal exchanges are two: nothing came in either."""
    link = Scripted(HELLO, HELLO, pack([b"0"]), pack([]), pack([]), pack([b"4000", b"8000"]))
    ground = Counter(3)
    assert drivers.run_lockstep_ground(ground, link.udp(), Tap(), impaired=True) == 12_000
    answers = [pack([b"0"]), pack([b"4000"]), pack([b"8000"]), pack([b"12000"], last=True)]
    assert link.sent == [HELLO, HELLO, *answers]
    assert ground.received == [b"0", b"4000", b"8000"]


def test_silence_is_named_before_and_after_the_first_exchange() -> None:
    with pytest.raises(LinkSilent, match=r"t = 0 s after 0.2 s of silence: nothing came from 192.0.2.1:14540"):
        drivers.run_lockstep_vehicle(Counter(), Scripted().udp(), Tap(), channels=channels(), start_deadline_s=0.2)
    link = Scripted(HELLO, pack([b"0"]))
    with pytest.raises(LinkSilent, match=r"t = 0.004 s after 0.3 s of silence"):
        drivers.run_lockstep_vehicle(Counter(), link.udp(), Tap(), channels=channels(), deadline_s=0.3)
    link = Scripted(HELLO, pack([b"0"]))
    with pytest.raises(LinkSilent, match=r"t = 0 s after 0.3 s of silence"):
        drivers.run_lockstep_ground(Counter(), link.udp(), Tap(), impaired=True, deadline_s=0.3)


def test_ends_that_do_not_agree_on_the_link_say_so() -> None:
    said = r"do both ends have the same \[link\]"
    with pytest.raises(LinkError, match=said):
        drivers.run_lockstep_ground(Counter(), Scripted(HELLO).udp(), Tap())
    with pytest.raises(LinkError, match=said):
        drivers.run_lockstep_ground(Counter(), Scripted(b"0").udp(), Tap(), impaired=True)
    with pytest.raises(LinkError, match=said):
        drivers.run_lockstep_vehicle(Counter(), Scripted(b"0").udp(), Tap(), channels=channels())


@pytest.mark.parametrize("end", ["vehicle", "ground"])
def test_a_run_over_a_bad_link_can_be_stopped_while_nothing_comes(end: str) -> None:
    def stop(flight_time_s: float) -> None:
        raise KeyboardInterrupt

    link = Scripted().udp()
    runs: dict[str, Callable[[], int]] = {
        "vehicle": lambda: drivers.run_lockstep_vehicle(Counter(), link, Tap(), channels=channels(), progress=stop),
        "ground": lambda: drivers.run_lockstep_ground(Counter(), link, Tap(), impaired=True, progress=stop),
    }
    with pytest.raises(KeyboardInterrupt):
        runs[end]()


def test_flight_time_reaches_the_channels() -> None:
    flight = shortened("hover-calm", 1.0)
    vehicle = Vehicle(flight, NullRecorder(), seed=1, lockstep=True)
    made = channels()
    made.fly(8000, vehicle.flight_time_s)
    assert made.to_ground.flight_began_us is None
    made.fly(1_500_000, 0.5)
    assert made.to_ground.flight_began_us == made.to_vehicle.flight_began_us == 1_000_000
