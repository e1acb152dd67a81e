"""Recordings from elsewhere: every number comes through as it was written, or the file is refused
in a sentence that names the line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import foreign_files as files
import numpy as np
import pytest
from imports import BY_NUMBER, assert_as_written, read, refused
from tiers import mostly_thorough

from rig.files.errors import ForeignFileError
from rig.files.imported.import_file import read_foreign
from rig.files.imported.source import MAX_BYTES

# Text


@pytest.mark.parametrize(
    "dialect",
    [
        *(("tab", "point"), ("tab", "comma"), ("semicolon", "point"), ("semicolon", "comma")),
        *(("comma", "point"), ("space", "point"), ("space", "comma")),
    ],
)
@pytest.mark.parametrize("header", [None, "# made by a logger; 3 channels, 1000 Hz\n\nt{0}S1{0}S2"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_text_comes_through_to_the_last_digit(
    tmp_path: Path, dialect: tuple[str, str], header: str | None, encoding: str
) -> None:
    mark = files.MARK[dialect[0]]
    head = None if header is None else header.format(mark)
    if encoding == "latin-1" and head is not None:
        head = head.replace("logger", "logger for µV")
    written = files.signals()
    content = files.text(written, *dialect, head).replace("\n", "\r\n").encode(encoding)
    assert_as_written(read(content, tmp_path), written)
    given = {"delimiter": dialect[0], "decimal": dialect[1]}
    header_lines = 0 if head is None else 3
    assert_as_written(read(content, tmp_path, header_lines=header_lines, **given), written)
    if head is not None:
        named = {"time": "t", "v_1": "S1", "v_2": "S2"}
        assert_as_written(read(content, tmp_path, named), written)


def test_columns_of_text_blanks_and_quotes_do_not_disturb(tmp_path: Path) -> None:
    written = files.signals(4)
    rows = zip(*map(np.ndarray.tolist, written.values()), strict=True)
    lines = [f'"2026-11-22, 10:00","{v_1}", {v_2} ,,ok' for _, v_1, v_2 in rows]
    content = 'when,"Strip 1, left",S2,unused,remark\n' + "\n".join(lines)
    columns = {"v_1": "Strip 1, left", "v_2": "S2"}
    assert_as_written(read(content, tmp_path, columns, rate_Hz=1000.0), written)


def test_an_empty_column_between_tabs_keeps_its_number(tmp_path: Path) -> None:
    content = "0.5\t\t1.5\t2.5\t\n0.6\t\t1.6\t2.6\t\n"
    recording = read(content, tmp_path, {"v_1": "3", "v_2": "4"}, rate_Hz=1000.0)
    assert recording.raw["v_1"].tolist() == [1.5, 1.6]
    aligned = "0.5 \t 1.5\n0.6 \t\t 1.6\n"
    columns = {"v_1": "1", "v_2": "2"}
    recording = read(aligned, tmp_path, columns, rate_Hz=1000.0, delimiter="space")
    assert recording.raw["v_2"].tolist() == [1.5, 1.6]


def test_scale_polarity_and_force_units_apply_to_the_values_alone(tmp_path: Path) -> None:
    written = files.signals() | {"F_n": np.linspace(1.0, 2.0, 40)}
    columns = BY_NUMBER | {"F_n": "4"}
    recording = read(
        files.text(written), tmp_path, columns, {"v_1": -1e-3, "v_2": 0.5, "F_n": 1e-3}
    )
    assert_as_written(recording, written)
    np.testing.assert_array_equal(recording.values("v_1"), written["v_1"] * -1e-3)
    np.testing.assert_array_equal(recording.values("F_n"), written["F_n"] * 1e-3)


ROWS = "0.000,1.5,2.5\n0.001,1.5,2.6\n0.002,1.6,2.7\n"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "an empty file"),
        (" \n\n", "an empty file"),
        ("t,v1,v2\n", "no rows of two numbers"),
        ("hello\nworld\n", "no rows of two numbers"),
        ("1.0\n2.0\n3.0\n", "no rows of two numbers"),
        (ROWS + "0.003,1.6\n", "line 4: 2 cells, the rows have 3 .*killed"),
        (ROWS + "0.003,1.6\n" + ROWS, "line 4: 2 cells, the rows have 3"),
        (ROWS + "0.003,1.6,2.7,9\n" + ROWS, "line 4: 4 cells"),
        (ROWS + "0.003,,2.7\n" + ROWS, "line 4: column 2: an empty cell is not a number"),
        (ROWS + "0.003,NaN,2.7\n" + ROWS, "line 4: column 2: 'NaN' is not a number"),
        (ROWS + "0.003,1.6,inf\n" + ROWS, "line 4: column 3: 'inf' is not a number"),
        (ROWS + "0.003,1_0,2.7\n" + ROWS, "line 4: column 2: '1_0' is not a number"),
        (ROWS + "0.003,1.6,٢\n" + ROWS, "line 4: column 3: '٢' is not a number"),
        (ROWS + '0.003,"1.6"2,2.7\n' + ROWS, "line 4: column 2: .* is not a number"),
        (ROWS + "0.003,1e999,2.7\n" + ROWS, "line 4: column 2 has a number beyond any double"),
        (ROWS + "# paused\n" + ROWS, "line 4: 1 cells"),
        (ROWS + "\n" + ROWS, "line 4: empty, but rows follow it"),
        (
            "NaN,NaN,NaN\n" + ROWS,
            "line 1: looks like a row, but column 1 holds 'NaN' where .*--header-lines 1",
        ),
        ("0.0,nan,inf\n" + ROWS, "line 1: looks like a row, but column 2 holds 'nan' where the"),
        ("0.0,1.5\n" + ROWS, "line 1: looks like a row, but not like the last ones: 3 cells"),
        ("0.0,1.5,2.50.001,1.6,2.6\n" + ROWS, "line 1: looks like a row"),
        ("0.5\n" + ROWS, "line 1: looks like a row"),
        ("t,v,v\n,NaN,1.0\n" + ROWS, "line 2: looks like a row, but column 1 holds an empty cell"),
        (ROWS + "0.003,\0,2.7\n", "line 4: character 0x00: a binary file"),
        ("x" * 70_000 + "\n" + ROWS, "line 1: 70000 characters, 65536 are allowed"),
        (",".join("1" * 1001) + "\n" + ",".join("1" * 1001), "1001 columns, 1000 are allowed"),
        (ROWS[: ROWS.index("\n")], "1 row; at least 2 are needed"),
    ],
)
def test_what_is_no_recording_is_refused_by_its_line(
    tmp_path: Path, content: str, reason: str
) -> None:
    with refused(reason):
        read(content, tmp_path, {"v_1": "2", "v_2": "3"}, rate_Hz=1000.0)


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"v_1": "0", "v_2": "3"}, "column 0: the file has 4"),
        ({"v_1": "2", "v_2": "5"}, "column 5: the file has 4"),
        ({"v_1": "S", "v_2": "2"}, "columns 2, 3 have the name 'S'; name it by its number"),
        ({"v_1": "s", "v_2": "2"}, "no column 's'; the header has S, t, v \\(mV\\)"),
        ({"v_1": "2", "v_2": "2"}, "v_1 and v_2 are both column 2"),
        ({"v_1": "2", "v_2": "4"}, "column 4 \\(v \\(mV\\)\\) is labelled mV, v_2 is read in V"),
    ],
)
def test_columns_are_what_the_file_calls_them(
    tmp_path: Path, columns: dict[str, str], reason: str
) -> None:
    content = "t,S,S,v (mV)\n0,1,2,3\n1,2,3,4\n"
    with refused(reason):
        read(content, tmp_path, columns, rate_Hz=1000.0)


def test_a_row_of_units_is_a_label_and_a_stated_scale_replaces_it(tmp_path: Path) -> None:
    content = "t\tA\tB\nms\tmV\tV\n" + "".join(f"{k}\t{k + 1}\t{k * k}\n" for k in range(5))
    with refused("labelled mV.*--scale v_1=1mV"):
        read(content, tmp_path, {"v_1": "A", "v_2": "B"}, rate_Hz=1000.0)
    with refused("labelled ms, time is read in s"):
        read(content, tmp_path, scale={"v_1": 1e-3})
    recording = read(content, tmp_path, scale={"v_1": 1e-3, "time": 1e-3})
    assert recording.rate_Hz == 1000.0
    assert recording.values("v_1")[0] == 1e-3


def test_numbers_of_columns_are_no_sample(tmp_path: Path) -> None:
    columns = {"v_1": "2", "v_2": "3"}
    for content in ("0,1,2\n" + ROWS, "1,2,3\n" + ROWS):
        with refused("line 1: .* numbers of columns; --header-lines 0 if it is a sample, 1 if"):
            read(content, tmp_path, columns, rate_Hz=1000.0)
        for header_lines, rows in ((0, 4), (1, 3)):
            recording = read(content, tmp_path, columns, rate_Hz=1e3, header_lines=header_lines)
            assert recording.rows == rows
    assert read("1,2,3\n2,1,4\n", tmp_path, columns, rate_Hz=1000.0).rows == 2


def test_a_scale_of_times_needs_times(tmp_path: Path) -> None:
    with refused("a scale of times without times"):
        read(ROWS, tmp_path, {"v_1": "2", "v_2": "3"}, {"time": 1e-3}, rate_Hz=1000.0)


def test_counts_without_a_scale_are_no_volts(tmp_path: Path) -> None:
    content = "12,30000\n15,-31000\n"
    with refused("line 2: column 2: -31000 times 1 V is too large for v_2"):
        read(content, tmp_path, {"v_1": "1", "v_2": "2"}, rate_Hz=1000.0)
    read(content, tmp_path, {"v_1": "1", "v_2": "2"}, {"v_2": 1e-3}, rate_Hz=1000.0)


def test_a_dead_channel_is_reported(tmp_path: Path) -> None:
    recording = read("1;2\n1;3\n1;4\n", tmp_path, {"v_1": "1", "v_2": "2"}, rate_Hz=1000.0)
    assert recording.warnings == ("v_1 is dead: column 1 is 1 in every row",)


def test_a_rate_at_which_no_slip_can_be_found_is_reported_with_its_likely_cause(
    tmp_path: Path,
) -> None:
    channels = {"v_1": "2", "v_2": "3", "time": "1"}
    in_ms = "0;1.5;2\n1;3;2.5\n2;4;2.6\n"
    (warning,) = read(in_ms, tmp_path, channels).warnings
    assert warning == (
        "1 Hz: slips are not found in recordings below 500 Hz; if the times are in ms, import it "
        "again with --scale time=1ms"
    )
    assert read(in_ms, tmp_path, channels, {"time": 1e-3}).warnings == ()
    stated = read(in_ms, tmp_path, {"v_1": "2", "v_2": "3"}, rate_Hz=400.0)
    assert stated.warnings == ("400 Hz: slips are not found in recordings below 500 Hz",)
    assert read(in_ms, tmp_path, {"v_1": "2", "v_2": "3"}, rate_Hz=500.0).warnings == ()
    assert read(in_ms, tmp_path, {"v_1": "2", "v_2": "3"}, rate_Hz=5e4).warnings == ()
    (warning,) = read(in_ms, tmp_path, {"v_1": "2", "v_2": "3"}, rate_Hz=1e6).warnings
    assert "1000000 Hz: slips are not found in recordings above 50000 Hz" in warning


def test_files_that_are_no_recordings_are_refused(tmp_path: Path) -> None:
    binary = np.random.default_rng(0).bytes(5000)
    with refused("a binary file, not text; text, LVM, MATLAB and NumPy npz files can be imported"):
        read(binary, tmp_path)
    with refused("not a regular file"):
        read_foreign(tmp_path)
    with refused("no such file"):
        read_foreign(tmp_path / "missing")
    huge = tmp_path / "huge"
    with huge.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with refused("larger than 128 MiB"):
        read_foreign(huge)


# Times


def timed(times: list[float] | np.ndarray, digits: int = 6) -> str:
    return "".join(f"{t:.{digits}f},{k},{-k % 7}\n" for k, t in enumerate(times))


@pytest.mark.parametrize(
    ("rate", "digits", "offset"),
    [(1000.0, 3, 0.0), (3000.0, 4, 0.0), (1024.0, 7, 12.5), (10.0, 1, 3.8e9), (999.5, 9, 0.0)],
)
def test_printed_times_give_their_round_rate(
    tmp_path: Path, rate: float, digits: int, offset: float
) -> None:
    content = timed(offset + np.arange(200) / rate, digits)
    assert read(content, tmp_path).rate_Hz == rate


@pytest.mark.parametrize(
    ("times", "reason"),
    [
        ([0, 0.001, 0.002, 0.004, 0.005, 0.006], "line 4: 0.002 s after the row above, 0.001 s"),
        ([0, 0.001, 0.002, 0.002, 0.003, 0.004], "line 4: 0 s after the row above"),
        ([0, 0.001, 0.002, 0.000, 0.001, 0.002], "line 4: -0.002 s after the row above"),
        ([0.0] * 5, "line 2: its time is not behind"),
        ([0.0, -0.001, -0.002], "line 2: its time is not behind"),
        (np.linspace(0, 1, 100) ** 1.1, "line 2: .* after the row above|off even spacing"),
        (np.arange(400) / 1000 + 4e-4 * np.sin(np.arange(400) / 30), "line .* off even spacing"),
        ([0, 1e12], "s is not a time"),
        ([0, 10.0, 20.0], "the times say 0.1 Hz: must be 1 to 1e\\+07 Hz"),
    ],
)
def test_uneven_times_are_refused_where_they_are(
    tmp_path: Path, times: list[float], reason: str
) -> None:
    with refused(reason):
        read(timed(times), tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        timed([0, 0, 0, 0, 0, 0.01, 0.01]),  # 1 kHz in hundredths
        timed([0, 0.001, 0.001, 0.002, 0.003, 0.003]),  # 1.5 kHz in thousandths
        "t,a,b\n0:00.001,1,2\n0:00.002,3,4\n",
    ],
    ids=["hundredths", "thousandths", "time of day"],
)
def test_times_that_no_rate_can_be_read_from_are_better_left_out(
    tmp_path: Path, content: str
) -> None:
    with pytest.raises(ForeignFileError) as refusal:
        read(content, tmp_path)
    assert "leave out --time and give --rate" in str(refusal.value.hint)


def test_rate_and_times_have_to_agree(tmp_path: Path) -> None:
    content = timed(np.arange(50) / 1000)
    assert read(content, tmp_path, rate_Hz=1000.2).rate_Hz == 1000.2
    with refused("--rate is 2000 Hz and the times say 1000 Hz"):
        read(content, tmp_path, rate_Hz=2000.0)
    with refused("sampling rate unknown; give --rate, or --time COLUMN"):
        read(content, tmp_path, {"v_1": "2", "v_2": "3"})


def packets(times: np.ndarray, a_row: int) -> str:
    """Rows of several times and as many samples of two strips."""
    rows = times.reshape(-1, a_row)
    numbers = np.arange(times.size).reshape(rows.shape)
    return files.text(dict(enumerate(np.hstack([rows, numbers, -numbers]).T)))


def test_times_of_every_sample_in_a_row_give_the_rate_of_the_samples(tmp_path: Path) -> None:
    """Five samples a row at 1 kHz with --time 1..5 are of 1 kHz, not 5."""
    content = packets(np.arange(100) / 1000, 5)
    columns = {"v_1": "6..10", "v_2": "11..15"}
    for times in ("1..5", "1"):
        found = read(content, tmp_path, columns | {"time": times})
        assert found.rate_Hz == 1000.0
        assert found.raw["v_1"].tolist() == list(range(100))
    with refused("times per row: 3, samples of each channel per row: 5; give one --time column"):
        read(content, tmp_path, columns | {"time": "1..3"})
    with refused("times per row: 5, samples of each channel per row: 1"):
        read(content, tmp_path, {"v_1": "6", "v_2": "11", "time": "1..5"})
    gap = np.arange(100) / 1000
    gap[57:] += 0.003
    with refused("line 12: 0.004 s after the row above"):
        read(packets(gap, 5), tmp_path, columns | {"time": "1..5"})


# LVM


@pytest.mark.parametrize("x_columns", ["One", "No", "Multi"])
@pytest.mark.parametrize(("separator", "decimal"), [("Tab", "."), ("Tab", ","), ("Comma", ".")])
def test_lvm_comes_through_with_its_rate(
    tmp_path: Path, x_columns: str, separator: str, decimal: str
) -> None:
    written = files.signals()
    delta = "0.001000".replace(".", decimal)
    segment = {"Delta_X": f"{delta}|{delta}", "X0": "0|0"}
    content = files.lvm(written, separator, decimal, x_columns, **segment)
    second = "4" if x_columns == "Multi" else "3"
    for columns in ({"v_1": "2", "v_2": second}, {"v_1": "v_1", "v_2": "v_2"}):
        assert_as_written(read(content, tmp_path, columns), written)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"Samples": "40|39"}, "40 rows, the header says Samples 39"),
        ({"Delta_X": "0.001|0.002"}, "Delta_X is 0.001 s for one channel and 0.002 s"),
        ({"Delta_X": "0.01|0.01"}, "the header says 100 Hz and the times say 1000 Hz"),
        ({"Delta_X": "0|0"}, "Delta_X 0 s is not a sampling period"),
        ({"Delta_X": "fast|fast"}, "Delta_X 'fast' is not a number"),
        ({"X0": "0|0.5"}, "X0 is 0 s for one channel and 0.5 s for another"),
        ({"X_Dimension": "Frequency|Frequency"}, "X_Dimension Frequency: not over time"),
        ({"Y_Unit_Label": "mV|Volts"}, "labelled mV, v_1 is read in V"),
        ({"separator": "Comma", "decimal": ";"}, "Decimal_Separator ';' is not one of"),
    ],
)
def test_an_lvm_header_that_says_otherwise_is_refused(
    tmp_path: Path, change: dict[str, str], reason: str
) -> None:
    content = files.lvm(files.signals(), **change)
    with refused(reason):
        read(content, tmp_path, {"v_1": "2", "v_2": "3"})


@pytest.mark.parametrize("x_digits", [0, 1, 2, 3])
def test_a_rounded_x_column_gives_way_to_the_rate_that_is_stated(
    tmp_path: Path, x_digits: int
) -> None:
    """The hint does not name --time, which was not given."""
    columns = {"v_1": "2", "v_2": "3"}
    written = files.signals(400)
    rounded = files.lvm(written, x_digits=x_digits, Samples="400|400")
    assert_as_written(read(rounded, tmp_path, columns), written)
    unstated = files.lvm(written, x_digits=x_digits, Samples="400|400", Delta_X="-")
    assert_as_written(read(unstated, tmp_path, columns, rate_Hz=1000.0), written)
    if x_digits == 2:
        with refused("if its times are only rounded, give --rate$|not behind"):
            read(unstated, tmp_path, columns)


@pytest.mark.parametrize("x_digits", [2, 3, 6])
def test_an_x_column_with_a_gap_is_refused_although_the_rate_is_stated(
    tmp_path: Path, x_digits: int
) -> None:
    written = files.signals(400)
    gap_s = 0.001 if x_digits > 2 else 0.01
    written["time"] = written["time"] + gap_s * (np.arange(400) > 200)
    content = files.lvm(written, x_digits=x_digits, Samples="400|400")
    with refused("after the row above|not behind"):
        read(content, tmp_path, {"v_1": "2", "v_2": "3"})


def test_several_segments_and_special_blocks_are_refused_by_name(tmp_path: Path) -> None:
    content = files.lvm(files.signals(4))
    again = content[content.index("Channels") :]
    columns = {"v_1": "2", "v_2": "3"}
    with refused("line 32: a second segment's header"):
        read(content + "\r\n" + again, tmp_path, columns)
    special = content.replace("Channels", "***Start_Special***\r\n***End_Special***\r\nChannels")
    with refused("line 11: a special block"):
        read(special, tmp_path, columns)
    with refused("1 of 2 lines"):
        read(content[: content.index("Channels")], tmp_path, columns)
    with refused("LVM files say themselves how they are written"):
        read(content, tmp_path, columns, delimiter="tab")


# MATLAB


@pytest.mark.parametrize(
    "kind", mostly_thorough(["5", "5 compressed", "7.3"], default=["5 compressed", "7.3"])
)
def test_matlab_variables_come_through(tmp_path: Path, kind: str) -> None:
    written = files.signals()
    variables = {
        "t": written["time"][:, None],
        "left": written["v_1"][None],
        "both": np.column_stack([written["v_1"], written["v_2"]]),
        "counts": np.arange(40, dtype=np.int16)[:, None],
        "single": written["v_2"].astype(np.float32)[:, None],
    }
    content = (
        files.matlab_73(**variables)
        if kind == "7.3"
        else files.matlab_5(compressed="compressed" in kind, **variables)
    )
    columns = {"time": "t", "v_1": "left", "v_2": "both:2", "F_n": "counts", "F_t": "single"}
    recording = read(content, tmp_path, columns)
    assert_as_written(recording, written)
    assert recording.raw["F_n"].tolist() == list(range(40))
    np.testing.assert_array_equal(recording.raw["F_t"], written["v_2"].astype(np.float32))
    assert recording.columns["v_2"] == "column 2 of variable both"


@pytest.mark.thorough
def test_the_only_matrix_needs_no_name(tmp_path: Path) -> None:
    written = files.signals()
    content = files.matlab_5(data=np.column_stack(list(written.values())), note="made in Kyoto")
    assert_as_written(read(content, tmp_path), written)


@pytest.mark.parametrize("column", ["v", "rec.v"])
def test_signals_in_a_struct_are_named_with_the_way_out(tmp_path: Path, column: str) -> None:
    """As MATLAB users keep recordings: neither the name of a part nor NAME.PART is a variable."""
    content = files.matlab_5(rec={"v": np.arange(6.0)})
    with refused("variable rec is a struct, not an array of numbers; .*'-struct', NAME"):
        read(content, tmp_path, {"v_1": column, "v_2": column}, rate_Hz=1000.0)


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ("x", "no variable 'x'; it has a, b, cube, empty, m, nan, short, z"),
        ("s", "variable s is a struct, not an array of numbers; .*-struct"),
        ("c", "variable c is a cell"),
        ("word", "variable word is a char"),
        ("sparse", "variable sparse is a sparse"),
        ("flag", "variable flag is logical, v_2 is read in V"),
        ("z", "variable z: complex128 .*real numbers"),
        ("m", "variable m has 3 columns: m is none of them; write m:1 to m:3"),
        ("m:4", "m:4 is none of them"),
        ("cube", "variable cube is 2 x 2 x 2"),
        ("empty", "variable empty is 0 x 0"),
        ("short", "variable short has 5 values, variable a 6"),
        ("nan", "row 3: variable nan: nan is not a number"),
    ],
)
@pytest.mark.thorough
def test_matlab_variables_that_are_no_signals_are_refused_by_name(
    tmp_path: Path, columns: str, reason: str
) -> None:
    from scipy.sparse import csc_array

    six = np.arange(6.0)
    content = files.matlab_5(
        a=six,
        b=six,
        m=np.ones((6, 3)),
        s={"v": 1.0},
        c=np.array([1, "x"], dtype=object),
        word="words",
        flag=np.array([True, False]),
        sparse=csc_array(np.eye(6)),
        z=six * 1j,
        cube=np.ones((2, 2, 2)),
        empty=np.zeros((0, 0)),
        short=six[:5],
        nan=np.where(six == 2, np.nan, six),
    )
    with refused(reason):
        read(content, tmp_path, {"v_1": "a", "v_2": columns}, rate_Hz=1000.0)


def test_whole_numbers_without_a_double_are_refused(tmp_path: Path) -> None:
    content = files.matlab_5(a=np.array([1, 2**53 + 1]), b=np.array([1.0, 2.0]))
    with refused("have no double"):
        read(content, tmp_path, {"v_1": "a", "v_2": "b"}, {"v_1": 1e-16}, 1000.0)


def test_structs_of_73_are_refused_by_name(tmp_path: Path) -> None:
    content = files.matlab_73(a=np.arange(4.0), b=np.arange(4.0))
    with refused("variable info is a struct"):
        read(content, tmp_path, {"v_1": "a", "v_2": "info"}, rate_Hz=1000.0)


@pytest.mark.parametrize("make", [files.matlab_5, files.matlab_73])
@pytest.mark.thorough
def test_damaged_matlab_files_are_refused(tmp_path: Path, make: Any) -> None:
    whole = make(a=np.arange(400.0), b=np.arange(400.0))
    for size in (19, 200, 600, len(whole) // 2):
        with refused("not a readable MATLAB file|no variable"):
            read(whole[:size], tmp_path, {"v_1": "a", "v_2": "b"}, rate_Hz=1000.0)


def test_a_file_that_crashes_scipy_costs_a_sentence(tmp_path: Path) -> None:
    """A struct's length, damaged: SciPy 1.17 ends with SIGSEGV on it."""
    t = np.arange(200.0)
    content = bytearray(
        files.matlab_5(a=np.sin(t), b=np.cos(t)[:, None], s={"x": 1}, m=np.outer(t, [1, 2, 3]))
    )
    content[3617] = 126
    with refused("not a readable MATLAB file"):
        read(bytes(content), tmp_path, {"v_1": "a", "v_2": "b", "F_n": "m:2"}, rate_Hz=1000.0)
