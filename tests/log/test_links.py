"""What links did, in the log: instances of a topic, one row a second, delays of that second alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pyulog.core import ULog

from mavsitl.clock import LatenessHistogram
from mavsitl.link.impaired import Channels
from mavsitl.log.flight import FlightData
from mavsitl.log.links import COUNTS, LinkLog
from mavsitl.log.topics import CHANNELS, TELEMETRY_STATUS
from mavsitl.log.ulog import MemoryRecorder, Recorder, UlogWriter, read
from mavsitl.scenario import Impairment, LinkModel, Outage
from tests.log.synthetic import RELEASE_US, Made, write
from tests.wire.test_link_impaired import frame


def test_instances_of_a_topic_are_told_apart(tmp_path: Path) -> None:
    path, memory = tmp_path / "a.ulg", MemoryRecorder()
    with UlogWriter(path, {}, {}, topics=TELEMETRY_STATUS) as ulog:
        for recorder in (ulog, memory):
            for number, topic in enumerate(TELEMETRY_STATUS[:2]):
                recorder.topic(topic).append(1000, *([number] * 9))
    tables = read(path)
    assert list(tables) == list(memory.tables()) == ["telemetry_status", "telemetry_status.1"]
    assert [table["rx_message_count"].tolist() for table in tables.values()] == [[0], [1]]
    log = ULog(str(path))
    assert [(data.name, data.multi_id) for data in log.data_list] == [("telemetry_status", 0), ("telemetry_status", 1)]


@given(st.lists(st.integers(0, 10**9), max_size=50), st.lists(st.integers(0, 10**9), max_size=50))
def test_a_histogram_since_an_earlier_one_is_what_came_after(first: list[int], second: list[int]) -> None:
    whole, alone = LatenessHistogram(), LatenessHistogram()
    for each in first:
        whole.add(each)
    earlier = whole.copy()
    for each in second:
        whole.add(each)
        alone.add(each)
    since = whole.since(earlier)
    assert since.count == alone.count
    for share in (0.0, 0.5, 0.99):
        assert alone.quantile_us(share) <= since.quantile_us(share) <= 1.126 * alone.quantile_us(share) + 0.002
    assert alone.max_us <= since.max_us <= 1.126 * alone.max_us + 0.002
    assert earlier.count == len(first)


def drive(recorder: Recorder, seconds: int = 6) -> Channels:
    """250 messages a second each way: 10 ms to the ground with an outage in the third second, half lost back."""
    model = LinkModel(
        to_ground=Impairment(latency_ms=10.0, outages=(Outage(start_s=2.0, duration_s=0.5, clock="simulated"),)),
        to_vehicle=Impairment(loss=0.5),
    )
    channels = Channels(model, 1)
    log = LinkLog(recorder, lambda: {"link": channels})
    for step in range(250 * seconds):
        now_us = 4000 * step
        for channel in (channels.to_ground, channels.to_vehicle):
            channel.send(frame(step), now_us)
            channel.due(now_us)
        if step % 250 == 249:
            log.write(now_us + 4000)
        if step == 250 * 4:
            channels.to_ground.configure(Impairment(latency_ms=40.0))
    return channels


def test_counts_run_on_and_delays_are_of_the_second(tmp_path: Path) -> None:
    recorder = MemoryRecorder()
    channels = drive(recorder)
    table = recorder.tables()[CHANNELS["link"]["to_ground"].key]
    for name in COUNTS:
        assert table[name][-1] == getattr(channels.to_ground.statistics, name)
        assert np.all(np.diff(table[name].astype(int)) >= 0)
    assert table["sent"].tolist() == [250, 500, 750, 1000, 1250, 1500]
    assert np.diff(table["outage"].astype(int)).tolist() == [0, 125, 0, 0, 0]
    assert np.all(table["delay_p50_ms"][:4] < 12.0)
    assert np.all(table["delay_p50_ms"][5:] >= 39.9)  # of all so far it would still be 10 ms


def test_a_flight_has_its_link_by_the_second_from_the_release_on() -> None:
    vehicle, ground = MemoryRecorder(), MemoryRecorder()
    write(Made(seconds=3.0), vehicle, ground)
    drive(vehicle)
    channels = FlightData.from_recorders(vehicle, ground, duration_s=3.0).channels
    to_ground, to_vehicle = channels["to_ground"], channels["to_vehicle"]
    assert RELEASE_US == 2_000_000
    assert to_ground.time_s.tolist() == to_vehicle.time_s.tolist() == [1.0, 2.0, 3.0]
    assert to_ground.sent.tolist() == [250.0] * 3
    assert to_ground.outage.tolist() == [125.0, 0.0, 0.0]
    assert to_vehicle.outage.tolist() == [0.0] * 3
    assert np.all((to_vehicle.lost > 90) & (to_vehicle.lost < 160))


def test_a_perfect_link_is_in_no_log() -> None:
    vehicle, ground = MemoryRecorder(), MemoryRecorder()
    write(Made(seconds=1.0), vehicle, ground)
    LinkLog(vehicle, dict).write(1_000_000)
    assert FlightData.from_recorders(vehicle, ground).channels == {}
