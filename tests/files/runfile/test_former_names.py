"""Run files whose columns have former names: read, resumed and verified by the present ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_run as run
from recorded_trials import LAYOUT

from rig.files.errors import RunFileError
from rig.files.journal.layout import Column, Layout
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.verify import safe_verdict

FORMER = (
    Column("trial", key="trial", long_name="Trial"),
    Column(
        "normal_force_set",
        "N",
        key="normal_force_set_N",
        long_name="Normal force asked for (N)",
    ),
    Column(
        "normal_force",
        "N",
        key="normal_force_N",
        long_name="Mean normal force in the motion (N)",
    ),
)
STREAM = {
    "name": "signals", "device": "computed", "channels": ["v_d", "v_1", "v_2"], "dtype": "<f8",
    "row_shape": [3], "units": "V", "long_name": "strips",
}  # fmt: skip


def write(journal: Path, layout: Layout, readings: list[dict[str, Any]]) -> Path:
    """The run file of trials with these readings."""
    points = [f"trial-{number:03d}" for number in range(1, len(readings) + 1)]
    header = run.header(
        procedure="slip-trial", layout=layout.to_json(), points=points, streams=[STREAM]
    )
    state = {"stream": 0, "rate_Hz": 1e3, "scale": [1.0] * 3, "offset": [0.0] * 3, "units": "V"}
    with JournalWriter.create(journal, header) as writer:
        for point, reading in zip(points, readings, strict=True):
            writer.point_begin(point, {})
            writer.stream(state)
            writer.block(0, 0, 0.0, np.zeros((10, 3)))
            writer.point_keep(point, reading)
        writer.end(run.end("complete", len(points)))
    return compile_run(journal, retire=True)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A file of two trials, the second of them resumed by a program that has the present names."""
    return write(
        tmp_path / "old.rigj",
        replace(LAYOUT, columns=FORMER),
        [
            {"trial": 1, "normal_force_set_N": 4.0, "normal_force_N": 3.98},
            {"trial": 2, "set_normal_force_N": 4.0, "mean_normal_force_N": 4.01},
        ],
    )


def test_columns_are_read_by_their_present_names(old: Path) -> None:
    with RunFile.open(old) as opened:
        assert opened.column("set_normal_force").tolist() == [4.0, 4.0]
        assert opened.column("mean_normal_force").tolist() == [3.98, 4.01]
        assert opened.columns() == ["trial", "normal_force_set", "normal_force"], "as they are"
        with pytest.raises(RunFileError, match="no column 'static_friction'"):
            opened.column("static_friction")


def test_readings_have_their_present_keys(old: Path) -> None:
    with RunFile.open(old) as opened:
        assert opened.readings() == [
            {"trial": 1, "set_normal_force_N": 4.0, "mean_normal_force_N": 3.98},
            {"trial": 2, "set_normal_force_N": 4.0, "mean_normal_force_N": 4.01},
        ]


def test_an_old_file_is_sound(old: Path) -> None:
    assert safe_verdict(old).sound


def test_another_procedures_columns_keep_their_names(tmp_path: Path) -> None:
    """A laboratory's own may well call its mean ``normal_force``."""
    layout = replace(LAYOUT, definition="NXlab_creep", columns=FORMER)
    reading = {"trial": 1, "normal_force_set_N": 4.0, "normal_force_N": 3.98}
    with RunFile.open(write(tmp_path / "own.rigj", layout, [reading])) as opened:
        assert opened.readings() == [reading]
        with pytest.raises(RunFileError, match="no column 'mean_normal_force'"):
            opened.column("mean_normal_force")


def test_samples_without_a_unit_of_their_own_have_that_of_their_state(tmp_path: Path) -> None:
    """Of a force sensor only its driver knows whether it sends mV/V or newtons."""
    header = run.header(
        procedure="slip-trial",
        layout=LAYOUT.to_json(),
        points=["a"],
        streams=[STREAM | {"units": ""}],
    )
    state = {"stream": 0, "rate_Hz": 1e3, "scale": [1.0] * 3, "offset": [0.0] * 3, "units": "N"}
    with JournalWriter.create(tmp_path / "newtons.rigj", header) as writer:
        writer.point_begin("a", {})
        writer.stream(state)
        writer.block(0, 0, 0.0, np.zeros((10, 3)))
        writer.point_keep("a", {})
        writer.end(run.end("complete", 1))
    with RunFile.open(compile_run(tmp_path / "newtons.rigj", retire=True)) as opened:
        (waveform,) = opened.waveforms("a")
        assert waveform.units == "N"
        assert opened.entry[f"{waveform.path}/v_d"].attrs["units"] == "N"
        assert opened.entry[f"{waveform.path}/v_d"].attrs["long_name"] == "v_d (N)"
