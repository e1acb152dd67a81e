"""The run file that an import makes: where it comes from, what it claims, what ends it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import foreign_files as files
import h5py
import numpy as np
import pytest
import recorded_run as run
from imports import BY_NUMBER, PROGRAM

from rig.core.errors import RigError
from rig.files.definitions import definition_path
from rig.files.errors import RecordingError
from rig.files.imported import import_file as importing
from rig.files.imported.import_file import RecordingNotes, read_foreign, write_import
from rig.files.imported.series import ChannelMap
from rig.files.journal.format import to_json
from rig.files.journal.values import RunHeader
from rig.files.runfile.reader import RunFile
from rig.files.runfile.recover import interrupted, recover
from rig.files.verify import verify

ABOUT = RecordingNotes(
    sensor="skin 9",
    sample="silicone",
    object="glass",
    user="A. Person",
    notes="from the shelf",
    options={"channels": "v_1=2,v_2=3", "time": "1"},
)
FORCED = BY_NUMBER | {"F_n": "4"}


def imported(
    folder: Path,
    about: RecordingNotes = ABOUT,
    columns: dict[str, str] = FORCED,
    name: str = "s.csv",
) -> Path:
    """A run file made of a text of four columns."""
    path = folder / name
    forced = files.signals() | {"F_n": np.linspace(1, 2, 40)}
    path.write_text(files.text(forced, header="t,S1,S2,Fn"))
    channels = ChannelMap(columns, {"v_2": -1e-3})
    return write_import(read_foreign(path), channels, about, folder / "results", PROGRAM)[0]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported(tmp_path_factory.mktemp("import"))


def test_the_file_says_where_it_comes_from_and_claims_nothing_else(file: Path) -> None:
    with RunFile.open(file) as opened:
        assert opened.outcome.imported
        assert opened.outcome.simulated is None
        entry = opened.entry
        assert entry["title"][()] == b"IMPORTED recording s.csv"
        assert entry["data/title"][()].startswith(b"IMPORTED")
        assert entry["outcome/imported"][()]
        for unknown in ("outcome/simulated", "start_time", "end_time"):
            assert unknown not in entry
        origin = entry["origin"]
        foreign = file.parents[2] / "s.csv"
        reported = subprocess.run(
            ["sha256sum", foreign], capture_output=True, text=True, check=True
        )
        assert origin["sha256"][()].decode() == reported.stdout.split()[0]
        assert origin["bytes"][()] == foreign.stat().st_size
        assert origin["file_name"][()] == b"s.csv"
        assert origin["format"][()] == b"text"
        assert origin["head"][()] == b"t,S1,S2,Fn"
        assert origin["options/channels"][()] == b"v_1=2,v_2=3"
        assert entry["program_name"].attrs["version"] == "0.0.1"
        assert opened.settings["sensor"] == "skin 9"
        assert opened.settings["object"] == "glass"
        assert opened.header.sample.name == "silicone"
        assert opened.header.user.name == "A. Person"
        assert entry["notes/data"][()] == b"from the shelf"
        assert "start" not in entry["events/time"].attrs


def test_raw_numbers_their_scale_and_what_follows_are_there(file: Path) -> None:
    written = files.signals()
    with RunFile.open(file) as opened:
        series = {w.stream: w for w in opened.waveforms("recording")}
        assert {w.rate_Hz for w in series.values()} == {1000.0}
        strips = series["strips"]
        np.testing.assert_array_equal(strips.counts["strip_2"], written["v_2"])
        assert strips.scale == {"strip_1": 1.0, "strip_2": -1e-3}
        assert strips.units == "V"
        v_1, v_2 = strips.values("strip_1"), strips.values("strip_2")
        np.testing.assert_array_equal(series["signals"].values("v_d"), v_1 - v_2)
        assert series["force"].units == "N"
        (reading,) = opened.readings()
        assert reading == {"samples": 40, "rate_Hz": 1000.0, "length_s": 0.04}
    with h5py.File(file) as opened:
        data = opened["entry/data"]
        np.testing.assert_array_equal(data["v_1"], v_1)
        np.testing.assert_array_equal(data["v_2"], v_2)
        np.testing.assert_array_equal(data["v_d"], v_1 - v_2)
        np.testing.assert_array_equal(data["time"], np.arange(40) / 1000)
        np.testing.assert_array_equal(opened["entry/force/F_n"], np.linspace(1, 2, 40))


@pytest.mark.thorough
def test_validators_and_viewers_take_it(file: Path, tmp_path: Path) -> None:
    import xarray
    from nexusformat.nexus.validate import lint_nxdl, validate_application, validate_file
    from silx.io.nxdata import NXdata, get_default

    definition = definition_path("NXrig_import")
    assert lint_nxdl(definition) == []
    dated = replace(ABOUT, start_time="2026-01-02T10:00:00+01:00")
    for path in (file, imported(tmp_path, dated, BY_NUMBER)):
        assert verify(path) == []
        assert validate_file(str(path)) == (0, 0)
        assert validate_application(str(path), application=str(definition)) == (0, 0)
        with h5py.File(path) as opened:
            assert get_default(opened).group.name == "/entry/data"
            for group in [opened["entry/data"], *opened["entry/waveforms"].values()]:
                assert NXdata(group).is_valid, group.name
        with xarray.open_dataset(
            path, group="/entry/data", engine="h5netcdf", phony_dims="sort"
        ) as data:
            assert data["v_d"].shape == (40,)
    with h5py.File(path) as opened:
        assert opened["entry/start_time"][()] == b"2026-01-02T10:00:00+01:00"
        assert opened["entry/end_time"][()] == b"2026-01-02T10:00:00.040000+01:00"
        assert "force" not in opened["entry"]


def test_it_is_read_only_with_its_checksum_and_cannot_be_resumed(file: Path) -> None:
    assert file.stat().st_mode & 0o777 == 0o444
    names = sorted(p.name for p in file.parent.iterdir())
    assert names == [file.name, f"{file.name}.sha256"]
    assert re.fullmatch(r"[0-9T-]+_import_r001\.h5", file.name)
    with pytest.raises(RigError, match="nothing to resume"):
        interrupted(file)


def test_changed_marks_are_found(tmp_path: Path) -> None:
    for change, finding in (
        ("outcome/imported", "outcome/imported is False"),
        ("origin", "origin is missing"),
    ):
        file = imported(tmp_path)
        file.chmod(0o644)
        with h5py.File(file, "a") as opened:
            del opened[f"entry/{change}"]
            if change == "outcome/imported":
                opened["entry/outcome/simulated"] = False
        assert finding in "; ".join(verify(file))
    file = imported(tmp_path)
    file.chmod(0o644)
    with h5py.File(file, "a") as opened:
        opened["entry/start_time"] = "2026-01-02T10:00:00+01:00"
    assert "start_time is there, although it was not known" in verify(file)


def test_a_run_of_this_bench_has_nothing_of_it() -> None:
    """Journals and files of earlier versions verify as they did."""
    header = RunHeader.model_validate(run.header())
    assert "origin" not in to_json(header)
    for change in ({"simulated": None}, {"start_time": None}):
        with pytest.raises(ValueError, match="not imported"):
            RunHeader.model_validate(run.header() | change)


@pytest.mark.parametrize("failure", [KeyboardInterrupt, SystemExit, RecordingError])
def test_what_ends_an_import_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: Any
) -> None:
    error = failure("x.h5", "full") if failure is RecordingError else failure()

    def fail(*_: object) -> None:
        raise error

    for place in (
        "runfile.compile._write",
        "hdf5.publishing.sha256_of",
        "hdf5.publishing.write_checksum",
        "imported.import_file._record",
    ):
        monkeypatch.setattr(f"rig.files.{place}", fail)
        with pytest.raises(failure):
            imported(tmp_path)
        assert [p for p in (tmp_path / "results").rglob("*") if p.is_file()] == []
        monkeypatch.undo()


def test_a_killed_import_is_recovered_as_failed_and_not_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nexusformat.nexus.validate import validate_application, validate_file

    left = tmp_path / "left.rigj"
    write_rows = importing._write_rows

    def killed(writer: Any, stream: int, *rows: Any) -> None:
        write_rows(writer, stream, *rows)
        if stream == 1:
            shutil.copy(writer.path, left)

    monkeypatch.setattr(importing, "_write_rows", killed)
    imported(tmp_path)
    with pytest.raises(RigError, match="an import cannot be resumed"):
        interrupted(left)
    file = recover(left)
    assert verify(file) == []
    assert validate_file(str(file)) == (0, 0)
    definition = definition_path("NXrig_import")
    assert validate_application(str(file), application=str(definition)) == (0, 0)
    with RunFile.open(file) as opened:
        assert opened.outcome.status == "failed"
        assert opened.outcome.imported
        assert opened.point_ids() == []


def test_names_that_are_no_text_are_kept_as_far_as_they_are(tmp_path: Path) -> None:
    file = imported(tmp_path, name=os.fsdecode(b"\xff\xfe$.csv"))
    assert verify(file) == []
    with RunFile.open(file) as opened:
        assert opened.header.title == "IMPORTED recording ??$.csv"


def test_every_import_is_a_file_of_its_own(tmp_path: Path) -> None:
    first = imported(tmp_path)
    before = first.read_bytes()
    second = imported(tmp_path)
    assert second != first
    assert first.read_bytes() == before
    assert second.name.endswith("_r002.h5")
