"""Parameters: the table, its limits, who overrides whom, what changes tell, and PX4's hash."""

from __future__ import annotations

import ast
import re
import struct
from math import inf, nan
from pathlib import Path
from typing import Any

import mavsitl_vehicle
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle import links
from mavsitl_vehicle.autopilot.parameters import INT32_MAX, INT32_MIN, TABLE, Layer, Parameters

from mavsitl.dialect import mavlink
from mavsitl.scenario import ScenarioError
from tests.autopilot.conftest import Client, flight

MUST_HAVE = """
    SYS_AUTOSTART SYS_AUTOCONFIG MAV_SYS_ID COM_RC_IN_MODE COM_RC_LOSS_T COM_DL_LOSS_T COM_LOW_BAT_ACT COM_OF_LOSS_T
    COM_OBL_RC_ACT COM_DISARM_LAND COM_DISARM_PRFLT COM_FAIL_ACT_T COM_RCL_EXCEPT COM_FLTMODE1 COM_FLTMODE2 COM_FLTMODE3
    COM_FLTMODE4 COM_FLTMODE5 COM_FLTMODE6 COM_ARM_WO_GPS NAV_DLL_ACT NAV_RCL_ACT NAV_ACC_RAD RTL_RETURN_ALT
    RTL_DESCEND_ALT RTL_LAND_DELAY MIS_TAKEOFF_ALT GF_ACTION GF_MAX_HOR_DIST GF_MAX_VER_DIST BAT_LOW_THR BAT_CRIT_THR
    BAT_EMERGEN_THR BAT1_N_CELLS BAT1_V_CHARGED BAT1_V_EMPTY BAT1_SOURCE CAL_ACC0_ID CAL_GYRO0_ID CAL_MAG0_ID
    CAL_MAG0_ROT CAL_MAG_SIDES SENS_BOARD_ROT SYS_HAS_MAG RC_MAP_ROLL RC_MAP_PITCH RC_MAP_YAW RC_MAP_THROTTLE
    RC_MAP_FLTMODE MPC_XY_VEL_MAX MPC_Z_VEL_MAX_UP MPC_Z_VEL_MAX_DN MPC_XY_CRUISE MPC_LAND_SPEED MPC_THR_HOVER
    MPC_TKO_SPEED SYS_FAILURE_EN
"""
"""What QGroundControl's setup pages, MAVSDK and their tests ask for."""


def outside(name: str) -> list[float]:
    """The nearest values that the row must refuse."""
    row = TABLE[name]
    if not row.is_integer:
        return [row.minimum - max(1e-3, 1e-6 * abs(row.minimum)), row.maximum + max(1e-3, 1e-6 * row.maximum)]
    holes = set(range(int(row.minimum), int(row.maximum))) - set(row.values) if row.values else set()
    return [row.minimum - 1, row.maximum + 1, row.minimum + 0.5, *holes]


# --- the table


def test_what_clients_need_is_there() -> None:
    assert [name for name in MUST_HAVE.split() if name not in TABLE] == []
    # QGroundControl shows "setup incomplete" where one of these is 0.
    assert all(TABLE[name].default for name in ("SYS_AUTOSTART", "CAL_ACC0_ID", "CAL_GYRO0_ID", "CAL_MAG0_ID"))
    assert TABLE["COM_RC_IN_MODE"].default == 1


def named_in_the_vehicle() -> set[str]:
    """Rows whose name stands in the vehicle's source, whole or as an f-string such as ``f"MC_{axis}RATE_P"``, and those
    of the links, which are composed of the names of links and settings.
    """
    found = {name for names in links.NAMES.values() for name in names.values()}
    for path in Path(mavsitl_vehicle.__file__).parent.rglob("*.py"):
        if path.name == "parameters.py":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            match node:
                case ast.Constant(value=str(text)):
                    found.update({text} & TABLE.keys())
                case ast.JoinedStr(values=[ast.Constant(value=str(start)), *_]) if re.match(r"[A-Z]+_", start):
                    parts = (re.escape(str(v.value)) if isinstance(v, ast.Constant) else r"\w+" for v in node.values)
                    pattern = re.compile("".join(parts))
                    found.update(name for name in TABLE if pattern.fullmatch(name))
    return found


def test_the_table_knows_what_the_vehicle_acts_on() -> None:
    """The docs page says of the others that they have no effect: `used_by` of a row must follow the code."""
    named = named_in_the_vehicle()
    assert sorted(name for name, row in TABLE.items() if row.used_by == "vehicle" and name not in named) == []
    assert sorted(name for name, row in TABLE.items() if row.used_by == "client" and name in named) == []


@pytest.mark.parametrize("name", TABLE)
def test_a_row_is_sound(name: str) -> None:
    row = TABLE[name]
    assert row.name == name
    assert re.fullmatch(r"[A-Z][A-Z0-9_]{0,15}", name)
    assert row.text
    assert row.group
    assert not row.text.endswith(".")
    assert row.problem(row.default) is None
    assert isinstance(row.default, int if row.is_integer else float)
    if row.is_integer:
        assert INT32_MIN <= row.minimum <= row.maximum <= INT32_MAX
    else:
        assert not row.values
        assert not row.bits
    if row.bits:
        assert (row.minimum, row.maximum) == (0, sum(1 << bit for bit in row.bits))


@pytest.mark.parametrize("name", TABLE)
def test_limits(name: str) -> None:
    row = TABLE[name]
    assert row.minimum <= row.default <= row.maximum
    for good in (row.minimum, row.maximum):
        assert Parameters({name: good})[name] == good
    for bad in (*outside(name), nan, inf, -inf):
        with pytest.raises(ScenarioError, match=rf"parameters\.{name}: .* is not allowed; allowed: "):
            Parameters({name: bad})


def test_a_limit_holds_for_the_float_that_the_wire_carries() -> None:
    nearest = struct.unpack("<f", struct.pack("<f", 0.1))[0]
    assert nearest > TABLE["MC_ROLLRATE_D"].maximum == 0.1
    assert Parameters().set("MC_ROLLRATE_D", nearest) is None


# --- layers


def test_unknown_name() -> None:
    with pytest.raises(ScenarioError, match=r"parameters\.MC_ROL_P: no such parameter; known: .*MC_ROLL_P"):
        Client(flight(parameters={"MC_ROL_P": 6.5}))


def test_out_of_range_in_a_scenario() -> None:
    with pytest.raises(ScenarioError, match=r"COM_OF_LOSS_T: 61 s is not allowed; allowed: 0 to 60 s"):
        Client(flight(parameters={"COM_OF_LOSS_T": 61.0}))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"MC_ROL_P": 1.0}, "hover.toml: parameters.MC_ROL_P: no such parameter; known: SYS_AUTOSTART,"),
        ({"MC_ROLL_P": 99.0}, "hover.toml: parameters.MC_ROLL_P: 99 1/s is not allowed; allowed: 0 to 30 1/s"),
        ({"FD_FAIL_R": 1.5}, "parameters.FD_FAIL_R: 1.5 deg is not allowed; allowed: whole numbers 0 to 180 deg"),
        ({"NAV_DLL_ACT": 4}, "parameters.NAV_DLL_ACT: 4 is not allowed; allowed: 0, 1, 2, 3, 5, 6"),
        ({"MC_ROLL_P": True}, "parameters.MC_ROLL_P: bool is not a number; allowed: 0 to 30 1/s"),
        ({"MC_ROLL_P": 10**400}, "parameters.MC_ROLL_P: an integer of 1329 bits 1/s is not allowed"),
    ],
)
def test_an_error_names_its_source(values: dict[str, float], text: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(text)):
        Parameters({"MC_ROLL_P": 1.0}, Layer("hover.toml", values))


def test_the_last_layer_wins() -> None:
    parameters = Parameters({"MC_ROLL_P": 1.0, "MC_YAW_P": 2.0}, Layer("scenario", {"MC_ROLL_P": 3.0}))
    assert (parameters["MC_ROLL_P"], parameters["MC_YAW_P"], parameters["MC_PITCH_P"]) == (3.0, 2.0, 6.5)


def test_integers_are_integers() -> None:
    values = Parameters({"COM_OBL_RC_ACT": 5.0, "MC_ROLL_P": 5}).as_dict()
    assert {name: type(value) for name, value in values.items()} == {
        name: int if row.is_integer else float for name, row in TABLE.items()
    }
    assert values["COM_OBL_RC_ACT"] == 5


# --- changes


def test_a_change_is_told_once_and_a_refusal_never() -> None:
    parameters = Parameters()
    told: list[tuple[str, float]] = []
    parameters.subscribe(lambda name, value: told.append((name, value)))
    assert parameters.set("MC_ROLL_P", 7.0) is None
    assert parameters.set("MC_ROLL_P", 7.0) is None
    assert parameters.set("FD_FAIL_R", 61.0) is None
    for value in (nan, inf, -inf, 3e38, 1e300, -1.0):
        assert parameters.set("MC_ROLL_P", value) is not None
    assert told == [("MC_ROLL_P", 7.0), ("FD_FAIL_R", 61)]
    assert parameters["MC_ROLL_P"] == 7.0


@pytest.mark.parametrize(
    ("name", "value", "error", "text"),
    [
        ("MC_ROL_P", 1.0, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST, "'MC_ROL_P': no such parameter"),
        ("COM_FLIGHT_UUID", 1, mavlink.MAV_PARAM_ERROR_READ_ONLY, "COM_FLIGHT_UUID: is read-only"),
        ("GF_ACTION", 6, mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE,
         "GF_ACTION: 6 is not allowed; allowed: 0, 1, 2, 3, 4, 5"),
    ],
)  # fmt: skip
def test_a_refusal_says_why(name: str, value: float, error: int, text: str) -> None:
    assert Parameters().set(name, value) == (error, text)


def test_writing_back_what_was_read_changes_nothing() -> None:
    parameters = Parameters({"MC_ROLLRATE_P": 0.32})
    told: list[str] = []
    parameters.subscribe(lambda name, value: told.append(name))
    (read,) = struct.unpack("<f", struct.pack("<f", parameters["MC_ROLLRATE_P"]))
    assert read != 0.32
    assert parameters.set("MC_ROLLRATE_P", read) is None
    assert parameters["MC_ROLLRATE_P"] == 0.32
    assert told == []


def test_the_vehicle_writes_what_clients_may_not() -> None:
    parameters = Parameters()
    parameters.put("COM_FLIGHT_UUID", 3)
    assert parameters["COM_FLIGHT_UUID"] == 3
    with pytest.raises(ValueError, match="COM_FLIGHT_UUID: -1 is not allowed"):
        parameters.put("COM_FLIGHT_UUID", -1)


def test_what_changed_and_back() -> None:
    parameters = Parameters({"MC_ROLL_P": 20.0})
    assert parameters.changed() == {}
    parameters.set("MC_ROLL_P", 6.5)
    parameters.set("GF_ACTION", 3)
    parameters.put("COM_FLIGHT_UUID", 3)
    assert parameters.changed() == {"GF_ACTION": 3, "MC_ROLL_P": 6.5}
    told: list[str] = []
    parameters.subscribe(lambda name, value: told.append(name))
    parameters.reset()
    assert sorted(told) == ["GF_ACTION", "MC_ROLL_P"]
    assert (parameters["MC_ROLL_P"], parameters["GF_ACTION"], parameters["COM_FLIGHT_UUID"]) == (20.0, 2, 3)


def test_restored_values_are_checked_one_by_one() -> None:
    parameters = Parameters()
    texts = parameters.restore(
        {
            "MC_ROLL_P": 9.0, "MC_PITCH_P": 99.0, "MC_YAW_P": "3", "GF_ACTION": 3, "GF_SOURCE": True, "FD_FAIL_R": None,
            "Ünknown name that is long": 1, "COM_FLIGHT_UUID": 7, "FD_FAIL_P": 1.5, "MPC_XY_P": nan,
        }
    )  # fmt: skip
    assert parameters.changed() == {"GF_ACTION": 3, "MC_ROLL_P": 9.0}
    assert len(texts) == 8
    assert all(text.isascii() for text in texts)
    assert "MC_PITCH_P: 99 1/s is not allowed; allowed: 0 to 30 1/s" in texts


# --- order and hash


def test_order() -> None:
    parameters = Parameters()
    assert list(parameters.names) == sorted(TABLE, key=str.encode)
    assert [parameters.index(name) for name in parameters.names] == list(range(len(TABLE)))
    assert parameters.index("MC_ROL_P") is None
    assert len(parameters) == len(TABLE)


def bitwise_hash(values: dict[str, float]) -> int:
    """PX4's `param_hash_check`, a bit at a time."""
    register = 0
    for name in sorted(values):
        if TABLE[name].volatile:
            continue
        packed = struct.pack("<i" if TABLE[name].is_integer else "<f", values[name])
        for byte in name.encode() + packed:
            register ^= byte
            for _ in range(8):
                register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register


@given(
    st.dictionaries(
        st.sampled_from(sorted(TABLE)).filter(lambda name: not TABLE[name].read_only),
        st.floats(0.0, 1.0),
        max_size=8,
    )
)
def test_hash_is_that_of_another_computation(shares: dict[str, float]) -> None:
    parameters = Parameters()
    parameters.hash()  # what is remembered must not outlive a change
    for name, share in shares.items():
        row = TABLE[name]
        value: Any = row.minimum + share * (row.maximum - row.minimum)
        parameters.set(name, round(value) if row.is_integer else value)
    assert parameters.hash() == bitwise_hash(parameters.as_dict())


def test_volatile_ones_are_not_in_the_hash() -> None:
    parameters = Parameters()
    before = parameters.hash()
    parameters.put("COM_FLIGHT_UUID", 9)
    assert parameters.hash() == before
    parameters.set("MC_ROLL_P", 6.4)
    assert parameters.hash() != before
