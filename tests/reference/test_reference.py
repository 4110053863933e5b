"""References: what they say, and that their derivatives are derivatives."""

from __future__ import annotations

from math import cos, pi, radians, sin
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mavsitl_ground.reference import reference_for

from mavsitl.scenario import Figure8, Hover, Reference, ScenarioError, Spiral, Step, Steps, Waypoints

ROWS = "x,y,z,yaw,hold\n0,0,1,0,2\n# a comment\n\n3,4,1,90\n3,4,1,-170,1\n3,4,6\n"


@pytest.fixture
def waypoints(tmp_path: Path) -> Waypoints:
    file = tmp_path / "path.csv"
    file.write_text(ROWS, "utf-8")
    return Waypoints(file=str(file), speed_m_s=2.0)


def test_hover() -> None:
    path = reference_for(Hover(position_nwu_m=(1.0, 2.0, 3.0), yaw_deg=90.0))
    for time_s in (-1.0, 0.0, 100.0):
        assert path.sample(time_s) == ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), pi / 2)


def test_the_papers_spiral() -> None:
    path = reference_for(Spiral())
    assert path.sample(0.0)[0] == (0.0, 1.0, 0.0)
    for time_s in (0.5, 17.0, 60.0):
        position, _, _, yaw = path.sample(time_s)
        assert position == pytest.approx((sin(0.2094 * time_s), cos(0.2094 * time_s), 0.0333 * time_s), rel=1e-14)
        assert yaw == 0.0


def test_steps_hold_from_their_time_on() -> None:
    first, second = (
        Step(time_s=2.0, position_nwu_m=(0.0, 0.0, 1.0)),
        Step(time_s=5.0, position_nwu_m=(1.0, 0.0, 1.0), yaw_deg=45.0),
    )
    path = reference_for(Steps(steps=(first, second)))
    assert [path.sample(t)[0][0] for t in (-1.0, 0.0, 2.0, 4.999, 5.0, 99.0)] == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0]
    assert path.sample(4.999)[3] == 0.0
    assert path.sample(5.0)[3] == pi / 4
    assert path.sample(5.0)[1] == (0.0, 0.0, 0.0)


def test_figure_8_starts_at_rest_in_its_centre_and_fills_its_box() -> None:
    path = reference_for(Figure8(length_m=4.0, width_m=2.0, period_s=12.0, altitude_m=1.5, ramp_s=4.0))
    position, velocity, acceleration, yaw = path.sample(0.0)
    assert position == (0.0, 0.0, 1.5)
    assert velocity == (0.0, 0.0, 0.0)
    assert acceleration == (0.0, 0.0, 0.0)
    assert yaw == 0.0
    points = np.array([path.sample(4.0 + 0.001 * k)[0] for k in range(12_000)])
    assert points.max(axis=0) == pytest.approx([2.0, 1.0, 1.5], abs=1e-5)
    assert points.min(axis=0) == pytest.approx([-2.0, -1.0, 1.5], abs=1e-5)
    assert path.sample(20.0)[0] == pytest.approx(path.sample(32.0)[0], abs=1e-12)
    # The curve: x^4 = (L/2)^2 (x^2 - (L/W)^2 y^2), Gerono's.
    x, y = points[:, 0], points[:, 1]
    assert x**4 == pytest.approx(4.0 * (x**2 - y**2 * 4.0 / 4.0), abs=1e-9)


@pytest.mark.parametrize(
    "reference",
    [
        Spiral(),
        Spiral(radius_m=3.0, rate_rad_s=1.5, climb_m_s=-0.4),
        Figure8(),
        Figure8(ramp_s=0.0),
        Figure8(ramp_s=9.0),
    ],
    ids=str,
)
@given(time_s=st.floats(0.001, 60.0))
@settings(deadline=None, max_examples=60)
def test_velocity_and_acceleration_are_the_derivatives(reference: Reference, time_s: float) -> None:
    path, h = reference_for(reference), 1e-4
    before, here, after = (path.sample(time_s + shift) for shift in (-h, 0.0, h))
    for axis in range(3):
        assert (after[0][axis] - before[0][axis]) / (2 * h) == pytest.approx(here[1][axis], abs=2e-7)
        assert (after[1][axis] - before[1][axis]) / (2 * h) == pytest.approx(here[2][axis], abs=1e-4)


def test_waypoints_hold_fly_and_turn(waypoints: Waypoints) -> None:
    """2 s at row 1, 2.5 s to row 2 (5 m), a turn on the spot, 1 s there, 2.5 s up (5 m), then hold."""
    path = reference_for(waypoints)
    still = (0.0, 0.0, 0.0)
    assert path.sample(-1.0) == path.sample(0.0) == ((0.0, 0.0, 1.0), still, still, 0.0)
    assert path.sample(1.999)[1] == still
    position, velocity, acceleration, yaw = path.sample(3.25)
    assert position == pytest.approx((1.5, 2.0, 1.0))
    assert velocity == pytest.approx((1.2, 1.6, 0.0))
    assert acceleration == still
    assert yaw == pytest.approx(pi / 4)
    assert path.sample(4.6) == ((3.0, 4.0, 1.0), still, still, radians(-170.0))
    position, velocity, _, yaw = path.sample(6.75)
    assert position == pytest.approx((3.0, 4.0, 3.5))
    assert velocity == pytest.approx((0.0, 0.0, 2.0))
    assert yaw == pytest.approx(radians(-85.0))
    assert path.sample(8.1) == path.sample(1e6) == ((3.0, 4.0, 6.0), still, still, 0.0)


def test_a_legs_yaw_turns_the_short_way(tmp_path: Path) -> None:
    file = tmp_path / "turn.csv"
    file.write_text("0,0,1,170\n1,0,1,-170\n", "utf-8")
    path = reference_for(Waypoints(file=str(file)))
    assert path.sample(0.5)[3] == pytest.approx(pi)


@given(time_s=st.floats(0.0, 12.0))
@settings(deadline=None, max_examples=60, suppress_health_check=[])
def test_waypoint_velocity_is_the_derivative_but_at_corners(
    tmp_path_factory: pytest.TempPathFactory, time_s: float
) -> None:
    file = tmp_path_factory.getbasetemp() / "derivative.csv"
    file.write_text(ROWS, "utf-8")
    path, h = reference_for(Waypoints(file=str(file), speed_m_s=2.0)), 1e-5
    if min(abs(time_s - corner) for corner in (0.0, 2.0, 4.5, 5.5, 8.0)) < 2 * h:
        return
    for axis in range(3):
        slope = (path.sample(time_s + h)[0][axis] - path.sample(time_s - h)[0][axis]) / (2 * h)
        assert slope == pytest.approx(path.sample(time_s)[1][axis], abs=1e-7)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x,y,z\n1,2,up\n", "row 2, column z: 'up'; allowed: a finite number (metres)"),
        ("1,2,3\n1,nan,3\n", "row 2, column y: 'nan'; allowed: a finite number (metres)"),
        ("1,2,3,east\n", "row 1, column yaw: 'east'; allowed: a finite number (degrees)"),
        ("1,2,3,0,-1\n", "row 1, column hold: '-1'; allowed: a finite number (seconds, at least 0)"),
        ("1,2,,0\n", "row 1, column z: ''; allowed"),
        ("1,2\n", "row 1: 2 columns; allowed: 3 to 5, x,y,z,yaw,hold"),
        ("1,2,3,4,5,6\n", "row 1: 6 columns; allowed: 3 to 5"),
        ("1,2,3\nx,y,z\n", "row 2, column x: 'x'"),
        ("# nothing\n\n", "no waypoint; at least one row"),
    ],
)
def test_a_wrong_waypoint_file_is_named_with_row_and_column(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "wrong.csv"
    file.write_text(text, "utf-8")
    with pytest.raises(ScenarioError) as caught:
        reference_for(Waypoints(file=str(file)))
    assert str(caught.value).startswith(str(file))
    assert said in str(caught.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"absent\.csv: cannot be read"):
        reference_for(Waypoints(file=str(tmp_path / "absent.csv")))
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ScenarioError, match=r"binary\.csv: cannot be read"):
        reference_for(Waypoints(file=str(tmp_path / "binary.csv")))
