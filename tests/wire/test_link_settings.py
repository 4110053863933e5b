"""What parameters and the scenario's changes make of a link in flight."""

from __future__ import annotations

from math import inf

import msgspec
import pytest
from mavsitl_vehicle.links import NAMES

from mavsitl.link.impaired import Channel, Channels, ImpairedLink, channels_for
from mavsitl.link.memory import memory_pair
from mavsitl.link.settings import AS_IN_SCENARIO, KEYS, PREFIXES, Overlay, initial
from mavsitl.scenario import Bursts, Impairment, LinkChange, LinkModel
from tests.wire.test_link_impaired import frame, numbers, run


def test_the_vehicles_parameters_are_named_after_the_settings() -> None:
    for link, prefix in PREFIXES.items():
        assert NAMES[link] == {key: prefix + key for key in (*KEYS, "DIR")}


def test_each_setting_replaces_one_key() -> None:
    everything = dict.fromkeys(KEYS, 1.0)
    made = Overlay(everything).of(Impairment(), "to_ground")
    assert made == Impairment(
        latency_ms=1.0, jitter_ms=1.0, loss=1.0, bursts=Bursts(bad_ms=1.0, good_ms=1.0), reorder=1.0, duplicate=1.0,
        corrupt=1.0, bandwidth_kbit_s=1.0, down=True,
    )  # fmt: skip
    assert made.down is True
    assert initial(LinkModel(to_vehicle=made)) == {**everything, "DIR": 0.0}


def test_what_is_not_named_stays_and_the_other_direction_too() -> None:
    scenario = Impairment(latency_ms=20.0, loss=0.1, keep_order=True)
    overlay = Overlay({"LOSS": 0.5}, 2)
    assert overlay.of(scenario, "to_vehicle") == msgspec.structs.replace(scenario, loss=0.5)
    assert overlay.of(scenario, "to_ground") is scenario
    failed = overlay._replace(everywhere={"LOSS": 1.0})
    assert failed.of(scenario, "to_ground").loss == failed.of(scenario, "to_vehicle").loss == 1.0


def test_an_overlay_knows_whether_it_does_anything() -> None:
    bad = LinkModel(to_ground=Impairment(loss=0.5))
    assert AS_IN_SCENARIO.leaves(bad)
    assert Overlay({"LOSS": 0.5}, 1).leaves(bad)
    assert not Overlay({"LOSS": 0.5}, 2).leaves(bad)
    assert not Overlay({}, everywhere={"DOWN": 1.0}).leaves(bad)


def changing(*changes: LinkChange) -> Channels:
    return Channels(LinkModel(changes=changes), 1)


def test_changes_come_at_their_time_and_in_their_direction() -> None:
    channels = changing(
        LinkChange(at_s=1.0, clock="simulated", loss=1.0, direction="to_vehicle"),
        LinkChange(at_s=0.5, latency_ms=40.0),
        LinkChange(at_s=2.0, clock="simulated", loss=0.0),
    )
    seen = []
    for now_us in range(0, 2_500_000, 100_000):
        channels.fly(now_us, now_us / 1e6 - 1.0)  # the flight begins at 1 s
        seen.append((channels.to_ground.impairment, channels.to_vehicle.impairment))
    assert seen[9] == (Impairment(), Impairment())
    assert seen[10] == (Impairment(), Impairment(loss=1.0))
    assert seen[15] == (Impairment(latency_ms=40.0), Impairment(latency_ms=40.0, loss=1.0))
    assert seen[20] == (Impairment(latency_ms=40.0), Impairment(latency_ms=40.0))


def test_the_next_flight_goes_through_its_changes_again() -> None:
    channels = changing(LinkChange(at_s=0.0, loss=0.5), LinkChange(at_s=1.0, loss=0.1))
    losses = []
    for flight_time_s in (-1.0, 0.0, 1.0, -1.0, 0.5, 1.5):
        channels.fly(0, flight_time_s)
        losses.append(channels.to_ground.impairment.loss)
    assert losses == [0.0, 0.5, 0.1, 0.1, 0.5, 0.1]


def test_parameters_lie_over_what_the_scenario_changes() -> None:
    channels = changing(LinkChange(at_s=0.0, loss=0.5, latency_ms=10.0))
    channels.lay_over(Overlay({"LOSS": 0.2}))
    assert channels.to_ground.impairment == Impairment(loss=0.2)
    channels.fly(0, 0.0)
    assert channels.to_ground.impairment == Impairment(loss=0.2, latency_ms=10.0)
    channels.lay_over(AS_IN_SCENARIO)
    assert channels.to_ground.impairment == Impairment(loss=0.5, latency_ms=10.0)


def test_a_link_that_is_down_loses_everything_as_an_outage() -> None:
    channel = Channel(Impairment(down=True), 1, "to_ground")
    assert run(channel, 100) == []
    assert channel.statistics.outage == 100


def test_another_setting_does_not_begin_a_burst_anew() -> None:
    """The bad and the good stretches are those that they would have been."""
    bursts = Bursts(bad_ms=100.0, good_ms=100.0)
    alone, changed = (Channel(Impairment(bursts=bursts), 1, "to_ground") for _ in range(2))
    lost: list[list[bool]] = [[], []]
    for step in range(2000):
        if step % 100 == 0:
            changed.configure(Impairment(bursts=bursts, queue_bytes=1000 + step))
        for channel, seen in zip((alone, changed), lost, strict=True):
            channel.send(frame(step), 4000 * step)
            seen.append(channel.due(4000 * step) == [])
    assert lost[0] == lost[1]
    assert 500 < sum(lost[0]) < 1500


def test_links_of_one_scenario_have_their_own_chance() -> None:
    model = LinkModel(to_ground=Impairment(loss=0.5))
    fates = []
    for place in ("link", "gcs_link", "tcp_link"):
        channels = channels_for(model, 1, place)
        assert channels is not None
        fates.append(tuple(numbers(run(channels.to_ground, 100))))
    assert len(set(fates)) == 3
    again = channels_for(model, 1)
    assert again is not None
    assert tuple(numbers(run(again.to_ground, 100))) == fates[0]


@pytest.mark.parametrize("distribution", ["uniform", "normal", "gamma"])
def test_jitter_without_latency_is_harmless(distribution: str) -> None:
    """No scenario says so, parameters may: no delay is negative, and nothing is divided by zero."""
    channel = Channel(Impairment(), 1, "to_ground")
    setting = msgspec.structs.replace(Impairment(distribution=distribution), jitter_ms=10.0)  # type: ignore[arg-type]
    channel.configure(setting)
    assert len(run(channel, 200)) == 200


def test_a_link_tells_when_the_next_message_arrives() -> None:
    near, far = memory_pair()
    channels = Channels(LinkModel(to_ground=Impairment(latency_ms=10.0), to_vehicle=Impairment(latency_ms=4.0)), 1)
    clock = [0]
    link = ImpairedLink(near, channels, lambda: clock[0])
    assert link.due_us() == inf
    link.send(frame(1))
    assert link.due_us() == 10_000.0
    far.send(frame(2))
    link.receive(0)
    assert link.due_us() == 4000.0
    clock[0] = 6000
    assert link.due_us() == 0.0
    assert [datagram for datagram, _ in link.receive(0)] == [frame(2)]
    assert link.due_us() == 4000.0
