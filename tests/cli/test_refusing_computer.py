"""What the computer refuses, such as a name, a process or memory, is said in one line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import recorded_trials as trials

from rig.files.errors import RecordingError
from rig.files.runfile.compile import compile_run

TOO_LONG = "n" * 256
LONG = "File name too long; give another name or place"
NO_PROCESS = """
import subprocess
def refuse(*_, **__):
    raise BlockingIOError(11, "Resource temporarily unavailable")
subprocess.Popen.__init__ = refuse
"""


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (("show", f"{TOO_LONG}.h5"), "no such file"),
        (("detect", f"{TOO_LONG}.h5"), LONG),
        (("sweep", "--results", TOO_LONG, "--frequencies", "80Hz"), LONG),
    ],
)
def test_a_name_that_is_too_long_is_refused_in_one_line(
    rig: Any, command: tuple[str, ...], reason: str
) -> None:
    done = rig.run(*command)
    assert done.code == 2
    assert "Traceback" not in done.stderr
    (error,) = done.errors
    assert reason in error


def test_a_results_folder_that_is_a_dangling_link_is_named(rig: Any) -> None:
    (rig.folder / "away").symlink_to(rig.folder / "gone" / "results")
    done = rig.run("sweep", "--results", "away", "--frequencies", "80Hz", "--no-figures")
    assert done.code == 1
    assert "away: no run can be recorded here: not a folder" in done.errors[0]


def test_a_process_that_cannot_be_started_is_said_in_one_line(rig: Any) -> None:
    done = rig.start("sweep", "--frequencies", "80Hz", before=NO_PROCESS).finish()
    assert done.code == 1
    assert "Traceback" not in done.stderr
    assert "processes (ulimit -u)" in done.errors[0]


@pytest.mark.thorough
def test_a_run_in_a_time_zone_a_day_away_from_utc_is_recorded_in_utc(rig: Any) -> None:
    rig.env["TZ"] = "UTC+24"
    done = rig.run("sweep", "--frequencies", "80Hz", "--no-figures", "--json")
    warning = done.stderr.splitlines()[0]
    assert warning.startswith("warning: TZ=UTC+24 is a day or more away from UTC")
    assert (done.code, done.object["outcome"]) == (0, "complete")
    shown = rig.run("show", done.object["file"], "--json")
    assert (shown.code, shown.object["start_time"][-6:]) == (0, "+00:00")


@pytest.mark.parametrize(
    ("zone", "warned"),
    [("LAB-24:30", True), ("LAB-23SUM-24", True), ("LAB+23:59", False), ("/no/zone", False)],
)
def test_every_time_zone_has_commands_that_work(rig: Any, zone: str, warned: bool) -> None:
    rig.env["TZ"] = zone
    done = rig.run("detectors")
    assert done.code == 0
    assert ("more away from UTC, so times are given in UTC" in done.stderr) is warned


def test_a_run_file_for_which_there_is_no_memory_leaves_the_journal_and_says_how(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = tmp_path / "a_r001.rigj"
    trials.write_trials(journal, {"trial-001": trials.quiet()}, complete=False)
    journal.with_suffix(".h5").unlink()
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "h5py", None)  # its import fails from now on
        with pytest.raises(RecordingError) as caught:
            compile_run(journal)
    assert "ulimit -v" in str(caught.value.hint)
    assert f"rig recover {journal}" in str(caught.value.hint)
    assert compile_run(journal).exists(), "the journal is as it was"
