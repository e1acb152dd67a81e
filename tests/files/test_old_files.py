"""Files that earlier versions of the program wrote are read, verified and continued as before.

``data/files-of-version-1.tar.xz`` was written by the program before its folders were regrouped: a
sweep with its journal, an interrupted journal, and an imported recording with its processed file.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import recorded_run as run

from rig.detector.detector import DETECTOR_VERSION
from rig.detector.registered import chosen_detector
from rig.detector.settings import DetectorSettings
from rig.files.journal.reader import read_journal
from rig.files.journal.writer import JournalWriter
from rig.files.processed.reader import ProcessedFile
from rig.files.runfile.compile import compile_run, journal_equals_file
from rig.files.runfile.reader import RunFile
from rig.files.runfile.recover import interrupted, recover
from rig.files.verify import verdict
from rig.processing.detection import DetectionJob, DetectionResult, detect_file

IMPORT = "2026-11-23T21-11-42_import_r001"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    shutil.unpack_archive(Path(__file__).parent / "data" / "files-of-version-1.tar.xz", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "extent"),
    [
        ("sweep.rigj", "complete, 5 of 5 points"),
        ("sweep.h5", "complete, 5 of 5 points"),
        (f"{IMPORT}.h5", "complete, 1 of 1 point"),
        (f"processed/{IMPORT}.rig-1-31e5fc930dbe.h5", "rig 1, 4 events in 1 trial"),
    ],
)
def test_they_verify_as_sound(old: Path, name: str, extent: str) -> None:
    found = verdict(old / name)
    assert found.findings == ()
    assert found.extent == extent


def test_an_old_run_file_gives_readings_and_samples(old: Path) -> None:
    with RunFile.open(old / "sweep.h5") as file:
        assert file.outcome.status == "complete"
        assert file.point_ids() == list(run.POINTS)
        np.testing.assert_array_equal(file.column("frequency"), run.FREQUENCIES)
        assert file.column("remark").tolist() == ["", "µ-slip", "", "", ""]
        (wave,) = file.waveforms(run.POINTS[3])
        np.testing.assert_array_equal(wave.counts["force"], run.samples(3)[:, 1])
        assert wave.rate_Hz == 4000.0
        assert file.header.layout.column("gain").long_name == "Gain (dB)"


def test_an_old_journal_compiles_to_what_the_old_file_holds(old: Path) -> None:
    again = compile_run(old / "sweep.rigj", old / "again.h5")
    assert journal_equals_file(old / "sweep.rigj", old / "sweep.h5")
    with h5py.File(old / "sweep.h5") as before, h5py.File(again) as after:
        was, now = objects(before), objects(after)
    # Counts are now labelled as what they are scaled to (decision 0094).
    for name in [name for name in now if name.endswith("@scale_factor")]:
        counts = name.removesuffix("@scale_factor")
        assert now.pop(name) == now[f"{counts}@scale"]
        assert now.pop(f"{counts}@add_offset") == now[f"{counts}@offset"]
        assert was.pop(f"{counts}@units") == "count"
        assert now.pop(f"{counts}@units") == now[f"{counts}@scaled_units"]
        del was[f"{counts}@long_name"], now[f"{counts}@long_name"]
    # Every number of the run itself has a unit now: counts have 1.
    assert was.pop("entry/points/attempt@units") == ""
    for name in sorted(now.keys() - was.keys()):
        assert name.startswith(("entry/outcome/", "entry/points/", "entry/parameters/"))
        assert name.endswith("@units")
        assert now.pop(name) == "1"
    assert was == now


def objects(file: h5py.File) -> dict[str, object]:
    """Every dataset's bytes or texts, and every attribute, by its path."""
    found: dict[str, object] = {}

    def note(path: str, item: h5py.Group | h5py.Dataset) -> None:
        for name, value in item.attrs.items():
            if name not in ("REFERENCE_LIST", "DIMENSION_LIST", "CLASS", "NAME"):  # of axes
                found[f"{path}@{name}"] = np.asarray(value).tolist()
        if isinstance(item, h5py.Dataset):
            value = item[()]
            kind = item.dtype.kind
            found[path] = value.tobytes() if kind in "iufb" else np.asarray(value).tolist()

    file.visititems(note)
    return found


def test_an_old_interrupted_run_is_continued_and_recovered(old: Path) -> None:
    journal = old / "interrupted.rigj"
    assert interrupted(journal).kept_ids() == list(run.POINTS[:2])
    with JournalWriter.reopen(journal) as writer:
        for number in (2, 3, 4):
            run.take_point(writer, number, 50)
        writer.end(run.end(attempt=2))
        writer.sync()
    contents = read_journal(journal)
    assert [attempt.status for attempt in contents.attempts][2] == "discarded"
    with RunFile.open(recover(journal)) as file:
        assert file.point_ids() == list(run.POINTS)
        assert file.outcome.attempt == 2


def test_an_old_processed_file_is_read_and_its_parameters_find_the_same_slip_today(
    old: Path,
) -> None:
    target = old / "processed" / f"{IMPORT}.rig-1-31e5fc930dbe.h5"
    before = target.read_bytes()
    with ProcessedFile.open(target) as processed:
        (first, *_) = [event for _, event in processed.events() if event.kind == "incipient slip"]
        assert first.time_s == 0.832
        assert processed.source.file_name == f"{IMPORT}.h5"
        assert list(processed.findings()) == []
        settings = processed.settings
    assert isinstance(settings, DetectorSettings)
    chosen = replace(chosen_detector("rig"), settings=settings)
    found = detect_file(DetectionJob(old / f"{IMPORT}.h5", chosen))
    assert isinstance(found, DetectionResult)
    # The detector's version is another one, so that both results stand side by side.
    assert found.file.name == f"{IMPORT}.rig-{DETECTOR_VERSION}-31e5fc930dbe.h5"
    assert target.read_bytes() == before
    with ProcessedFile.open(found.file) as processed:
        (again, *_) = [event for _, event in processed.events() if event.kind == "incipient slip"]
        assert again.time_s == first.time_s
