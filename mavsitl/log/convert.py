"""Logs in other formats, by the ending of the output's name: `ENDINGS`."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mavsitl.log.content import Content, Table, flat, flights_of, joined
from mavsitl.log.endings import ENDINGS, ONE_TOPIC
from mavsitl.log.errors import LogError, NoLogError


def outputs(source: Path, out: Path) -> dict[Path, Path]:
    """What `convert` is to write: log or flight to file.

    Of one it is `out`. Of a run of several flights, or of a fleet, each has a file that is named after its folder, in
    a folder that is named after `out` without its ending; folders are made. Raises `LogError`.
    """
    ending = _ending(out)
    flights = flights_of(source) if source.is_dir() else ()
    if len(flights) < 2:
        return {source: out}
    common = Path(os.path.commonpath(flights))
    into = out.with_name(out.name.removesuffix(ending))
    files = {flight: into / f"{flight.relative_to(common)}{ending}" for flight in flights}
    try:
        for file in files.values():
            file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"{into}: no folder can be made there: {error.strerror or error}") from error
    return files


def convert(source: Path, out: Path, topics: Sequence[str] = ()) -> tuple[str, ...]:
    """Write the log, or a run's ULogs as one, to `out`; the topics in it.

    `topics` are the keys of those that are wanted; empty: all. The file is there whole, or as it was before.
    Raises `LogError` for a log that cannot be read, an ending or a topic that there is not, and an output that cannot
    be written.
    """
    ending = _ending(out)
    content = joined(source)
    missing = [key for key in topics if key not in content.tables]
    if missing:
        raise NoLogError(f"{source}: no topic {', '.join(missing)}; there are {', '.join(sorted(content.tables))}")
    chosen = {key: table for key, table in content.tables.items() if not topics or key in topics}
    if ending in ONE_TOPIC and len(chosen) != 1:
        raise NoLogError(
            f"{out}: holds one topic, and there are {len(chosen)}: choose by --topic NAME, or name it "
            f"{out.stem}{out.suffix}.zip, which holds a file of each"
        )
    with _whole(out) as unfinished:
        WRITERS[ending](unfinished, replace(content, tables=chosen))
    return tuple(chosen)


def _ending(out: Path) -> str:
    for ending in ENDINGS:
        if out.name.endswith(ending) and out.name != ending:
            return ending
    raise NoLogError(f"{out}: its ending says the format; allowed: {', '.join(ENDINGS)}")


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """A name beside `out` to write to, which takes its place at the end. Raises `LogError`."""
    unfinished = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        yield unfinished
        unfinished.replace(out)
    except OSError as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            unfinished.unlink()


# --- a table ---------------------------------------------------------------------------------------------------------


def _csv_bytes(table: Table) -> bytes:
    columns = flat(table)
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(columns)
    # As numpy prints them: the shortest that reads back to the same float32.
    rows.writerows(zip(*(values.astype(str).tolist() for values in columns.values()), strict=True))
    return text.getvalue().encode()


def _parquet_bytes(table: Table) -> bytes:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise LogError("Parquet needs pyarrow: pip install 'mavsitl[sweep]'") from error
    out = io.BytesIO()
    parquet.write_table(pyarrow.table({name: pyarrow.array(values) for name, values in flat(table).items()}), out)
    return out.getvalue()


def _one(made: Callable[[Table], bytes]) -> Callable[[Path, Content], None]:
    def write(out: Path, content: Content) -> None:
        (table,) = content.tables.values()
        out.write_bytes(made(table))

    return write


def _zipped(made: Callable[[Table], bytes], ending: str) -> Callable[[Path, Content], None]:
    def write(out: Path, content: Content) -> None:
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for key, table in sorted(content.tables.items()):
                member = zipfile.ZipInfo(f"{key}{ending}")  # without the time of day: equal logs, equal archives
                member.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(member, made(table))

    return write


# --- rows of all topics, by time -------------------------------------------------------------------------------------


def in_order(content: Content) -> Iterator[tuple[int, str, int]]:
    """(us, topic, number of its row) by time, those of one time by topic."""
    names = sorted(content.tables)
    stamps = np.concatenate([content.tables[name]["timestamp"] for name in names])
    counts = [len(content.tables[name]["timestamp"]) for name in names]
    topics = np.repeat(np.arange(len(names)), counts)
    rows = np.concatenate([np.arange(count) for count in counts])
    order = np.lexsort((rows, topics, stamps))
    for stamp, topic, row in zip(
        stamps[order].tolist(), topics[order].tolist(), rows[order].tolist(), strict=True
    ):  # fmt: skip
        yield stamp, names[topic], row


def documents(table: Table) -> list[dict[str, Any]]:
    """A row each, for JSON: arrays are lists, and what is no number is null, or the text that says it is infinite."""
    columns = {name: values.tolist() for name, values in table.items()}
    for name, values in table.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            columns[name] = [_finite(each) for each in columns[name]]
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(each) for each in value]
    if math.isfinite(value):
        return value
    return None if math.isnan(value) else ("Infinity" if value > 0.0 else "-Infinity")


def _write_jsonl(out: Path, content: Content) -> None:
    made = {name: documents(table) for name, table in content.tables.items()}
    with out.open("w", encoding="utf-8", newline="\n") as file:
        for _, name, row in in_order(content):
            file.write(json.dumps({"topic": name, **made[name][row]}, separators=(",", ":")) + "\n")


def _write_mcap(out: Path, content: Content) -> None:
    from mavsitl.log.mcap import write_mcap

    write_mcap(out, content)


def _write_ulog(out: Path, content: Content) -> None:
    from mavsitl.log.rejoin import write_ulog

    write_ulog(out, content)


WRITERS: dict[str, Callable[[Path, Content], None]] = {
    ".csv.zip": _zipped(_csv_bytes, ".csv"),
    ".csv": _one(_csv_bytes),
    ".parquet.zip": _zipped(_parquet_bytes, ".parquet"),
    ".parquet": _one(_parquet_bytes),
    ".jsonl": _write_jsonl,
    ".mcap": _write_mcap,
    ".ulg": _write_ulog,
}
"""As `ENDINGS`."""
