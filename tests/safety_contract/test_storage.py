"""Disks that fill up or cannot be written: safe first, then the error; what is kept is kept."""

from __future__ import annotations

import resource
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

LIMIT_BYTES = 400_000
FREQUENCIES = ("--frequencies", "300,400,500,600,700,800,900,1000")
FORTY_POINTS = ",".join(str(500 + 10 * k) for k in range(40))
LONG_RECORDS = ("--shortest-record", "0.5s")
"""Several of them do not fit."""


@pytest.mark.thorough
def test_a_disk_that_fills_up_ends_the_run_safely(rig):
    """A file-size limit of the process stands for a full disk: the write fails in the same way."""

    def small_disk() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT_BYTES, LIMIT_BYTES))

    ended = subprocess.run(
        rig.command(*rig.sweep_arguments(*FREQUENCIES, *LONG_RECORDS)),
        cwd=rig.folder,
        env=rig.env,
        preexec_fn=small_disk,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )

    assert ended.returncode == 1, ended.stderr
    errors = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
    assert ".rigj" in errors[0]
    assert "File too large" in errors[0]
    assert rig.outputs() == [True, False]
    # With room again, everything that had reached the journal can be compiled.
    journal = rig.only("*.rigj")
    recovered = rig.run("recover", str(journal))
    assert recovered.code == 0, recovered.stderr
    assert rig.run("verify", recovered.stdout.strip()).code == 0


@pytest.mark.thorough
def test_a_results_folder_that_cannot_be_written_is_reported_before_anything_moves(rig):
    (rig.folder / "results").write_text("a file where a folder should be")
    ended = rig.sweep("--frequencies", "20")

    assert ended.code == 1, ended.stderr
    (error,) = ended.errors
    assert "results" in error
    assert "--results" in error
    assert True not in rig.outputs()


def test_a_read_only_results_folder_is_reported_before_anything_moves(rig):
    ended = rig.sweep("--frequencies", "20", "--results", "/proc/results")

    assert ended.code == 1, ended.stderr
    (error,) = ended.errors
    assert "/proc/results" in error
    assert True not in rig.outputs()
    assert not Path("/proc/results").exists()


def disk(kind, **keys):
    """A fault plan for the disk."""
    return f'[[fault]]\ndevice = "disk"\nkind = "{kind}"\n' + "".join(
        f"{key} = {value}\n" for key, value in keys.items()
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "cause"), [("disk-full", "No space left"), ("read-only", "Read-only file system")]
)
def test_a_disk_that_gives_out_in_the_run_ends_it_safely_with_what_it_had_taken(rig, kind, cause):
    plan = rig.fault(disk(kind, after_bytes=LIMIT_BYTES))
    ended = rig.sweep(*FREQUENCIES, *LONG_RECORDS, "--fault", plan)

    assert ended.code == 1, ended.stderr
    assert ".rigj: write failed: " + cause in ended.errors[0]
    assert "free space or write access there" in ended.errors[0]
    assert rig.outputs() == [True, False]
    journal = rig.only("*.rigj")
    assert journal.stat().st_size <= LIMIT_BYTES
    recovered = rig.run("recover", str(journal))
    assert recovered.code == 0, recovered.stderr
    assert rig.run("verify", recovered.stdout.strip()).code == 0


@pytest.mark.thorough
def test_a_disk_that_is_read_only_from_the_start_is_reported_before_anything_moves(rig):
    ended = rig.sweep("--frequencies", "300", "--fault", rig.fault(disk("read-only")))
    assert ended.code == 1, ended.stderr
    (error,) = ended.errors
    assert "Read-only file system" in error
    assert True not in rig.outputs()


@pytest.mark.thorough
def test_a_slow_disk_only_costs_time(rig):
    ended = rig.sweep(
        "--frequencies", "300,600", "--fault", rig.fault(disk("slow-sync", delay_s=0.6))
    )
    assert ended.code == 0, ended.stderr
    assert ended.object["warnings"] == []
    assert verify(rig.only("*.h5")) == []


@pytest.mark.thorough
def test_a_bench_that_others_record_from_has_no_disk_to_fail(rig):
    ended = rig.run("simulate", "--fault", rig.fault(disk("read-only")))
    assert ended.code == 2
    assert "device = 'disk': no such device on this bench" in ended.stderr


@pytest.mark.thorough
def test_a_run_whose_results_are_deleted_ends_safely_and_keeps_everything(rig):
    running = rig.start_sweep("--frequencies", FORTY_POINTS)
    running.wait_for(r"^3/40 ")
    shutil.rmtree(rig.folder / "results")
    ended = running.finish()

    assert ended.code == 1, ended.stderr
    (error,) = ended.errors
    assert "was deleted while the run was writing it" in error
    assert rig.outputs() == [True, False]
    file = rig.folder / ended.object["file"]
    assert "_rescued" in file.name
    assert file.with_suffix(".rigj").name in error
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert len(run.point_ids()) >= 3


SET_BACK = """
import pathlib, time
real = time.time
time.time = lambda: real() - (3600 if pathlib.Path("set-back").exists() else 0)
"""


@pytest.mark.thorough
def test_a_clock_that_is_set_back_is_recorded_and_the_resumed_run_is_sound(rig):
    """`time.time` of the run stands for the computer's clock, which a test must not set."""
    (rig.folder / "sitecustomize.py").write_text(SET_BACK)
    rig.env["PYTHONPATH"] = str(rig.folder)
    running = rig.start_sweep("--frequencies", FORTY_POINTS)
    running.wait_for(r"^3/40 ")
    (rig.folder / "set-back").touch()
    running.wait_for(r"clock was set back by 3600 s")
    running.send(signal.SIGINT)
    stopped = running.finish()
    assert stopped.code == 130, stopped.stderr
    resumed = rig.run("resume", str(rig.only("*.rigj")), "--no-figures")
    assert resumed.code == 0, resumed.stderr
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert b"clock-set" in run.entry["events/code"][()].tolist()
