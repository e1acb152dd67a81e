"""Whatever is in a text or an LVM file: it is read as it stands, or refused in a sentence."""

from __future__ import annotations

import re
from typing import Any

import foreign_files as files
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from imports import read

from rig.files.errors import ForeignFileError
from rig.files.imported.series import ChannelMap, Recording, recording_of
from rig.files.imported.text import read_text

FEW = settings(
    max_examples=20,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
DIALECTS = st.sampled_from(
    [
        *(("tab", "point"), ("tab", "comma"), ("semicolon", "point"), ("semicolon", "comma")),
        *(("comma", "point"), ("space", "point"), ("space", "comma")),
    ]
)
VOLTS = st.floats(-900, 900)
TABLES = st.lists(st.tuples(VOLTS, VOLTS, VOLTS), min_size=2, max_size=12)


def accepted(content: str | bytes, columns: dict[str, str]) -> tuple[Any, Recording] | None:
    """What is made of a text; None where it is refused in one sentence."""
    raw = content.encode("utf-8", "surrogatepass") if isinstance(content, str) else content
    try:
        source = read_text(raw, "x")
        return source, recording_of(source, ChannelMap(columns, {}, 1000.0), "x")
    except ForeignFileError as error:
        refusal = error.one_line()
    assert refusal.startswith("x: ")
    assert len(refusal) < 1000
    return None


@FEW
@given(TABLES, DIALECTS, st.sampled_from([None, "a{0}b{0}c"]))
def test_any_table_comes_through(
    rows: list[tuple[float, ...]], dialect: tuple[str, str], header: str | None
) -> None:
    columns = dict(zip("abc", np.array(rows).T, strict=True))
    head = None if header is None else header.format(files.MARK[dialect[0]])
    found = accepted(files.text(columns, *dialect, head), {"v_1": "1", "v_2": "3"})
    assert found is not None
    np.testing.assert_array_equal(found[1].raw["v_1"], columns["a"])
    np.testing.assert_array_equal(found[1].raw["v_2"], columns["c"])


SPOILT = st.sampled_from(
    [*"0159.,;-+eE \t\n\r\"'#_", "\0", "NaN", "inf", "\n\n", "٣", "\u2028", "−", "1,5", ";;"]
)


@settings(FEW, max_examples=80)
@given(TABLES, DIALECTS, st.data())
def test_a_corrupt_text_is_refused_or_read_as_it_stands(
    rows: list[tuple[float, ...]], dialect: tuple[str, str], data: st.DataObject
) -> None:
    """What is accepted is what a second, simpler reader finds in the lines that are named, and no
    line is left out."""
    columns = dict(zip("abc", np.array(rows).T, strict=True))
    content = files.text(columns, *dialect)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        cut = data.draw(st.integers(0, 3))
        content = content[:at] + data.draw(SPOILT) + content[at + cut :]
        assume(content)
    found = accepted(content, {"v_1": "1", "v_2": "3"})
    if found is None:
        return
    source, recording = found
    lines = content.replace("\r\n", "\n").replace("\r", "\n").rstrip(" \t\n").split("\n")
    numbers = [int(source.place(row).removeprefix("line ")) for row in range(recording.rows)]
    assert numbers == list(range(numbers[0], len(lines) + 1))
    above = [line for line in lines[: numbers[0] - 1] if line.strip()]
    for line in above:
        assert not re.fullmatch(r"[-+0-9.,;eE \t]*[0-9][-+0-9.,;eE \t]*", line), line
    delimiter, decimal = source.written_as.split(", decimal ")
    for row, number in enumerate(numbers):
        line = lines[number - 1].replace('"', "")
        mark = r"[ \t]+" if delimiter == "space" else files.MARK[delimiter]
        cells = re.split(mark, line.strip(" \t") if delimiter == "space" else line)
        for channel, k in (("v_1", 0), ("v_2", 2)):
            text = cells[k].replace(",", ".") if decimal == "comma" else cells[k]
            assert recording.raw[channel][row] == float(text)


@settings(FEW, max_examples=60)
@given(st.one_of(st.binary(max_size=300), st.text(max_size=300)))
def test_anything_else_is_refused_in_a_sentence(content: bytes | str) -> None:
    found = accepted(content, {"v_1": "1", "v_2": "2"})
    if found is not None:
        assert np.isfinite(found[1].raw["v_1"]).all()


@settings(FEW, max_examples=40)
@given(st.data())
def test_a_corrupt_lvm_is_refused_or_read_in_full(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    written = files.signals(6)
    content = files.lvm(written)
    at = data.draw(st.integers(20, len(content) - 1))
    content = content[:at] + data.draw(SPOILT) + content[at + data.draw(st.integers(0, 40)) :]
    try:
        recording = read(content, tmp_path_factory.getbasetemp(), {"v_1": "2", "v_2": "3"})
    except ForeignFileError:
        return
    assert recording.rows == 6 or "Samples" not in content
