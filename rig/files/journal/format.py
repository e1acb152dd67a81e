"""The bytes of a journal: records to and from bytes, without any file.

    magic "RIGJ0001", then records   u32 length | u32 crc32 of the payload | payload
    payload   u8 type, then a body: JSON (ASCII), or for a block
              u16 stream | u64 first_index | f64 host_time | rows

All little-endian. JSON has no NaN and no infinities: a non-finite number is written as
``{"$float": "nan"}`` ("inf", "-inf") and comes back as that float; null stays None. Finite floats
are written with ``repr`` and come back bit for bit.
"""

from __future__ import annotations

import contextlib
import json
import math
import struct
import sys
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from pydantic import BaseModel, ValidationError

from rig.core.errors import ConfigurationError
from rig.files.journal.values import End, JournalEvent, Results, RunHeader, StreamState

MAGIC = b"RIGJ0001"
MAX_PAYLOAD = 16 << 20
MAX_JSON = 4 << 20
"""JSON grows some thirty times when it is read: a bound of its own keeps a hostile record small."""

PREFIX = struct.Struct("<II")
BLOCK_HEAD = struct.Struct("<BHQd")
_JSON_KEYS = (str, int, float, type(None))
"""Types of the names that `json.dumps` takes."""


class RecordKind(IntEnum):
    """First byte of a payload: what the record is."""

    HEADER = 1
    BLOCK = 2
    EVENT = 3
    POINT_BEGIN = 4
    POINT_KEEP = 5
    POINT_DISCARD = 6
    END = 7
    STREAM = 8
    RESULTS = 9


@dataclass(frozen=True, slots=True)
class Block:
    """Rows of one stream. `data` is their bytes, C order; `host_time` is in s since the run's
    start.
    """

    stream: int
    first_index: int
    host_time: float
    data: memoryview


@dataclass(frozen=True, slots=True)
class PointBegin:
    """A point begins; `fields` is what the procedure knows about it."""

    id: str
    fields: dict[str, Any]
    text: str


@dataclass(frozen=True, slots=True)
class PointKeep:
    """The open point is valid and has this reading."""

    id: str
    reading: dict[str, Any]
    text: str


@dataclass(frozen=True, slots=True)
class PointDiscard:
    """The open point is not valid: what it recorded stays in the journal, marked as discarded."""

    id: str
    reason: str
    text: str


JournalRecord = (
    RunHeader
    | Block
    | JournalEvent
    | PointBegin
    | PointKeep
    | PointDiscard
    | End
    | StreamState
    | Results
)


class BadRecord(ValueError):  # noqa: N818 - an intermediate finding, not an error that a user sees
    """The bytes are not a record; the message is the reason."""


def to_json(value: Any) -> str:
    """Return the JSON text of a value, NaN as stated above. Raises TypeError for what JSON
    lacks."""
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"), default=_plain)
    except ValueError:
        return json.dumps(_tagged(value), allow_nan=False, separators=(",", ":"))


def unlike_json(value: Any, name: str = "") -> tuple[str, Any, str] | None:
    """Return the first thing in a nested value that `to_json` does not accept, or that is too large
    for a number of a file: its dotted name, the value, and why, as the end of "which ...". Return
    None if there is none."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, _JSON_KEYS):
                return name, key, "is a key, and keys are texts or numbers"
            inner = f"{name}.{key}" if name else str(key)
            if (found := unlike_json(item, inner)) is not None:
                return found
        return None
    if isinstance(value, (list, tuple)):
        inside = (unlike_json(item, f"{name}.{n}") for n, item in enumerate(value, 1))
        return next((found for found in inside if found is not None), None)
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        return name, value, f"is beyond {sys.float_info.max:.1e}, the largest number of a run file"
    if value is None or isinstance(value, (str, int, float)):
        return None
    with contextlib.suppress(TypeError):
        plain = _plain(value)
        if type(plain) is not type(value):  # numpy's longdouble has no plain form
            return unlike_json(plain, name)
    return name, value, "a run file cannot hold"


def from_json(text: str | bytes) -> Any:
    """Return the value of a JSON text. BadRecord for anything else, however hostile."""
    if len(text) > MAX_JSON:
        raise BadRecord(f"{len(text)} bytes of JSON, at most {MAX_JSON} are allowed")
    try:
        return json.loads(text, object_hook=_untagged, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise BadRecord(f"not JSON: {error}") from None


def _plain(value: Any) -> Any:
    """Return the NumPy scalars and arrays, settings and mappings as what json.dumps knows."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return dict(value)
    if hasattr(value, "tolist") and not isinstance(value, (bytes, memoryview)):
        plain = value.tolist()
        if not isinstance(plain, complex):
            return plain
    raise TypeError(f"{type(value).__name__} has no place in JSON")


def _tagged(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return {"$float": repr(float(value))}
    if isinstance(value, Mapping):
        return {key: _tagged(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_tagged(item) for item in value]
    if value is None or isinstance(value, (str, int, float)):
        return value
    return _tagged(_plain(value))


_NON_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def _untagged(value: dict[str, Any]) -> Any:
    if len(value) == 1 and "$float" in value:
        number = value["$float"]
        if isinstance(number, str) and number in _NON_FINITE:
            return _NON_FINITE[number]
        raise ValueError("$float is not nan, inf or -inf")
    return value


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def frame(payload: bytes) -> bytes:
    """Return a payload as a record, with its length and checksum. Raises ValueError beyond
    MAX_PAYLOAD."""
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"a record of {len(payload)} bytes; at most {MAX_PAYLOAD} are allowed")
    return PREFIX.pack(len(payload), zlib.crc32(payload)) + payload


def json_record(kind: RecordKind, value: Any) -> bytes:
    """Return a record of JSON. Raises ValueError beyond MAX_JSON, TypeError for what JSON lacks."""
    text = to_json(value).encode("ascii")
    if len(text) > MAX_JSON:
        raise ValueError(f"{kind.name}: {len(text)} bytes of JSON; at most {MAX_JSON} are allowed")
    return frame(bytes((kind,)) + text)


def block_record(stream: int, first_index: int, host_time: float, data: memoryview) -> bytes:
    """Return a record of sample rows."""
    return frame(BLOCK_HEAD.pack(RecordKind.BLOCK, stream, first_index, host_time) + data)


def decode(payload: bytes, header: RunHeader | None) -> JournalRecord:
    """Return the record of a payload whose checksum is right. BadRecord if it makes no sense.

    Without a header only a HEADER is accepted, and with one everything but a HEADER.
    """
    kind = payload[0]
    if (kind == RecordKind.HEADER) != (header is None):
        raise BadRecord("a second HEADER" if header else f"type {kind} where HEADER is expected")
    if header is not None and kind == RecordKind.BLOCK:
        return _decode_block(payload, header)
    if kind not in _JSON_KINDS:
        raise BadRecord(f"unknown record type {kind}")
    try:
        text = payload[1:].decode("utf-8")
    except UnicodeDecodeError:
        raise BadRecord("not UTF-8") from None
    value = from_json(text)
    if not isinstance(value, dict):
        raise BadRecord(f"{RecordKind(kind).name} is not a JSON object")
    return _decode_json(RecordKind(kind), value, text, header)


_JSON_KINDS = frozenset(RecordKind) - {RecordKind.BLOCK}


def _decode_block(payload: bytes, header: RunHeader) -> Block:
    if len(payload) < BLOCK_HEAD.size:
        raise BadRecord("a block too short for its own head")
    _, stream, first_index, host_time = BLOCK_HEAD.unpack_from(payload)
    data = memoryview(payload)[BLOCK_HEAD.size :]
    try:
        header.check_block(stream, len(data), first_index, host_time)
    except ValueError as error:
        raise BadRecord(f"block: {error}") from None
    return Block(stream, first_index, host_time, data)


def _decode_json(
    kind: RecordKind, value: dict[str, Any], text: str, header: RunHeader | None
) -> JournalRecord:
    if kind in (RecordKind.POINT_BEGIN, RecordKind.POINT_KEEP, RecordKind.POINT_DISCARD):
        return _decode_point(kind, value, text)
    try:
        if kind == RecordKind.HEADER:
            return RunHeader.model_validate(value)
        if kind == RecordKind.EVENT:
            return JournalEvent.model_validate(value)
        if kind == RecordKind.END:
            return End.model_validate(value)
        if kind == RecordKind.RESULTS:
            return Results.model_validate(value)
        state = StreamState.model_validate(value)
        if header is not None:
            header.check_state(state)
        return state
    except ValidationError as error:
        raise BadRecord(ConfigurationError.from_validation(error, kind.name).message) from None
    except (ValueError, RecursionError) as error:
        raise BadRecord(f"{kind.name}: {error}") from None


def _decode_point(kind: RecordKind, value: dict[str, Any], text: str) -> JournalRecord:
    point_id = value.get("id")
    if not isinstance(point_id, str) or not 0 < len(point_id) <= 256:
        raise BadRecord(f"{kind.name}: id is not a text of 1 to 256 characters")
    if kind == RecordKind.POINT_BEGIN:
        fields = value.get("point", {})
        if isinstance(fields, dict):
            return PointBegin(point_id, fields, text)
    elif kind == RecordKind.POINT_KEEP:
        reading = value.get("reading")
        if isinstance(reading, dict):
            return PointKeep(point_id, reading, text)
    else:
        reason = value.get("reason", "")
        if isinstance(reason, str):
            return PointDiscard(point_id, reason, text)
    raise BadRecord(f"{kind.name}: its content is of the wrong type")
