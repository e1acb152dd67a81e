"""The run file: everything of the journal is in it, and viewers and validators take it."""

from __future__ import annotations

import errno
import json
import math
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np
import pytest
import recorded_run as run
from tiers import mostly_thorough

from rig.files.checksum import sha256_of
from rig.files.definitions import definition_path
from rig.files.errors import JournalError, RecordingError, RunFileError
from rig.files.hdf5.nexus import CHUNK_ROWS
from rig.files.journal.layout import TRUTH, Layout, Trace
from rig.files.journal.reader import read_journal
from rig.files.journal.writer import JournalWriter
from rig.files.naming import journal_path, next_run_path
from rig.files.runfile.compile import compile_run, journal_equals_file
from rig.files.runfile.read_back import differences
from rig.files.runfile.reader import RunFile
from rig.files.runfile.recover import recover
from rig.files.runfile.sample_walk import SampleWalk
from rig.files.verify import verify


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run.write_run(tmp_path_factory.mktemp("run") / "sweep.rigj")


@pytest.fixture(scope="module")
def file(journal: Path) -> Path:
    return compile_run(journal)


@pytest.fixture(scope="module")
def retired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run file whose journal is gone."""
    return compile_run(run.write_run(tmp_path_factory.mktemp("own") / "own.rigj"), retire=True)


@pytest.fixture
def own_file(retired: Path, tmp_path: Path) -> Path:
    """A run file to be damaged, its journal gone."""
    for path in retired.parent.iterdir():
        shutil.copy(path, tmp_path)
    file = tmp_path / retired.name
    file.chmod(0o644)
    return file


def test_the_curve_is_in_order_though_the_points_were_not(file: Path) -> None:
    with h5py.File(file) as opened:
        data = opened["entry/data"]
        np.testing.assert_array_equal(data["frequency"], run.FREQUENCIES)
        np.testing.assert_array_equal(data["gain"], [run.reading(n)["gain_dB"] for n in range(5)])
        assert np.isnan(data["gain_errors"][2])
        assert data["gain"].attrs["long_name"] == "Gain (dB)"
        assert data["gain"].attrs["units"] == "dB"
        style = json.loads(data.attrs["SILX_style"])
        assert style == {"axes_scale_type": ["log"], "axes_scale_types": ["log"]}


def test_raw_counts_and_their_scale_are_there_for_every_point(file: Path) -> None:
    with RunFile.open(file) as opened:
        for number, point in enumerate(run.POINTS):
            (wave,) = opened.waveforms(point)
            np.testing.assert_array_equal(wave.counts["strip_a"], run.samples(number)[:, 0])
            np.testing.assert_array_equal(wave.counts["force"], run.samples(number)[:, 1])
            assert wave.counts["force"].dtype == np.dtype("<i2")
            assert wave.rate_Hz == 1000.0 * (1 + number)
            expected = run.samples(number)[:, 1] * 1.52587890625e-4 + 0.1
            np.testing.assert_array_equal(wave.values("force"), expected)
        (between,) = opened.waveforms(status="between")
        np.testing.assert_array_equal(between.counts["strip_a"], run.samples(99, 20)[:, 0])
    with h5py.File(file) as opened:
        group = opened["entry/waveforms/f_10_Hz_lo_1_N"]
        np.testing.assert_array_equal(group["time"], np.arange(500) / 1000.0)
        assert group["force"].attrs["delay_s"] == 4e-6
        assert group["force"].attrs["range"] == 5.0
        blocks = opened["entry/blocks/daq"]
        assert blocks["host_time"][:3].tolist() == [0.05, 3.1, 3.2]
        assert group["force"].compression == "gzip"
        assert group["force"].fletcher32
        assert group["force"].shuffle


def test_what_the_run_was_is_in_the_file(file: Path) -> None:
    with RunFile.open(file) as opened:
        assert opened.settings == run.header()["settings"]
        assert opened.outcome.status == "complete"
        assert opened.outcome.points_done == 5
        assert opened.outcome.duration == 7.25
        assert opened.point_ids() == list(run.POINTS)
        assert list(opened.column("remark")) == ["", "µ-slip", "", "", ""]
        assert math.isnan(opened.readings()[2]["gain_error_dB"])
        entry = opened.entry
        assert entry["configuration/data"][()].decode() == run.BENCH_TOML
        assert entry["parameters/load/peak_N"][()] == 1.0
        assert entry["parameters/load/peak_N"].attrs["units"] == "N"
        assert entry["program_name"].attrs["configuration"] == "abc123+dirty"
        assert entry["start_time"][()] == b"2026-11-21T22:00:00+01:00"
        assert entry["events/message"][()].tolist() == [b"armed", b"done"]
        assert entry["sample/details/thickness_um"][()] == 28.0
        with pytest.raises(RunFileError, match="no column 'gian'"):
            opened.column("gian")


def test_a_setting_with_a_unit_is_a_number_also_where_it_was_left_out(tmp_path: Path) -> None:
    settings = {"tick_Hz": None, "loads_N": [], "servo": {"rate_S_s": 500}, "object": ""}
    units = {"tick_Hz": "Hz", "loads_N": "N", "servo.rate_S_s": "1/s"}
    journal = run.write_run(tmp_path / "a.rigj", settings=settings, setting_units=units)
    with RunFile.open(compile_run(journal)) as opened:
        assert opened.settings == settings
        parameters = opened.entry["parameters"]
        assert np.isnan(parameters["tick_Hz"][()])
        assert parameters["tick_Hz"].attrs["units"] == "Hz"
        assert parameters["loads_N"].shape == (0,)
        assert parameters["servo/rate_S_s"][()] == 500
        assert parameters["object"][()] == b""


def test_a_calibration_record_is_an_nxcalibration_with_its_matrix(file: Path) -> None:
    with h5py.File(file) as opened:
        part = opened["entry/instrument/calibrations/force"]
        assert part.attrs["NX_class"] == "NXcalibration"
        assert part["last_process"][()] == b"2026-01-01"
        assert part["applied"][()]
        values = part["calibration_parameters"]
        assert values["matrix"][()].tolist() == [[80.0, 0.5, 0.0], [0.0, 81.0, -0.25]]
        assert values["rows"][()] == b"[[1.0],[2.0,3.0]]"  # ragged: as text


def test_a_trace_shows_the_samples_of_the_first_kept_point(tmp_path: Path) -> None:
    layout = replace(
        run.LAYOUT,
        plots=run.LAYOUT.plots[1:],
        traces=(Trace("data", "daq", "force", ("strip_a",), title="Strip and force"),),
    )
    file = compile_run(run.write_run(tmp_path / "trial.rigj", layout=layout.to_json()))
    with h5py.File(file) as opened:
        data = opened["entry/data"]
        assert opened["entry"].attrs["default"] == "data"
        assert data.attrs["signal"] == "force"
        assert list(data.attrs["axes"]) == ["time"]
        assert data["title"][()].decode() == f"SIMULATED Strip and force: {run.POINTS[0]}"
        assert (data["force"][()] == run.samples(0)[:, 1]).all()
        assert (data["strip_a"][()] == run.samples(0)[:, 0]).all()
        assert opened["entry/points/id"][()].tolist() == [p.encode() for p in run.POINTS]
    assert verify(file) == []


def test_a_run_without_points_has_no_trace_and_is_sound(tmp_path: Path) -> None:
    layout = replace(run.LAYOUT, plots=(), traces=(Trace("data", "daq", "force"),))
    journal = run.write_run(tmp_path / "trial.rigj", order=(), layout=layout.to_json())
    file = compile_run(journal)
    with h5py.File(file) as opened:
        assert "data" not in opened["entry"]
        assert opened["entry"].attrs["default"] in opened["entry"]
    assert verify(file) == []


def test_a_simulated_run_says_so_everywhere(file: Path) -> None:
    with h5py.File(file) as opened:
        entry = opened["entry"]
        assert entry["title"][()] == b"SIMULATED Sweep of strip A"
        assert entry["data/title"][()].startswith(b"SIMULATED")
        assert entry["outcome/simulated"][()]
        for name in ("stage", "generator", "daq"):
            assert entry[f"instrument/{name}/fabrication/vendor"][()].startswith(b"SIMULATED")
            assert entry[f"instrument/{name}/fabrication/model"][()].startswith(b"SIMULATED")


def test_the_whole_world_of_a_simulated_run_is_in_its_file_with_units(tmp_path: Path) -> None:
    world = """
[simulation.world]
film = "drawn"
since = 2026-11-21
skin = { "youngs_modulus_MPa" = 1.7, "strips" = { "offset_mm" = 0.35 } }
"""
    bench = run.BENCH_TOML.rstrip() + world
    journal = run.write_run(tmp_path / "a.rigj", bench_toml=bench)
    file = compile_run(journal)
    assert verify(file) == []
    with h5py.File(file) as opened:
        found = opened["entry/simulated_world"]
        assert found["film"][()] == b"drawn"
        assert found["since"][()] == b"2026-11-21"
        assert found["skin/youngs_modulus_MPa"][()] == 1.7
        assert found["skin/youngs_modulus_MPa"].attrs["units"] == "MPa"
        assert found["skin/strips/offset_mm"].attrs["units"] == "mm"


def test_every_number_has_units_but_for_what_people_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found in a review: docs/files.md promises them, and counts had none."""
    world = "\n[simulation.world]\nfilm_gain = 10.0\nskin = { ridges = 9, strips_mm = [1, 2] }\n"
    truth = {"gross_slip_us": None, "first_slip_us": [3, None], "ridge": 4, "moves": [[0, 1.5]]}
    reading = run.reading
    monkeypatch.setattr(run, "reading", lambda n: reading(n) | {TRUTH: json.dumps(truth)})
    journal = run.write_run(
        tmp_path / "a.rigj",
        bench_toml=run.BENCH_TOML.rstrip() + world,
        settings={"trials": 20, "regrip": True, "object": "glass", "load": {"peak_N": 1.0}},
        setting_units={"load.peak_N": "N"},
    )
    file = compile_run(journal)
    assert verify(file) == []
    units: dict[str, str] = {}

    def note(name: str, item: object) -> None:
        by_people = {"details", "calibrations", "options"} & set(name.split("/"))
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "iuf" and not by_people:
            units[name] = str(item.attrs.get("units", ""))

    with h5py.File(file) as opened:
        entry = opened["entry"]
        entry.visititems(note)
        true = next(group for name, group in entry["simulated_truth"].items() if "Hz" in name)
        assert np.isnan(true["gross_slip_us"][()])
        np.testing.assert_array_equal(true["first_slip_us"][()], [3.0, math.nan])
        assert "units" not in entry["parameters/regrip"].attrs
    assert [name for name, unit in units.items() if not unit] == []
    of_truth = {n.split("/")[-1]: u for n, u in units.items() if n.startswith("simulated_truth")}
    assert of_truth == {"gross_slip_us": "us", "first_slip_us": "us", "ridge": "1", "moves": "1"}
    for name in ("outcome/exit", "outcome/seed", "parameters/trials", "simulated_world/film_gain"):
        assert units[name] == "1"
    assert units["parameters/load/peak_N"] == "N"
    assert units["simulated_world/skin/strips_mm"] == "mm"


@pytest.mark.parametrize("bench", ["no TOML", "simulation = 3", "[simulation]\nworld = 'flat'"])
def test_a_bench_file_that_states_no_world_leaves_none(tmp_path: Path, bench: str) -> None:
    file = compile_run(run.write_run(tmp_path / "a.rigj", bench_toml=bench))
    with h5py.File(file) as opened:
        assert "simulated_world" not in opened["entry"]


def test_a_real_run_does_not(tmp_path: Path) -> None:
    instruments = [i | {"simulated": False} for i in run.header()["instruments"]]
    journal = run.write_run(tmp_path / "a.rigj", simulated=False, instruments=instruments)
    file = compile_run(journal)
    assert verify(file) == []
    assert b"SIMULATED" not in file.read_bytes()


# Files and their fate


def test_the_file_is_read_only_and_its_checksum_is_beside_it(file: Path) -> None:
    assert file.stat().st_mode & 0o777 == 0o444
    command = ["sha256sum", "-c", f"{file.name}.sha256"]
    done = subprocess.run(command, cwd=file.parent, capture_output=True, check=False)
    assert done.stdout == f"{file.name}: OK\n".encode()
    assert sorted(p.suffix for p in file.parent.iterdir()) == [".h5", ".rigj", ".sha256"]


def test_the_same_journal_gives_the_same_bytes(journal: Path, file: Path, tmp_path: Path) -> None:
    again = compile_run(journal, tmp_path / file.name)
    assert sha256_of(again) == sha256_of(file)


def test_the_journal_continuesly_with_a_complete_run(tmp_path: Path) -> None:
    complete = run.write_run(tmp_path / "a.rigj")
    assert compile_run(complete, retire=True).exists()
    assert not complete.exists()
    with JournalWriter.create(tmp_path / "b.rigj", run.header()) as journal:
        run.take_point(journal, 0)
        journal.end(run.end("stopped", 1))
    assert compile_run(journal.path, retire=True).exists()
    assert journal.path.exists()


def test_a_resumed_run_supersedes_its_partial_file(tmp_path: Path) -> None:
    path = tmp_path / "a.rigj"
    with JournalWriter.create(path, run.header()) as journal:
        run.take_point(journal, 4)
        journal.point_begin(run.POINTS[0], {})
        journal.block(0, 0, 1.1, run.samples(50, 30))
    file = compile_run(path)
    with RunFile.open(file) as opened:
        assert opened.outcome.status == "failed"
        assert opened.outcome.reason == "the run ended without closing its journal"
        assert opened.entry["end_time"][()] == b"2026-11-21T22:00:04.200000+01:00"
        assert opened.point_ids() == [run.POINTS[4]]
        (wave,) = opened.waveforms(status="unfinished")
        np.testing.assert_array_equal(wave.counts["force"], run.samples(50, 30)[:, 1])
    with JournalWriter.reopen(path) as journal:
        for number in (2, 0, 1, 3):
            run.take_point(journal, number)
        journal.end(run.end(attempt=2))
    assert recover(path) == file
    assert not path.exists()
    with RunFile.open(file) as opened:
        assert opened.point_ids() == list(run.POINTS)
        assert opened.outcome.attempt == 2
        (wave,) = opened.waveforms(status="discarded")
        np.testing.assert_array_equal(wave.counts["force"], run.samples(50, 30)[:, 1])
    assert verify(file) == []


def test_another_runs_file_is_not_overwritten(journal: Path, tmp_path: Path) -> None:
    other = compile_run(run.write_run(tmp_path / "b.rigj", run_uuid="another"))
    before = sha256_of(other)
    with pytest.raises(RunFileError, match="another run"):
        compile_run(journal, other)
    assert sha256_of(other) == before


@pytest.mark.parametrize(
    ("number", "reason"),
    [(errno.EMFILE, "too many files are open"), (errno.EIO, "Input/output error")],
)
def test_a_file_that_cannot_be_opened_is_not_overwritten_as_if_it_were_damaged(
    number: int, reason: str, journal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = compile_run(run.write_run(tmp_path / "b.rigj", run_uuid="another"))
    before = sha256_of(other)

    def refuse(*_: object) -> None:
        raise OSError(number, "Unable to synchronously open file")

    monkeypatch.setattr(h5py, "File", refuse)
    with pytest.raises(RunFileError, match=f"cannot be replaced unread: {reason}") as raised:
        compile_run(journal, other)
    assert raised.value.hint == "move it away, or compile to another name"
    assert sha256_of(other) == before


def test_a_file_that_does_not_read_back_equal_is_not_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = run.write_run(tmp_path / "a.rigj")
    monkeypatch.setattr(
        "rig.files.runfile.write_samples.channel_attributes", lambda *_: {"scale": 0.0}
    )
    with pytest.raises(RunFileError, match="does not read back equal"):
        compile_run(journal, retire=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.rigj"]


FULL_DISK = """
import resource, sys
from rig.core.errors import RigError
from rig.files.runfile.compile import compile_run
for size in range(0, int(sys.argv[2]), int(sys.argv[3])):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        compile_run(sys.argv[1])
    except RigError as error:
        print(type(error).__name__, error.one_line())
"""


@pytest.mark.parametrize("every", mostly_thorough([9001, 27001], default=[27001]))
def test_a_full_disk_leaves_the_journal_and_no_half_file(
    tmp_path: Path, file: Path, every: int
) -> None:
    """Wherever in the file the disk is full; HDF5 alone crashes the process at some places."""
    journal = run.write_run(tmp_path / "a.rigj")
    size = file.stat().st_size
    command = [sys.executable, "-c", FULL_DISK, str(journal), str(size), str(every)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert len(lines) == -(-size // every)
    for line in lines:
        assert line.startswith(f"RecordingError {tmp_path / 'a.h5'}: cannot be written: File too")
        assert "journal is untouched" in line
    assert [p.name for p in tmp_path.iterdir()] == ["a.rigj"]


def test_a_folder_that_cannot_be_written_is_a_recording_error(journal: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written"):
        compile_run(journal, Path("/proc/none.h5"))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("missing.rigj", "no such file"),
        (".", "a folder"),
        ("closed.h5", "nothing to recover"),
        ("closed.rigj", "nothing to recover"),
        ("text.rigj", "not a journal"),
    ],
)
def test_recover_says_why_there_is_nothing_to_do(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "text.rigj").write_text("hello, this is a text")
    compile_run(run.write_run(tmp_path / "closed.rigj"), retire=True)
    with pytest.raises(JournalError, match=reason):
        recover(tmp_path / name)


def test_a_damaged_journal_is_compiled_as_far_as_it_is_sound_and_kept(tmp_path: Path) -> None:
    path = run.write_run(tmp_path / "a.rigj")
    data = bytearray(path.read_bytes())
    data[9000] ^= 1
    path.write_bytes(data)
    with RunFile.open(recover(path)) as opened:
        assert 0 < opened.outcome.points_done < 5
        assert opened.outcome.status == "failed"
        assert "the journal is damaged: bad record at byte" in opened.outcome.reason
    assert path.read_bytes() == data


def test_odd_names_and_odd_readings_compile(tmp_path: Path) -> None:
    points = ["a/b", "a b", "../../x", "µ", "\0", "x" * 256, "x" * 255]
    with JournalWriter.create(tmp_path / "a.rigj", run.header(points=points)) as journal:
        journal.event(run.event(message="nul \0 and µ"))
        for point in points:
            journal.point_begin(point, {})
            journal.block(0, 0, 0.0, run.samples(0, 10))
            journal.block(0, 90, 0.1, run.samples(1, 10))  # a gap: 80 rows are missing
            journal.point_keep(point, {"frequency_Hz": "fast", "gain_dB": 10**400, "x": math.inf})
        journal.end(run.end(points=len(points)))
    file = compile_run(journal.path)
    assert verify(file) == []
    with RunFile.open(file) as opened:
        assert len(opened.point_ids()) == len(points)
        assert np.isnan(opened.column("frequency")).all()
        assert opened.readings()[0]["gain_dB"] == 10**400
        assert len(list(opened.waveforms("a/b"))) == 2
        assert any("frequency" in warning for warning in opened.outcome.warnings)


@pytest.mark.parametrize("rows", [262143, 262144, 262145, 600000])
def test_long_waveforms_are_whole_across_chunks(tmp_path: Path, rows: int) -> None:
    data = run.samples(0, rows)
    with JournalWriter.create(tmp_path / "a.rigj", run.header()) as journal:
        journal.stream(run.state())
        for at in range(0, rows, 100_001):
            journal.block(0, at, 0.0, data[at : at + 100_001])
    with RunFile.open(compile_run(journal.path)) as opened:
        (wave,) = opened.waveforms(status="between")
        np.testing.assert_array_equal(wave.counts["strip_a"], data[:, 0])
        np.testing.assert_array_equal(wave.counts["force"], data[:, 1])


# Viewers and validators


def validate(path: Path) -> list[tuple[int, int]]:
    from nexusformat.nexus.validate import lint_nxdl, validate_application, validate_file

    definition = definition_path("NXrig_sweep")
    assert lint_nxdl(definition) == []
    return [validate_file(str(path)), validate_application(str(path), application=str(definition))]


def test_nexusformat_finds_nothing(file: Path, tmp_path: Path) -> None:
    assert validate(file) == [(0, 0), (0, 0)]
    with JournalWriter.create(tmp_path / "empty.rigj", run.header()):
        pass
    assert validate(compile_run(tmp_path / "empty.rigj")) == [(0, 0), (0, 0)]


def test_nexusformat_would_find_something(own_file: Path) -> None:
    with h5py.File(own_file, "a") as opened:
        del opened["entry/data/gain"]
        opened["entry/outcome/status"][()] = "fine"
    for _, errors in validate(own_file):
        assert errors + _ > 0


def test_silx_plots_every_group(file: Path) -> None:
    from silx.io.nxdata import NXdata, get_default

    with h5py.File(file) as opened:
        default = get_default(opened)
        assert default.group.name == "/entry/data"
        assert default.title == "SIMULATED Gain of the film"
        assert default.plot_style.axes_scale_types == ("log",)
        assert default.errors.name == "/entry/data/gain_errors"
        entry = opened["entry"]
        groups = [entry[name] for name in ("data", "phase", "coherence")]
        groups += [*entry["waveforms"].values(), *entry["between_points"].values()]
        assert len(groups) == 9
        for group in groups:
            assert NXdata(group).is_valid, group.name
        assert get_default(entry["waveforms"]).signal.shape == (500,)


def test_xarray_opens_the_default_plot_with_its_dimension(file: Path) -> None:
    import xarray

    with xarray.open_dataset(file, group="/entry/data", engine="h5netcdf") as data:
        assert data["gain"].dims == ("frequency",)
        assert data["gain"].sel(frequency=40.0) == run.reading(2)["gain_dB"]


KINDS = {
    "frequency": "Hz",
    "phase": "rad",
    "time": "s",
    "duration": "s",
    "host_time": "s",
    "strip_a": "V",
    "force": "V",
    "peak_N": "N",
}


def test_units_are_of_the_right_kind(file: Path) -> None:
    import pint

    units = pint.UnitRegistry()
    checked = set()

    def check(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and "units" in item.attrs:
            unit = units(str(item.attrs["units"]).replace("1", "dimensionless")).units
            last = name.split("/")[-1]
            if last in KINDS and not name.startswith("between_points"):  # of unknown scale
                assert unit.is_compatible_with(units(KINDS[last]).units), name
                checked.add(last)

    with h5py.File(file) as opened:
        opened["entry"].visititems(check)
    assert checked == set(KINDS)


# Verifying


def test_a_sound_file_has_no_findings(file: Path, journal: Path, own_file: Path) -> None:
    assert verify(file) == []
    assert verify(own_file) == []
    assert journal_equals_file(journal, file)


def test_a_changed_byte_is_found(own_file: Path) -> None:
    data = bytearray(own_file.read_bytes())
    data[-2000] ^= 1
    own_file.write_bytes(data)
    assert any("SHA-256" in finding for finding in verify(own_file))


def change(path: str, value: object):
    def act(opened: h5py.File) -> None:
        opened[f"entry/{path}"][...] = value

    return act


def rename(path: str):
    return lambda opened: opened.move(f"entry/{path}", f"entry/{path}_gone")


@pytest.mark.parametrize(
    ("act", "finding"),
    [
        (change("outcome/points_done", 4), "points_done is 4"),
        (change("outcome/status", "fine"), "outcome/status is 'fine'"),
        (change("outcome/simulated", False), "outcome/simulated is False"),
        (change("title", "Sweep"), "the title does not agree"),
        (change("points/id", "a"), "a point appears twice"),
        (change("instrument/daq/fabrication/vendor", "Keysight"), "instrument/daq"),
        (change("configuration/data", ""), "configuration is not"),
        (rename("waveforms"), "segments of samples are missing"),
        (rename("data/gain_errors"), "data/gain_errors is missing"),
        (rename("events"), "events is missing"),
        (rename("outcome/seed"), "seed"),
        (rename("journal_header"), "not a run file"),
    ],
)
def test_a_changed_file_is_found_wrong(own_file: Path, act, finding: str) -> None:
    with h5py.File(own_file, "a") as opened:
        act(opened)
    sidecar = own_file.with_name(own_file.name + ".sha256")
    sidecar.write_text(f"{sha256_of(own_file)}  {own_file.name}\n")
    findings = verify(own_file)
    assert any(finding in found for found in findings), findings


def test_a_file_that_is_not_its_journals_is_found(tmp_path: Path) -> None:
    journal = run.write_run(tmp_path / "a.rigj", order=(0, 1))
    file = compile_run(journal)
    with JournalWriter.reopen(journal) as more:
        run.take_point(more, 2)
    assert not journal_equals_file(journal, file)
    assert any("not what its journal holds" in finding for finding in verify(file))


def test_damaged_and_foreign_files_are_findings_never_a_crash(own_file: Path) -> None:
    whole = own_file.read_bytes()
    rng = np.random.default_rng(0)
    for size in (0, 7, 100, len(whole) // 2, len(whole) - 1):
        own_file.write_bytes(whole[:size])
        assert verify(own_file)
        with pytest.raises(RunFileError):
            RunFile.open(own_file)
    for _ in range(30):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 20):
            data[at] = int(rng.integers(0, 256))
        own_file.write_bytes(data)
        assert verify(own_file)
    assert verify(own_file.parent / "missing.h5") == ["no such file"]


# Names and layouts


def test_runs_of_a_day_are_counted(tmp_path: Path) -> None:
    when = datetime(2026, 11, 21, 22, 0, 0)
    first = next_run_path(tmp_path, "sweep", when)
    assert first == tmp_path / "2026-11-21" / "2026-11-21T22-00-00_sweep_r001.h5"
    JournalWriter.create(journal_path(first), run.header()).close()
    (first.parent / "2026-11-21T23-00-00_slip-trial_r016.h5").touch()
    (first.parent / "notes_r099.txt").touch()
    assert next_run_path(tmp_path, "sweep", when).name == "2026-11-21T22-00-00_sweep_r017.h5"
    assert next_run_path(tmp_path, "sweep", when.replace(day=22)).name.endswith("_r001.h5")


def test_a_layout_survives_json() -> None:
    assert Layout.from_json(json.loads(json.dumps(run.LAYOUT.to_json()))) == run.LAYOUT


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("default",), "none"),
        (("definition",), "sweep"),
        (("plots", 0, "signal"), "unknown"),
        (("plots", 0, "signal"), "remark"),
        (("plots", 0, "group"), "outcome"),
        (("plots", 0, "axes"), []),
        (("plots", 0, "log_axes"), ["phase"]),
        (("columns", 0, "name"), "a b"),
        (("columns", 0, "kind"), "image"),
        (("columns", 1, "name"), "frequency"),
        (("colour",), "red"),
    ],
)
def test_a_layout_that_makes_no_plot_is_refused(path: tuple, value: object) -> None:
    plain = run.LAYOUT.to_json()
    place = plain
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(ValueError, match=r"."):
        Layout.from_json(plain)


def test_a_journal_is_read_without_h5py() -> None:
    script = "import sys, rig.files, rig.files.runfile.recover, rig.files.verify\n"
    script += "sys.exit('h5py' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


def test_progress_can_be_read_while_the_run_writes(tmp_path: Path) -> None:
    with JournalWriter.create(tmp_path / "a.rigj", run.header()) as journal:
        run.take_point(journal, 0)
        assert read_journal(journal.path).kept_ids() == [run.POINTS[0]]


def test_a_sample_that_differs_is_found_in_whatever_chunk_it_is(tmp_path: Path) -> None:
    rows = CHUNK_ROWS + 1000
    path = tmp_path / "long.rigj"
    with JournalWriter.create(path, run.header()) as journal:
        run.take_point(journal, 0, rows)
        journal.end(run.end(points=1))
        journal.sync()
    file = compile_run(path)
    walk = SampleWalk(read_journal(path)).exhaust()
    assert differences(walk, file) == []
    assert differences(SampleWalk(read_journal(path)), file) != [], "nothing was compared"
    for row, first in ((7, 0), (CHUNK_ROWS + 999, CHUNK_ROWS)):
        changed = tmp_path / f"{row}.h5"
        changed.write_bytes(file.read_bytes())
        with h5py.File(changed, "r+") as opened:
            (data,) = opened["entry/waveforms"].values()
            data["force"][row] ^= 1
            name = data["force"].name
        assert differences(walk, changed) == [f"{name} differs at rows from {first}"]
