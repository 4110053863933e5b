"""A made-up flight with known errors, through the logs and back into the paper's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mavsitl.log import topics
from mavsitl.log.flight import FlightData, FlightError, equal
from mavsitl.log.ulog import LogError, MemoryRecorder, UlogWriter
from tests.log.synthetic import RELEASE_US, Made, quaternion_ned, write

SHORT = Made(seconds=3.0, windy=True)


def recorded(made: Made) -> tuple[MemoryRecorder, MemoryRecorder]:
    vehicle, ground = MemoryRecorder(), MemoryRecorder()
    write(made, vehicle, ground)
    return vehicle, ground


def test_memory_and_files_give_the_same_flight(tmp_path: Path) -> None:
    with UlogWriter(tmp_path / "vehicle.ulg", {}, {}) as vehicle, UlogWriter(tmp_path / "ground.ulg", {}, {}) as ground:
        write(SHORT, vehicle, ground)
    from_files = FlightData.from_folder(tmp_path)
    assert equal(from_files, FlightData.from_recorders(*recorded(SHORT)))
    assert not equal(from_files, FlightData.from_recorders(*recorded(Made(seconds=3.0))))


def test_the_flight_is_in_the_papers_frame_from_the_release_on() -> None:
    flight = FlightData.from_recorders(*recorded(SHORT))
    t = flight.time_s
    np.testing.assert_allclose(t, 0.004 * np.arange(751), atol=1e-9)
    np.testing.assert_allclose(flight.position_reference_nwu_m, np.tile((0.0, 0.0, 1.0), (751, 1)))
    sines = np.column_stack((np.sin(3 * t), np.cos(2.3 * t), np.sin(1.7 * t)))
    np.testing.assert_allclose(flight.position_error_nwu_m(), 0.01 * sines, atol=1e-6)
    np.testing.assert_allclose(flight.velocity_nwu_m_s[5], (0.1, 0.2, 0.3), rtol=1e-6)
    # The made-up vehicle leans into the wind: phi = -1.5 v, theta = 1.5 u.
    np.testing.assert_allclose(flight.attitude_reference_deg[:, 0], -1.5 * flight.wind_nwu_m_s[:, 1], atol=1e-5)
    np.testing.assert_allclose(flight.attitude_reference_deg[:, 1], 1.5 * flight.wind_nwu_m_s[:, 0], atol=1e-5)
    errors = np.column_stack((np.sin(9 * t), np.cos(11 * t), 0.3 * np.sin(5 * t)))
    np.testing.assert_allclose(flight.attitude_error_deg(), 0.1 * errors, atol=2e-4)
    assert flight.has_wind
    assert flight.weights is not None
    np.testing.assert_allclose(flight.weights[0], [[961.0, 328.0, 92.4]] * 2 + [[130.0, 148.0, 22.8]], rtol=1e-6)
    assert flight.saturated_share == pytest.approx(76 / 751)
    assert flight.link is not None
    assert (flight.link.received[-1], flight.link.lost[-1], flight.link.state_age_ms[-1]) == (1250.0, 1.0, 4.0)


def test_angles_come_out_as_they_went_in() -> None:
    angles = [(10.0, -20.0, 170.0), (-35.0, 15.0, -100.0), (0.0, 0.0, 90.0), (60.0, 0.0, 0.0)]
    vehicle, ground = recorded(Made(seconds=0.004))
    stamps = [RELEASE_US + 4000 * k for k in range(2, 6)]
    for stamp, each in zip(stamps, angles, strict=True):
        vehicle.topic(topics.LOCAL_POSITION_TRUTH).append(stamp, 0, 0, 0, 0, 0, 0)
        vehicle.topic(topics.ATTITUDE_TRUTH).append(stamp, *quaternion_ned(*each))
        ground.topic(topics.TRAJECTORY_SETPOINT).append(stamp, *[0] * 7)
        ground.topic(topics.ATTITUDE_SETPOINT).append(stamp, 0, 0, np.radians(179.0), *[0] * 8)
    flight = FlightData.from_recorders(vehicle, ground)
    np.testing.assert_allclose(flight.attitude_deg[-4:], angles, atol=1e-4)
    np.testing.assert_allclose(flight.attitude_reference_deg[-4:, 2], -179.0, atol=1e-4)
    # 170 against -179 degrees is 11 degrees short, not 349 too far.
    assert flight.attitude_error_deg()[-4, 2] == pytest.approx(-11.0, abs=1e-3)


def test_samples_without_their_counterpart_are_left_out_and_rarer_topics_held() -> None:
    vehicle, ground = recorded(Made(seconds=1.0))
    rare = vehicle.tables() | {
        "wind_groundtruth": {
            "timestamp": np.array([RELEASE_US + 400_000], np.uint64),
            "windspeed_north": np.array([1.0], np.float32),
            "windspeed_east": np.array([2.0], np.float32),
            "windspeed_down": np.array([3.0], np.float32),
        }
    }
    setpoints = {
        name: {column: values[::2] for column, values in table.items()} for name, table in ground.tables().items()
    }
    flight = FlightData.from_tables(rare, setpoints)
    np.testing.assert_allclose(np.diff(flight.time_s), 0.008, atol=1e-9)
    assert np.isnan(flight.wind_nwu_m_s[flight.time_s < 0.3999]).all()
    np.testing.assert_array_equal(flight.wind_nwu_m_s[flight.time_s > 0.3999], np.tile((1.0, -2.0, -3.0), (76, 1)))


def test_the_flight_is_cut_to_its_duration() -> None:
    tables = [recorder.tables() for recorder in recorded(Made(seconds=1.0, learning=False))]
    flight = FlightData.from_tables(*tables, duration_s=0.5)
    assert flight.time_s[-1] == pytest.approx(0.5)
    assert flight.weights is None
    assert not flight.has_wind


def test_logs_without_a_flight_say_what_is_missing(tmp_path: Path) -> None:
    vehicle, ground = (recorder.tables() for recorder in recorded(Made(seconds=0.1)))
    with pytest.raises(FlightError, match="no vehicle_attitude_setpoint was logged"):
        FlightData.from_tables(vehicle, {k: v for k, v in ground.items() if k != "vehicle_attitude_setpoint"})
    held = vehicle["vehicle_land_detected"] | {"landed": np.ones(2, np.uint8)}
    with pytest.raises(FlightError, match="never released"):
        FlightData.from_tables(vehicle | {"vehicle_land_detected": held}, ground)
    late = {name: table | {"timestamp": table["timestamp"] + np.uint64(1)} for name, table in ground.items()}
    with pytest.raises(FlightError, match="no equal timestamp"):
        FlightData.from_tables(vehicle, late)
    with pytest.raises(LogError, match=r"vehicle\.ulg: cannot be read"):
        FlightData.from_folder(tmp_path)
    for name in ("vehicle.ulg", "ground.ulg"):
        UlogWriter(tmp_path / name, {}, {}).close()
    with pytest.raises(FlightError, match=f"{tmp_path}.*no vehicle_local_position_groundtruth"):
        FlightData.from_folder(tmp_path)
