"""Requests of other terminals to stop a batch: each is for the one that runs, and for its run."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from tiers import mostly_thorough

from rig.batch import running
from rig.batch.execute import worker_link
from rig.batch.execute.supervisor import (
    Supervisor,
    TerminalStop,
    _Supervision,
    requests_in,
)
from rig.batch.execute.worker import Worker
from rig.batch.folder import BatchFolder
from rig.batch.plan.conditions import BatchPlan
from rig.batch.plan.settings import BatchFile
from rig.batch.queue import Queue
from rig.batch.queue_file import QueueWriteError
from rig.batch.queue_records import WAITS_FOR_A_PERSON
from rig.cli.commands import batch
from rig.core.errors import ExitCode
from rig.run.locks import lock_holder
from rig.run.stopping import StopFlag


def batch_in(path: Path) -> BatchFolder:
    """The folder of a batch without runs."""
    folder = BatchFolder(path)
    experiment = {"procedure": "sweep"}
    file = BatchFile.model_validate({"batch": {"name": "night"}, "experiment": [experiment]})
    terms = {"name": "night", "file": file.model_dump_json(), "simulated": "yes"}
    Queue.create(folder.queue, BatchPlan({}, ()), {}, terms).close()
    return folder


def supervisor(tmp_path: Path, request: str, stop: StopFlag | None = None) -> Supervisor:
    """A supervisor of a batch for which a terminal has left this request."""
    folder = batch_in(tmp_path)
    with Queue.open(folder.queue) as queue:
        queue.add_request(request)
    return Supervisor(folder, stop or StopFlag(), lambda _: None)


@contextlib.contextmanager
def supervision(
    tmp_path: Path, request: str = "", stop: StopFlag | None = None
) -> Iterator[_Supervision]:
    """What the supervisor's thread has open, for a batch with this request of a terminal."""
    folder = batch_in(tmp_path)
    terminal = TerminalStop(stop or StopFlag())
    with Queue.open(folder.queue) as queue, folder.log.open("ab", buffering=0) as log:
        if request:
            queue.add_request(request)
        with folder.held_by("postprocess", 0.0) as lock:
            yield _Supervision(folder, queue, log, lock, terminal, lambda _: None)


def test_a_request_that_an_earlier_supervisor_has_not_seen_is_not_meant_for_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resumed = supervisor(tmp_path, "stop-now")
    seen: list[Any] = []

    def to_the_end(self: _Supervision) -> ExitCode:
        seen.extend(requests_in(self._queue))
        return ExitCode.DONE

    monkeypatch.setattr(_Supervision, "to_the_end", to_the_end)
    assert (resumed.run(), seen) == (ExitCode.DONE, [])


def test_a_stop_at_once_reaches_a_batch_whose_disk_takes_no_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its queue cannot be written: the supervisor gets the signal of a terminal instead."""
    folder = batch_in(tmp_path)
    asked: list[Path] = []

    def full(self: Queue, kind: str) -> None:
        raise QueueWriteError("queue.sqlite: the queue cannot be written: disk is full", "free it")

    monkeypatch.setattr(Queue, "add_request", full)
    monkeypatch.setattr(lock_holder, "ask_to_stop", asked.append)
    with folder.held_by("supervisor", 0.0):
        batch.stop(tmp_path, now=True)
        assert asked == [tmp_path / "supervisor.lock"]
        with pytest.raises(typer.Exit):
            batch.stop(tmp_path)
    assert "ask again; rig batch stop --now works without the queue" in capsys.readouterr().err
    assert len(asked) == 1


def test_a_stop_at_once_reaches_a_batch_whose_supervisor_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By Ctrl-Z, for instance: its worker still takes the run under way."""
    folder = batch_in(tmp_path)
    asked: list[Path] = []
    monkeypatch.setattr(batch, "UNHEARD_S", 0.0)
    monkeypatch.setattr(batch, "UNHEARD_NOW_S", 0.0)
    monkeypatch.setattr(lock_holder, "ask_to_stop", asked.append)
    with folder.held_by("supervisor", 0.0):
        batch.stop(tmp_path, now=True)
        assert asked == [tmp_path / "worker.lock"]
        with pytest.raises(typer.Exit):
            batch.pause(tmp_path)
    said = capsys.readouterr().err
    assert "it is stopped (Ctrl-Z) or hangs; the process that has the bench was asked" in said
    assert f"error: batch {tmp_path}: its supervisor took no request" in said
    assert "pausing" not in said
    assert len(asked) == 1


@pytest.mark.parametrize("spoil", [lambda queue: queue.write_bytes(b"x"), Path.unlink])
def test_a_stop_at_once_reaches_a_batch_whose_queue_cannot_be_opened(
    spoil: Callable[[Path], object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = batch_in(tmp_path)
    spoil(folder.queue)
    asked: list[Path] = []
    monkeypatch.setattr(lock_holder, "ask_to_stop", asked.append)
    with folder.held_by("supervisor", 0.0):
        batch.stop(tmp_path, now=True)
        assert asked == [tmp_path / "supervisor.lock"]
        with pytest.raises(typer.Exit):
            batch.stop(tmp_path)
    said = capsys.readouterr().err
    assert f"batch {tmp_path}: stopping now" in said
    assert "rig batch stop --now works without the queue" in said


@pytest.fixture
def silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BatchFolder:
    """The folder of a batch on a disk that has stalled: what looks into it waits without end."""
    folder = batch_in(tmp_path)
    monkeypatch.setattr(batch, "ANSWER_S", 0.5)
    monkeypatch.setattr(batch, "UNHEARD_NOW_S", 0.0)
    monkeypatch.setattr("rig.batch.folder.find_folder", lambda *_: threading.Event().wait())
    return folder


@pytest.mark.parametrize(
    "command", mostly_thorough([batch.status, batch.pause, batch.stop], [batch.stop])
)
def test_a_folder_that_does_not_answer_is_reported_with_what_works_without_it(
    command: Callable[..., None], silent: BatchFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended:
        command(silent.path)
    assert ended.value.exit_code == ExitCode.INTERNAL
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {silent.path} did not answer for ")
    assert "its disk has stalled, or its network share is away; " in line
    assert ("the request may still be carried out" in line) is (command is not batch.status)
    assert "; what works without it: " in line
    assert line.endswith("Ctrl-C in the terminal of the batch, rig batch stop --now, rig make-safe")


@pytest.mark.parametrize("stopped", [False, True])
@pytest.mark.parametrize("named", [False, True])
def test_a_stop_at_once_reaches_a_batch_whose_folder_does_not_answer(
    silent: BatchFolder,
    stopped: bool,
    named: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The kernel knows its supervisor; where that was stopped, the worker is asked."""
    asked: list[Path] = []
    monkeypatch.setattr("rig.batch.running.is_stopped", lambda _: stopped)
    monkeypatch.setattr("rig.batch.running.ask_to_stop", lambda path, **_: asked.append(path))
    with silent.held_by("supervisor", 0.0):
        batch.stop(silent.path if named else None, results=silent.path.parent, now=True)
    assert asked == [silent.worker_lock if stopped else silent.supervisor_lock]
    warning, said = capsys.readouterr().err.splitlines()
    assert "did not answer for" in warning
    assert "the process that runs the batch was asked directly" in warning
    assert said == f"batch {silent.path}: stopping now"


def test_a_stop_at_once_that_reaches_no_batch_says_so(
    silent: BatchFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended:
        batch.stop(silent.path, now=True)
    assert ended.value.exit_code == ExitCode.INTERNAL
    (line,) = capsys.readouterr().err.splitlines()
    assert "did not answer for" in line
    known = "no process of yours on this computer is known to run a batch"
    assert f"; not stopped: {known} in {silent.path}; " in line
    assert line.endswith("press Ctrl-C in the terminal of the batch, or run: rig make-safe")


def test_making_safe_stops_the_batch_of_a_run_although_its_folder_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = batch_in(tmp_path)
    asked: list[Path] = []
    monkeypatch.setattr(running, "REQUEST_S", 0.5)
    monkeypatch.setattr(running, "batch_of", lambda _: threading.Event().wait())
    monkeypatch.setattr(running, "ask_to_stop", lambda path, **_: asked.append(path))
    with folder.held_by("supervisor", 0.0):
        running.stop_batch_of(folder.journal(1, "sweep"))
        running.stop_batch_of(tmp_path.parent / "films" / "x.rigj")  # of no batch
    assert asked == [folder.supervisor_lock]


def _fails(_: object) -> None:
    raise OSError(errno.EIO, "Input/output error")


def _is_full(_: object) -> None:
    raise QueueWriteError("the disk is full")


@pytest.mark.parametrize("fails", [_fails, _is_full])
def test_making_safe_stops_the_batch_of_a_run_whose_disk_takes_no_request(
    fails: Callable[[object], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = batch_in(tmp_path)
    asked: list[Path] = []
    monkeypatch.setattr(running, "batch_of", fails)
    monkeypatch.setattr(running, "ask_to_stop", lambda path, **_: asked.append(path))
    with folder.held_by("supervisor", 0.0):
        running.stop_batch_of(folder.journal(1, "sweep"))
    assert asked == [folder.supervisor_lock]


def test_a_batch_on_another_computer_whose_queue_is_damaged_is_stopped_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its lock is seen on a network drive, but no process here holds it."""
    folder = BatchFolder(tmp_path)
    folder.queue.write_bytes(b"x")

    def nobody(path: Path) -> None:
        raise lock_holder.NotStoppedError(f"no process holds {path}: the run has ended or died")

    monkeypatch.setattr(lock_holder, "ask_to_stop", nobody)
    with folder.held_by("supervisor", 0.0), pytest.raises(typer.Exit):
        batch.stop(tmp_path, now=True)
    said = capsys.readouterr().err
    assert f"batch {tmp_path} could not be asked to stop: {folder.queue} cannot be read" in said
    assert "give the command on the computer and as the user that runs the batch" in said


def test_a_batch_is_ones_own_although_its_process_cannot_be_looked_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = BatchFolder(tmp_path)
    unseen = lock_holder.LockHolder(4242, "bob", own=False)
    monkeypatch.setattr("rig.batch.running.holder_of", lambda _: unseen)
    with folder.held_by("supervisor", 0.0):
        running.require_own(folder)


def test_a_batch_whose_status_cannot_be_read_at_its_end_still_says_that_its_bench_is_not_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its folder was moved away. The exit code is that of the batch, not of the status."""

    class Ended:
        bench = "Bench is NOT safe (see above)."

        def __init__(self, *_: object) -> None: ...

        def run(self) -> ExitCode:
            return ExitCode.UNSAFE

    monkeypatch.setattr("rig.batch.execute.supervisor.Supervisor", Ended)
    monkeypatch.setattr(batch, "start_log", lambda _: None)
    with pytest.raises(typer.Exit) as ended:
        batch._supervise(BatchFolder(tmp_path), as_json=True)
    assert ended.value.exit_code == ExitCode.UNSAFE
    shown = capsys.readouterr()
    assert json.loads(shown.out) == {"folder": str(tmp_path), "exit": 7}
    warning, bench = shown.err.splitlines()
    assert warning.startswith(
        f"warning: the status of the batch cannot be read: {tmp_path} holds no batch"
    )
    assert bench == Ended.bench


def test_the_batch_of_another_user_is_not_asked_and_its_owner_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    nobody = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: nobody)
    folder = batch_in(tmp_path)
    owner = lock_holder.LockHolder(4242, "bob", own=False)
    monkeypatch.setattr("rig.batch.running.holder_of", lambda _: owner)
    with folder.held_by("supervisor", 0.0):
        for asking in (batch.stop, batch.pause, batch.resume):
            with pytest.raises(typer.Exit):
                asking(tmp_path)
            assert "belongs to bob (process 4242)" in capsys.readouterr().err
    with Queue.open(folder.queue) as queue:
        assert queue.take_requests() == []


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ("paused: between runs", "resumed"),
        ("pausing", "resumed"),
        ("held: the film is torn", "resumed"),
        ("running", "is neither paused nor held (running); it continues, and a stop that was"),
    ],
)
def test_a_resume_of_a_batch_that_runs_says_what_it_has_changed(
    state: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = batch_in(tmp_path)
    with Queue.open(folder.queue) as queue:
        queue.set_meta("state", state)
    monkeypatch.setattr(BatchFolder, "is_held", lambda *_: True)
    batch.resume(tmp_path)
    assert said in capsys.readouterr().err
    with pytest.raises(typer.Exit):
        batch.resume(tmp_path, retry_failed=True)
    assert "--retry-failed and --despite-changes are for a batch that has" in (
        capsys.readouterr().err
    )
    with Queue.open(folder.queue) as queue:
        assert queue.take_requests() == ["go"]


def test_a_stop_is_heard_while_the_last_files_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given_up: list[float] = []

    class NeverReady:
        def __len__(self) -> int:
            return 1

        def close(self, patience_s: float) -> None:
            given_up.append(patience_s)

    def one_more_round(**_: object) -> None:
        raise AssertionError("the request was not heard")

    with supervision(tmp_path, "stop-after-point") as finishing:
        monkeypatch.setattr(finishing, "_make_files", one_more_round)
        finishing._files = NeverReady()  # type: ignore[assignment]
        assert finishing._finish_files() is signal.SIGTERM
    assert len(given_up) == 1


@pytest.mark.parametrize("by_request", [False, True])
@pytest.mark.parametrize(("missing", "code"), [([7], ExitCode.SIGTERM), ([], ExitCode.DONE)])
def test_a_stop_that_leaves_files_of_finished_runs_out_is_the_exit_code_of_the_batch(
    missing: list[int],
    code: ExitCode,
    by_request: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By a signal, or by a request from another terminal while the files are made."""
    stop = StopFlag()

    def workers() -> ExitCode:
        stop.requested = None if by_request else signal.SIGTERM
        monkeypatch.setattr(Queue, "unprocessed", lambda _: missing)
        return ExitCode.DONE

    with supervision(tmp_path, stop=stop) as finishing:
        monkeypatch.setattr(finishing, "_workers", workers)
        left_by = signal.SIGTERM if by_request else None
        monkeypatch.setattr(finishing, "_finish_files", lambda: left_by)
        assert finishing.to_the_end() == code


def test_a_worker_that_dies_after_a_request_to_stop_gets_no_successor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workers: list[int] = []

    def one_worker() -> int:
        workers.append(1)
        stopping._asked_to_end |= len(workers) == 1
        return -signal.SIGKILL

    with supervision(tmp_path) as stopping:
        monkeypatch.setattr(stopping, "_one_worker", one_worker)
        assert stopping._workers() == ExitCode.INTERNAL
    assert len(workers) == 1


@pytest.mark.parametrize(
    ("requests", "holds", "paused"),
    [
        (["pause"], [], "a person has paused it"),
        (["pause", "go"], [], ""),
        ([], [{"text": "the film is torn", "by_itself": ""}], "the film is torn"),
        (["go"], [{"text": "the film is torn", "by_itself": ""}], ""),
        ([], [{"text": "disk full", "by_itself": "there is room on the disk"}], ""),
        (
            ["pause"],
            [{"text": "disk full", "by_itself": "there is room"}],
            "a person has paused it",
        ),
    ],
)
def test_a_batch_that_waits_for_a_person_waits_also_when_its_worker_has_died(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    requests: list[str],
    holds: list[dict[str, str]],
    paused: str,
) -> None:
    requested = iter([requests, []])
    monkeypatch.setattr(Queue, "take_requests", lambda _: next(requested, []))
    begun: list[str] = []
    lines = [json.dumps({"event": "hold", "bench": "", **hold}).encode() for hold in holds]

    class Worker:
        pid, exit_code = 0, -signal.SIGKILL

        def __init__(self, _: object, __: object, waits_because: str) -> None:
            begun.append(waits_because)
            self._rounds = iter([lines, [], None] if len(begun) == 1 else [None])

        def __enter__(self) -> Worker:
            return self

        def __exit__(self, *_: object) -> None: ...

        def lines(self, _: float) -> list[bytes] | None:
            return next(self._rounds)

        def beat(self) -> None: ...

        def send(self, command: str) -> None: ...

    monkeypatch.setattr("rig.batch.execute.supervisor.WorkerProcess", Worker)
    with supervision(tmp_path) as waiting:
        assert waiting._workers() == ExitCode.INTERNAL, "none of these workers has begun a run"
        assert waiting._queue.meta(WAITS_FOR_A_PERSON) == paused, "for the next supervisor"
    assert begun[0] == ""
    assert set(begun[1:]) == {paused}


@pytest.mark.parametrize("unattended", [False, True])
def test_a_batch_that_waits_for_a_person_waits_also_when_a_service_restarts_it(
    unattended: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = batch_in(tmp_path)
    with Queue.open(folder.queue) as queue:
        queue.set_meta(WAITS_FOR_A_PERSON, "a person has paused it")
    begun: list[str] = []

    def to_the_end(self: _Supervision) -> ExitCode:
        begun.append(self._reports.waits_because)
        return ExitCode.DONE

    monkeypatch.setattr(_Supervision, "to_the_end", to_the_end)
    monkeypatch.setattr(batch, "start_log", lambda _: None)
    monkeypatch.setattr("rig.batch.execute.batch_clock.renew_window", lambda _: None)
    with pytest.raises(typer.Exit):
        batch.resume(tmp_path, despite_changes=True, unattended=unattended)
    assert begun == ["a person has paused it" if unattended else ""]


def test_a_service_does_not_resume_a_batch_that_a_person_has_paused_in_a_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = batch_in(tmp_path)
    monkeypatch.setattr(BatchFolder, "is_held", lambda *_: True)
    with pytest.raises(typer.Exit) as ended:
        batch.resume(tmp_path, unattended=True)
    assert ended.value.exit_code == ExitCode.USAGE
    assert "is running already" in capsys.readouterr().err
    with Queue.open(folder.queue) as queue:
        assert queue.take_requests() == []


def test_a_stop_by_a_key_is_recorded_under_the_name_of_the_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[str] = []
    sent: list[str] = []

    class Worker:
        exit_code = 130

        def __init__(self, *_: object) -> None:
            self._rounds = iter([[], None])

        def __enter__(self) -> Worker:
            return self

        def __exit__(self, *_: object) -> None: ...

        def lines(self, _: float) -> list[bytes] | None:
            return next(self._rounds)

        def send(self, command: str) -> None:
            sent.append(command)

        pid, beat = 0, staticmethod(lambda: None)

    stop = StopFlag()
    stop.requested = signal.SIGINT
    monkeypatch.setattr("rig.batch.execute.supervisor.WorkerProcess", Worker)
    with supervision(tmp_path, stop=stop) as stopping:
        monkeypatch.setattr(stopping, "_record_request", requested.append)
        stopping._one_worker()
    assert requested == ["stop by Ctrl-C"]
    assert sent == ["signal 2"]


def test_a_stop_reaches_the_worker_while_the_disk_keeps_the_supervisor_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk of the batch's folder, such as a network share, does not answer: whatever writes to
    it waits, and no signal ends that."""
    stop = StopFlag()
    stopping = supervisor(tmp_path, "go", stop)
    stalled, passed_on = threading.Event(), threading.Event()
    sent: list[str] = []

    class Worker:
        pid, exit_code, beat = 0, 130, staticmethod(lambda: None)

        def __init__(self, *_: object) -> None: ...

        def __enter__(self) -> Worker:
            return self

        def __exit__(self, *_: object) -> None: ...

        def lines(self, _: float) -> list[bytes] | None:
            return None if stalled.is_set() else []

        def send(self, command: str) -> None:
            sent.append(command)
            passed_on.set()

    def write_to_a_stalled_disk() -> None:
        if not stalled.is_set():
            stalled.set()
            os.kill(os.getpid(), signal.SIGINT)
            assert passed_on.wait(30), "the worker was not asked to stop"

    def to_the_end(self: _Supervision) -> ExitCode:
        return ExitCode(self._one_worker())

    monkeypatch.setattr("rig.batch.execute.supervisor.WorkerProcess", Worker)
    monkeypatch.setattr(_Supervision, "to_the_end", to_the_end)
    monkeypatch.setattr(_Supervision, "_poll", lambda _: write_to_a_stalled_disk())
    with stop:
        assert stopping.run() == ExitCode.SIGINT
    assert sent == ["signal 2"]


@pytest.mark.parametrize(
    ("commands", "ended_by"),
    [
        ([b"stop-now\n"], worker_link.STOP_NOW),
        ([b"signal 2\n"], ""),
        ([], worker_link.SUPERVISOR_DIED),
    ],
)
def test_a_batch_says_by_whom_it_was_ended_and_not_by_which_signal(
    commands: list[bytes], ended_by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, sent = StopFlag(), list[dict[str, Any]]()
    heard = iter([*commands, b""])  # which is the end of its standard input
    own = SimpleNamespace(
        read=lambda *_: next(heard),
        getpid=os.getpid,
        kill=lambda _, number: setattr(stop, "requested", stop.requested or number),
    )
    monkeypatch.setattr(worker_link, "os", own)
    nothing = SimpleNamespace(start=lambda: None)
    monkeypatch.setattr(worker_link.threading, "Thread", lambda **_: nothing)  # type: ignore[attr-defined]
    listener = worker_link.CommandListener(stop, lambda *_, **__: None)
    listener._listen()

    worker = Worker.__new__(Worker)
    worker._commands = listener
    worker._send = lambda _, **fields: sent.append(fields)
    worker._benches = SimpleNamespace(abandon=lambda: None)  # type: ignore[assignment]
    worker._recover = lambda: stop.check()  # type: ignore[method-assign]
    with Queue.open(batch_in(tmp_path).queue) as worker._queue:
        worker.work()
        state = worker._queue.meta("state")
    assert sent[-1]["text"] == (ended_by or "stopped by Ctrl-C")
    assert state == sent[-1]["text"]


@pytest.mark.parametrize(
    ("command", "sent"),
    [("stop-run", True), ("stop-run 12", True), ("stop-run 11", False), ("stop-run 1", False)],
)
def test_a_stop_of_one_run_does_not_reach_the_next(
    command: str, sent: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    signals: list[int] = []
    monkeypatch.setattr(os, "kill", lambda _, number: signals.append(number))
    nothing = SimpleNamespace(start=lambda: None)
    monkeypatch.setattr(worker_link.threading, "Thread", lambda **_: nothing)  # type: ignore[attr-defined]
    listener = worker_link.CommandListener(StopFlag(), lambda *_, **__: None)
    listener.run, listener.in_run = 12, True
    listener._handle(command)
    assert signals == ([signal.SIGTERM] if sent else [])
