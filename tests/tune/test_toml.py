"""Scenarios written as files."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl import scenario
from mavsitl.scenario import Impairment, LinkChange, LinkModel, Outage, Scenario, Steps
from mavsitl.tune import toml


@pytest.mark.parametrize("name", scenario.names())
def test_every_shipped_scenario_comes_back(name: str, tmp_path: Path) -> None:
    written = scenario.load(name).scenario
    file = tmp_path / "again.toml"
    file.write_text(toml.write(written, head="two\nlines"), "utf-8")
    assert scenario.load(str(file)).scenario == written


def test_nested_tables_arrays_of_tables_and_names_come_back(tmp_path: Path) -> None:
    written = msgspec.structs.replace(
        scenario.load("hover-wind-ekf").scenario,
        link=LinkModel(
            to_ground=Impairment(loss=0.1, outages=(Outage(start_s=3.0, duration_s=1.0),)),
            changes=(LinkChange(at_s=1.0, loss=0.2), LinkChange(at_s=2.0, down=True)),
        ),
        reference=Steps(steps=scenario.load("steps-calm").scenario.reference.steps),  # type: ignore[union-attr]
        parameters={"MC_ROLL_P": 1e-7, "odd name\n": 2.0},
    )
    file = tmp_path / "again.toml"
    file.write_text(toml.write(written), "utf-8")
    assert scenario.load(str(file)).scenario == written


@given(title=st.text(), description=st.text(), number=st.floats(1e-300, 1e300))
def test_any_text_and_number_comes_back(title: str, description: str, number: float) -> None:
    written = Scenario(title=title, description=description, duration_s=number)
    data = scenario._parse(toml.write(written), "text")
    assert msgspec.convert(data, Scenario) == written


def test_a_note_stands_behind_its_key_even_where_it_has_the_default() -> None:
    text = toml.write(Scenario(title="x"), notes={"controller.altitude.k_p_per_s2": "was 3"})
    assert "[controller.altitude]\nk_p_per_s2 = 5.29  # was 3\n" in text
    assert "position" not in text
