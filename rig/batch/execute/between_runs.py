"""What a batch waits for between its runs, while its bench is safe, and what may end it there."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from rig.batch.execute.batch_clock import window_of
from rig.batch.execute.disk_room import LEAST_B, has_room
from rig.batch.execute.drift_watch import PUT_BACK
from rig.batch.plan.settings import BatchFile
from rig.batch.plan.window import does_not_fit, how_to_continue
from rig.batch.queue import Queue, give_up
from rig.batch.queue_file import QueueWriteError
from rig.batch.queue_records import TIME_OVER
from rig.core.errors import ExitCode, RigError
from rig.run.interlocks.store import InterlockStore
from rig.run.interlocks.watch import InterlockError, InterlockWatch, watched
from rig.run.stopping import StopFlag, TimeLimit

if TYPE_CHECKING:
    from rig.batch.execute.batch_clock import BatchClock
    from rig.batch.execute.run_benches import RunBenches
    from rig.batch.execute.worker_link import CommandListener, SendEvent
    from rig.batch.folder import BatchFolder
    from rig.core.clock import Clock

LOOK_EVERY_S = 1.0
"""Interval in s at which a batch whose hold can end by itself looks whether it is over."""
CHECK_EVERY_S = 0.05
"""Interval in s at which a worker that waits for a person checks for commands."""
SUPERVISOR_S = 10.0
"""Time in s without a word of the supervisor, which sends one every second, after which no further
run begins: no one would notice what becomes of it."""

BENCH_SAFE = "the bench is safe"
"""How the bench is while a batch is held, for people."""
BENCH_IN_USE = "the bench is left to the other program"
"""The same, of a bench that another program has."""

UNSUPERVISED = (
    f"the supervisor of the batch was not heard for {SUPERVISOR_S:g} s, it was stopped or hung: no "
    "run was begun until it was heard again"
)


@dataclass(frozen=True)
class SelfEnding:
    """A condition that ends a hold without a person."""

    is_over: Callable[[], bool]
    words: str
    """What is so then, for people: "there is room on the disk"."""


def room_on_disk(is_there: Callable[[], bool]) -> SelfEnding:
    """Return the end of a hold because of a full disk."""
    return SelfEnding(is_there, "there is room on the disk")


class EndOfBatchError(RigError):
    """Raised where the batch ends, safely, before its last run."""


def stopped_by_request(when: str) -> EndOfBatchError:
    """Return the end of a batch that `rig batch stop` has asked for; `when` says at what point."""
    return EndOfBatchError(f"stopped by rig batch stop, {when}", None, ExitCode.SIGTERM)


class BetweenRuns:
    """The waits of a batch: for a person, its window, the supervisor, room on the disk.

    Every wait acts on requests to stop and watches the interlock contacts of the bench of
    `benches`, which no run does then.
    """

    def __init__(
        self,
        folder: BatchFolder,
        queue: Queue,
        on_hold: Literal["wait", "stop"],
        clock: BatchClock,
        benches: RunBenches,
        stop: StopFlag,
        commands: CommandListener,
        send: SendEvent,
    ):
        self._folder, self._queue, self._on_hold = folder, queue, on_hold
        self._clock, self._benches = clock, benches
        self._stop, self._commands, self._send = stop, commands, send
        self._from, self._until = window_of(queue)
        batch = BatchFile.model_validate_json(queue.meta("file")).batch
        self._to_continue = how_to_continue(batch)
        """What to do once `stop_by` has ended the batch."""
        self._interlocks: InterlockWatch | None = None
        """The watch over the interlock contacts while a wait lasts."""

    def check(self) -> None:
        """Act on requests to stop or pause, and on interlocks; the bench is safe. Wait while the
        supervisor is stopped or hangs."""
        self._stop.check()
        self._check_interlocks()
        if not self._is_supervised():
            self._send("note", level="warning", text=UNSUPERVISED)
            with self._interlocks_watched():
                while not self._is_supervised():
                    self._stop.check()
                    self._check_interlocks()
                    time.sleep(CHECK_EVERY_S)
        if self._commands.stop_after_run:
            raise stopped_by_request("between runs")
        if self._commands.paused.is_set():
            text = self._commands.paused_because or "between runs"
            self._send("state", state="paused", text=text)
            self._wait("paused")

    def rest(self, seconds: float) -> None:
        """Rest before a run, in the time of the batch."""
        with self._interlocks_watched():
            self._clock.rest(seconds, self.check)

    def wait_for_the_window(self) -> None:
        """Wait until the batch may begin its first run, if it has a window."""
        if self._from is None or self._from <= self._clock.now():
            return
        self._send(
            "state",
            state="waiting",
            text=f"not before {self._from.astimezone():%Y-%m-%d %H:%M:%S}",
        )
        self._clock.wait_until(self._from, self.check)
        self._send("state", state="running")

    def hold(
        self,
        why: str,
        over: SelfEnding | None = None,
        bench: str = BENCH_SAFE,
        *,
        by_resume: bool = True,
    ) -> None:
        """Wait for a person, or end the batch by an EndOfBatchError, as `on_hold` says. With `over`
        the batch also continues by itself as soon as that is so, unless a person has paused it.
        `bench` says how the bench is meanwhile; `by_resume` is False where `why` says what is to be
        done instead of a mere `rig batch resume`."""
        self._queue.add_event("hold", why)
        if self._on_hold == "stop":
            hint = "rig batch resume" if by_resume else None
            raise EndOfBatchError(why, hint, ExitCode.STOPPED_BY_CONDITION)
        self._commands.paused.set()
        by_itself = "" if over is None else over.words
        self._send("hold", text=why, by_itself=by_itself, bench=bench, by_resume=by_resume)
        self._wait("held", over)
        self._stay_paused()

    def wait_for_the_queue(self, error: QueueWriteError) -> None:
        """Return when the disk has room again, and the batch's folder is in its place; between
        runs, with the bench safe. The queue tries its transaction again then, before anything else
        happens. Raises EndOfBatchError, without waiting, where `on_hold` is "stop"."""
        if self._on_hold == "stop":
            self._queue.wait_for_disk = give_up
            raise EndOfBatchError(error.message, "rig batch resume", ExitCode.STOPPED_BY_CONDITION)
        self._commands.paused.set()
        over, why = room_on_disk(self._queue_has_room), error.one_line()
        if not self._queue.path.exists():  # SQLite writes to no file that was moved
            over = SelfEnding(self._queue_has_room, "the folder is in its place")
            why = f"the folder {self._folder.path} of the batch was moved or deleted: {PUT_BACK}"
        self._send("hold", text=why, by_itself=over.words, bench=BENCH_SAFE)
        try:
            self._wait("held", over)
        except RigError:
            self._queue.wait_for_disk = give_up  # the batch ends, with or without its record
            raise
        self._stay_paused()

    def _stay_paused(self) -> None:
        """Pause the batch after a hold if a person has asked for it and has not resumed it."""
        if self._commands.for_a_person:
            self._commands.paused.set()

    def _queue_has_room(self) -> bool:
        # Where the folder is away, one of its name may have been made again.
        return self._queue.path.exists() and has_room(self._folder.path, LEAST_B)

    def require_time(self, takes_s: float, spread_s: float) -> None:
        """Raise EndOfBatchError where a run of this length, and of this uncertainty, would not end
        before `stop_by`."""
        if why := does_not_fit(self._clock.now(), self._until, takes_s, spread_s):
            raise self.time_over(why)

    def time_over(self, why: str) -> EndOfBatchError:
        """Return the decision that ends the batch at its `stop_by`; where that is a time of the
        day, the next `rig batch resume` opens a new window."""
        self._queue.wait_for_disk = give_up
        with contextlib.suppress(QueueWriteError):
            self._queue.set_meta(TIME_OVER, "yes")
        return EndOfBatchError(why, self._to_continue, ExitCode.STOPPED_BY_CONDITION)

    def time_limit(self, bench_clock: Clock) -> TimeLimit | None:
        """Return the time by which a run that begins now has to end; None without `stop_by`."""
        if self._until is None:
            return None
        now, until = self._clock.now, self._until
        begun_s = bench_clock.now()

        def left_s() -> float:
            passed_s = bench_clock.now() - begun_s if bench_clock.is_virtual else 0.0
            return (until - now()).total_seconds() - passed_s

        return TimeLimit(self._limit_name(), left_s)

    def _wait(self, state: str, over: SelfEnding | None = None) -> None:
        looked_s = time.monotonic()
        with self._interlocks_watched():
            while self._commands.paused.is_set():
                self._stop.check()
                self._check_interlocks()
                if self._commands.stop_after_run:
                    raise stopped_by_request(f"while {state}")
                if self._until is not None and self._clock.now() >= self._until:
                    raise self.time_over(f"{self._limit_name()} was reached while it was {state}")
                if over is not None and time.monotonic() - looked_s >= LOOK_EVERY_S:
                    looked_s = time.monotonic()
                    if over.is_over():
                        self._commands.paused.clear()
                        self._send("state", state="running", text=f"{over.words} again")
                        return
                time.sleep(CHECK_EVERY_S)

    def _is_supervised(self) -> bool:
        return time.monotonic() - self._commands.heard_s < SUPERVISOR_S

    @contextmanager
    def _interlocks_watched(self) -> Iterator[None]:
        """Watch the bench's interlock contacts while no run does: a door that is opened and closed
        between two runs latches as well."""
        bench = self._benches.lasting
        if bench is None or not bench.plan.settings.interlock or self._interlocks is not None:
            yield
            return
        with ExitStack() as at_the_end:
            try:
                records = InterlockStore(bench.plan, lasting=True)
                self._interlocks = at_the_end.enter_context(watched(bench.plan, records))
            except RigError as error:  # The next run judges it.
                text = f"interlocks are not watched between runs: {error.one_line()}"
                self._send("note", level="warning", text=text)
            try:
                self._check_interlocks()
                yield
            finally:
                self._interlocks = None

    def _check_interlocks(self) -> None:
        """Raise EndOfBatchError if a person's contact is latched."""
        if self._interlocks is None:
            return
        try:
            self._interlocks.check()
        except InterlockError as latched:
            raise EndOfBatchError(latched.message, latched.hint, latched.code) from latched

    def _limit_name(self) -> str:
        assert self._until is not None
        return f"stop_by ({self._until.astimezone():%Y-%m-%d %H:%M:%S})"
