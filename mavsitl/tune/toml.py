"""A scenario as a TOML file: what differs from the defaults, and what is to stand there in any case."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from mavsitl.scenario import Scenario

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def write(scenario: Scenario, *, head: str = "", notes: Mapping[str, str] | None = None) -> str:
    """The text of a file that `mavsitl.scenario.load` reads as this scenario.

    `head` stands above it as comments; `notes` are comments behind dotted keys, which stand there even with their
    default value.
    """
    remarks = dict(notes or {})
    data = _differing(scenario, Scenario(title=""), remarks, "")
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    if lines:
        lines.append("")
    return "\n".join([*lines, *_table(data, "", remarks)]) + "\n"


def _differing(value: msgspec.Struct, default: Any, notes: Mapping[str, str], path: str) -> dict[str, Any]:
    """Plain data of the fields that are not the default's, nested structs likewise. A tag stays."""
    data: dict[str, Any] = {}
    config = value.__struct_config__
    if config.tag_field is not None:
        data[config.tag_field] = config.tag
    same = default if type(default) is type(value) else None
    for field in msgspec.structs.fields(value):
        name, mine = field.name, getattr(value, field.name)
        key = f"{path}.{name}" if path else name
        fallback = getattr(same, name) if same is not None else _default(field)
        noted = any(note == key or note.startswith(f"{key}.") for note in notes)
        if mine is None or (mine == fallback and not noted and not field.required):
            continue
        if isinstance(mine, msgspec.Struct):
            data[name] = _differing(mine, fallback, notes, key)
        elif isinstance(mine, tuple) and mine and isinstance(mine[0], msgspec.Struct):
            data[name] = [_differing(each, None, {}, "") for each in mine]
        else:
            data[name] = msgspec.to_builtins(mine)
    return data


def _default(field: msgspec.structs.FieldInfo) -> Any:
    """Of a struct's field; `NODEFAULT` where it must be given."""
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


def _table(data: Mapping[str, Any], path: str, notes: Mapping[str, str]) -> Iterator[str]:
    """Plain keys first, then the tables below."""
    below: dict[str, Any] = {}
    for name, value in data.items():
        if isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], dict)):
            below[name] = value
            continue
        note = notes.get(_join(path, name))
        yield f"{_key(name)} = {_value(value)}" + (f"  # {note}" if note else "")
    for name, value in below.items():
        place = _join(path, name)
        for table in value if isinstance(value, list) else [value]:
            plain = any(not isinstance(each, dict) for each in table.values()) or not table
            if isinstance(value, list) or plain:
                yield ""
                yield f"[[{place}]]" if isinstance(value, list) else f"[{place}]"
            yield from _table(table, place, notes)


def _join(path: str, name: str) -> str:
    return f"{path}.{_key(name)}" if path else _key(name)


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else _text(name)


def _value(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return _text(value)
        case list() | tuple():
            return "[" + ", ".join(_value(each) for each in value) + "]"
        case dict():
            return "{" + ", ".join(f"{_key(name)} = {_value(each)}" for name, each in value.items()) + "}"
        case _:
            return repr(value)


def _text(text: str) -> str:
    """A basic string: JSON's escapes are TOML's, but for the control character that JSON lets stand."""
    return msgspec.json.encode(text).decode().replace("\x7f", "\\u007f")
