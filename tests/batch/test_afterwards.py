"""What is made of runs afterwards, in this process and by the real steward with its worker."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "files"))

import recorded_run
import recorded_trials as trials

from rig.batch.execute.postprocess import Afterwards, Answer, Job, answer_of, job_of
from rig.batch.execute.postprocess_worker import work_on
from rig.detector.settings import named_detectors
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
    answer = work_on(Job(journal))
    assert (answer.error, answer.warnings) == ("", ())
    assert answer.file == tmp_path / "a.h5"
    assert verify(answer.file) == []
    assert answer.figures == (tmp_path / "a.png", tmp_path / "a.svg")
    assert all(figure.stat().st_size > 1000 for figure in answer.figures)
    assert answer.processed is not None
    found = detection.detect_file(
        detection.DetectionJob(answer.file, named_detectors()["paper-hp"])
    )
    assert isinstance(found, detection.DetectionResult)
    assert found.kept, "as `rig detect` makes it"
    assert found.file == answer.processed


def test_a_job_that_is_given_again_changes_nothing(tmp_path: Path) -> None:
    journal = recorded(tmp_path, "a", procedure="import")
    first = work_on(Job(journal))
    before = {name: (tmp_path / name).read_bytes() for name in names(tmp_path)}
    assert work_on(Job(journal)) == first
    assert {name: (tmp_path / name).read_bytes() for name in names(tmp_path)} == before


def test_a_run_that_is_complete_loses_its_journal_and_can_be_given_by_its_name(
    tmp_path: Path,
) -> None:
    journal = recorded_run.write_run(tmp_path / "s.rigj")
    answer = work_on(Job(journal, figures=False))
    assert answer.file == tmp_path / "s.h5"
    assert answer.processed is None, "a sweep has no strips, and that is no failure"
    assert answer.warnings == ()
    assert not journal.exists()
    assert work_on(Job(journal, figures=False)) == answer


def test_what_is_not_asked_for_is_not_done(tmp_path: Path) -> None:
    answer = work_on(Job(recorded(tmp_path, "a"), figures=False, detect=False))
    assert answer.figures == ()
    assert answer.processed is None
    assert names(tmp_path) == {"a.rigj", "a.h5", "a.h5.sha256"}


def test_a_figure_that_fails_is_told_and_the_rest_is_done(tmp_path: Path) -> None:
    answer = work_on(Job(recorded(tmp_path, "a", procedure="slip-trial")))
    assert answer.processed is not None
    assert answer.figures == ()
    (warning,) = answer.warnings
    assert warning.startswith("a.h5: not drawn: ")


def test_a_journal_that_is_none_is_told(tmp_path: Path) -> None:
    (tmp_path / "n.rigj").write_text("nonsense")
    answer = work_on(Job(tmp_path / "n.rigj"))
    assert answer.file is None
    assert "n.rigj" in answer.error


def test_jobs_and_answers_survive_their_lines() -> None:
    answer = Answer(Path("a.rigj"), Path("a.h5"), None, (Path("a.png"),), ("w",), "")
    assert answer_of(json.loads(answer.as_line())) == answer
    assert job_of('{"journal": "a.rigj", "figures": false}') == Job(Path("a.rigj"), figures=False)
    for line in ("x", "[]", "{}", '{"journal": 1}', '{"journal": "a", "detect": "no"}', '{"j": 1}'):
        with pytest.raises(ValueError, match="no job"):
            job_of(line)


# --- the processes -----------------------------------------------------------------------------

pytestmark = pytest.mark.skipif(not Path("/proc").exists(), reason="looks at processes in /proc")


def eventually(what: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def child_of(pid: int) -> int | None:
    """Of a process, once it runs its own program."""
    with contextlib.suppress(OSError):
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        if children and b"postprocess_worker" in Path(f"/proc/{children[0]}/cmdline").read_bytes():
            return int(children[0])
    return None


def state_of(pid: int) -> str:
    """R, S, T (stopped) ...; "" where it is gone."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return ""


@pytest.fixture
def afterwards() -> Iterator[Afterwards]:
    steward = Afterwards()
    yield steward
    steward.close(PATIENCE_S)


def worker_of(steward: Afterwards) -> int:
    eventually(lambda: child_of(steward.pid) is not None)
    worker = child_of(steward.pid)
    assert worker is not None
    return worker


def test_jobs_are_done_in_turn_and_one_that_fails_does_not_end_the_others(
    afterwards: Afterwards, tmp_path: Path
) -> None:
    (tmp_path / "n.rigj").write_text("nonsense")
    jobs = [recorded(tmp_path, "a"), tmp_path / "n.rigj", recorded(tmp_path, "b")]
    for journal in jobs:
        afterwards.give(Job(journal, figures=False))
    answers = afterwards.close(PATIENCE_S)
    assert [answer.journal for answer in answers] == jobs
    assert [bool(answer.error) for answer in answers] == [False, True, False]
    assert all(answer.processed for answer in answers if not answer.error)
    assert afterwards.lost


def test_the_worker_has_the_lowest_priority_and_one_thread(
    afterwards: Afterwards, tmp_path: Path
) -> None:
    afterwards.give(Job(recorded(tmp_path, "a"), figures=False))
    worker = worker_of(afterwards)
    assert os.sched_getscheduler(worker) == os.SCHED_IDLE
    assert os.getpriority(os.PRIO_PROCESS, worker) == 19
    environment = Path(f"/proc/{worker}/environ").read_bytes().split(b"\0")
    assert b"OPENBLAS_NUM_THREADS=1" in environment


def test_a_worker_that_is_held_stands_still_until_it_may_go_on(
    afterwards: Afterwards, tmp_path: Path
) -> None:
    afterwards.give(Job(recorded(tmp_path, "a"), figures=False))
    worker = worker_of(afterwards)
    afterwards.hold()
    eventually(lambda: state_of(worker) == "T")
    afterwards.give(Job(recorded(tmp_path, "b"), figures=False))
    time.sleep(0.5)
    assert state_of(worker) == "T"
    assert afterwards.answers() == []
    afterwards.go()
    assert len(afterwards.close(PATIENCE_S)) == 2


def test_sigterm_ends_it_after_the_file_under_way(afterwards: Afterwards, tmp_path: Path) -> None:
    jobs = [recorded(tmp_path, name) for name in "abc"]
    for journal in jobs:
        afterwards.give(Job(journal, figures=False))
    worker_of(afterwards)
    os.kill(afterwards.pid, signal.SIGTERM)
    answers = afterwards.close(PATIENCE_S)
    assert [answer.journal for answer in answers] == jobs[:1]
    assert not (tmp_path / "b.h5").exists()


def test_a_worker_that_dies_over_a_file_costs_that_file(
    afterwards: Afterwards, tmp_path: Path
) -> None:
    jobs = [recorded(tmp_path, name) for name in "ab"]
    for journal in jobs:
        afterwards.give(Job(journal, figures=False))
    os.kill(worker_of(afterwards), signal.SIGKILL)
    died, done = afterwards.close(PATIENCE_S)
    assert died.journal == jobs[0]
    assert "the worker died over it with exit code -9" in died.error
    assert done.file == tmp_path / "b.h5"


@pytest.mark.parametrize("seen", ["a.h5", "processed", "a.png"])
def test_a_worker_that_is_killed_leaves_whole_files_only(
    afterwards: Afterwards, tmp_path: Path, seen: str
) -> None:
    """Killed as soon as something of a name is seen, also a part of it; then done again."""
    journal = recorded(tmp_path, "a", procedure="import")
    afterwards.give(Job(journal))
    worker = worker_of(afterwards)
    eventually(lambda: any(seen in path.name for path in tmp_path.iterdir()))
    os.kill(worker, signal.SIGKILL)
    afterwards.close(PATIENCE_S)
    for file in tmp_path.rglob("[!.]*.h5"):
        assert verify(file) == []
    for figure in tmp_path.glob("[!.]*.png"):
        assert figure.read_bytes().endswith(b"IEND\xaeB`\x82")
    for figure in tmp_path.glob("[!.]*.svg"):
        assert figure.read_text().rstrip().endswith("</svg>")
    answer = work_on(Job(journal))
    assert answer.processed is not None
    assert len(answer.figures) == 2


def test_a_steward_that_is_killed_leaves_its_file_whole_and_nobody_behind(tmp_path: Path) -> None:
    steward = Afterwards()
    steward.give(Job(recorded(tmp_path, "a"), figures=False))
    worker = worker_of(steward)
    steward.hold()
    eventually(lambda: state_of(worker) == "T")
    os.kill(steward.pid, signal.SIGKILL)
    eventually(lambda: state_of(worker) in ("", "Z"))
    steward.close(1.0)
    for file in tmp_path.rglob("[!.]*.h5"):
        assert verify(file) == []


def test_its_end_is_the_end_of_what_is_given(tmp_path: Path) -> None:
    """By hand, without the batch's side."""
    lines = "nonsense\n" + json.dumps({"journal": str(recorded(tmp_path, "a")), "figures": False})
    done = subprocess.run(
        [sys.executable, "-m", "rig.batch.execute.postprocess"],
        input=lines + "\n",
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    first, second = [answer_of(json.loads(line)) for line in done.stdout.splitlines()]
    assert first.journal is None
    assert "nonsense" in first.error
    assert second.file == tmp_path / "a.h5"
