"""Polls the stages, collects and records in every tick of a trial, whatever else the tick does.

Samples of the strips, frames of the force sensor and positions come at rates of their own. Each is
recorded once in a poll interval, in a tick of its own where there are several ticks to choose from,
so that no tick has to do all of it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from procedures.pressed.record.detection import DetectionRecord
from procedures.pressed.record.force import TrialForce
from procedures.pressed.record.positions import AxisRows, LookWatch, PositionRecorder
from procedures.pressed.record.strips import StripRecorder
from rig.core.errors import RigError
from rig.instruments.roles import CountsMisreadings

if TYPE_CHECKING:
    from procedures.pressed.axes import PolledAxis, PolledStage
    from procedures.pressed.links import TrialLinks
    from procedures.pressed.record.detection import LiveDetection
    from procedures.pressed.record.trial_record import TrialRecord
    from rig.control.tick_loop import Tick
    from rig.files.journal.detections import Detection
    from rig.run.context import Run


LEAST_WAIT_S = 1e-6
"""Shortest wait that a virtual clock counts in; a shorter one would never be over."""


class PollSchedule:
    """Selects the ticks of a loop that poll the stages: `rate_Hz` times a second at most."""

    def __init__(self, rate_Hz: float):
        self._rate_Hz = rate_Hz
        self._every = 1
        """Ticks of the loop under way from one poll to the next."""
        self._latest = -1
        """Number of the latest poll in the loop under way."""
        self._due = False
        """Whether the tick under way polls."""
        self.interval_s = math.inf
        """Time in s from one poll to the next."""

    def begin_loop(self, tick_Hz: float) -> None:
        """Count from the first tick of a loop at this rate; it is due."""
        self._every = max(1, round(tick_Hz / self._rate_Hz))
        self.interval_s, self._latest = self._every / tick_Hz, -1

    def is_due(self, tick: Tick) -> bool:
        """Return whether this tick polls: once in an interval, also where ticks were missed."""
        number = tick.number // self._every
        self._due, self._latest = number != self._latest, number
        return self._due

    @property
    def leaves_time(self) -> bool:
        """Whether the links have time for a further request in the tick under way: it does not
        poll, or every tick does."""
        return self._every == 1 or not self._due

    def is_last(self, tick: Tick) -> bool:
        """Return whether the next tick polls."""
        return (tick.number + 1) % self._every == 0


class TickRecorder:
    """Polls the axes, and records strips, force and positions, tick by tick."""

    def __init__(
        self,
        run: Run,
        record: TrialRecord,
        links: TrialLinks,
        stages: tuple[PolledStage, PolledStage],
        poll_rate_Hz: float,
        detection: LiveDetection,
        block_s: float,
    ):
        self._run, self._record, self._links = run, record, links
        self._axes: list[PolledAxis] = [*stages]
        """Axes in the order in which they are polled."""
        self.force = TrialForce(run, record)
        self._detection = detection
        self.strips = StripRecorder(run, record, links, detection, block_s)
        self._found = DetectionRecord(run, record, detection)
        self._positions = PositionRecorder(run, record, *stages)
        self._schedule = PollSchedule(poll_rate_Hz)
        self._watch = LookWatch(record)
        self._poll_due = self._recording = False
        self._misread_before = 0
        self._left: list[Callable[[], None]] = []
        """Tasks that are still to be done in this poll interval, the next one last."""

    def add_axis(self, rows: AxisRows) -> None:
        """Poll a further axis, after the stages, and record its positions with theirs."""
        self._axes.append(rows.axis)
        self._positions.add(rows)

    def start(self) -> None:
        """Begin to sample the strips and to record them, the forces and the positions."""
        self.strips.start()
        self.force.start_recording()
        self._misread_before = self._misreadings()
        self._recording = True

    def stop(self) -> None:
        """Record what has still come, and end the acquisition."""
        self._positions.add_row()
        self._positions.record_rows()
        self.strips.collect_rest()
        self.force.count_frames()
        self.force.record_frames()
        self._record.misread = self._misreadings() - self._misread_before
        self._recording = False
        self.strips.stop()
        self._found.take()

    def give_up(self) -> None:
        """End the acquisition of a record that nothing will be made of."""
        self._recording = False
        self.strips.stop()
        self._found.take()

    def _misreadings(self) -> int:
        stages = [axis.stage for axis in self._axes]
        return sum(stage.misreadings for stage in stages if isinstance(stage, CountsMisreadings))

    @contextlib.contextmanager
    def loop(self, tick_Hz: float) -> Iterator[None]:
        """Prepare for a loop of ticks at this rate within the block. At its end, record what had
        come when the last tick began; an exception of this is dropped if the block itself has
        raised."""
        self._schedule.begin_loop(tick_Hz)
        try:
            yield
        except BaseException:
            with contextlib.suppress(RigError):
                self._record_open_blocks()
            raise
        self._record_open_blocks()

    def wait(self, seconds: float) -> list[Detection]:
        """Wait for at most so long, and read and judge the strips' blocks as they come; return as
        soon as something was detected, with what it is."""
        clock, strips, until_s = self._run.clock, self.strips, self._run.clock.now() + seconds
        while not (found := self._found.take()):
            if (now_s := clock.now()) >= until_s - LEAST_WAIT_S:
                break
            if now_s >= strips.next_s - LEAST_WAIT_S:
                strips.ask_block()
            else:
                clock.sleep_unless(self._detection.woken, min(strips.next_s, until_s) - now_s)
        return found

    def detected(self) -> list[Detection]:
        """Return what was detected since the last call of this or of `wait`."""
        return self._found.take()

    def collect(self, tick: Tick, wait: bool = False) -> float:
        """Poll and record what is due in this tick; return the latest normal force in N.

        With `wait`, the stages are polled in any case, and their answers waited for. Raises what
        an earlier request on one of the links has raised.
        """
        due = self._schedule.is_due(tick)
        self._links.check()
        self._watch.note(self._axes, tick.began_s, self._schedule.interval_s)
        self._poll_due = wait or due
        if wait or self._run.clock.is_virtual:
            self.poll_if_due()
        if wait:
            self._links.settle("stage_z", "stage_x")
        if self._recording:
            self.force.count_frames()
            if due:
                self._positions.add_row()
            self._collect_in_turn(due, self._schedule.is_last(tick))
        return self.force.update()

    @property
    def leaves_time(self) -> bool:
        """Whether the links have time for a further request in the tick under way. On a slow line
        that two stages share, their polls and the new target take a tick's time."""
        return self._schedule.leaves_time

    def poll_if_due(self) -> None:
        """Poll the axes in motion, where this tick has not done so: in real time after the tick's
        own task, so that a new target goes ahead of the poll."""
        due, self._poll_due = self._poll_due, False
        if due:
            for axis in self._axes:
                if axis.in_motion:
                    axis.ask_poll()

    def _collect_in_turn(self, due: bool, last: bool) -> None:
        """Collect strips and frames of a poll interval, one of them per tick, both before the next
        poll."""
        if due:
            self._collect_left()
            block_frames = self.force.timing.block_frames
            self._left = [
                lambda: self.force.record_frames(block_frames),
                lambda: self.strips.collect(self._schedule.interval_s),
            ]
        elif self._left:
            self._left.pop()()
        if last:
            self._collect_left()

    def _collect_left(self) -> None:
        while self._left:
            self._left.pop()()

    def _record_open_blocks(self) -> None:
        if self._recording:
            self._positions.record_rows()
            self.force.record_frames()
