"""Component metadata: what ground stations read of the table, and the checksums they check."""

from __future__ import annotations

import json
import lzma
from typing import Any

from mavsitl_vehicle.autopilot import metadata
from mavsitl_vehicle.autopilot.parameters import TABLE

KEYS = {
    "name", "type", "shortDesc", "longDesc", "units", "default", "decimalPlaces", "min", "max", "increment",
    "rebootRequired", "group", "category", "volatile", "values", "bitmask", "readOnly",
}  # fmt: skip
"""All that MAVLink's parameter.schema.json allows."""


def described() -> dict[str, dict[str, Any]]:
    document = json.loads(metadata.parameters_json())
    assert document["version"] == 1
    assert document.keys() == {"version", "parameters"}
    return {row["name"]: row for row in document["parameters"]}


def bitwise_crc(data: bytes) -> int:
    register = 0
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register


def test_every_parameter_is_described_within_the_schema() -> None:
    rows = described()
    assert list(rows) == sorted(TABLE)
    for name, row in rows.items():
        assert row.keys() <= KEYS
        assert row["type"] == ("Int32" if TABLE[name].is_integer else "Float")
        assert row["min"] <= row["default"] <= row["max"]
        if TABLE[name].is_integer:
            assert all(isinstance(row[key], int) for key in ("default", "min", "max"))
            assert "decimalPlaces" not in row


def test_rows_of_each_kind() -> None:
    rows = described()
    assert rows["COM_OF_LOSS_T"] == {
        "name": "COM_OF_LOSS_T", "type": "Float", "shortDesc": TABLE["COM_OF_LOSS_T"].text, "group": "Commander",
        "category": "Standard", "default": 1.0, "min": 0.0, "max": 60.0, "units": "s", "decimalPlaces": 2,
        "increment": 0.01,
    }  # fmt: skip
    assert rows["GF_ACTION"]["values"][3] == {"value": 3, "description": "Return"}
    assert rows["COM_DLL_EXCEPT"]["bitmask"] == [
        {"index": 0, "description": "Mission"},
        {"index": 1, "description": "Hold"},
        {"index": 2, "description": "OFFBOARD"},
    ]
    assert rows["SYS_HAS_MAG"]["rebootRequired"] is True
    assert rows["COM_FLIGHT_UUID"]["volatile"] is rows["COM_FLIGHT_UUID"]["readOnly"] is True
    assert "volatile" not in rows["SYS_HAS_MAG"]


def test_the_general_file_leads_to_the_others() -> None:
    files = metadata.files()
    general = json.loads(files["/etc/extras/component_general.json"])
    assert general["version"] == 1
    (entry,) = general["metadataTypes"]
    assert entry["type"] == 1
    for uri, crc in (("uri", "fileCrc"), ("uriFallback", "fileCrcFallback")):
        data = files[entry[uri].removeprefix("mftp:/")]
        assert entry[crc] == metadata.file_crc(data) == bitwise_crc(data)
    packed = files[entry["uri"].removeprefix("mftp:/")]
    assert lzma.decompress(packed) == files["/etc/extras/parameters.json"] == metadata.parameters_json()
    assert metadata.GENERAL_URI.removeprefix("mftp:/") in files


def test_the_files_are_small_and_the_same_each_time() -> None:
    files = metadata.files()
    assert files == metadata.files()
    assert len(files["/etc/extras/parameters.json.xz"]) < 16_000
