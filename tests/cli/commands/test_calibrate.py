"""``rig calibrate``: a film from the file of a sweep, force sensor and load cell from weights."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from procedures.sweep.layout import LAYOUT
from rig.analysis.estimate import with_error
from rig.cli.options.calibration import sensor_name
from rig.core.errors import ConfigurationError
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.instruments.calibration import (
    FilmCalibration,
    ForceCalibration,
    LoadCellCalibration,
    header_entry,
    read_calibration,
)
from rig.physics import pvdf
from rig.physics.vibrator import drawn_film, true_response

# --- a film from a sweep ---------------------------------------------------------------------

SEED = 3
GRID = (*np.geomspace(2, 190, 21), *np.geomspace(200, 20e3, 241))
NOISE = 1e-3
BENCH = '[film]\nname = "film 7"\namplifier_gain = 1.0\n'


def sweep_file(
    folder: Path,
    frequencies: Any = GRID,
    age_days: float = 1.0,
    end: dict[str, Any] | None = None,
    **changes: Any,
) -> Path:
    """A run file as a sweep of a drawn film leaves it, a thousandth of noise on each point."""
    start = datetime.now().astimezone() - timedelta(days=age_days)
    header = {
        "procedure": "sweep",
        "layout": LAYOUT.to_json(),
        "title": "sweep",
        "run_uuid": "6d1f3a52-7a07-4d7b-9c4a-3a5f6c1a2b3c",
        "start_time": start.isoformat(),
        "program": {"name": "rig", "version": "0.1.0"},
        "settings": {},
        "fingerprint": "",
        "bench_toml": BENCH,
        "simulated": True,
        "points": [f"{f:.9g}Hz" for f in frequencies],
        "user": {"name": "A. Person"},
    } | changes
    random = np.random.default_rng(1)
    path = folder / "run.rigj"
    with JournalWriter.create(path, header) as journal:
        for f in frequencies:
            truth = complex(true_response(f, *drawn_film(SEED)))
            noise = NOISE * abs(truth)
            found = truth + noise * complex(*random.standard_normal(2))
            journal.point_begin(f"{f:.9g}Hz", {"time": 0.0})
            journal.point_keep(
                f"{f:.9g}Hz",
                {
                    "frequency_Hz": float(f),
                    "response_real_V_N": found.real,
                    "response_imag_V_N": found.imag,
                    "response_var_real": noise**2,
                    "response_var_imag": noise**2,
                    "response_cov_real_imag": 0.0,
                    "preload_N": 25.0,
                },
            )
        ending = {"status": "complete", "duration_s": 1.0, "points_done": len(frequencies)}
        journal.end(ending | {"end_time": start.isoformat()} | (end or {}))
    return compile_run(path)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a complete sweep."""
    return sweep_file(tmp_path_factory.mktemp("sweep"))


def test_a_sweeps_file_becomes_the_films_record(rig: Any, good: Path) -> None:
    done = rig.run("calibrate", "pvdf", str(good), "--temperature", "21.5", "--json")
    assert done.code == 0, done.stderr
    path = rig.folder / done.object["file"]
    assert path.parent == rig.folder / "calibrations"
    record = read_calibration(path, FilmCalibration)

    circuit = drawn_film(SEED)[1]
    b, corner = pvdf.level_at_one_hertz(circuit), pvdf.corner_frequency(circuit)
    assert record.b_dB.value == pytest.approx(b, abs=0.02)
    assert record.corner_Hz.value == pytest.approx(corner, rel=0.01)
    assert len(record.drops) == 3
    assert record.sensor == "film 7"
    assert record.operator == "A. Person"
    assert record.temperature_degC == 21.5
    assert record.preload_N == pytest.approx(25.0)
    assert record.simulated
    assert record.source.run_uuid == "6d1f3a52-7a07-4d7b-9c4a-3a5f6c1a2b3c"
    assert record.source.file == good.name
    assert record.source.simulated
    assert record.valid_until - record.date == timedelta(days=90)
    assert done.object["simulated"] is True
    assert done.object["summary"]["b_dB"]["value"] == record.b_dB.value
    assert re.search(r"b = -\d+\.\d+ dB \(95 %: .* re 1 V/N at 1 Hz", done.stderr)
    assert "SIMULATED film 'film 7'" in done.stderr
    assert "does not include the error of the load" in done.stderr


@pytest.mark.thorough
def test_the_load_cells_record_in_the_run_widens_b(rig: Any, tmp_path: Path) -> None:
    sensitivity = {"value": 0.1, "standard_error": 0.001}
    cell = {"kind": "load-cell", "sensor": "cell 3", "sensitivity_V_N": sensitivity}
    file = sweep_file(tmp_path, calibrations=[cell])
    done = rig.run("calibrate", "pvdf", str(file), "--json")
    assert done.code == 0, done.stderr
    assert "does not include the error of the load" not in done.stderr
    found = done.object["summary"]
    assert found["load_cell_error_percent"] == pytest.approx(1.0)
    assert found["b_dB"]["standard_error"] == pytest.approx(0.0869, rel=0.02)


@pytest.mark.parametrize(
    ("bench", "gain"),
    [
        ('[film]\nname = "film 7"\n', 1.0),
        ('[film]\nname = "film 7"\namplifier_gain = 12.5\n', 12.5),
        ("", None),
    ],
    ids=["the default", "stated", "no film"],
)
def test_a_record_states_the_gain_of_its_amplifier_or_warns(
    rig: Any, tmp_path: Path, bench: str, gain: float | None
) -> None:
    """A record without a gain is refused for a strip, so that the default is recorded as well."""
    file = sweep_file(tmp_path, GRID[::8], bench_toml=bench)
    done = rig.run("calibrate", "pvdf", str(file), "--film", "film 7", "--json")
    assert done.code == 0, done.stderr
    assert (
        read_calibration(rig.folder / done.object["file"], FilmCalibration).amplifier_gain == gain
    )
    assert ("does not state the gain of the film's amplifier" in done.stderr) == (gain is None)
    assert ("does not state amplifier_gain in [film]: it is taken as 1;" in done.stderr) == (
        gain == 1.0
    )


@pytest.mark.thorough
def test_a_second_record_of_a_day_stands_beside_the_first(rig: Any, good: Path) -> None:
    arguments = ("calibrate", "pvdf", str(good), "--to", "here", "--film", "film 9", "--valid",
                 "30d", "--operator", "B. Person")  # fmt: skip
    first, second = rig.run(*arguments), rig.run(*arguments)
    paths = [rig.folder / ended.stdout.strip() for ended in (first, second)]
    assert paths[1].name == paths[0].name.replace(".json", "-2.json")
    record = read_calibration(paths[0], FilmCalibration)
    assert (record.sensor, record.operator) == ("film 9", "B. Person")
    assert record.valid_until - record.date == timedelta(days=30)


STOPPED = {"status": "stopped", "reason": "stopped by Ctrl-C", "exit": 130}


@pytest.mark.parametrize(
    ("made", "arguments", "reported"),
    [
        ({"end": STOPPED}, (), ("not complete", "rig resume")),
        ({"procedure": "slip-trial"}, (), ("a run of slip-trial, not of a sweep", "rig sweep")),
        ({"frequencies": GRID[:5]}, (), ("5 different frequencies", "too few")),
        ({"frequencies": GRID[60:80]}, (), ("20 different frequencies", "over a decade")),
        ({"age_days": 100.0}, (), ("would have expired", "--valid")),
        ({"bench_toml": ""}, (), ("does not state the film", "--film")),
        ({}, ("--valid", "soon"), ("--valid soon", "90d")),
        ({}, ("--valid", "0d"), ("1 to 3650 days",)),
        ({}, ("--film", "f" * 201), ("--film", "200")),
        ({}, ("--to", "run.h5"), ("cannot be written", "--to")),
    ],
    ids=["incomplete", "procedure", "few", "narrow", "old", "no film", "valid", "zero", "label",
         "to"],
)  # fmt: skip
@pytest.mark.thorough
def test_a_run_that_makes_no_record_is_refused_in_one_line(
    rig: Any, made: dict[str, Any], arguments: tuple[str, ...], reported: tuple[str, ...]
) -> None:
    file = sweep_file(rig.folder, **made)
    ended = rig.run("calibrate", "pvdf", file.name, *arguments)
    assert ended.code == (1 if "cannot be written" in reported else 2), ended.stderr
    (error,) = ended.errors
    for words in reported:
        assert words in error
    assert not list(rig.folder.rglob("pvdf-*.json"))


def test_a_file_that_is_no_run_is_refused(rig: Any) -> None:
    ended = rig.run("calibrate", "pvdf", "none.h5")
    assert (ended.code, ended.errors) == (2, ["error: none.h5: no such file"])
    (rig.folder / "README.md").write_text("hello\n")
    ended = rig.run("calibrate", "pvdf", "README.md")
    assert ended.code == 8
    assert ended.errors == ["error: README.md: not a journal and not a run file"]


def test_a_file_with_a_changed_byte_makes_no_record(rig: Any) -> None:
    file = sweep_file(rig.folder)
    content = bytearray(file.read_bytes())
    content[-2000] ^= 1
    file.chmod(0o644)
    file.write_bytes(content)
    ended = rig.run("calibrate", "pvdf", file.name)
    assert ended.code == 8, ended.stderr
    (error,) = ended.errors
    assert "SHA-256" in error
    assert "rig verify" in error
    assert not list(rig.folder.rglob("pvdf-*.json"))


# --- sensors from weights --------------------------------------------------------------------

QUICK = ("--duration", "0.2s", "--settling", "0.1s")


def test_the_force_sensor_of_the_simulated_bench_is_found_as_it_is(rig: Any) -> None:
    from drivers.simulated.instruments.gsv8_converter import Sensor

    done = rig.run("calibrate", "force", "--yes", "--tolerance", "0", "--json", *QUICK)
    assert done.code == 0, done.stderr
    record = read_calibration(rig.folder / done.object["file"], ForceCalibration)
    truth, truth_zero = np.array(Sensor().matrix), np.array(Sensor().zero_mV_V)
    found, errors = np.array(record.matrix_N_mV_V), np.array(record.matrix_standard_error_N_mV_V)
    off = np.abs(found - truth) / errors
    assert off.max() < 4
    assert (off <= record.coverage).sum() >= 7
    assert np.abs(found / truth - 1).max() < 0.01
    zero_errors = np.array(record.zero_standard_error_mV_V)
    assert (np.abs(np.array(record.zero_mV_V) - truth_zero) < 4 * zero_errors).all()
    assert record.largest_residual_N < 0.005
    assert record.crosstalk_percent == pytest.approx(1.82, abs=0.05)
    assert record.sensor.startswith("SIM")
    assert record.simulated
    assert len(record.readings) == 21
    assert record.readings[3].force_N == (20.0, 0.0, 0.0)
    assert record.valid_until - record.date == timedelta(days=365)
    for words in ("SIMULATED", "the simulated bench puts the weights on", "4/21: put 20 N on +x",
                  "take all weights off", "matrix (N per mV/V", "crosstalk"):  # fmt: skip
        assert words in done.stderr


@pytest.mark.parametrize(("truth", "zero"), [(0.1, 0.0), (0.0973, 0.0211)])
def test_the_load_cells_true_sensitivity_is_within_the_interval(
    rig: Any, truth: float, zero: float
) -> None:
    world = rig.world(f"load_cell_sensitivity_V_N = {truth}\nload_cell_zero_V = {zero}\n")
    done = rig.run("calibrate", "load-cell", "--yes", "--world", world, "--sensor", "cell 3",
                   "--json", *QUICK)  # fmt: skip
    assert done.code == 0, done.stderr
    record = read_calibration(rig.folder / done.object["file"], LoadCellCalibration)
    found = record.sensitivity_V_N
    assert found.value == pytest.approx(truth, rel=1e-3)
    assert found.low <= truth <= found.high
    assert record.zero_V.low <= zero <= record.zero_V.high
    assert record.sensor == "cell 3"
    assert [reading.load_N for reading in record.readings] == [0.0, 2.0, 5.0, 10.0, 0.0]
    assert header_entry(record, "it.json")["kind"] == "load-cell"


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_readings(rig: Any) -> None:
    arguments = ("calibrate", "force", "--yes", "--seed", "5", *QUICK, "--weights", "5,10")
    first, second = (rig.folder / rig.run(*arguments).stdout.strip() for _ in range(2))
    readings = [json.loads(path.read_text())["readings"] for path in (first, second)]
    assert readings[0] == readings[1]


@pytest.mark.parametrize(
    ("arguments", "code", "reported"),
    [
        (("force", "--weights", "5,60"), 4, ("60 N are over the limit of", "force_sensor")),
        (("force", "--weights", "5"), 2, ("two different weights",)),
        (("force", "--weights", "5,ten"), 2, ("--weights ten",)),
        (("force", "--weights", "0,5"), 2, ("above 0 N",)),
        (("force", "--axes", "+x,+y"), 2, ("leaves out z",)),
        (("force", "--axes", "+x,+y,up"), 2, ("'up' is not a direction",)),
        (("force", "--rate", "90000"), 4, ("--rate 90000 is outside",)),
        (("force", "--duration", "0"), 2, ("--duration",)),
        (("force", "--tolerance", "9"), 2, ("--tolerance 9", "0 to 5 percent")),
        (("force", "--valid", "soon"), 2, ("--valid soon",)),
        (("force", "--temperature", "inf"), 2, ("--temperature",)),
        (("load-cell", "--to", "/proc/none"), 2, ("cannot be written to /proc/none", "--to")),
        (("load-cell", "--weights", "5,30"), 4, ("30 N are over the limit of 20 N",)),
        (("load-cell", "--weights", "5,15"), 4, ("beyond the range of 1.25 V", "--range")),
        (("load-cell", "--preload", "15"), 4, ("25 N are over the limit of 20 N",)),
        (("load-cell", "--range", "3V"), 4, ("a range of 3 V does not exist",)),
        (("load-cell", "--range", "0V"), 2, ("--range 0V: must be above 0 V",)),
    ],
)
@pytest.mark.thorough
def test_what_cannot_be_weighed_is_refused_before_the_first_weight(
    rig: Any, arguments: tuple[str, ...], code: int, reported: tuple[str, ...]
) -> None:
    ended = rig.run("calibrate", *arguments, "--yes")
    assert ended.code == code, ended.stderr
    (error,) = ended.errors
    for words in reported:
        assert words in error
    assert "\n1/" not in ended.stderr
    assert not list(rig.folder.rglob("*.json"))


def test_a_saturated_channel_is_rejected_and_nothing_is_written(rig: Any) -> None:
    world = rig.world("load_cell_zero_V = 0.5\n")
    ended = rig.run("calibrate", "load-cell", "--yes", "--world", world, *QUICK)
    assert ended.code == 3, ended.stderr
    assert ended.stderr.count("reading rejected: ") == 2
    (error,) = ended.errors
    assert "at the end of the 1.25 V range" in error
    assert re.search(r"; the readings taken so far \(\d\) are not kept; ", error)
    assert not list(rig.folder.rglob("*.json"))


def test_a_simulated_bench_in_real_time_cannot_put_the_weights_on(rig: Any) -> None:
    simulator = rig.start("simulate", "--write", "sim.toml")
    simulator.wait_for("drive it")
    ended = rig.run("calibrate", "load-cell", "--bench", "sim.toml")
    assert ended.code == 2, ended.stderr
    assert "weights cannot be put on it" in ended.errors[0]
    simulator.send(signal.SIGTERM)
    assert simulator.finish().code == 0


# --- at a terminal ---------------------------------------------------------------------------


class Terminal:
    """The command with a terminal as its stdin, answered line by line."""

    def __init__(self, rig: Any, *arguments: str):
        self.answers, slave = pty.openpty()
        self.process = subprocess.Popen(
            rig.command("calibrate", *arguments),
            cwd=rig.folder,
            env=rig.env,
            stdin=slave,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        os.close(slave)
        self.reported = ""
        self._seen = 0
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def wait_for(self, text: str, patience_s: float = 60.0) -> None:
        """Wait until the text comes, after what was waited for before."""
        deadline = time.monotonic() + patience_s
        with self._news:
            while (at := self.reported.find(text, self._seen)) < 0:
                assert self._reader.is_alive(), f"no {text!r} in:\n{self.reported}"
                assert time.monotonic() < deadline, f"no {text!r} in:\n{self.reported}"
                self._news.wait(0.2)
            self._seen = at + len(text)

    def answer(self, text: str) -> None:
        """Type a line."""
        os.write(self.answers, f"{text}\n".encode())

    def finish(self) -> tuple[int, str]:
        """Exit code and stdout."""
        assert self.process.stdout is not None
        stdout = self.process.stdout.read()
        code = self.process.wait(60)
        self._reader.join(60)
        return code, stdout

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.answers)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._news:
                self.reported += line
                self._news.notify_all()


@pytest.fixture
def terminal(rig: Any) -> Iterator[Any]:
    """Start a calibration at a terminal."""
    started: list[Terminal] = []

    def start(*arguments: str) -> Terminal:
        started.append(Terminal(rig, *arguments))
        return started[-1]

    yield start
    for each in started:
        each.close()


CELL = ("load-cell", *QUICK, "--weights", "2,5")


def test_a_person_continues_with_enter_and_repeats_with_r(rig: Any, terminal: Any) -> None:
    at = terminal(*CELL)
    at.wait_for("1/4: take all weights off [Enter, q quits]")
    at.answer("what?")
    at.wait_for("'what?' is not an answer")
    at.answer("")
    at.wait_for("2/4: put 2 N on +z [Enter, r repeats the previous reading, q quits]")
    at.answer("")
    at.wait_for("3/4: put 5 N on +z")
    at.answer("r")
    at.wait_for("2/4: put 2 N on +z")
    for step in ("3/4: put 5 N on +z", "4/4: take all weights off", "next: fit"):
        at.answer("")
        at.wait_for(step)
    at.answer("r")
    at.wait_for("4/4: take all weights off")
    at.answer("")
    at.wait_for("next: fit, and write the record")
    at.answer("")
    code, stdout = at.finish()
    assert code == 0, at.reported
    record = read_calibration(rig.folder / stdout.strip(), LoadCellCalibration)
    assert [reading.load_N for reading in record.readings] == [0.0, 2.0, 5.0, 0.0]
    assert record.sensitivity_V_N.value == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize(
    ("how", "code", "reported"),
    [
        ("q", 130, "stopped with q"),
        (signal.SIGINT, 130, "stopped by Ctrl-C"),
        (signal.SIGQUIT, 131, "stopped by Ctrl-\\"),
        (signal.SIGTERM, 143, "stopped by SIGTERM"),
        (signal.SIGHUP, 129, "stopped by SIGHUP"),
    ],
)
@pytest.mark.thorough
def test_a_person_may_stop_at_a_question_and_nothing_is_written(
    rig: Any, terminal: Any, how: Any, code: int, reported: str
) -> None:
    at = terminal(*CELL)
    at.wait_for("1/4")
    at.answer("")
    at.wait_for("2/4")
    if how == "q":
        at.answer("q")
    else:
        at.process.send_signal(how)
    assert at.finish() == (code, "")
    assert at.reported.splitlines()[-1] == (
        f"{reported}; the readings taken so far (1) are not kept; nothing was written, the sensor "
        "is at rest"
    )
    assert "Traceback" not in at.reported
    assert not list(rig.folder.rglob("*.json"))


def test_ctrl_c_within_a_reading_ends_the_stream_and_writes_nothing(
    rig: Any, terminal: Any
) -> None:
    log = rig.folder / "world.jsonl"
    at = terminal("force", "--duration", "60s", "--world-log", str(log))
    at.wait_for("1/21: take all weights off")
    at.answer("")
    deadline = time.monotonic() + 60
    while "weights" not in (log.read_text() if log.exists() else ""):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(0.1)
    at.process.send_signal(signal.SIGINT)
    code, stdout = at.finish()
    assert (code, stdout) == (130, ""), at.reported
    assert at.reported.splitlines()[-1].startswith("stopped by Ctrl-C; nothing was written")
    said = [
        (e["device"], e["what"], e["value"])
        for e in map(json.loads, log.read_text().split("\n")[:-1])
    ]
    streams = [
        value for device, what, value in said if device == "force_sensor" and "stream" in what
    ]
    assert streams[-2:] == [True, False], said
    assert not list(rig.folder.rglob("*.json"))


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("--duration", "0s"), "--duration 0 s: must be 0.1 to 60 s"),
        (("--settling", "2min"), "--settling 120 s: must be 0 to 60 s"),
        (("--rate", "fast"), "--rate fast"),
        (("--weights", "10N,5N"), "--weights 10N,5N: every weight must be larger"),
        (("--temperature", "-400"), "--temperature -400: must be -40 to 85 degC"),
        (("--notes", "M\udcfcller"), r"--notes M\udcfcller: this text is not UTF-8"),
        (("--operator", "M\udcfcller"), r"--operator M\udcfcller: this text is not UTF-8"),
        (("--sensor", "x" * 201), "--sensor has 201 characters: a record keeps at most 200"),
    ],
)
@pytest.mark.thorough
def test_options_that_cannot_be_are_refused_before_any_bench_is_started(
    rig: Any, arguments: tuple[str, ...], reported: str
) -> None:
    ended = rig.run("calibrate", "force", "--yes", *arguments)
    assert ended.code == 2
    (error,) = ended.errors
    assert reported in error
    assert ended.stderr.splitlines() == [error]


@pytest.mark.parametrize("text", ["x" * 201, "M\udcfcller"])
def test_a_name_that_no_record_could_keep_is_refused_before_the_weights(text: str) -> None:
    with pytest.raises(ConfigurationError, match=r"^--sensor "):
        sensor_name("--sensor", text)


def test_an_error_is_reported_to_two_figures_never_as_zero() -> None:
    assert with_error(0.0123456789, 0.0000003217) == "+0.01234568 ± 0.00000032"
    assert with_error(-80.123, 0.05) == "-80.123 ± 0.050"
    assert with_error(1.5, 0.0) == "+1.5"


# --- records in use ---------------------------------------------------------------------------


def test_a_dry_run_refuses_a_record_that_no_run_could_use(rig: Any) -> None:
    """Found by an attack: the dry run of the evening went well, and the night was refused."""
    calibrated = '[fixture]\nmounted = "film-clamp"\n[calibrations]\nload_cell = "cell.json"\n'
    (rig.folder / "own.toml").write_text('name = "b"\n' + calibrated)
    ended = rig.run("sweep", "--dry-run", "--bench", "own.toml", "--frequencies", "200")
    assert ended.code == 2, ended.stderr
    (error,) = ended.errors
    assert "cannot read the calibration record cell.json" in error
    assert "starting" not in ended.stderr
