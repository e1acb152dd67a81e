"""Journals and run files as an enemy would write them: strategies for hypothesis."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

import recorded_run as run
from hypothesis import strategies as st

from rig.files.journal.format import BLOCK_HEAD, MAGIC, RecordKind, frame, to_json

DEEP: dict[str, Any] = {}
for _ in range(25):
    DEEP = {"a": DEEP}

VALUES = st.sampled_from(
    [
        *(None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**30, -(10**30), 10**400),
        *(1e308, -1e308, 5e-324, {"$float": "nan"}, {"$float": "inf"}, {"$float": "-inf"}),
        *("", "a", "\0", "\ud800", "../../../etc/passwd", "/etc/passwd", "a/b", ".", ".."),
        *("\x1b[31m", "é" * 300, "x" * 70_000, "9999-12-31T23:59:59+00:00"),
        *("0001-01-01T00:00:00+14:00", [], [[]], {}, {"": ""}, {"/": 1, ".": 2, "..": 3}),
        *([1] * 100, [1.0, 2], [[1.0], [2.0]], [[1, 2], [3]], DEEP),
    ]
)
"""Wrong types, huge counts, deep nesting, paths that climb out, terminal codes."""
KEYS = st.sampled_from(["extra", "", "/", ".", "time", "title", "a/b", "units", "simulated_truth"])


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values inside a JSON value."""
    pairs: Any = ()
    if isinstance(value, dict):
        pairs = value.items()
    elif isinstance(value, list):
        pairs = enumerate(value)
    for key, inner in pairs:
        yield (*path, key)
        yield from places(inner, (*path, key))


@st.composite
def spoiled(draw: st.DrawFn, value: Any) -> Any:
    """The JSON value with one or two of its values replaced, left out or added to."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 2))):
        inside = list(places(value))
        if not inside:
            break
        *path, key = draw(st.sampled_from(inside))
        parent = value
        for step in path:
            parent = parent[step]
        act = draw(st.sampled_from(["replace", "replace", "replace", "leave out", "add"]))
        if act == "leave out" and isinstance(parent, dict):
            del parent[key]
        elif act == "add" and isinstance(parent, dict):
            parent[draw(KEYS)] = copy.deepcopy(draw(VALUES))
        else:
            parent[key] = copy.deepcopy(draw(VALUES))
    return value


def json_record(kind: RecordKind, value: Any) -> bytes:
    """A record with the checksum that belongs to it, whatever is in it."""
    return frame(bytes((kind,)) + json.dumps(value, allow_nan=False).encode())


BLOCKS = st.builds(
    lambda stream, first, time, rows: frame(
        BLOCK_HEAD.pack(RecordKind.BLOCK, stream, first, time) + rows
    ),
    st.sampled_from([0, 1, 65535]),
    st.sampled_from([0, 5, 2**63 - 1, 2**63, 2**64 - 1]),
    st.sampled_from([0.0, -1.0, 1e10, 1e300, float("nan")]),
    st.sampled_from([b"", b"abc", b"abcd", bytes(4000)]),
)

HEADER: dict[str, Any] = json.loads(to_json(run.header()))
TRUTH = {"simulated_truth": json.dumps({"contact": {"force_N": 1.0}})}


def _body() -> list[tuple[RecordKind, Any]]:
    body: list[tuple[RecordKind, Any]] = [(RecordKind.EVENT, run.event())]
    for k in range(2):
        reading = json.loads(to_json(run.reading(k))) | TRUTH
        body += [
            (RecordKind.POINT_BEGIN, {"id": run.POINTS[k], "point": {"time": 1.0 * k}}),
            (RecordKind.STREAM, run.state()),
            (
                RecordKind.BLOCK,
                frame(BLOCK_HEAD.pack(RecordKind.BLOCK, 0, 0, 1.0) + run.samples(k, 20).tobytes()),
            ),
            (RecordKind.POINT_KEEP, {"id": run.POINTS[k], "reading": reading}),
        ]
    return [*body, (RecordKind.EVENT, run.event(6.0)), (RecordKind.END, run.end(points=2))]


@st.composite
def journals(draw: st.DrawFn) -> bytes:
    """A journal whose checksums are right and whose header or one of whose records is not."""
    header, body = HEADER, _body()
    if draw(st.booleans()):
        header = draw(spoiled(header))
    else:
        number = draw(st.integers(0, len(body) - 1))
        kind, value = body[number]
        body[number] = kind, draw(BLOCKS if kind is RecordKind.BLOCK else spoiled(value))
    if draw(st.integers(0, 4)) == 0:
        body = draw(st.permutations(body))
    records = [v if k is RecordKind.BLOCK else json_record(k, v) for k, v in body]
    return MAGIC + json_record(RecordKind.HEADER, header) + b"".join(records)


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """The bytes cut short, overwritten with others of their own or with zeros, or flipped."""
    data = bytearray(whole)
    at = draw(st.integers(0, len(data) - 1))
    act = draw(st.sampled_from(["cut", "copy", "zeros", "flip", "flip"]))
    if act == "cut":
        return bytes(data[:at])
    length = draw(st.sampled_from([8, 64, 512, 4096]))
    if act == "copy":
        other = draw(st.integers(0, len(data) - 1))
        data[at : at + length] = data[other : other + length]
    elif act == "zeros":
        data[at : at + length] = bytes(len(data[at : at + length]))
    else:
        used = [k for k, byte in enumerate(data) if byte]
        for k in draw(st.lists(st.sampled_from(used), min_size=1, max_size=16)):
            data[k] = draw(st.integers(0, 255))
    return bytes(data)
