"""Strips with calibration records: load rates in the file, and records that do not serve."""

from __future__ import annotations

import json
import math
from datetime import datetime, timedelta
from multiprocessing import get_context

import numpy as np
import pytest

from drivers.simulated.bench.start import start
from procedures.slip_trial import SlipTrial
from rig.bench.plan import parse_bench
from rig.core.clock import ControlLink, SlavedClock
from rig.files.hdf5.safe_reading import text_of
from rig.files.runfile.reader import RunFile
from rig.instruments.calibration import FilmCalibration, make_record, write_calibration
from rig.physics.pvdf import level_at_one_hertz
from rig.physics.transducer import TransducerSettings
from rig.run.execute import execute
from rig.run.job import RunJob
from rig.run.stopping import StopFlag

SHORT = ("--distance", "0.4mm", "--speed", "1mm/s", "--rest", "100ms", "--rehearsal", "never")
TRUE_b_dB = level_at_one_hertz(TransducerSettings().circuit)
"""Of the World's strips with their amplifiers, whose gain is 1000."""
ERROR_dB = 0.05


def record(film, days=30.0, age_days=60.0):
    """A record of a strip's film that holds for `days` from now."""
    interval = {"low": None, "high": None}
    now = datetime.now().astimezone()
    fields = {
        "sensor": film,
        "date": now - timedelta(days=age_days),
        "valid_until": now + timedelta(days=days),
        "simulated": True,
        "source": {"run_uuid": "", "file": "", "simulated": True},
        "b_dB": {"value": TRUE_b_dB, "standard_error": 0.03, "unit": "dB re 1 V/N", **interval},
        "corner_Hz": {"value": 6631.0, "standard_error": 10.0, "unit": "Hz", **interval},
        "delay_us": {"value": 0.0, "standard_error": 1.0, "unit": "us", **interval},
        "inverse_corner_s": 1 / (2 * math.pi * 6631.0),
        "polarity": 1,
        "covariance": [[0.03**2, 0, 0], [0, 1e-12, 0], [0, 0, 1e-12]],
        "gain_model_error_dB": 0.04,
        "points": 100,
        "lowest_frequency_Hz": 2.0,
        "highest_frequency_Hz": 20e3,
        "amplifier_gain": 1000.0,
    }
    return make_record(FilmCalibration, fields)


def naming(text, records):
    """The text of a bench file with these records in use, by strip."""
    named = "\n".join(f'{strip} = "{path.name}"' for strip, path in records.items())
    films = 'films = { strip_1 = "film 7", strip_2 = "film 8" }\n'
    return text.replace("[skin]\n", f"[skin]\n{films}") + f"\n[calibrations]\n{named}\n"


def take_on_a_slaved_bench(folder, stages, world, records):
    """A short trial on the simulated bench in slaved time, whose bench file names the records; in a
    process of its own, which the run's guard may kill. Leaves ``outcome.json``."""
    process = start({"fixture": "plate", "stages": stages, "world": world})
    said = process.ready()
    text = naming(said["bench_toml"], records)
    job = RunJob(
        procedure=SlipTrial(SlipTrial.Settings(distance_mm=0.4, speed_mm_s=1.0, rest_s=0.1)),
        seed=0,
        results=folder / "results",
        recorded_toml=naming(said["recorded_toml"], records),
    )
    plan = parse_bench(text, str(folder / "bench.toml"))
    clock = SlavedClock(ControlLink(said["control_port"]))
    outcome = execute(job, plan, clock, StopFlag())
    process.wait()
    reported = {"errors": [f.one_line() for f in outcome.failures], "warnings": outcome.warnings}
    (folder / "outcome.json").write_text(json.dumps(reported))


@pytest.mark.thorough
def test_calibrated_strips_are_recorded_as_load_rates_with_their_error(rig, tmp_path):
    files = {
        "strip_1": write_calibration(record("film 7", days=5.0), tmp_path),
        "strip_2": write_calibration(record("film 8"), tmp_path),
    }
    run = get_context("spawn").Process(
        target=take_on_a_slaved_bench, args=(tmp_path, rig.bench.stages, rig.world(""), files)
    )
    run.start()
    run.join()
    reported = json.loads((tmp_path / "outcome.json").read_text())
    assert reported["errors"] == []
    (warning,) = [w for w in reported["warnings"] if "calibration" in w]
    assert "the calibration of 'film 7'" in warning
    assert "expires on" in warning
    (file,) = tmp_path.rglob("*.h5")
    with RunFile.open(file) as run:
        series = {w.stream: w for w in run.waveforms("trial-001")}
        (reading,) = run.readings()
        kept = run.entry["instrument/calibrations"]
        described = [text_of(part["description"]) for part in kept.values()]
    assert described == ["calibration of film 7", "calibration of film 8"]
    for strip, volts in (("strip_1", "v_1"), ("strip_2", "v_2")):
        seen, number = series["signals"].values(volts), strip[-1]
        factor = 2 * math.pi * 10 ** (-TRUE_b_dB / 20)
        rates = series["load_rate"].values(strip)
        assert rates == pytest.approx(factor * (seen - seen[:200].mean()), abs=1e-9)
        error = reading[f"load_scale_{number}_error_N_s_V"]
        assert error / factor == pytest.approx(ERROR_dB * math.log(10) / 20, rel=1e-6)
    down = int(np.argmax(series["force"].values("F_n") > 3.5))
    borne_N = series["load_rate"].values("strip_1")[:down].sum() * 1e-3
    assert 0.02 < abs(borne_N) < 0.6, "a strip's share of the force on its ridge, 0.57 N at 4 N"


@pytest.mark.thorough
def test_records_that_do_not_serve_are_refused_in_one_line_before_any_motion(rig):
    with rig.served("--fixture", "plate") as path:
        good = write_calibration(record("film 7"), rig.folder)
        cases = {
            "expired on": write_calibration(record("film 8", days=-1.0), rig.folder),
            "on the bench is 'film 8'": good,
            "cannot read the calibration record": rig.folder / "nowhere.json",
        }
        calibrated = path.with_name("calibrated.toml")
        for words, file in cases.items():
            calibrated.write_text(naming(path.read_text(), {"strip_1": good, "strip_2": file}))
            ended = rig.run("slip-trial", "--bench", str(calibrated), *SHORT)
            assert ended.code == 2, ended.stderr
            (error,) = ended.errors
            assert words in error
            assert "rig calibrate pvdf" in error
    assert "move" not in {entry["what"] for entry in rig.log()}


@pytest.mark.thorough
def test_strips_without_a_record_are_said_to_have_none(rig):
    given = ("--world-log", str(rig.world_log), "--no-figures", "--json")
    ended = rig.run("slip-trial", *given, *SHORT)
    assert ended.code == 0, ended.stderr
    (warning,) = [w for w in ended.object["warnings"] if "no calibration record" in w]
    assert warning.startswith("strips 1 and 2 have")
    with RunFile.open(rig.only("*.h5")) as run:
        assert "load_rate" not in {w.stream for w in run.waveforms("trial-001")}
        assert np.isnan(run.column("load_scale_1")).all()
