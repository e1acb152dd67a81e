"""A run, its watchers, its operator, offs that fail, in any order: what is promised all the same.

`rig.run.execute.execute` runs a procedure that does what a state machine tells it, on a bench
of roles that are put together here. Bench time stands still until the machine lets a slice of it
pass; meanwhile the machine does what happens to a run: it presses on the force sensor, takes its
frames away, asks for a stop, pauses, lets drive, disk or procedure fail. Run, arming, holds, force
monitor with its thread, recorder and compilation are the program's own. The guard and the handlers
of signals are not: they have tests of their own.

The order of what happened is written down and judged at the end, not foretold step by step.
"""

from __future__ import annotations

import contextlib
import itertools
import signal
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from rig.bench.plan import BenchPlan, InstrumentPlan
from rig.bench.settings import BenchSettings
from rig.core.clock import WAIT_SLICE_S, Clock
from rig.core.errors import ExitCode, InstrumentError, InstrumentTimeoutError, LimitError
from rig.core.settings import Settings
from rig.files.errors import RecordingError
from rig.files.journal.layout import Column, Layout, Plot
from rig.files.runfile.reader import RunFile
from rig.instruments.roles import ForceFrames, Identity
from rig.run import execute as execution
from rig.run import observers
from rig.run.context import Run
from rig.run.execute import execute
from rig.run.holds import PAUSE
from rig.run.job import RunJob
from rig.run.making_safe.guard_link import TakenOver
from rig.run.observers import RunObserver
from rig.run.outcome import RunOutcome
from rig.run.points import Point, Reading
from rig.run.procedure import Procedure
from rig.run.stopping import STOP_SIGNALS, StopFlag

PATIENCE_S = 60.0
STUCK_S = 0.02
"""Deadline of an off that hangs."""
LIMIT_N = 10.0
FORCE_STREAM = "force stream"
SLICES_OF_A_LOOK = 6
"""A run on hold looks every 0.1 s whether it may go on."""
POINTS = ("first", "second", "third", "fourth")
LAYOUT = Layout(
    definition="NXrig_noop",
    version="1",
    columns=(Column("x", "V", key="x", long_name="x"), Column("y", "V", key="y", long_name="y")),
    plots=(Plot("data", "y", ("x",)),),
)
REFUSED = InstrumentError("stage_z", "move", "the axis was made safe meanwhile")
UNHEARD = InstrumentTimeoutError("daq", "WAV:DATA?", "no answer within 3 s")
FAILURES: Mapping[str, tuple[Exception, ExitCode]] = {
    "instrument": (InstrumentError("daq", "DIG", "not complete"), ExitCode.INSTRUMENT),
    "time-out": (UNHEARD, ExitCode.INSTRUMENT),
    "limit": (LimitError("amplitude 12 V is outside 0 to 10 V"), ExitCode.LIMIT),
    "bug": (ZeroDivisionError("by nothing"), ExitCode.INTERNAL),
}
OFFS = ("works", "works", "works", "fails", "fails once", "bug", "hangs")
MEANWHILE = ("nothing", "stop", "blip", "overload", "lost drive")
GONE = InstrumentError("stage_z", "read register 100", "connection failed")
ENDINGS = ("stop", "lost drive", "full disk", "silence", *FAILURES)
THINGS = st.dictionaries(
    st.sampled_from("abc"),
    st.tuples(st.sampled_from(OFFS), st.sampled_from(MEANWHILE)),
    min_size=1,
    max_size=2,
)
Story = list[tuple[str, Any]]
Thing = dict[str, Any]


class BenchTime(Clock):
    """Bench time that passes in the run's own thread only when `let_pass` is called."""

    is_virtual = True

    def __init__(self) -> None:
        super().__init__()
        self.run_thread: threading.Thread | None = None
        self.each_pass: Callable[[], None] = lambda: None
        self.over = False
        self._now_s = 0.0
        self._turn, self._arrived = threading.Semaphore(0), threading.Semaphore(0)

    def now(self) -> float:
        return self._now_s

    def jump(self, seconds: float) -> None:
        """Time goes by without anybody looking."""
        self._now_s += seconds

    def let_pass(self) -> None:
        """Let the run go on to its next wait, or to its end."""
        self._turn.release()
        self.await_run()

    def await_run(self) -> None:
        assert self._arrived.acquire(timeout=PATIENCE_S), "the run is stuck"

    def end(self) -> None:
        """From the run's thread: it waits no more."""
        self.over = True
        self._arrived.release()

    def _pass(self, seconds: float) -> None:
        self._now_s += seconds
        self.each_pass()
        if threading.current_thread() is self.run_thread:
            self._arrived.release()
            assert self._turn.acquire(timeout=PATIENCE_S)


class Instrument:
    """What every instrument has."""

    identity = Identity("nobody", "made up", "SIM1", "0")

    def limits(self) -> Mapping[str, Any]:
        return {}

    def close(self) -> None:
        pass


class Sensor(Instrument):
    """A force sensor whose frames come by hand."""

    bytes_consumed = 0
    frames_behind = 0.0

    def __init__(self, story: Story) -> None:
        self.silent = False
        self._story = story
        self._streaming = False
        self._coming: list[ForceFrames] = []
        self._under_way = 0
        self._noise_N = itertools.cycle((0.0, 1e-3))
        """A force that stands still to the last bit is that of a sensor that does not measure."""
        self._news = threading.Condition()

    def start(self, rate_S_s: float) -> float:
        self._streaming = True
        return rate_S_s

    def read(self) -> ForceFrames | None:
        with self._news:
            if not self._coming:
                self._under_way = 0  # whoever reads again has handled what he had
                self._news.notify_all()
                self._news.wait(0.005)
            if not self._coming:
                return None
            self._under_way = 1
            return self._coming.pop(0)

    def stop(self) -> None:
        self._streaming = False
        self._story.append(("off", FORCE_STREAM))

    def feel(self, force_N: float) -> None:
        """A frame; returns when the watchers have seen it."""
        if self.silent or not self._streaming:
            return
        force = np.array([[0.0, 0.0, force_N + next(self._noise_N)]])
        frames = ForceFrames(0, force.astype(np.float32), force, np.array([False]))
        with self._news:
            self._coming.append(frames)
            self._news.notify_all()
            handled = lambda: not (self._coming or self._under_way)  # noqa: E731
            assert self._news.wait_for(handled, PATIENCE_S), "nobody reads the force sensor"


class Stage(Instrument):
    """A drive of which only the keep-alives matter."""

    dead: InstrumentError | None = None

    def keep_alive(self) -> None:
        if self.dead is not None:
            raise self.dead


class Guard:
    """What the run tells its guard."""

    def __init__(self, story: Story) -> None:
        self._story = story

    pid = 0

    def beat(self) -> None:
        pass

    def zero(self, raw: object) -> None:
        pass

    def trouble(self) -> None:
        pass

    def hangs(self, what: str) -> None:
        pass

    def safe(self) -> None:
        self._story.append(("guard", "safe"))

    def limit(self, limit_N: float) -> None:
        pass

    def done(self) -> None:
        self._story.append(("guard", "done"))

    def take_over(self, over_limit: Sequence[str], cause: str = "") -> TakenOver:
        self._story.append(("guard", "take over"))
        return TakenOver(True, "the guard then made the bench safe")


class Puppet(Procedure):
    """A procedure that waits for orders, and obeys one after each slice of bench time."""

    name, fixtures = "puppet", ("film-clamp",)
    Settings, layout = Settings, LAYOUT

    def __init__(self, story: Story) -> None:
        super().__init__(Settings())
        self.phase = "elsewhere"
        self.order: Callable[[Run], object] | None = None
        self.arm_kit: Callable[[Run], object] = lambda run: None
        self.run: Run | None = None
        self._story = story

    def points(self) -> tuple[Point, ...]:
        return tuple(Point(name, name, ()) for name in POINTS)

    def arm(self, run: Run) -> None:
        if self.run is None:
            self.run = run
            self._write_down_passes(run)
        run.stream_force(100.0)
        self._story.append(("arm", FORCE_STREAM))
        run.force.watch(LIMIT_N)
        self.arm_kit(run)
        self._obey(run, "arming")

    def take(self, run: Run, point: Point) -> Reading:
        self._story.append(("begin", point.id))
        self._obey(run, "taking")
        return {"x": 1.0, "y": 2.0}

    def _obey(self, run: Run, phase: str) -> None:
        """Whatever it is given, slice by slice; arming is over after one."""
        self.phase = phase
        try:
            done = None
            while done is None:
                run.clock.sleep(WAIT_SLICE_S)
                order, self.order = self.order, None
                done = order(run) if order is not None else None
                if phase == "arming":
                    return
        finally:
            self.phase = "elsewhere"

    def _write_down_passes(self, run: Run) -> None:
        make_safe = run.arming.make_safe

        def written_down(beat: Callable[[], None], watch_on: bool = False) -> Any:
            self._story.append(("pass", watch_on))
            failures = make_safe(beat, watch_on)
            self._story.append(("passed", [failure.name for failure in failures]))
            return failures

        run.arming.make_safe = written_down  # type: ignore[method-assign]


class Observer(RunObserver):
    """Writes down which points are recorded."""

    def __init__(self, story: Story) -> None:
        self._story = story

    def point_recorded(self, number: int, total: int, point: Point, reading: Reading) -> None:
        self._story.append(("kept", point.id))


class Ending(RuleBasedStateMachine):
    """One run, from its first arming to its file."""

    def __init__(self) -> None:
        super().__init__()
        self.story: Story = []
        self.clock, self.stop = BenchTime(), StopFlag()
        self.sensor, self.stage = Sensor(self.story), Stage()
        self.puppet = Puppet(self.story)
        self.clock.each_pass = lambda: self.sensor.feel(1.0)
        self.release = threading.Event()
        self.ending = ""
        self.cause: tuple[ExitCode, str] | None = None
        """How it has to end if all offs work: code, and words of the first cause."""
        self.outcome: RunOutcome | None = None
        self.folder = tempfile.TemporaryDirectory(prefix="every-ending-")
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(execution, "GuardLink", lambda *_: Guard(self.story))
        self.patch.setattr(execution, "PauseSwitch", lambda _: contextlib.nullcontext())
        # The order of what is written down must not depend on how busy the computer is.
        self.patch.setattr(observers, "OBSERVED_S", PATIENCE_S)
        self.thread = threading.Thread(target=self._execute, name="run")
        self.clock.run_thread = self.thread

    @initialize(things=THINGS, ending=st.sampled_from(ENDINGS))
    def begin(self, things: dict[str, tuple[str, str]], ending: str) -> None:
        """The procedure arms these things each time; where nothing else ends the run, this does."""
        self.ending = ending
        kit = self.made(things)
        self.puppet.arm_kit = lambda run: [self.register(run, thing) for thing in kit]
        self.thread.start()
        self.clock.await_run()
        assert self.puppet.phase == "arming"

    def _execute(self) -> None:
        def plan_of(role: str, instrument: Instrument) -> InstrumentPlan:
            driver: Any = SimpleNamespace(connect=lambda settings, clock: instrument)
            return InstrumentPlan(role, "made-up", driver, Settings())

        parts = plan_of("stage_z", self.stage), plan_of("force_sensor", self.sensor)
        own = BenchSettings.model_validate({"name": "b", "fixture": {"mounted": "film-clamp"}})
        plan = BenchPlan(own, parts, "", "bench.toml")
        job = RunJob(self.puppet, 0, Path(self.folder.name))
        try:
            self.outcome = execute(job, plan, self.clock, self.stop, Observer(self.story))
        finally:
            self.clock.end()

    # --- what the procedure does --------------------------------------------------------------

    def working(self) -> bool:
        return self.puppet.phase in ("arming", "taking")

    def obey(self, order: Callable[[Run], object]) -> None:
        """The procedure does it after the next slice."""
        self.puppet.order = order
        self.clock.let_pass()

    @precondition(working)
    @rule(things=THINGS)
    def arm(self, things: dict[str, tuple[str, str]]) -> None:
        """Things are switched on, their offs registered; an off of the same name is replaced."""
        for thing in self.made(things):
            self.obey(partial(self.register, thing=thing))

    def made(self, things: dict[str, tuple[str, str]]) -> list[Thing]:
        """What `Run.arm` is given."""
        return [
            {
                "name": name,
                "off": self.off(name, off, meanwhile),
                "deadline_s": STUCK_S if off == "hangs" else PATIENCE_S,
                "emergency": self.at_once(name, off),
            }
            for name, (off, meanwhile) in things.items()
        ]

    def register(self, run: Run, thing: Thing) -> None:
        run.arm(**thing)
        self.story.append(("arm", thing["name"]))

    def off(self, name: str, off: str, meanwhile: str) -> Callable[[], None]:
        """Takes a few slices of bench time, during which something may happen."""
        tries = itertools.count(1)

        def switch_off() -> None:
            self.story.append(("off", name))
            if meanwhile == "stop":
                self.stop._remember(signal.SIGTERM, None)
            elif meanwhile == "blip":
                self.run.holds.begin("blip")
                self.run.holds.end("blip")
            elif meanwhile == "overload":
                self.sensor.feel(2 * LIMIT_N)
            elif meanwhile == "lost drive":
                self.stage.dead = GONE
            if off == "works" or (off == "fails once" and next(tries) > 1):
                self.clock.sleep(3 * WAIT_SLICE_S)
                return
            self.story.append(("stays on", name))
            if off == "bug":
                raise ZeroDivisionError
            if off == "hangs":
                self.release.wait(PATIENCE_S)
            raise InstrumentError(name, "off", "no answer", "pull the plug")

        return switch_off

    def at_once(self, name: str, off: str) -> Callable[[], None]:
        """What the force's watcher does."""

        def stop() -> None:
            self.story.append(("at once", name))
            if off == "bug":
                raise ZeroDivisionError

        return stop

    @precondition(working)
    @rule()
    def finish(self) -> None:
        """Armed, or the point's reading is there."""
        last = self.puppet.phase == "taking" and self.story_of("kept") == list(POINTS[:-1])
        if last:
            self.cause = ExitCode.DONE, ""
        self.obey(lambda run: True)
        assert last or self.puppet.phase == "taking"

    # --- what happens to it ----------------------------------------------------------------------

    @property
    def run(self) -> Run:
        assert self.puppet.run is not None
        return self.puppet.run

    def disturb(self) -> None:
        self.story.append(("disturbed", None))

    def end(self) -> None:
        """What ends a run: the operator, a drive, the disk, the procedure itself."""
        how = self.ending
        if how in FAILURES and self.working():
            error, code = FAILURES[how]
            self.cause = code, str(error)

            def raise_it(run: Run) -> None:
                raise error

            self.puppet.order = raise_it
        elif how == "silence" and self.on_hold() and self.sensor.silent:
            self.clock.jump(6.0)
            self.cause = ExitCode.INSTRUMENT, "no frame for"
        elif how == "full disk":
            self.fill_disk()
        elif how == "lost drive":
            self.stage.dead = GONE
            self.cause = GONE.code, GONE.message
        else:
            for number in (signal.SIGINT, signal.SIGTERM):  # the first one counts
                self.stop._remember(number, None)
            self.cause = ExitCode.SIGINT, "stopped by Ctrl-C"
        self.disturb()
        for _ in range(SLICES_OF_A_LOOK if how == "silence" else 1):
            if not self.clock.over:
                self.clock.let_pass()
        assert self.clock.over, "it is seen within a slice, or at the next look of a hold"

    def fill_disk(self) -> None:
        """What was put before is written; nothing is any more."""
        recorder = self.run._recorder
        recorder.barrier()
        full = RecordingError(recorder.journal.path, "no space left on device")

        def refuse(records: object) -> None:
            raise full

        recorder.journal.append = refuse  # type: ignore[method-assign]
        self.run.event("info", "last", "words")
        with pytest.raises(RecordingError):
            recorder.barrier()
        self.cause = full.code, "no space left"

    @precondition(working)
    @rule(refused=st.booleans())
    def press(self, refused: bool) -> None:
        """Force over the limit: the things are stopped at once, in the reader's thread. The
        procedure perhaps first meets a drive that refuses to move because of that."""
        armed = [name for name in self.armed() if name != FORCE_STREAM]
        retaken = self.puppet.phase == "taking" and not self.tripped()
        before = len(self.story)
        self.disturb()
        if refused:

            def move(run: Run) -> None:
                self.sensor.feel(2 * LIMIT_N)
                raise REFUSED

            self.puppet.order = move
        else:
            self.sensor.feel(2 * LIMIT_N)
        self.story.append(("tripped", self.begun()))
        self.clock.let_pass()
        at_once = [name for what, name in self.story[before:] if what == "at once"]
        assert at_once[: len(armed)] == armed[::-1]
        self.goes_on(ExitCode.LIMIT, "is over the limit of 10 N", retaken)

    @precondition(working)
    @rule(how=st.sampled_from(("stays", "came and went", "explains a time-out")))
    def pause(self, how: str) -> None:
        """The operator's, or one that nobody has seen come and go."""
        self.disturb()
        self.run.holds.begin(PAUSE)
        if how != "stays":
            self.run.holds.end(PAUSE)
        if how == "explains a time-out":

            def ask(run: Run) -> None:
                run.holds.begin("blip")
                run.holds.end("blip")
                raise UNHEARD

            self.run.holds.acknowledge()
            self.puppet.order = ask
        self.clock.let_pass()
        self.goes_on(ExitCode.INSTRUMENT, "no answer", on_hold=how == "stays")

    @precondition(working)
    @rule()
    def silence(self) -> None:
        """No frames any more."""
        self.disturb()
        self.sensor.silent = True
        self.clock.jump(0.3)
        self.clock.let_pass()
        self.goes_on(ExitCode.INSTRUMENT, "no answer", on_hold=True)

    def on_hold(self) -> bool:
        return not self.clock.over and not self.working()

    @precondition(on_hold)
    @rule()
    def go_on(self) -> None:
        """The operator's word, and frames again."""
        self.sensor.silent = False
        self.run.holds.end(PAUSE)
        for _ in range(SLICES_OF_A_LOOK):
            if not self.working():
                self.clock.let_pass()
        assert self.puppet.phase == "arming"

    @precondition(lambda self: self.clock.over)
    @rule()
    def nothing_more(self) -> None:
        """The story is over."""

    # --- what has to follow -------------------------------------------------------------------

    def goes_on(
        self, code: ExitCode, words: str, retaken: bool = True, on_hold: bool = False
    ) -> None:
        """After a disturbance: armed anew, or waiting; or the end, with this code, where it was
        one too many or an off did not work; or with a stop's that came meanwhile."""
        failed = [names for what, names in self.story if what == "passed" and names]
        if not retaken or failed:
            self.cause = code, "" if failed and code is ExitCode.INSTRUMENT else words
        elif self.stage.dead is not None:
            self.cause = GONE.code, GONE.message
        elif self.stop.requested is not None:
            self.cause = STOP_SIGNALS[self.stop.requested], "stopped by"
        else:
            assert not self.clock.over
            assert self.on_hold() if on_hold else self.puppet.phase == "arming"
            return
        assert self.clock.over

    def story_of(self, what: str) -> list[Any]:
        return [who for how, who in self.story if how == what]

    def begun(self) -> str | None:
        begun = self.story_of("begin")
        return begun[-1] if begun else None

    def tripped(self) -> bool:
        """Whether the point under way has been disturbed by a trip before."""
        return self.begun() in self.story_of("tripped")

    def armed(self) -> list[str]:
        """What is on, by the story, in the order of arming."""
        armed: list[str] = []
        for what, who in self.story:
            if what == "arm":
                armed = [name for name in armed if name != who] + [who]
            elif what == "pass":
                watched = who
            elif what == "passed":
                still = [FORCE_STREAM] if watched else []
                armed = [name for name in armed if name in still + who]
        return armed

    def teardown(self) -> None:
        if self.thread.ident is None:
            self._forget()
            return
        try:
            if not self.clock.over:
                self.end()
            self.thread.join(PATIENCE_S)
            assert self.outcome is not None, "execute() raised"
            self.judge_offs()
            self.judge_points(self.outcome)
            self.judge_end(self.outcome)
        finally:
            self.release.set()
            if not self.clock.over:
                self.stop._remember(signal.SIGINT, None)
                for _ in range(100):
                    if not self.clock.over:
                        self.clock.let_pass()
            self.thread.join(PATIENCE_S)
            self._forget()

    def _forget(self) -> None:
        self.patch.undo()
        self.folder.cleanup()

    def judge_offs(self) -> None:
        """In every pass each thing that is on is switched off once, the last one first, and nothing
        keeps an off from its work; only the force is read on during a hold. Those that failed are
        tried again in the next."""
        armed: list[str] = []
        begun: list[str] | None = None
        stay_on: list[str] = []
        watch_on = False
        for what, who in self.story:
            if what == "arm":
                armed = [name for name in armed if name != who] + [who]
            elif what == "pass":
                begun, stay_on, watch_on = [], [], who
            elif what == "stays on":
                stay_on.append(who)
            elif what == "off" and begun is not None:
                begun.append(who)
            elif what == "passed":
                spared = [FORCE_STREAM] if watch_on else []
                assert begun == [name for name in reversed(armed) if name not in spared]
                assert who == stay_on
                armed = [name for name in armed if name in who or name in spared]
                begun = None

    def judge_points(self, outcome: RunOutcome) -> None:
        """A point is kept once, and only from an attempt that nothing has disturbed."""
        kept: list[str] = []
        disturbed = True
        for what, who in self.story:
            if what == "begin":
                disturbed = False
            elif what == "disturbed":
                disturbed = True
            elif what == "kept":
                assert not disturbed
                kept.append(who)
                disturbed = True
        assert kept == list(POINTS[: len(kept)])
        assert outcome.points_done == len(kept)
        assert outcome.file is not None
        with RunFile.open(outcome.file) as run:
            assert list(run.point_ids()) == kept
            assert run.outcome.status == outcome.status
            attempts = [word.decode() for word in run.entry["attempts/status"][()]]
        assert attempts.count("kept") == len(kept)
        assert len(attempts) == len(self.story_of("begin"))

    def judge_end(self, outcome: RunOutcome) -> None:
        """Safe first: nothing is on any more, or it is reported and the guard takes over."""
        assert self.cause is not None
        code, words = self.cause
        left_on = self.story_of("passed")[-1]
        assert {failure.name for failure in outcome.off_failures} == set(left_on)
        assert set(self.armed()) == set(left_on)
        if words:
            assert words in outcome.failures[0].one_line()
        if left_on:
            assert outcome.code is ExitCode.UNSAFE
            assert outcome.status == "failed"
            assert self.story_of("guard") == ["take over"]
            return
        assert outcome.code is code
        expected = {ExitCode.DONE: "complete", **dict.fromkeys(STOP_SIGNALS.values(), "stopped")}
        assert outcome.status == expected.get(code, "failed")
        assert self.story_of("guard") == ["safe", "done"]
        last_off = max(k for k, (what, _) in enumerate(self.story) if what == "passed")
        assert self.story.index(("guard", "safe")) > last_off


class TestEveryEnding(Ending.TestCase):
    """A few random stories."""

    settings = settings(max_examples=5, stateful_step_count=12, deadline=None)


@pytest.mark.thorough
class TestManyMoreEndings(Ending.TestCase):
    """Many random stories."""

    settings = settings(max_examples=40, stateful_step_count=12, deadline=None)


def test_a_hold_between_two_trips_buys_no_further_retake() -> None:
    run = Ending()
    run.begin(things={"a": ("works", "nothing")}, ending="stop")
    run.finish()
    run.press(refused=False)
    run.finish()
    run.pause(how="came and went")
    run.finish()
    run.press(refused=True)
    assert run.cause == (ExitCode.LIMIT, "is over the limit of 10 N")
    run.teardown()
