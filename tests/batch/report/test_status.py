"""The status of a batch says first what is wrong with its bench."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from rig.batch import queue as queue_module
from rig.batch.execute.worker import _ended
from rig.batch.folder import BatchFolder, find_folder, folder_to_rebuild, folder_to_resume
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.plan.settings import BatchFile
from rig.batch.queue import Queue
from rig.batch.queue_records import TIME_OVER, AttemptResult, RunEstimate, RunState
from rig.batch.report.status import status_of
from rig.bench.plan import read_bench
from rig.core.errors import ConfigurationError, ExitCode
from rig.run.arming import ShutdownFailure
from rig.run.locks.bench_mark import BenchMarks
from rig.run.locks.lock import address_names
from rig.run.making_safe.guard_link import TakenOver
from rig.run.outcome import RunOutcome
from rig.run.stopping import StopFlag, StopRequestedError

BENCH = """
name = "bench-3"
[fixture]
mounted = "film-clamp"
[generator]
driver = "keysight-33500b"
resource = "TCPIP::127.0.0.1::5025::SOCKET"
max_amplitude_V = 5.0
"""


def test_a_bench_that_was_left_pressed_or_unsafe_is_said_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))
    bench = tmp_path / "bench.toml"
    bench.write_text(BENCH)
    meta = {"name": "night", "bench": str(bench), "state": "stopped"}
    Queue.create(tmp_path / "queue.sqlite", BatchPlan({}, ()), {}, meta).close()
    marks = BenchMarks(address_names(read_bench(bench)), "bench-3", None)

    marks.stopped("still pressed at 12.44 mm, 3.9 N")
    pressed = status_of(BatchFolder(tmp_path))
    assert pressed.lines()[0].endswith("still pressed at 12.44 mm, 3.9 N")
    marks.unsafe({"stage_z": "no answer"})
    unsafe = status_of(BatchFolder(tmp_path))
    assert "the bench bench-3 was left unsafe" in unsafe.lines()[0]
    assert unsafe.as_object()["bench_warnings"]
    remedy = f"heck the bench, then run: rig make-safe --bench {bench}"
    assert unsafe.lines()[-1] == f"c{remedy}", "a resume would be refused"
    assert unsafe.closing_lines("")[-1] == f"C{remedy}"
    marks.clear()
    assert status_of(BatchFolder(tmp_path)).lines()[0].startswith("batch night")
    bench.unlink()
    assert "the state of the bench is not known" in status_of(BatchFolder(tmp_path)).lines()[0]


def test_the_lock_of_a_batch_can_be_opened_by_its_owner_alone(tmp_path: Path) -> None:
    """Who may read a file may lock it, and the batch would seem to be at work."""
    folder = BatchFolder(tmp_path)
    with folder.held_by("supervisor", 0.0):
        assert folder.is_held("supervisor")
        assert (tmp_path / "supervisor.lock").stat().st_mode & 0o777 == 0o600


def test_who_waits_for_the_lock_of_a_batch_can_be_stopped(tmp_path: Path) -> None:
    """The guard of an earlier worker may hold it for minutes."""
    stop, folder = StopFlag(), BatchFolder(tmp_path)
    stop.requested = signal.SIGTERM
    with (
        folder.held_by("worker", 0.0),
        pytest.raises(StopRequestedError),
        folder.held_by("worker", 600.0, stop.check),
    ):
        pass


HOLDER = """
import os, subprocess, sys
from pathlib import Path
from rig.batch.folder import BatchFolder
with BatchFolder(Path(sys.argv[1])).held_by("worker", 0.0) as lock:
    void = subprocess.DEVNULL
    child = subprocess.Popen(["sleep", "60"], pass_fds=[lock], stdout=void, stderr=void)
    print(os.getpid(), child.pid, flush=True)
    os._exit(0)
"""


def test_the_guard_of_a_worker_that_has_died_is_not_taken_for_a_worker(tmp_path: Path) -> None:
    """What a worker has started holds its lock until it has ended as well."""
    given = [sys.executable, "-c", HOLDER, str(tmp_path)]
    died, child = subprocess.run(given, capture_output=True, text=True, check=True).stdout.split()
    said = rf"the worker before \(process {died}\) has died, and a process that it started, such"
    try:
        with (
            pytest.raises(ConfigurationError, match=said),
            BatchFolder(tmp_path).held_by("worker", 0.0),
        ):
            pass
    finally:
        os.kill(int(child), signal.SIGKILL)


def test_the_batch_of_another_user_is_running_although_its_lock_may_not_be_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody would believe that its supervisor has died, and resume it."""
    folder = BatchFolder(tmp_path)
    opened = os.open

    def refused(path: os.PathLike[str], *given: int) -> int:
        if os.fspath(path).endswith("supervisor.lock"):
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *given)

    with folder.held_by("supervisor", 0.0):
        monkeypatch.setattr(os, "open", refused)
        assert folder.is_held("supervisor")
    assert not folder.is_held("supervisor")


def three_batches(results: Path) -> list[BatchFolder]:
    """Three batches that do not run, the latest last."""
    folders = [BatchFolder(results / name) for name in ("first", "second", "third")]
    made_s = 0.0
    for folder in folders:
        folder.path.mkdir()
        Queue.create(folder.queue, BatchPlan({}, ()), {}, {"name": folder.path.name}).close()
        while folder.queue.stat().st_ctime <= made_s:  # the clock of a file system has long steps
            os.utime(folder.queue)
        made_s = folder.queue.stat().st_ctime
    return folders


def test_a_resume_without_a_name_guesses_no_batch_where_one_runs_and_another_is_later(
    tmp_path: Path,
) -> None:
    """The first may be paused and the other interrupted."""
    first, _, third = three_batches(tmp_path)
    assert folder_to_resume(None, tmp_path) == third
    with third.held_by("supervisor", 0.0):
        assert folder_to_resume(None, tmp_path) == third
    with first.held_by("supervisor", 0.0):
        with pytest.raises(ConfigurationError) as raised:
            folder_to_resume(None, tmp_path)
        assert folder_to_resume(third.path, tmp_path) == third
    assert f"{first.path} runs, {third.path} is the latest" in raised.value.message
    for one in (first, third):
        assert f"rig batch resume {one.path}" in str(raised.value.hint)


def test_a_rebuild_without_a_name_means_the_latest_batch_that_does_not_run(tmp_path: Path) -> None:
    first, second, third = three_batches(tmp_path)
    assert folder_to_rebuild(None, tmp_path) == third
    with third.held_by("supervisor", 0.0):
        assert folder_to_rebuild(None, tmp_path) == second
        with (
            first.held_by("supervisor", 0.0),
            second.held_by("supervisor", 0.0),
            pytest.raises(ConfigurationError, match=r"every batch in .* is running"),
        ):
            folder_to_rebuild(None, tmp_path)


def test_without_a_name_the_batch_that_runs_is_meant_and_of_two_none_is_guessed(
    tmp_path: Path,
) -> None:
    """The queue written to last may be another's: a stop would not reach the batch that runs."""
    folders = three_batches(tmp_path)
    assert find_folder(None, tmp_path) == folders[2]
    with folders[0].held_by("supervisor", 0.0):
        assert find_folder(None, tmp_path) == folders[0]
        with (
            folders[1].held_by("supervisor", 0.0),
            pytest.raises(ConfigurationError, match=r"2 batches run: .*first, .*second"),
        ):
            find_folder(None, tmp_path)


def test_a_share_that_locks_nothing_is_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with (
        pytest.raises(ConfigurationError, match=r"supervisor\.lock cannot be locked") as raised,
        BatchFolder(tmp_path).held_by("supervisor", 0.0),
    ):
        pass
    assert "a file system that locks files" in str(raised.value.hint)


@pytest.mark.parametrize(
    "state", ["begun", "starting", "running", "resting: 30 s", "pausing", "paused: x", "held: x"]
)
def test_a_batch_that_a_power_cut_ended_is_called_interrupted(tmp_path: Path, state: str) -> None:
    meta = {"name": "night", "state": state}
    Queue.create(tmp_path / "queue.sqlite", BatchPlan({}, ()), {}, meta).close()
    status = status_of(BatchFolder(tmp_path))
    assert f"interrupted ({state}); its supervisor has died" in status.lines()[0]
    assert status.as_object()["state"].startswith("interrupted"), "on the page, too"


def three_runs() -> tuple[BatchPlan, dict[str, RunEstimate]]:
    """The plan of three runs of one condition, and what is expected of them."""
    condition = BatchCondition("sweep-001", 0, "sweep", {}, {})
    runs = tuple(PlannedRun(k, "sweep-001", k) for k in (1, 2, 3))
    return BatchPlan({"sweep-001": condition}, runs), {"sweep-001": RunEstimate(10.0, 2.0)}


def ended(
    tmp_path: Path,
    state: str,
    *outcomes: RunState,
    bench: str = "",
    entries: Mapping[str, str] | None = None,
) -> list[str]:
    """The closing lines of a batch of three runs of a simulated bench, 10 s each; `entries` are
    further ones of its queue."""
    folder, (plan, estimates) = BatchFolder(tmp_path), three_runs()
    meta = {"name": "night", "state": state, "simulated": "yes", **(entries or {})}
    with Queue.create(folder.queue, plan, estimates, meta) as queue:
        for number, outcome in enumerate(outcomes, 1):
            queue.finish(queue.claim(number), AttemptResult("complete", bench_s=10.0), outcome)
            queue.set_processed(number, {})
    return status_of(folder).closing_lines(bench)


def test_a_batch_ends_with_the_lines_of_a_run(tmp_path: Path) -> None:
    assert ended(tmp_path, "complete", "done", "done", "done", bench="Bench is safe.") == [
        "Finished: 3 of 3 runs in 30 s of bench time (simulated).",
        f"Saved: {tmp_path}",
        "Bench is safe.",
    ]


def test_a_batch_that_was_stopped_says_by_what_and_how_it_is_continued(tmp_path: Path) -> None:
    assert ended(tmp_path, "stopped by Ctrl-C", "done") == [
        "Stopped by Ctrl-C: 1 of 3 runs in 10 s of bench time (simulated).",
        f"Saved: {tmp_path}",
        f"Continue with: rig batch resume {tmp_path}",
    ], "nothing is said of a bench that is not known"


def test_a_batch_that_was_stopped_before_its_first_run_says_nothing_of_its_time(
    tmp_path: Path,
) -> None:
    assert ended(tmp_path, "stopped by SIGTERM")[0] == (
        "Stopped by SIGTERM: 0 of 3 runs (simulated)."
    )


def test_a_batch_that_left_its_bench_unsafe_is_continued_once_that_is_safe(tmp_path: Path) -> None:
    failure, *lines = ended(
        tmp_path, "stopped: no answer", "done", "failed", bench="Bench is NOT safe (see above)."
    )
    assert failure.startswith("failed: run 2 sweep-001: ")
    assert lines == [
        "Stopped: 1 of 3 runs, 1 failed, in 20 s of bench time (simulated): no answer",
        f"Saved: {tmp_path}",
        "Bench is NOT safe (see above).",
        f"Once the bench is safe, continue with: rig batch resume {tmp_path}",
        "Once the bench is safe, take failed and left-out runs again with: "
        f"rig batch resume {tmp_path} --retry-failed",
    ]


def test_a_run_without_a_valid_trial_is_named_although_it_is_done(tmp_path: Path) -> None:
    folder = BatchFolder(tmp_path)
    condition = BatchCondition("slip-001", 0, "slip-trial", {}, {})
    runs = tuple(PlannedRun(k, "slip-001", k) for k in range(1, 8))
    plan = BatchPlan({"slip-001": condition}, runs)
    meta = {"name": "night", "state": "complete", "simulated": "yes"}
    with Queue.create(folder.queue, plan, {"slip-001": RunEstimate(10.0, 2.0)}, meta) as queue:
        for number in range(1, 8):
            valid = 2 if number == 2 else 0
            code = ExitCode.DONE if number == 2 else ExitCode.FINISHED_WITH_FAILURES
            summary = {} if number == 3 else {"trials": 2, "valid_trials": valid}
            result = AttemptResult("complete", code=int(code), summary=summary)
            queue.finish(queue.claim(number), result, "done")
            queue.set_processed(number, {})
    status = status_of(folder)
    found = [line for line in status.closing_lines("") if line.startswith("invalid: ")]
    assert found == [line for line in status.lines() if line.startswith("invalid: ")]
    file = tmp_path / "runs" / "r00007_slip-trial.h5"
    assert found[0] == (f"invalid: run 7 slip-001: 0 of 2 trials valid; why: rig show --all {file}")
    assert "run 3 slip-001: some points are invalid; " in found[4]
    assert found[5:] == ["invalid: 1 earlier run with invalid points"]
    shown = status.as_object()
    assert shown["runs_with_invalid_points"] == 6
    assert shown["latest_invalid"][0] == {
        "run": 7, "condition": "slip-001", "valid": "0 of 2 trials valid",
    }  # fmt: skip


def test_times_of_a_batch_have_their_zone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the night in which a clock is set back there are two half past twos."""
    monkeypatch.setattr(queue_module, "_now", lambda: "2026-10-25T02:30:00.500000+01:00")
    folder, (plan, estimates) = BatchFolder(tmp_path), three_runs()
    with Queue.create(folder.queue, plan, estimates, {"name": "night"}) as queue:
        queue.add_event("info", "started")
    status = status_of(folder, running=True)
    assert "2026-10-25 02:30:00+01:00 info: started" in status.lines()
    ends = status.finish.isoformat(" ", "minutes")
    assert [line for line in status.lines() if line.endswith(f", until {ends}")]


def file_until(stop_by: str) -> str:
    """The queue's entry of a batch file with this `stop_by`."""
    given = {"batch": {"name": "night", "stop_by": stop_by}}
    return BatchFile.model_validate(
        {**given, "experiment": [{"procedure": "sweep"}]}
    ).model_dump_json()


def test_runs_left_by_a_stop_by_with_a_date_are_not_sent_to_a_resume_that_takes_none(
    tmp_path: Path,
) -> None:
    new = "egin a new batch with the runs that are left: rig batch resume does not change a "
    new += "stop_by with a date"
    passed = {"file": file_until("2026-01-14T07:00:00"), "bench": str(tmp_path / "bench.toml")}
    assert ended(tmp_path, "stopped: stop_by", "done", entries=passed)[-1] == f"B{new}"
    assert status_of(BatchFolder(tmp_path)).lines()[-1] == f"b{new}"
    (tmp_path / "unsafe").mkdir()
    unsafe = ended(
        tmp_path / "unsafe", "stopped", bench="Bench is NOT safe (see above).", entries=passed
    )
    assert unsafe[-1] == f"Once the bench is safe, b{new}"


@pytest.mark.parametrize(
    ("stop_by", "over", "words"),
    [
        ("2026-01-14T07:00:00", "yes", "Begin a new batch"),
        ("2026-01-14T07:00:00", "", "Continue with: rig batch resume"),  # its time is virtual
        ("07:00:00", "yes", "Continue with: rig batch resume"),
    ],
)
def test_a_simulated_batch_is_over_where_its_own_time_is(
    tmp_path: Path, stop_by: str, over: str, words: str
) -> None:
    lines = ended(tmp_path, "stopped", entries={"file": file_until(stop_by), TIME_OVER: over})
    assert lines[-1].startswith(words)


@pytest.mark.parametrize(
    ("when", "words"),
    [
        ({"finished_runs": 1}, "Begin a new batch with the runs that are left"),
        ({"failed_runs": 1}, "Take failed runs again with rig batch resume --retry-failed, or "),
        ({"finished_runs": 2}, "Take failed and left-out runs again with: rig batch resume "),
    ],
)
def test_a_resume_that_would_end_at_once_is_not_proposed(
    tmp_path: Path, when: dict[str, int], words: str
) -> None:
    """A stop condition stays met."""
    given = {"batch": {"name": "night", "stop_when": when}, "experiment": [{"procedure": "sweep"}]}
    file = {"file": BatchFile.model_validate(given).model_dump_json()}
    lines = ended(tmp_path, "stopped: 1 runs are finished", "done", "failed", entries=file)
    assert lines[-1].startswith(words)


def test_files_still_to_be_made_are_made_by_a_resume_also_after_stop_by(tmp_path: Path) -> None:
    folder, (plan, estimates) = BatchFolder(tmp_path), three_runs()
    meta = {"name": "night", "state": "", "file": file_until("2026-01-14T07:00:00")}
    with Queue.create(folder.queue, plan, estimates, meta | {TIME_OVER: "yes"}) as queue:
        queue.finish(queue.claim(1), AttemptResult("complete"), "done")
    assert status_of(folder).lines()[-1] == (
        f"make the missing files with: rig batch resume {tmp_path}"
    )
    with Queue.open(folder.queue) as queue:
        for number in (2, 3):
            queue.finish(queue.claim(number), AttemptResult("complete"), "done")
    assert status_of(folder).lines()[-1] == f"continue with: rig batch resume {tmp_path}"


def test_only_a_run_without_its_run_file_is_called_not_compiled(tmp_path: Path) -> None:
    folder = BatchFolder(tmp_path)
    plan, estimates = three_runs()
    (tmp_path / "runs").mkdir()
    with Queue.create(
        folder.queue, plan, estimates, {"name": "night", "state": "stopped"}
    ) as queue:
        for number in (1, 2, 3):
            queue.finish(queue.claim(number), AttemptResult("complete"), "done")
    folder.run_file(1, "sweep").touch()
    folder.run_file(2, "sweep").touch()
    lines = status_of(folder).lines()
    assert "not compiled yet: 1 run file" in lines
    assert "figures and results still to be made: 2 runs" in lines
    assert lines[-1].startswith("continue with: rig batch resume")


def test_the_bench_is_called_safe_only_where_that_is_known() -> None:
    safe = RunOutcome("complete", ExitCode.DONE, made_safe=("generator off",), safe=True)
    assert _ended(safe).bench == "Bench is safe."
    refused = RunOutcome("failed", ExitCode.INSTRUMENT)
    assert _ended(refused).bench == "", "nothing was connected"
    untouched = RunOutcome("stopped", ExitCode.SIGINT, safe=True, armed=False)
    assert _ended(untouched).bench == "", "an earlier run may have left something pressed"
    left = RunOutcome("failed", ExitCode.INSTRUMENT, left=("the film may still be pressed",))
    assert _ended(left).bench.startswith("Bench is stopped, but the film may still be pressed")
    unsafe = RunOutcome("failed", ExitCode.UNSAFE)
    unsafe.off_failures = [ShutdownFailure("preload", "no answer")]
    assert _ended(unsafe).bench == "Bench is NOT safe (see above)."
    unsafe.taken_over = TakenOver(True, "the guard has stopped it")
    assert _ended(unsafe).bench == "Bench was made safe by the guard (see above)."


def test_runs_that_were_not_taken_after_failures_are_called_left_out(tmp_path: Path) -> None:
    folder, (plan, estimates) = BatchFolder(tmp_path), three_runs()
    with Queue.create(folder.queue, plan, estimates, {"name": "night", "state": ""}) as queue:
        queue.finish(queue.claim(1), AttemptResult("failed", bench_s=10.0), "failed")
        queue.set_aside("sweep-001", "1 run failed")
    status = status_of(folder)
    assert "0 of 3 runs done, 1 failed, 2 left out" in status.lines()
    assert any("0 of 3 runs, 1 failed, 2 left out" in line for line in status.closing_lines(""))
    again = f"ake failed and left-out runs again with: rig batch resume {tmp_path} --retry-failed"
    assert status.lines()[-1] == f"t{again}"
    assert status.closing_lines("")[-1] == f"T{again}"
