"""Links that change in flight: in lock-step repeatable to the byte, in real time from the next message on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers, ends, pair, wings
from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.drivers import Tap
from mavsitl.ends import NullRecorder
from mavsitl.link.base import Link
from mavsitl.link.impaired import Channels, ImpairedLink
from mavsitl.link.memory import memory_pair
from mavsitl.link.settings import Overlay
from mavsitl.log import topics
from mavsitl.log.flight import FlightData
from mavsitl.scenario import Flight, Impairment, LinkModel
from tests.drivers.exercise import fly_in_memory, hash_in_memory, shortened
from tests.drivers.test_between_ticks import Bench

CHANGES: list[dict[str, Any]] = [
    {"at_s": 0.5, "loss": 0.3, "latency_ms": 8.0},
    {"at_s": 1.0, "direction": "to_vehicle", "down": True},
    {"at_s": 1.2, "direction": "to_vehicle", "down": False},
]


def changing(**more: Any) -> Flight:
    return shortened("hover-wind", 2.0, controller__level="attitude", link__changes=CHANGES, **more)


@pytest.mark.sockets
def test_a_link_that_changes_is_the_same_in_one_process_and_in_two(tmp_path: Path) -> None:
    flight = changing()
    in_memory = ends.in_memory(flight, tmp_path / "one", report=lambda text: None, progress=None)
    assert hash_in_memory(flight) == in_memory.wire_hash
    assert hash_in_memory(changing(seed=2)) != in_memory.wire_hash
    changes = ", ".join(
        "{" + ", ".join(f"{key} = {_toml(value)}" for key, value in change.items()) + "}" for change in CHANGES
    )
    settings = ["duration_s=2.0", "controller.level=attitude", f"link.changes=[{changes}]"]
    result = pair.fly("hover-wind", settings, tmp_path / "two", lambda end, event: None)
    assert result.vehicle["wire_hash"] == in_memory.wire_hash
    assert result.vehicle["link"] == in_memory.links["link"]
    for folder in ("one", "two"):
        log = FlightData.from_folder(tmp_path / folder, duration_s=2.0).channels
        assert log["to_vehicle"].outage.sum() == in_memory.links["link"]["to_vehicle"]["outage"] > 10
        assert log["to_ground"].outage.sum() == 0
        assert log["to_ground"].lost.sum() == in_memory.links["link"]["to_ground"]["lost"] > 50


def _toml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else f"{value}"


def test_until_it_changes_the_flight_is_the_one_over_the_perfect_link() -> None:
    perfect = fly_in_memory(shortened("hover-wind", 2.0, controller__level="attitude")).data
    changed = fly_in_memory(changing()).data
    before = int(np.searchsorted(perfect.time_s, 0.499))
    assert before > 100
    assert np.array_equal(perfect.position_nwu_m[:before], changed.position_nwu_m[:before])
    assert len(changed.time_s) < len(perfect.time_s)


class Setter(Ground):
    """Sets parameters of the vehicle when it has flown for a second."""

    def __init__(self, flight: Flight, sets: dict[str, float]) -> None:
        super().__init__(flight, NullRecorder())
        self._sets = dict(sets)
        self.errors: list[Any] = []

    def receive(self, port: int, datagram: bytes) -> int:
        self.errors += [
            frame.message for frame in parse(datagram) if frame.message.get_type() in ("PARAM_ERROR", "STATUSTEXT")
        ]
        return super().receive(port, datagram)

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        out = super().datagrams(port, combine=combine)
        if self._sets and self.flight_time_s > 1.0:
            out += [
                encode(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, 9), 0, 200, 1)
                for name, value in self._sets.items()
            ]
            self._sets = {}
        return out


def fly_with(monkeypatch: pytest.MonkeyPatch, flight: Flight, sets: dict[str, float]) -> tuple[ends.Outcome, Setter]:
    ground = Setter(flight, sets)
    find = wings.find
    monkeypatch.setattr(wings, "find", lambda group, name=None: (
        (lambda *_, **__: ground) if group == wings.GROUND_GROUP else find(group, name)
    ))  # fmt: skip
    return ends.in_memory(flight, None, report=lambda text: None, progress=None), ground


def test_a_parameter_makes_a_live_link_bad_in_lock_step(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = shortened("hover-calm", 3.0, controller__level="attitude", link__live=True)
    outcome, _ = fly_with(monkeypatch, flight, {"SIM_LINK_LOSS": 0.2})
    lost = {way: counts["lost"] / counts["sent"] for way, counts in outcome.links["link"].items()}
    assert outcome.finished
    assert all(0.05 < share < 0.2 for share in lost.values()), lost


def test_a_perfect_link_in_lock_step_refuses_with_a_text(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = shortened("hover-calm", 2.0)
    outcome, ground = fly_with(monkeypatch, flight, {"SIM_LINK_LOSS": 0.2})
    assert outcome.finished
    assert outcome.links == {}
    texts = "".join(message.text for message in ground.errors if message.get_type() == "STATUSTEXT")
    assert "SIM_LINK_LOSS: the lock-step exchange of this flight has a perfect link" in texts
    [error] = [message for message in ground.errors if message.get_type() == "PARAM_ERROR"]
    assert error.error == mavlink.MAV_PARAM_ERROR_READ_ONLY


def live(**changes: Any) -> tuple[ends._LiveLinks, list[Link], list[Any]]:
    near, far = zip(*(memory_pair() for _ in range(3)), strict=True)
    links: list[Link] = list(near)
    return ends._LiveLinks(links, shortened("hover-calm", 1.0, **changes), 1.0), links, list(far)


def test_a_perfect_link_has_nothing_before_it_until_it_is_made_bad() -> None:
    made, links, far = live()
    before = list(links)
    made.listen("link", Overlay({}))
    made.listen("gcs_link", Overlay({}))
    assert links == before
    assert made.statistics() == {}
    made.listen("gcs_link", Overlay({"DOWN": 1.0}))
    assert links[0] is before[0]
    assert [type(link) for link in links[1:]] == [ImpairedLink] * 2
    frame = encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), 0, 1, 1)
    for link in links:
        link.send(frame)
    assert [len(end.receive(0)) for end in far] == [1, 0, 0]
    made.listen("gcs_link", Overlay({}))
    for link in links:
        link.send(frame)
    assert [len(end.receive(0)) for end in far] == [1, 1, 1]
    assert {place: ways["to_ground"]["outage"] for place, ways in made.statistics().items()} == {
        "gcs_link": 1, "tcp_link": 1,
    }  # fmt: skip


def test_the_scenarios_ground_station_link_is_each_of_them_with_chance_of_its_own() -> None:
    made, links, _ = live(gcs_link__to_ground__loss=0.5)
    assert [type(link) is ImpairedLink for link in links] == [False, True, True]
    for number in range(200):
        for link in links:
            link.send(encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), number & 0xFF, 1, 1))
    lost = [made.channels[place].to_ground.statistics.lost for place in ("gcs_link", "tcp_link")]
    assert all(60 < each < 140 for each in lost)
    assert lost[0] != lost[1]


def test_in_lock_step_there_is_no_ground_station_link_and_no_error() -> None:
    flight = shortened("hover-wind", 1.0, gcs_link__to_ground__loss=0.5)
    assert hash_in_memory(flight) == hash_in_memory(shortened("hover-wind", 1.0))


@pytest.mark.parametrize("latency_ms", [1.0, 6.5, 10.3])
def test_a_message_arrives_when_it_is_due_and_not_at_the_next_tick(
    monkeypatch: pytest.MonkeyPatch, latency_ms: float
) -> None:
    """Both ways, on a wall clock that the test moves; nothing else wakes the vehicle."""
    bench = Bench(monkeypatch)
    model = LinkModel(to_ground=Impairment(latency_ms=latency_ms), to_vehicle=Impairment(latency_ms=latency_ms))
    link = ImpairedLink(bench.near, Channels(model, 1), lambda: bench.wall.ns // 1000)
    sent_us: list[int] = []
    came_us: list[int] = []
    send = link.send

    def noted(datagram: bytes) -> None:
        sent_us.append(bench.wall.ns // 1000)
        send(datagram)

    found_us: list[int] = []
    take_up = link.channels.to_vehicle.send

    def found(datagram: bytes, now_us: int, tag: Any = None) -> None:
        found_us.append(bench.wall.ns // 1000)
        take_up(datagram, now_us, tag)

    monkeypatch.setattr(link, "send", noted)
    monkeypatch.setattr(link.channels.to_vehicle, "send", found)
    monkeypatch.setattr(bench.far, "_deliver", lambda datagram, source: came_us.append(bench.wall.ns // 1000))
    bench.far.send(encode(mavlink.MAVLink_ping_message(0, 1, 0, 0), 0, 200, 1))

    def wait(links: Sequence[Link], timeout_s: float) -> bool:
        bench.wall.sleep_s(timeout_s)
        return False

    looks = iter([False] * 10 + [True])
    drivers.run_realtime_vehicle(
        bench.vehicle, (link,), Tap(), stop=lambda: next(looks), wait=wait, due_s=lambda: link.due_us() * 1e-6
    )
    [taken_us] = bench.vehicle.taken_us
    assert -10 <= taken_us - found_us[0] - 1e3 * latency_ms < 400
    delays_us = [came - sent for sent, came in zip(sent_us, came_us, strict=False)]
    assert len(delays_us) > 10
    assert all(1e3 * latency_ms - 10 <= delay < 1e3 * latency_ms + 400 for delay in delays_us)


def test_bad_input_and_what_the_link_did_is_in_the_vehicles_log(tmp_path: Path) -> None:
    flight = shortened("hover-calm", 2.0, controller__level="attitude", link__to_vehicle__corrupt=0.05)
    outcome = ends.in_memory(flight, tmp_path, report=lambda text: None, progress=None)
    from mavsitl.log.ulog import read

    log = read(tmp_path / "vehicle.ulg")
    status, channel = log["telemetry_status"], log["link_to_vehicle"]
    corrupted = outcome.links["link"]["to_vehicle"]["corrupted"]
    assert channel["corrupted"][-1] == corrupted > 10
    assert np.all(np.diff(status["timestamp"]) == 1_000_000)
    assert 0 < status["bad_crc"][-1] <= outcome.dropped["bad_crc"] <= corrupted
    assert np.all(np.diff(status["rx_message_count"].astype(int)) > 0)
    assert sum(outcome.dropped.get(name, 0) for name in ("bad_crc", "bad_length", "unknown_id", "incompatible")) > 0


def test_each_port_of_the_vehicle_counts_its_own_input() -> None:
    from mavsitl.log.ulog import MemoryRecorder

    recorder = MemoryRecorder()
    vehicle = Vehicle(shortened("hover-calm", 1.0), recorder, seed=1, ports=("offboard", "gcs"))
    vehicle.step(0)
    good = encode(mavlink.MAVLink_ping_message(0, 1, 0, 0), 0, 200, 1)
    vehicle.receive(1, good)
    vehicle.receive(1, good[:-1] + b"\0\0")
    for tick in range(1, 252):
        vehicle.step(4000 * tick)
    tables = recorder.tables()
    first, second = (tables[topic.key] for topic in topics.TELEMETRY_STATUS[:2])
    assert first["rx_message_count"].tolist() == [0, 0]
    assert second["rx_message_count"].tolist() == [0, 1]
    assert second["rx_parse_errors"].tolist() == [0, 1]
    assert topics.TELEMETRY_STATUS[2].key not in tables
