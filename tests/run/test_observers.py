"""Whatever an observer of a run raises: the bench is made safe, the data are saved, and the person
is warned once."""

from __future__ import annotations

import inspect
import threading
from pathlib import Path
from typing import Any

import pytest
from made_up import Example, run_of

from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.files.errors import RecordingError
from rig.files.journal.recorder import Recorder
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.reader import RunFile
from rig.run import execute, saving
from rig.run import observers as observing
from rig.run.context import Run
from rig.run.observers import Observers, RunObserver
from rig.run.points import Point, Reading

METHODS = [
    name
    for name, member in vars(RunObserver).items()
    if inspect.isfunction(member) and not name.startswith("_")
]
LIFE = ["on", "first", "second", "off", "guard: safe", "guard: done"]


class Noting(RunObserver):
    """Notes what is reported."""

    def __init__(self) -> None:
        self.said: list[tuple[str, Any]] = []

    def __getattribute__(self, name: str) -> Any:
        if name in METHODS:
            return lambda *values: self.said.append((name, values))
        return super().__getattribute__(name)


class Raising(Noting):
    """Raises something in one of its methods."""

    def __init__(self, method: str, error: BaseException):
        super().__init__()
        self._method, self._error = method, error

    def __getattribute__(self, name: str) -> Any:
        if name in METHODS and name == super().__getattribute__("_method"):
            return self._raise
        return super().__getattribute__(name)

    def _raise(self, *_: object) -> None:
        raise self._error


def test_an_observer_sees_a_run_from_its_plan_to_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Noting()
    outcome = run_of(Example(Settings()), tmp_path, monkeypatch, seen)
    assert outcome.code is ExitCode.DONE, outcome.failures
    assert [name for name, _ in seen.said] == [
        "planned",
        "state",
        "point_recorded",
        "point_recorded",
        "state",
        "saving",
        "saved",
    ]
    assert [values for name, values in seen.said if name == "state"] == [
        ("running",),
        ("making safe",),
    ]
    assert outcome.made_safe == ("lamp off",)
    assert outcome.safe


@pytest.mark.parametrize(
    "error", [KeyError("my_figure"), SystemExit(3), RuntimeError("line 1\nline 2")], ids=repr
)
@pytest.mark.parametrize(
    "method", [name for name in METHODS if name not in ("event", "hold_begun", "pressed")]
)
def test_an_observer_that_raises_disturbs_neither_safety_nor_data_nor_other_observers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, error: BaseException
) -> None:
    procedure, seen = Example(Settings()), Noting()
    raising = Raising(method, error)
    outcome = run_of(procedure, tmp_path, monkeypatch, raising, seen)

    assert outcome.code is ExitCode.DONE, outcome.failures
    assert procedure.log == LIFE
    assert outcome.points_done == 2
    assert outcome.summary == {"points": 2}
    (warning,) = outcome.warnings
    assert warning.startswith(f"Raising failed: {type(error).__name__}: ")
    assert "\n" not in warning
    assert ("event", ("warning", warning)) in seen.said
    assert len([name for name, _ in seen.said if name == "event"]) == 1, "once"
    assert [name for name, _ in seen.said if name == "saved"] == ["saved"]
    assert outcome.file is not None
    with RunFile.open(outcome.file) as run:
        assert run.point_ids() == ["first", "second"]


def test_an_observer_whose_event_raises_as_well_is_harmless(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = Example(Settings())
    outcome = run_of(
        procedure,
        tmp_path,
        monkeypatch,
        Raising("planned", KeyError("first")),
        Raising("event", KeyError("second")),
    )
    assert outcome.code is ExitCode.DONE, outcome.failures
    assert procedure.log == LIFE
    assert len(outcome.warnings) == 2


def test_the_bench_is_safe_before_an_observer_that_hangs_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = Example(Settings())
    log_when_it_went_on: list[str] = []

    class Hanging(RunObserver):
        """Waits, when the bench is being made safe, until it is."""

        def state(self, name: str) -> None:
            if name == "making safe":
                import time

                give_up = time.monotonic() + 10
                while "off" not in procedure.log and time.monotonic() < give_up:
                    time.sleep(0.01)
                log_when_it_went_on.extend(procedure.log)

    outcome = run_of(procedure, tmp_path, monkeypatch, Hanging())
    assert outcome.code is ExitCode.DONE, outcome.failures
    assert "off" in log_when_it_went_on


def test_what_is_said_at_once_waits_for_no_observer() -> None:
    """One hangs: who warns goes on all the same, and the warning is shown when that is over."""
    let_on, shown, seen = threading.Event(), threading.Event(), list[str]()

    class Hanging(RunObserver):
        """Takes note when it is let."""

        def event(self, level: str, message: str) -> None:
            assert let_on.wait(10)
            seen.append(f"{level}: {message}")
            shown.set()

    observers = Observers([Hanging()], seen.append)
    observers.warn_at_once("not safe yet")
    assert seen == []
    let_on.set()
    observers.end()
    assert shown.wait(10)
    assert seen == ["warning: not safe yet"]


def test_an_observer_that_blocks_holds_up_no_armed_run_and_hears_everything_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It blocks at the first point, as a terminal does after Ctrl-S, until the bench is safe."""
    monkeypatch.setattr(observing, "OBSERVED_S", 0.0)
    bench_is_safe, seen = threading.Event(), list[str]()

    class Blocking(RunObserver):
        """Takes note of the first point only once the bench is safe."""

        def point_recorded(self, number: int, total: int, point: Point, reading: Reading) -> None:
            seen.append(point.id if bench_is_safe.wait(10) else "the run waited for this")

        def state(self, name: str) -> None:
            seen.append(name)

        def saved(self, run_file: Path) -> None:
            seen.append("saved")

    class Switching(Example):
        """Says when its lamp is off."""

        def arm(self, run: Run) -> None:
            run.arm("lamp", lambda: (self.log.append("off"), bench_is_safe.set())[0])
            self.log.append("on")

    procedure = Switching(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch, Blocking())
    assert outcome.code is ExitCode.DONE, outcome.failures
    assert procedure.log == LIFE
    assert seen == ["running", "first", "second", "making safe", "saved"]


def test_several_calls_wait_once_for_an_observer_that_blocks() -> None:
    let_on, seen = threading.Event(), list[str]()

    class Blocking(RunObserver):
        """Takes note when it is let."""

        def event(self, level: str, message: str) -> None:
            assert let_on.wait(10)
            seen.append(message)

    waits: list[float] = []
    observers = Observers([Blocking()], seen.append)
    wait_for = observers._changed.wait_for

    def noted(predicate: Any, longest_s: float) -> bool:
        waits.append(longest_s)
        return wait_for(predicate, longest_s)

    observers._changed.wait_for = noted  # type: ignore[method-assign,assignment]
    for message in "abc":
        observers.event("info", message)
    assert waits == [observing.OBSERVED_S]
    assert seen == []
    let_on.set()
    observers.end()
    assert waits == [observing.OBSERVED_S, observing.ANNOUNCED_S]
    assert seen == ["a", "b", "c"]


def test_where_saving_waits_for_the_disk_it_is_shown_that_the_bench_is_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execute, "SLOW_SAVING_S", 0.0)
    noting, shown = Noting(), threading.Event()

    class Waiting(RunObserver):
        """Sees the line that is meant."""

        def event(self, level: str, message: str) -> None:
            if message == execute.SLOW_SAVING[True]:
                shown.set()

    def compiled_on_a_stalled_disk(*given: Any, **named: Any) -> Path:
        assert shown.wait(10), "nothing is shown while the disk does not answer"
        return compile_run(*given, **named)

    compile_run = saving.compile_run
    monkeypatch.setattr(saving, "compile_run", compiled_on_a_stalled_disk)
    outcome = run_of(Example(Settings()), tmp_path, monkeypatch, noting, Waiting())
    assert outcome.code is ExitCode.DONE, outcome.failures
    assert ("event", ("info", execute.SLOW_SAVING[True])) in noting.said


@pytest.mark.parametrize("answers", [True, False])
def test_a_disk_that_answers_late_costs_no_reading_and_one_that_fails_those_not_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answers: bool
) -> None:
    given_up = threading.Event()
    append, barrier = JournalWriter.append, Recorder.barrier

    def append_late(journal: JournalWriter, records: list[bytes]) -> None:
        if threading.current_thread().name == "recorder":
            assert given_up.wait(30)
            if not answers:
                raise RecordingError(journal.path, "Input/output error")
        append(journal, records)

    def wait_shortly(recorder: Recorder) -> None:
        try:
            barrier(recorder, 0.2)
        finally:
            given_up.set()

    monkeypatch.setattr(JournalWriter, "append", append_late)
    monkeypatch.setattr(Recorder, "barrier", wait_shortly)
    outcome = run_of(Example(Settings()), tmp_path, monkeypatch)
    late = "the disk has not acknowledged anything for 0.2 s; it answered later, and nothing was"
    if answers:
        assert (outcome.status, outcome.code) == ("complete", ExitCode.DONE), outcome.failures
        assert (outcome.points_done, outcome.summary) == (2, {"points": 2})
        assert [late in warning for warning in outcome.warnings] == [True]
        assert outcome.file is not None
        with RunFile.open(outcome.file) as file:
            assert len(file.readings()) == 2
    else:
        assert (outcome.status, outcome.code) == ("failed", ExitCode.INTERNAL)
        assert "Input/output error" in outcome.failures[0].message
        assert (outcome.points_done, outcome.summary) == (0, {})


def test_what_is_shown_unless_the_run_is_over_is_not_shown_after_its_end() -> None:
    noting = Noting()
    observers = Observers([noting], lambda _: None)
    observers.unless_over(60.0, "still saving")
    observers.event("info", "a line meanwhile")
    observers.end()
    assert noting.said == [("event", ("info", "a line meanwhile"))]


def test_a_guard_that_reads_heartbeats_again_is_reported_as_it_was_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = iter([None, "is silent", "is silent"])
    monkeypatch.setattr("made_up.Guard.trouble", lambda _: next(looks, None))
    monkeypatch.setattr("rig.run.wait_checks.BEAT_EVERY_S", 0.0)
    seen = Noting()
    outcome = run_of(Example(Settings()), tmp_path, monkeypatch, seen)
    missed = "the guard is silent: if this run dies as well, nothing makes the bench safe"
    assert [values for name, values in seen.said if name == "event"] == [
        ("warning", missed),
        ("info", "the guard reads heartbeats again and watches this run"),
    ]
    assert outcome.warnings == [missed]


def test_a_disk_that_takes_nothing_is_reported_and_that_it_does_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = iter([0.2, 12.0, 12.1])
    monkeypatch.setattr(Recorder, "unacknowledged_s", property(lambda _: next(waiting, 0.1)))
    monkeypatch.setattr("rig.run.wait_checks.BEAT_EVERY_S", 0.0)
    seen = Noting()
    outcome = run_of(Example(Settings()), tmp_path, monkeypatch, seen)
    missed = (
        "what was recorded 12 s ago is not on the disk yet: it is in memory only, and is lost if "
        "this run dies"
    )
    assert [values for name, values in seen.said if name == "event"] == [
        ("warning", missed),
        ("info", "what was recorded is on the disk again; nothing was lost"),
    ]
    assert outcome.warnings == [missed]
