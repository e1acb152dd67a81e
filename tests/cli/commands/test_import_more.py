"""`rig import` of combinations of channels, several samples a row, npz, folders and labels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.core.errors import ConfigurationError
from rig.evaluation.labelled_files import listed_trials
from rig.files.errors import ForeignFileError
from rig.files.imported.import_file import RecordingNotes, read_foreign
from rig.files.imported.labels import label_of, read_labels
from rig.files.imported.series import ChannelMap, Recording, recording_of
from rig.files.runfile.reader import RunFile

TABLE = np.random.default_rng(0).integers(-9, 9, (40, 5)) / 8
"""Eighths, which text and sums hold exactly."""


def csv(path: Path, table: np.ndarray = TABLE, head: str = "t,left,right,common,F") -> Path:
    table = np.array(table)
    table[:, 0] = np.arange(len(table)) / 1000
    path.write_text(head + "\n" + "\n".join(",".join(map(str, row)) for row in table.tolist()))
    return path


def read(path: Path, columns: dict[str, str], rate_Hz: float | None = 1000.0) -> Recording:
    foreign = read_foreign(path)
    return recording_of(foreign.source, ChannelMap(columns, {}, rate_Hz), path.name)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("left - common", TABLE[:, 1] - TABLE[:, 3]),
        ("2 - 4", TABLE[:, 1] - TABLE[:, 3]),
        ("-left + right", TABLE[:, 2] - TABLE[:, 1]),
        ("left + right - common", TABLE[:, 1] + TABLE[:, 2] - TABLE[:, 3]),
        ("-2", -TABLE[:, 1]),
    ],
)
def test_a_channel_may_be_a_sum_of_columns(tmp_path: Path, text: str, expected: np.ndarray) -> None:
    found = read(csv(tmp_path / "a.csv"), {"v_1": text, "v_2": "3"})
    assert found.raw["v_1"].tolist() == expected.tolist()
    assert "column 2 (left)" in found.columns["v_1"]


def test_a_column_of_that_name_has_priority(tmp_path: Path) -> None:
    path = csv(tmp_path / "a.csv", head="t,left - right,right,left,F")
    assert (
        read(path, {"v_1": "left - right", "v_2": "3"}).raw["v_1"].tolist() == TABLE[:, 1].tolist()
    )


def test_several_samples_a_row_are_in_their_order_and_rate(tmp_path: Path) -> None:
    path = csv(tmp_path / "a.csv")
    found = read(path, {"v_1": "2..3", "v_2": "common..F", "time": "1"}, rate_Hz=None)
    assert found.rate_Hz == 2000.0
    assert found.raw["v_1"].tolist() == TABLE[:, 1:3].ravel().tolist()
    assert found.raw["v_2"].tolist() == TABLE[:, 3:5].ravel().tolist()
    again = read(path, {"v_1": "2..3 - 4..5", "v_2": "4..5"})
    assert again.raw["v_1"].tolist() == (TABLE[:, 1:3] - TABLE[:, 3:5]).ravel().tolist()


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"v_1": "2..4", "v_2": "4..5"}, "samples per row: v_1 3, v_2 2; all channels need"),
        ({"v_1": "2..3 - 4", "v_2": "4..5"}, "its terms have 1 and 2 samples per row"),
        ({"v_1": "3..2", "v_2": "4..5"}, "column 2 (left) comes before column 3 (right)"),
        ({"v_1": "left - nothing", "v_2": "4"}, "nothing"),
        (
            {"v_1": "left - common", "v_2": "left - common"},
            "v_1 and v_2 are both column 2",
        ),
        ({"v_1": "2 -", "v_2": "4"}, "2 -"),
        ({"v_1": "2..", "v_2": "4"}, "''"),
    ],
)
def test_what_cannot_be_combined_is_named(
    tmp_path: Path, columns: dict[str, str], reason: str
) -> None:
    with pytest.raises(ForeignFileError) as refused:
        read(csv(tmp_path / "a.csv"), columns)
    assert reason in refused.value.one_line()


def matrices(folder: Path) -> Path:
    """An npz file of two matrices."""
    path = folder / "m.npz"
    np.savez(path, M=TABLE[:, 1:], N=TABLE)
    return path


def test_ranges_of_a_matrix_do_not_depend_on_the_order_of_asking(tmp_path: Path) -> None:
    """`M:3 - M:1` before `M:1..M:3` is not a reversed range."""
    path = matrices(tmp_path)
    found = read(path, {"v_1": "M:2..M:3 - M:1..2", "v_2": "M:1..M:2"})
    assert found.raw["v_1"].tolist() == (TABLE[:, 2:4] - TABLE[:, 1:3]).ravel().tolist()
    assert found.raw["v_2"].tolist() == TABLE[:, 1:3].ravel().tolist()
    with pytest.raises(ForeignFileError, match="samples per row: v_1 1, v_2 3"):
        read(path, {"v_1": "M:3 - M:1", "v_2": "M:1..M:3"})


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("M:3..M:1", "M:3..M:1: column 1 comes before column 3; exchange them"),
        ("M:1..N:3", "M:1..N:3: a range must be of the columns of one variable; write it like"),
        ("M..N", "M..N: a range must be of the columns of one variable"),
        ("M:1..", "M:1..: a range must be of the columns of one variable"),
        ("M:1..M:9", "variable M has 4 columns: M:5 is none of them"),
        ("K:1..K:2", "no variable 'K:1'"),
    ],
)
def test_a_range_that_a_matrix_does_not_have_is_named(
    tmp_path: Path, text: str, reason: str
) -> None:
    """A range is of one variable, and in its order."""
    with pytest.raises(ForeignFileError) as refused:
        read(matrices(tmp_path), {"v_1": text, "v_2": "M:1..M:2"})
    assert reason in refused.value.one_line()


def test_an_npz_is_read_as_a_matlab_file_is(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, strips=TABLE[:, 1:3], force=TABLE[:, 4].astype(np.float32), words=np.array("x"))
    columns = {"v_1": "strips:1", "v_2": "strips:2", "F_n": "force"}
    found = read(path, columns)
    assert found.raw["v_2"].tolist() == TABLE[:, 2].tolist()
    assert found.raw["F_n"].tolist() == TABLE[:, 4].tolist()
    assert read_foreign(path).source.format == "NumPy npz"
    with pytest.raises(ForeignFileError) as refused:
        read(path, {**columns, "v_1": "strip"})
    assert "no variable 'strip'" in refused.value.one_line()
    assert "force, strips" in refused.value.one_line()


@pytest.mark.parametrize("dtype", ["?", "u1", "f2", "g"])
def test_a_mask_of_any_type_marks_when_something_begins(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "a.npz"
    begun = (np.arange(len(TABLE)) >= 8).astype(dtype)
    np.savez(path, left=TABLE[:, 1], right=TABLE[:, 2], moves=begun)
    found = read(path, {"v_1": "left", "v_2": "right", "motion": "moves"})
    assert found.labels_s["motion"] == 0.008


def test_a_mask_is_no_signal_and_is_listed_for_what_it_can_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, left=TABLE[:, 1], right=TABLE[:, 2], moves=np.arange(len(TABLE)) >= 8)
    with pytest.raises(ForeignFileError, match="variable moves is logical, v_2 is read in V"):
        read(path, {"v_1": "left", "v_2": "moves"})
    with pytest.raises(ForeignFileError) as refused:
        read(path, {"v_1": "left", "v_2": "right", "motion": "move"})
    assert "it has left, right, and for motion, slip and lift_off moves" in str(refused.value.hint)


def test_what_is_not_a_number_in_an_npz_is_refused_with_a_remedy_for_numpy(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, left=TABLE[:, 1].astype("M8[ms]"), right=TABLE[:, 2])
    with pytest.raises(ForeignFileError) as refused:
        read(path, {"v_1": "left", "v_2": "right"})
    assert refused.value.hint == "save it as an array of numbers, such as float64"


def test_a_single_number_is_not_a_channel(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, left=TABLE[:, 1], right=3.0)
    with pytest.raises(ForeignFileError, match="variable right is a single number, not a vector"):
        read(path, {"v_1": "left", "v_2": "right"})


def test_a_matrix_with_a_row_for_each_channel_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, strips=np.arange(600.0).reshape(2, 300))
    with pytest.raises(ForeignFileError, match="strips has 2 rows and 300 columns") as refused:
        read(path, {"v_1": "strips:1", "v_2": "strips:2"})
    assert "transpose" in str(refused.value.hint)
    with pytest.raises(ForeignFileError, match="strips has 2 rows and 300 columns"):
        read(path, {"v_1": "strips", "v_2": "strips:2"})


def test_a_matrix_with_a_row_for_each_packet_of_many_samples_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, packets=np.arange(1000.0).reshape(2, 500))
    found = read(path, {"v_1": "packets:1..packets:250", "v_2": "packets:251..packets:500"})
    assert found.raw["v_1"].tolist() == [*np.arange(250.0), *np.arange(500.0, 750.0)]


def test_pickled_objects_in_an_npz_are_not_loaded(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (tmp_path / "ran",)

    path = tmp_path / "a.npz"
    np.savez(path, strips=TABLE[:, :2], evil=np.array([Evil()], dtype=object))
    assert read(path, {"v_1": "strips:1", "v_2": "strips:2"}).rows == len(TABLE)
    with pytest.raises(ForeignFileError, match="variable evil holds values of the type object"):
        read(path, {"v_1": "strips:1", "v_2": "evil"})
    assert not (tmp_path / "ran").exists()
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ForeignFileError, match="not a readable NumPy npz"):
        read(path, {"v_1": "strips:1", "v_2": "strips:2"})


def with_labels(tmp_path: Path, motion_row: int = 10, slip_row: int | None = 25) -> Path:
    table = np.array(TABLE)
    table[:, 3] = np.arange(40) >= motion_row
    table[:, 4] = 0 if slip_row is None else np.arange(40) >= slip_row
    return csv(tmp_path / "a.csv", table)


def test_columns_that_begin_are_labels(tmp_path: Path) -> None:
    columns = {"v_1": "2", "v_2": "3", "motion": "4", "slip": "5"}
    found = read(with_labels(tmp_path), columns)
    assert set(found.raw) == {"v_1", "v_2"}
    assert label_of(found, None, "a.csv") == {
        "label": "slip", "motion_s": 0.010, "node_slip_s": 0.025, "ridge_slip_s": 0.025,
    }  # fmt: skip
    never = read(with_labels(tmp_path, slip_row=None), columns)
    assert label_of(never, None, "a.csv") == {"label": "hold", "motion_s": 0.010}


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ({"label": "slide", "motion_s": "0.01"}, "label 'slide' is not one of slip, "),
        ({"ridge_slip_s": "0.02"}, "not when the motion began"),
        ({"motion_s": "0.02", "ridge_slip_s": "0.01"}, "ridge_slip_s 0.01 s is before motion_s"),
        (
            {"motion_s": "0.01", "ridge_slip_s": "9"},
            "9 s in --labels: the record is from 0 to",
        ),
        ({"motion_s": "soon"}, "motion_s 'soon' in --labels is not a number"),
        (
            {"label": "hold", "motion_s": "0.01", "ridge_slip_s": "0.02"},
            "'hold' with the time",
        ),
        ({"label": "slip", "motion_s": "0.01"}, "label 'slip' without the time ridge_slip_s"),
    ],
)
def test_labels_that_cannot_be_are_refused(
    tmp_path: Path, line: dict[str, str], reason: str
) -> None:
    found = read(csv(tmp_path / "a.csv"), {"v_1": "2", "v_2": "3"})
    with pytest.raises(ForeignFileError) as refused:
        label_of(found, line, "a.csv")
    assert reason in refused.value.one_line()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("file\na.csv\n", "its first line must name the column 'file' and one of label"),
        ("file,slip\na.csv,1\n", "unknown column 'slip'"),
        ("file,label\na.csv,hold\na.csv,hold\n", "line 3: a.csv appears twice"),
    ],
)
def test_a_list_of_labels_that_cannot_be_used_is_refused(
    tmp_path: Path, text: str, reason: str
) -> None:
    path = tmp_path / "labels.csv"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as refused:
        read_labels(path)
    assert reason in refused.value.one_line()
    assert RecordingNotes().labels is None


@pytest.mark.thorough
def test_a_folder_of_labelled_trials_can_be_scored(rig: Any) -> None:
    folder = rig.folder / "trials"
    folder.mkdir()
    rng = np.random.default_rng(1)
    for number in (1, 2):
        table = np.zeros((2000, 5))
        table[:, 1:3] = 1e-4 * rng.standard_normal((2000, 2))
        csv(folder / f"t{number}.csv", table)
    (folder / "t3.csv").write_text("nothing\n")
    (folder / "remarks.pdf").write_text("no recording")
    labels = folder / "labels.csv"  # among the recordings, of which it is none
    labels.write_text("file,label,motion_s,ridge_slip_s\nt1.csv,hold,0.5,\nt2.csv,slip,0.5,1.2\n")
    line = ("import", "trials", "--channels", "v_1=2,v_2=3", "--time", "1", "--no-figures")
    done = rig.run(*line, "--labels", "trials/labels.csv", "--json")
    assert done.code == 5, done.stderr
    assert "t3.csv: no rows of two numbers" in done.errors[0]
    reported = json.loads(done.stdout)
    assert reported["summary"] == {"files": 3, "failed": 1}
    files = [one["file"] for one in reported["results"]]
    (rig.folder / "list.csv").write_text("file\n" + "\n".join(files) + "\n")
    with RunFile.open(rig.folder / files[1]) as run:
        assert run.readings()[0]["label"] == "slip"
        assert run.readings()[0]["ridge_slip_s"] == 1.2
    held, slipped = (one.truth for one, _ in listed_trials(rig.folder / "list.csv"))
    assert (held.label, held.motion_s, held.slipped) == ("hold", 0.5, False)
    assert (slipped.label, slipped.ridge_slip_s, slipped.slipped) == ("slip", 1.2, True)
    scored = rig.run("score", "--files", "list.csv", "--no-roc")
    assert scored.code == 0, scored.stderr
    assert rig.run("verify", *files).code == 0
    wrong = rig.run(*line, "--labels", "list.csv")
    assert wrong.code == 2
