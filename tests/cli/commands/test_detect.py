"""``rig detect`` and ``rig filter`` as people use them."""

from __future__ import annotations

import csv
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_run
import recorded_trials as trials
from distributed import Client

import rig as package
from rig.cli.commands.detect import literal_remark
from rig.detector.detector import DETECTOR_VERSION
from rig.detector.registered import chosen_detector
from rig.detector.settings import named_detectors
from rig.files.runfile.compile import compile_run
from rig.processing.detection import DetectionResult

HP = ("--detector", "paper-hp")
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of three slip trials; the last one is quiet."""
    folder = tmp_path_factory.mktemp("runs")
    given = [trials.slipping(seed=1), trials.slipping(seed=2), trials.quiet()]
    for number, volts in enumerate(given):
        trials.write_trials(folder / f"r{number}.rigj", {"trial-001": volts})
    return folder


@pytest.fixture
def runs(rig: Any, recorded: Path) -> list[str]:
    """Names of these files, copied into the folder of the command."""
    shutil.copytree(recorded, rig.folder, dirs_exist_ok=True)
    return ["r0.h5", "r1.h5", "r2.h5"]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.thorough
def test_one_line_a_file_says_what_was_found(rig: Any, runs: list[str]) -> None:
    done = rig.run("detect", *HP, "--jobs", "2", *runs)
    assert done.code == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == runs
    assert "1 trial: 1 alarm of incipient slip (first at 0.90" in lines[0]
    assert (
        f"of trial-001), 1 motion under load begun. Saved processed/r0.paper-hp-{DETECTOR_VERSION}-"
        in lines[0]
    )
    assert lines[2].startswith("r2.h5: 1 trial: cannot judge 1 trial (no touch was seen). Saved")
    progress = done.stderr.splitlines()
    assert [line.split()[0] for line in progress] == ["1/3", "2/3", "3/3"]

    again = rig.run("detect", *HP, *runs)
    assert again.stdout == done.stdout.replace("Saved ", "Saved before as ")


@pytest.mark.thorough
def test_the_default_detector_is_paper_hp_and_the_help_says_why(rig: Any, runs: list[str]) -> None:
    default = rig.run("detect", runs[0])
    assert default.code == 0, default.stderr
    assert f"Saved processed/r0.paper-hp-{DETECTOR_VERSION}-" in default.stdout
    named = rig.run("detect", *HP, runs[0])
    assert named.stdout == default.stdout.replace("Saved ", "Saved before as ")
    shown = " ".join(re.sub(r"[│╭╮╰╯─]", " ", rig.run("detect", "--help").stdout).split())
    assert "[default: paper-hp]" in shown
    assert "none is shown to reach it, so the default is the published detector" in shown
    assert "rig misses 1 of 8 where the commands of x and of the held force are known" in shown


@pytest.mark.thorough
@pytest.mark.parametrize("name", [name for name in named_detectors() if name != "paper-hp"])
def test_every_other_detector_is_there_for_who_asks_for_it(
    rig: Any, runs: list[str], name: str
) -> None:
    done = rig.run("detect", "--detector", name, runs[0])
    assert done.code == 0, done.stderr
    assert f"Saved processed/r0.{name}-" in done.stdout
    (file,) = rig.folder.glob(f"processed/r0.{name}-*.h5")
    assert rig.run("verify", str(file)).code == 0


@pytest.mark.thorough
def test_processes_and_one_after_the_other_give_the_same_bytes(rig: Any, runs: list[str]) -> None:
    for jobs in ("1", "3"):
        done = rig.run("detect", *HP, "--jobs", jobs, "--to", f"by-{jobs}", *runs)
        assert done.code == 0, done.stderr
    one = contents(rig.folder / "by-1")
    assert len(one) == 6
    assert contents(rig.folder / "by-3") == one


def test_a_file_that_is_not_there_is_refused_without_progress(rig: Any) -> None:
    done = rig.run("detect", *HP, "none.h5", "nor-this.h5")
    assert done.code == 2
    assert [line for line in done.stderr.splitlines() if "/2" in line or "/1" in line] == []
    assert [line.partition(":")[0] for line in done.errors] == ["error", "error"]
    assert "none.h5: no such file" in done.stderr


@pytest.mark.thorough
def test_a_file_that_fails_is_named_and_the_others_go_on(rig: Any, runs: list[str]) -> None:
    compile_run(recorded_run.write_run(rig.folder / "sweep.rigj"))
    done = rig.run("detect", *HP, "--json", runs[0], "sweep.h5", "none.h5", runs[1])
    assert done.code == 5
    reported = done.object
    assert (reported["exit"], reported["outcome"], reported["simulated"]) == (5, "failed", True)
    assert reported["summary"] == {"files": 4, "failed": 2, "kept": 0}
    assert [result["exit"] for result in reported["results"]] == [0, 2, 2, 0]
    assert reported["results"][0]["events"]["incipient slip"] == 1
    assert reported["results"][0]["first_slip_trial"] == "trial-001"
    assert any("sweep.h5: a sweep, which records no strips" in line for line in done.errors)
    assert any("none.h5: no such file" in line for line in done.errors)

    alone = rig.run("detect", *HP, "sweep.h5")
    assert alone.code == 2
    assert alone.stdout == ""


@pytest.mark.thorough
def test_parameters_may_be_given_otherwise(rig: Any, runs: list[str]) -> None:
    (rig.folder / "deaf.toml").write_text(
        "fire_mV = 100.0\n[low_pass]\nstop_Hz = 60\nstop_dB = 50\n"
    )
    done = rig.run("detect", *HP, "--settings", "deaf.toml", runs[0])
    assert done.code == 0, done.stderr
    assert "incipient slip" not in done.stdout
    file = done.stdout.split("Saved ")[1].split(";")[0]
    brief = " ".join(rig.run("show", "--no-figures", file).stdout.split())
    assert "fire_mV 100" in brief
    shown = rig.run("show", "--no-figures", "--all", file)
    for line in ("  fire_mV: 100", "    stop_Hz: 60", "    lag_deg: none", "simulated: yes"):
        assert line in shown.stdout.splitlines()


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("fire = 2.0\n", "fire: unknown key"),
        ("[low_pass]\nstop = 2.0\n", "low_pass.stop: unknown key"),
        ("fire_mV = -1\n", "fire_mV = -1 mV: must be above 0 mV"),
        ("fire_mV = nan\n", "fire_mV = nan mV: must be a finite number"),
        ('fire_mV = "2"\n[[low_pass]]\n', "low_pass"),
        ('logic = "rig"\n', "--detector names the logic"),
        ("fire_mV 2\n", "correct the TOML syntax"),
    ],
)
@pytest.mark.thorough
def test_parameters_that_are_none_are_refused(
    rig: Any, runs: list[str], text: str, reported: str
) -> None:
    (rig.folder / "own.toml").write_text(text)
    done = rig.run("detect", *HP, "--settings", "own.toml", runs[0])
    assert done.code == 2
    (error,) = done.errors
    assert "own.toml" in error
    assert reported in error
    assert not (rig.folder / "processed").exists()


def test_an_unknown_detector_is_refused_with_the_known_ones(rig: Any, runs: list[str]) -> None:
    done = rig.run("detect", "--detector", "paper", runs[0])
    assert done.code == 2
    assert (
        "--detector paper: must be one of impulse, paper-hp, paper-literal, rig" in done.errors[0]
    )


@pytest.mark.thorough
def test_a_folder_that_cannot_be_written_to_is_reported(rig: Any, runs: list[str]) -> None:
    (rig.folder / "taken").write_text("no folder")
    done = rig.run("detect", *HP, "--to", "taken", runs[0])
    assert done.code == 1
    assert "cannot be written" in done.errors[0]
    assert "--to" in done.errors[0]


@pytest.mark.thorough
def test_a_processed_file_is_shown_drawn_and_verified(rig: Any, runs: list[str]) -> None:
    done = rig.run("detect", *HP, "--json", runs[0])
    file = done.object["file"]
    verified = rig.run("verify", file)
    assert (verified.code, verified.stderr) == (0, "")
    assert f"sound (paper-hp {DETECTOR_VERSION}, 2 events in 1 trial)" in verified.stdout
    shown = rig.run("show", file, "--figures-to", "figures")
    assert shown.code == 0, shown.stderr
    assert "run: r0.h5" in shown.stdout
    assert "incipient slip at 0.90" in shown.stdout
    drawn = {path.suffix for path in (rig.folder / "figures").iterdir()}
    assert drawn == {".png", ".svg"}
    assert all(
        path.name.startswith(f"r0.paper-hp-{DETECTOR_VERSION}-")
        for path in (rig.folder / "figures").iterdir()
    )

    refused = rig.run("detect", *HP, file)
    assert refused.code == 2
    assert "a processed file, not a run" in refused.errors[0]


@pytest.mark.thorough
def test_an_imported_recording_is_processed_and_marked(rig: Any) -> None:
    rows = np.column_stack([np.arange(1500) / trials.RATE_HZ, trials.slipping()])
    np.savetxt(rig.folder / "own.csv", rows, delimiter=",", header="t,a,b", comments="")
    imported = rig.run(
        "import", "own.csv", "--time", "t", "--channels", "v_1=a,v_2=b", "--no-figures", "--json"
    )
    assert imported.code == 0, imported.stderr
    done = rig.run("detect", *HP, "--json", imported.object["file"])
    assert done.code == 0, done.stderr
    (result,) = done.object["results"]
    assert result["simulated"] is None
    assert result["events"]["incipient slip"] == 1
    shown = rig.run("show", "--no-figures", result["file"])
    assert "title: IMPORTED – slip detection in 1 trial: recording own.csv" in shown.stdout
    assert rig.run("verify", result["file"]).code == 0


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a Dask scheduler or worker in a folder of its own; they end with the test."""
    started: list[subprocess.Popen[str]] = []

    def start(what: str, *options: str, code: str | None = None) -> subprocess.Popen[str]:
        folder = tmp_path / f"dask-{len(started)}"
        folder.mkdir()
        path = {} if code is None else {"PYTHONPATH": code}
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{what}", *options],
            cwd=folder,
            env={**os.environ, **path},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def scheduler(dask: Callable[..., subprocess.Popen[str]]) -> tuple[str, subprocess.Popen[str]]:
    """Address and process of a scheduler."""
    process = dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    return heard(process, r"Scheduler at:\s+(tcp\S+)"), process


def heard(process: subprocess.Popen[str], pattern: str) -> str:
    """Return what the process says on stderr. The rest is read, so that it can go on."""
    assert process.stderr is not None
    for line in process.stderr:
        if found := re.search(pattern, line):
            threading.Thread(target=process.stderr.read, daemon=True).start()
            return found[1]
    raise AssertionError(f"it ended with {process.wait()}")


def worker(
    dask: Callable[..., subprocess.Popen[str]], address: str, code: str | None = None
) -> tuple[str, subprocess.Popen[str]]:
    """Address and process of a new worker."""
    options = ("--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard", "--no-nanny")
    process = dask("worker", address, *options, code=code)
    name = heard(process, r"Start worker at:\s+(tcp\S+)")
    return name, process


@pytest.mark.thorough
def test_a_cluster_gives_the_same_bytes(
    rig: Any, runs: list[str], dask: Any, scheduler: tuple[str, Any]
) -> None:
    address, _ = scheduler
    name, _ = worker(dask, address)
    here = rig.run("detect", *HP, "--to", "here", *runs)
    there = rig.run("detect", *HP, "--scheduler", address, "--to", "there", *runs, "none.h5")
    assert here.code == 0, here.stderr
    assert there.code == 5, there.stderr
    assert "none.h5: no such file" in there.errors[0]
    assert f"(on worker {name}, {platform.node()})" in there.errors[0]
    assert len(there.stdout.splitlines()) == 3
    assert contents(rig.folder / "there") == contents(rig.folder / "here")


@pytest.mark.thorough
def test_a_worker_with_other_code_is_noticed(
    rig: Any, runs: list[str], dask: Any, scheduler: tuple[str, Any], tmp_path: Path
) -> None:
    address, _ = scheduler
    shutil.copytree(Path(package.__file__).parent, tmp_path / "other" / "rig")
    changed = tmp_path / "other" / "rig" / "detector" / "fir.py"
    changed.write_text(changed.read_text() + "\n# changed\n")
    name, _ = worker(dask, address, code=str(tmp_path / "other"))
    done = rig.run("detect", *HP, "--scheduler", address, runs[0])
    assert done.code == 2, done.stderr
    assert "differs from that of the command" in done.errors[0]
    assert name in done.errors[0]
    assert not (rig.folder / "processed").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("who", ["scheduler", "worker", "nobody"])
def test_a_cluster_that_dies_ends_the_command(
    rig: Any, runs: list[str], dask: Any, scheduler: tuple[str, Any], who: str
) -> None:
    address, process = scheduler
    _, other = worker(dask, address)
    other.send_signal(signal.SIGSTOP)  # so that the command waits
    begun = rig.start("detect", *HP, "--scheduler", address, runs[0])
    with Client(address, set_as_default=False) as client:
        give_up_s = time.monotonic() + PATIENCE_S
        while not client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)):
            assert time.monotonic() < give_up_s, "the command has asked for nothing"
            time.sleep(0.1)
    if who == "scheduler":
        process.kill()
    elif who == "worker":
        other.kill()
    else:
        begun.send(signal.SIGTERM)
    done = begun.finish()
    if who == "nobody":
        assert done.code == 143, done.stderr
        return
    assert done.code != 0
    assert runs[0] in done.errors[0]
    reported = {"scheduler": "see whether its scheduler", "worker": "no worker for 30 s"}
    assert reported[who] in done.errors[0]


@pytest.mark.thorough
def test_without_the_package_a_cluster_is_refused_with_the_remedy(
    rig: Any, runs: list[str]
) -> None:
    (rig.folder / "distributed.py").write_text("raise ImportError('not there')\n")
    rig.env["PYTHONPATH"] = str(rig.folder)
    done = rig.run("detect", *HP, "--scheduler", "tcp://127.0.0.1:8786", runs[0])
    assert done.code == 2
    assert "tactile-rig[cluster]" in done.errors[0]
    assert rig.run("detect", *HP, runs[0]).code == 0, "nobody else imports it"


# The filter


@pytest.mark.thorough
def test_the_filter_is_printed_drawn_and_written_as_data(rig: Any) -> None:
    done = rig.run("filter", "--json", "--results", "out")
    assert done.code == 0, done.stderr
    reported = done.object["summary"]
    assert reported["half_power_Hz"] == pytest.approx(28.0, abs=0.01)
    assert reported["lag_deg"] == pytest.approx(9.0, abs=0.001)
    names = [Path(file).name for file in done.object["files"]]
    assert names == [
        "low-pass-paper-1000Hz.png", "low-pass-paper-1000Hz.svg",
        "low-pass-paper-1000Hz-frequency.csv", "low-pass-paper-1000Hz-step.csv",
    ]  # fmt: skip
    with (rig.folder / "out" / names[2]).open() as file:
        rows = list(csv.DictReader(file))
    f = np.array([float(row["frequency_Hz"]) for row in rows])
    gain = np.array([float(row["gain_dB"]) for row in rows])
    assert np.interp(28.0, f, gain) == pytest.approx(-3.0, abs=0.01)
    assert gain[f > reported["stop_Hz"]].max() <= -73.5
    phase = np.array([float(row["phase_deg"]) for row in rows])
    assert np.interp(1.0, f, phase) == pytest.approx(-9.0, abs=0.01)
    with (rig.folder / "out" / names[3]).open() as file:
        step = [float(row["step_response"]) for row in csv.DictReader(file)]
    assert len(step) == reported["taps"]
    assert step[-1] == pytest.approx(1.0)


def test_each_number_of_a_filter_says_what_it_means(rig: Any) -> None:
    done = rig.run("filter", "--no-figures", "--attenuation", "50dB", "--lag", "6")
    assert done.code == 0, done.stderr
    for label in (
        "stop band (-50 dB) from: ", "largest side lobe of the stop band: ",
        "gain first below the largest side lobe at: ", "step response reaches 50 % after: ",
    ):  # fmt: skip
        assert f"\n{label}" in done.stdout


@pytest.mark.thorough
def test_a_specification_of_ones_own_takes_units_and_replaces_the_lag(rig: Any) -> None:
    done = rig.run(
        "filter", "--json", "--no-figures", "--half-power", "0.03kHz", "--stop-from", "80",
        "--attenuation", "40dB", "--rate", "2kHz",
    )  # fmt: skip
    assert done.code == 0, done.stderr
    reported = done.object["summary"]
    assert reported["half_power_Hz"] == pytest.approx(30.0, abs=0.01)
    assert reported["stop_Hz"] <= 80.0
    assert reported["specification"]["stop_dB"] == 40.0
    assert reported["specification"]["lag_deg"] is None
    assert done.object["files"] == []


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (("--lag", "2"), "--lag 2 deg at 1 Hz must be at least"),
        (("--lag", "9", "--stop-from", "60"), "--lag 9.0 and --stop-from 60.0: give exactly one"),
        (("--stop-from", "20"), "--stop-from 20 Hz must be above --half-power 28 Hz"),
        (("--attenuation", "5"), "--attenuation = 5.0 dB: must be at least 21 dB"),
        (("--half-power", "28V"), "'V' does not convert to Hz"),
        (("--rate", "50"), "--half-power 28 Hz must be below half the sampling rate of 50 Hz"),
        (("--rate", "nan"), "--rate nan Hz: must be above 0 Hz"),
        (("slow",), "low-pass slow: must be one of paper, fast, faster"),
    ],
)
@pytest.mark.thorough
def test_specifications_that_cannot_be_met_are_refused(
    rig: Any, options: tuple[str, ...], reported: str
) -> None:
    done = rig.run("filter", *options)
    assert done.code == 2
    (error,) = done.errors
    assert reported in error
    assert not rig.results.exists()


def test_the_literal_logic_says_that_it_disagrees_with_the_paper() -> None:
    """Its threshold is ours, and the default slide stays 1.3 mV below it."""
    literal = chosen_detector("paper-literal")

    def found(**events: int) -> DetectionResult:
        kinds = {name.replace("_", " "): count for name, count in events.items()}
        return DetectionResult(Path("r.h5"), False, True, 1, kinds, None)

    remark = literal_remark(literal, [found(predictive=2), found(predictive=1, incipient_slip=1)])
    assert remark is not None
    assert "in 1 file a motion under load began and v_d stayed below 30 mV" in remark
    assert "The paper states no threshold" in remark
    assert "DISAGREES with the paper" in remark
    assert literal_remark(literal, [found(predictive=1, incipient_slip=1), found()]) is None
    assert literal_remark(chosen_detector("paper-hp"), [found(predictive=2)]) is None
