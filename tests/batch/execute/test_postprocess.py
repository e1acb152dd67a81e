"""What is made of finished runs, in this process and by real processes of a queue."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest
import recorded_run
import recorded_trials as trials
from packages import install

from rig.batch.execute.postprocess import (
    PostprocessJob,
    PostprocessQueue,
    PostprocessResult,
    _result_of,
    make_files,
    result_from,
)
from rig.batch.execute.run_files import RunFiles
from rig.batch.folder import BatchFolder
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.core.child import ChildResult
from rig.detector.registered import chosen_detector
from rig.files.verify import verify
from rig.processing import detection

PATIENCE_S = 200.0
"""A process of the lowest priority gets what a busy computer leaves."""


def recorded(folder: Path, name: str, **changes: str) -> Path:
    """The journal of a recording with a slip, that was stopped and has not been compiled."""
    journal = folder / f"{name}.rigj"
    slipping = {"trial-001": trials.slipping()}
    trials.write_trials(journal, slipping, complete=False, **changes).unlink()
    return journal


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


# --- one run -----------------------------------------------------------------------------------


def test_a_journal_is_compiled_judged_and_drawn(tmp_path: Path) -> None:
    journal = recorded(tmp_path, "a", procedure="import")
    result = make_files(PostprocessJob(journal))
    assert (result.error, result.warnings) == ("", ())
    assert result.file == tmp_path / "a.h5"
    assert verify(result.file) == []
    assert result.figures == (tmp_path / "a.png", tmp_path / "a.svg")
    assert all(figure.stat().st_size > 1000 for figure in result.figures)
    assert result.processed is not None
    found = detection.detect_file(detection.DetectionJob(result.file, chosen_detector("paper-hp")))
    assert isinstance(found, detection.DetectionResult)
    assert found.kept, "as `rig detect` makes it"
    assert found.file == result.processed


@pytest.mark.thorough
def test_a_job_that_is_given_again_changes_nothing(tmp_path: Path) -> None:
    journal = recorded(tmp_path, "a", procedure="import")
    first = make_files(PostprocessJob(journal))
    before = {name: (tmp_path / name).read_bytes() for name in names(tmp_path)}
    assert make_files(PostprocessJob(journal)) == first
    assert {name: (tmp_path / name).read_bytes() for name in names(tmp_path)} == before


def test_a_run_that_is_complete_loses_its_journal_and_can_be_given_by_its_name(
    tmp_path: Path,
) -> None:
    journal = recorded_run.write_run(tmp_path / "s.rigj")
    result = make_files(PostprocessJob(journal, figures=False))
    assert result.file == tmp_path / "s.h5"
    assert result.processed is None, "a sweep has no strips, and that is no failure"
    assert result.warnings == ()
    assert not journal.exists()
    assert make_files(PostprocessJob(journal, figures=False)) == result


def test_what_is_not_asked_for_is_not_done(tmp_path: Path) -> None:
    result = make_files(PostprocessJob(recorded(tmp_path, "a"), figures=False, detect=False))
    assert result.figures == ()
    assert result.processed is None
    assert names(tmp_path) == {"a.rigj", "a.h5", "a.h5.sha256"}


@pytest.mark.thorough
def test_a_figure_that_fails_is_reported_and_the_rest_is_done(tmp_path: Path) -> None:
    result = make_files(PostprocessJob(recorded(tmp_path, "a", procedure="slip-trial")))
    assert result.processed is not None
    assert result.figures == ()
    of_a_trial, of_the_series = sorted(result.warnings)
    assert of_a_trial.startswith("a.h5: the figure slip-trial (")
    assert of_the_series.startswith("a.h5: the figure slip-trial.series (")


def test_a_journal_that_is_none_is_reported(tmp_path: Path) -> None:
    (tmp_path / "n.rigj").write_text("nonsense")
    result = make_files(PostprocessJob(tmp_path / "n.rigj"))
    assert result.file is None
    assert "n.rigj" in result.error


def test_a_result_survives_its_line() -> None:
    result = PostprocessResult(Path("a.rigj"), Path("a.h5"), None, (Path("a.png"),), ("w",), "")
    assert result_from(json.loads(result.as_line())) == result


def test_a_process_that_ends_while_it_draws_costs_the_figures_that_are_missing() -> None:
    made = PostprocessResult(Path("a.rigj"), Path("a.h5"), None, (Path("a.png"),), ("w",))
    lines = made.as_line("the figure vib of lab-vib").encode()
    job = PostprocessJob(Path("x/a.rigj"))
    found = _result_of(job, ChildResult("it did not finish within 9 s", lines))
    assert found == replace(
        made,
        journal=job.journal,
        warnings=(
            "w",
            "a.h5: the figure vib of lab-vib and those after it were not drawn: the process that "
            "makes its files ended early (it did not finish within 9 s); `rig show --figures a.h5` "
            "draws them again",
        ),
    )
    late = _result_of(job, ChildResult("SIGKILL", made.as_line().encode()))
    assert (late.file, late.figures, late.error) == (made.file, made.figures, "")
    assert late.warnings[-1].startswith("a.h5: the process that makes its files ended early")
    assert _result_of(job, ChildResult("SIGKILL", b"")).error


def test_a_warning_of_a_figure_is_in_the_log_of_the_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = recorded(tmp_path, "r1", procedure="import")
    folder: Any = SimpleNamespace(
        journal=lambda *_: journal, run_file=lambda *_: journal.with_suffix(".h5")
    )
    settings: Any = SimpleNamespace(figures=True, detect=False)
    said: list[str] = []
    with (tmp_path / "batch.log").open("ab", buffering=0) as log:
        queue: Any = SimpleNamespace(add_event=None, set_processed=None)
        files = RunFiles(folder, settings, queue, lambda *_: None, said.append, log, log.fileno())
        files.add(1, "import")
        result = PostprocessResult(journal, tmp_path / "r1.h5", warnings=("the figure x: late",))
        monkeypatch.setattr(PostprocessQueue, "poll", lambda *_, **__: result)
        files.poll(start=True)
    assert said == ["warning: the figure x: late"]
    assert (tmp_path / "batch.log").read_text() == "warning: the figure x: late\n"


def test_a_run_whose_folder_is_away_is_not_written_off(tmp_path: Path) -> None:
    """Its files are made once the folder is back."""
    folder, moved = BatchFolder(tmp_path / "night"), tmp_path / "moved"
    folder.path.mkdir()
    sweep = BatchCondition("sweep-001", 0, "sweep", {}, {})
    plan = BatchPlan({"sweep-001": sweep}, (PlannedRun(1, "sweep-001", 1),))
    estimates = {"sweep-001": RunEstimate(10.0, 2.0)}
    settings: Any = SimpleNamespace(figures=True, detect=False)
    with (
        Queue.create(folder.queue, plan, estimates, {"name": "night"}) as queue,
        (tmp_path / "batch.log").open("ab", buffering=0) as log,
    ):
        queue.finish(queue.claim(1), AttemptResult("complete"), "done")
        files = RunFiles(
            folder,
            settings,
            queue,
            lambda write, *values: write(*values),
            lambda _: None,
            log,
            log.fileno(),
        )
        folder.path.rename(moved)
        (folder.path / "runs").mkdir(parents=True)
        files.add_all(queue.unprocessed())
        assert queue.unprocessed() == [(1, "sweep")]
        (folder.path / "runs").rmdir()
        folder.path.rmdir()
        moved.rename(folder.path)
        files.add_all(queue.unprocessed())
        assert queue.unprocessed() == [], "now it is known to have failed before its first record"


# --- the processes -----------------------------------------------------------------------------


def results(queue: PostprocessQueue) -> list[PostprocessResult]:
    """Everything that the queue comes to."""
    found = []
    deadline_s = time.monotonic() + PATIENCE_S
    while len(queue):
        assert time.monotonic() < deadline_s
        if (result := queue.poll(start=True)) is not None:
            found.append(result)
        time.sleep(0.02)
    return found


def eventually(what: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def begun(queue: PostprocessQueue) -> int:
    """Begin with the first run; the process that makes its files."""
    assert queue.poll(start=True) is None
    assert queue.pid is not None
    return queue.pid


@pytest.fixture
def log(tmp_path: Path) -> Iterator[IO[bytes]]:
    with (tmp_path / "batch.log").open("ab") as file:
        yield file


@pytest.fixture
def queue(log: IO[bytes]) -> Iterator[PostprocessQueue]:
    queue = PostprocessQueue(log)
    yield queue
    queue.close(0.0)


@pytest.mark.thorough
def test_runs_are_worked_on_in_turn_and_one_that_fails_does_not_end_the_others(
    queue: PostprocessQueue, tmp_path: Path
) -> None:
    (tmp_path / "n.rigj").write_text("nonsense")
    jobs = [recorded(tmp_path, "a"), tmp_path / "n.rigj", recorded(tmp_path, "b")]
    for journal in jobs:
        queue.add(PostprocessJob(journal, figures=False))
    found = results(queue)
    assert [result.journal for result in found] == jobs
    assert [bool(result.error) for result in found] == [False, True, False]
    assert all(result.processed for result in found if not result.error)


@pytest.mark.thorough
def test_all_runs_are_compiled_before_a_figure_is_drawn(
    queue: PostprocessQueue, tmp_path: Path
) -> None:
    jobs = [recorded(tmp_path, name, procedure="import") for name in "abc"]
    for journal in jobs:
        queue.add(PostprocessJob(journal))
    seen: list[set[str]] = []
    found = []
    deadline_s = time.monotonic() + PATIENCE_S
    while len(queue):
        assert time.monotonic() < deadline_s
        if (result := queue.poll(start=True)) is not None:
            found.append(result)
        if {"a.png", "b.png", "c.png"} & (there := names(tmp_path)):
            seen.append(there)
        time.sleep(0.02)
    assert {"a.h5", "b.h5", "c.h5"} <= seen[0]
    assert sorted(result.journal for result in found) == jobs
    for result in found:
        assert (result.error, result.warnings) == ("", ())
        assert [figure.suffix for figure in result.figures] == [".png", ".svg"]
        assert result.processed is not None


@pytest.mark.thorough
def test_nothing_is_begun_while_the_bench_is_in_use_and_what_is_under_way_is_finished(
    queue: PostprocessQueue, tmp_path: Path
) -> None:
    for name in "ab":
        queue.add(PostprocessJob(recorded(tmp_path, name), figures=False, detect=False))
    assert queue.poll(start=False) is None
    assert queue.pid is None
    begun(queue)
    found = []

    def first_is_done() -> bool:
        found.append(queue.poll(start=False))
        return found[-1] is not None

    eventually(first_is_done)
    assert found[-1].file == tmp_path / "a.h5"
    assert queue.poll(start=False) is None
    assert queue.pid is None
    assert len(queue) == 1


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc").exists(), reason="looks at processes in /proc")
def test_the_process_has_the_lowest_priority_and_one_thread(
    queue: PostprocessQueue, tmp_path: Path
) -> None:
    queue.add(PostprocessJob(recorded(tmp_path, "a"), figures=False))
    pid = begun(queue)
    eventually(lambda: os.getpriority(os.PRIO_PROCESS, pid) == 19)
    assert b"OPENBLAS_NUM_THREADS=1" in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")


@pytest.mark.thorough
def test_a_process_that_is_killed_costs_the_files_of_its_run(
    queue: PostprocessQueue, tmp_path: Path
) -> None:
    jobs = [recorded(tmp_path, name) for name in "ab"]
    for journal in jobs:
        queue.add(PostprocessJob(journal, figures=False))
    os.kill(begun(queue), signal.SIGKILL)
    died, done = results(queue)
    assert died.journal == jobs[0]
    assert "a.rigj: the process that makes its files failed: SIGKILL" in died.error
    assert done.file == tmp_path / "b.h5"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import os\ndef draw(run):\n    os._exit(3)\n", "were not drawn: the process that makes "),
        (
            "def draw(run):\n    raise KeyError('colour')\n",
            "could not be drawn: lab_bad.py line 2: KeyError: 'colour'",
        ),
    ],
)
def test_a_figure_that_ends_the_process_or_fails_costs_itself_and_is_named(
    log: IO[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, words: str
) -> None:
    entries = "[rig.figures]\nimport.z = lab_bad:draw\n"
    site = install(tmp_path / "site", "lab-bad", entries, {"lab_bad.py": source})
    monkeypatch.setenv("PYTHONPATH", str(site))
    queue = PostprocessQueue(log)
    queue.add(PostprocessJob(recorded(tmp_path, "a", procedure="import"), detect=False))
    (result,) = results(queue)
    assert result.error == ""
    assert result.file == tmp_path / "a.h5"
    assert [figure.name for figure in result.figures] == ["a.png", "a.svg"]
    (warning,) = result.warnings
    assert warning.startswith("a.h5: the figure import.z (lab_bad:draw) of lab-bad ")
    assert words in warning
    said = (tmp_path / "batch.log").read_text()
    assert ("Traceback" in said) == ("KeyError" in words)


@pytest.mark.thorough
def test_a_process_that_hangs_is_killed_at_its_time_limit(log: IO[bytes], tmp_path: Path) -> None:
    """Stopped by a signal, as one that waits for a dead disk: it never ends by itself."""
    queue = PostprocessQueue(log, longest_s=1.0)
    queue.add(PostprocessJob(recorded(tmp_path, "a"), figures=False))
    os.kill(begun(queue), signal.SIGSTOP)
    (result,) = results(queue)
    assert "it did not finish within 1 s" in result.error


@pytest.mark.thorough
def test_close_begins_nothing_more_and_waits_for_the_files_under_way(
    queue: PostprocessQueue, tmp_path: Path
) -> None:
    for name in "ab":
        queue.add(PostprocessJob(recorded(tmp_path, name), figures=False))
    begun(queue)
    result = queue.close(PATIENCE_S)
    assert result is not None
    assert result.file == tmp_path / "a.h5"
    assert len(queue) == 1
    assert not (tmp_path / "b.h5").exists()


@pytest.mark.thorough
def test_close_kills_what_takes_too_long(queue: PostprocessQueue, tmp_path: Path) -> None:
    queue.add(PostprocessJob(recorded(tmp_path, "a"), figures=False))
    pid = begun(queue)
    os.kill(pid, signal.SIGSTOP)
    assert queue.close(0.2) is None
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.thorough
@pytest.mark.parametrize("seen", ["a.h5", "a.png"])
def test_a_process_that_is_killed_leaves_whole_files_only(
    queue: PostprocessQueue, tmp_path: Path, seen: str
) -> None:
    """Killed as soon as something of a name is seen, also a part of it; then done again."""
    journal = recorded(tmp_path, "a", procedure="import")
    queue.add(PostprocessJob(journal))
    pid = begun(queue)
    eventually(lambda: any(seen in path.name for path in tmp_path.iterdir()))
    os.kill(pid, signal.SIGKILL)
    results(queue)
    for file in tmp_path.rglob("[!.]*.h5"):
        assert verify(file) == []
    for figure in tmp_path.glob("[!.]*.png"):
        assert figure.read_bytes().endswith(b"IEND\xaeB`\x82")
    for figure in tmp_path.glob("[!.]*.svg"):
        assert figure.read_text().rstrip().endswith("</svg>")
    result = make_files(PostprocessJob(journal))
    assert result.processed is not None
    assert len(result.figures) == 2


@pytest.mark.thorough
def test_by_hand_it_reports_on_one_line(tmp_path: Path) -> None:
    journal = recorded(tmp_path, "a")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "rig.batch.execute.postprocess"),
            *(str(journal), "--no-figures", "--no-detect"),
        ],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    assert result_from(json.loads(line)).file == tmp_path / "a.h5"
    assert not (tmp_path / "a.png").exists()
