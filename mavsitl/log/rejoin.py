"""ULogs of both ends as one, for tools that open one file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mavsitl.log import topics
from mavsitl.log.content import Content, Table
from mavsitl.log.convert import in_order
from mavsitl.log.errors import LogError
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import NUMBERS, UlogWriter

_SEVERITIES = {
    name: level
    for level, name in enumerate(("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG"))
}
"""pyulog's names of the levels."""
_ULOG_TYPES = {
    "f4": "float", "f8": "double", "u1": "uint8_t", "u2": "uint16_t", "u4": "uint32_t", "u8": "uint64_t",
    "i4": "int32_t",
}  # fmt: skip


def write_ulog(out: Path, content: Content) -> None:
    """Rows by time, with parameters and texts. The ground's reference is a vehicle_local_position_setpoint, too, where
    the vehicle has none of its own: there tools look for it. Raises `LogError` for a tlog.
    """
    if content.kind != "ULog":
        raise LogError(f"{content.path}: a {content.kind}, which cannot become a ULog")
    tables = dict(content.tables)
    reference = tables.get(topics.TRAJECTORY_SETPOINT.key)
    if reference is not None and topics.LOCAL_POSITION_SETPOINT.key not in tables:
        tables[topics.LOCAL_POSITION_SETPOINT.key] = _as_setpoint(reference)
    declared = {key: _topic(key, table) for key, table in tables.items()}
    information = {key: value for key, value in content.information.items() if isinstance(value, str) or key in NUMBERS}
    with UlogWriter(out, information, content.parameters, topics=declared.values(), start_us=content.start_us) as log:
        log.begin({}, content.defaults)
        rows = {key: log.topic(topic) for key, topic in declared.items()}
        values = {key: _flat_rows(table) for key, table in tables.items()}
        texts, changes = list(content.texts[::-1]), list(content.changes[::-1])
        for stamp, key, row in in_order(Content(content.path, "ULog", 0, tables)):
            while texts and texts[-1][0] <= stamp:
                us, level, text = texts.pop()
                log.message(us, _SEVERITIES[level], text)
            while changes and changes[-1][0] < stamp:
                _, name, value = changes.pop()
                log.parameter(name, value)
            rows[key].append(stamp, *values[key][row])
        for us, level, text in reversed(texts):
            log.message(us, _SEVERITIES[level], text)
        for _, name, value in reversed(changes):
            log.parameter(name, value)


def _as_setpoint(reference: Table) -> Table:
    count = len(reference["timestamp"])
    free = np.full(count, np.nan, np.float32)
    position, velocity = reference["position"], reference["velocity"]
    named = zip(("x", "y", "z", "vx", "vy", "vz"), (*position.T, *velocity.T), strict=True)
    return {
        "timestamp": reference["timestamp"],
        **dict(named),
        "acceleration": np.full((count, 3), np.nan, np.float32),
        "yaw": reference["yaw"],
        "yawspeed": free,
    }


def _topic(key: str, table: Table) -> Topic:
    name, _, instance = key.partition(".")
    fields = []
    for column, values in table.items():
        if column != "timestamp":
            width = f"[{values.shape[1]}]" if values.ndim == 2 else ""
            fields.append(f"{_ULOG_TYPES[values.dtype.str[1:]]}{width} {column}")
    return Topic(name, tuple(fields), int(instance or 0))


def _flat_rows(table: Table) -> list[list[float]]:
    columns = [values for name, values in table.items() if name != "timestamp"]
    parts = [column.reshape(len(column), -1).tolist() for column in columns]
    return [[value for part in row for value in part] for row in zip(*parts, strict=True)]
