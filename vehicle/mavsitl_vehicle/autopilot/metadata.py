"""Component metadata: what a ground station shows of each parameter, as the JSON files it fetches by MAVLink FTP.

Layout: MAVLink's component metadata, `parameter.schema.json` and `general.schema.json`; version 1, as PX4 writes it.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Mapping
from typing import Any
from zlib import crc32

from mavsitl_vehicle.autopilot.parameters import TABLE, Parameter

FOLDER = "/etc/extras"
GENERAL_URI = "mftp://etc/extras/component_general.json"
"""For COMPONENT_METADATA."""
PACKED_URI = "mftp://etc/extras/parameters.json.xz"
PLAIN_URI = "mftp://etc/extras/parameters.json"

_TYPE_PARAMETER = 1
"""COMP_METADATA_TYPE_PARAMETER"""


def file_crc(data: bytes) -> int:
    """MAVLink's CRC-32 of a file as it is transferred: polynomial 0xEDB88320, initial value 0, no final inversion."""
    return crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def parameters_json(table: Mapping[str, Parameter] = TABLE) -> bytes:
    """The description of all parameters."""
    rows = [_described(table[name]) for name in sorted(table)]
    return _encoded({"version": 1, "parameters": rows})


def general_json(packed: bytes, plain: bytes) -> bytes:
    """The file that COMPONENT_METADATA points to: it names the two forms of the parameters' file, with checksums."""
    entry = {
        "type": _TYPE_PARAMETER,
        "uri": PACKED_URI,
        "fileCrc": file_crc(packed),
        "uriFallback": PLAIN_URI,
        "fileCrcFallback": file_crc(plain),
    }
    return _encoded({"version": 1, "metadataTypes": [entry]})


def files() -> dict[str, bytes]:
    """Path in the FTP tree to content. COMPONENT_METADATA carries `GENERAL_URI` and the `file_crc` of that file."""
    plain = parameters_json()
    packed = lzma.compress(plain, preset=9)
    return {
        f"{FOLDER}/component_general.json": general_json(packed, plain),
        f"{FOLDER}/parameters.json": plain,
        f"{FOLDER}/parameters.json.xz": packed,
    }


def _described(row: Parameter) -> dict[str, Any]:
    described: dict[str, Any] = {
        "name": row.name,
        "type": "Int32" if row.is_integer else "Float",
        "shortDesc": row.text,
        "group": row.group,
        "category": row.category,
        "default": row.default,
        "min": row.minimum,
        "max": row.maximum,
    }
    long = " ".join(text for text in (row.long, f"{row.note}." if row.note else "") if text)
    optional = {
        "longDesc": long,
        "units": row.unit,
        "values": [{"value": value, "description": row.values[value]} for value in sorted(row.values)],
        "bitmask": [{"index": bit, "description": row.bits[bit]} for bit in sorted(row.bits)],
        "rebootRequired": row.reboot_required,
        "volatile": row.volatile,
        "readOnly": row.read_only,
    }
    described.update({key: value for key, value in optional.items() if value})
    if not row.is_integer:
        described["decimalPlaces"] = row.decimals
        described["increment"] = 10.0**-row.decimals
    return described


def _encoded(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode("utf-8")
