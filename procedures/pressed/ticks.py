"""The tick loops of a trial, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from procedures.pressed.record.recorder import LEAST_WAIT_S
from rig.control.tick_loop import TooSlowError, tick_loop

if TYPE_CHECKING:
    from procedures.pressed.links import TrialLinks
    from procedures.pressed.record.recorder import TickRecorder
    from rig.control.tick_loop import LoopStatistics, Tick
    from rig.files.journal.detections import Detection
    from rig.run.context import Run

OWN_RATE = (
    "end other programs, or ask for fewer samples (--rate) a second, or for a --tick below {0:g} "
    "Hz: an approach runs at {0:g} Hz with every higher --tick"
)
"""Remedy where a loop with a rate of its own, which is slower than the servo's, is too slow."""


class TrialTicks:
    """Runs loops of ticks, in each of which the links work and the recorder polls what is due."""

    def __init__(
        self,
        run: Run,
        links: TrialLinks,
        recorder: TickRecorder,
        loops: list[LoopStatistics],
        tick_s: float,
    ):
        """`tick_s` is the servo's tick; the statistics of each loop are added to `loops`."""
        self._run, self._links, self._recorder = run, links, recorder
        self._loops, self._tick_s = loops, tick_s
        self._next_tick_s = 0.0
        """Time on the run's clock at which the first tick of the next loop is due."""
        self.begun = 0
        """Ticks that have begun or were missed since the trial began."""
        self.on_detection: Callable[[Detection], None] = lambda detection: None
        """Called with everything that the detector finds while ticks run, at once: also between
        two ticks."""

    def run(
        self, longest_s: float, on_tick: Callable[[Tick], bool], tick_s: float | None = None
    ) -> None:
        """Call `on_tick` in every tick of the servo, or every `tick_s`, for `longest_s` or until it
        returns False. One loop follows another as one tick follows another."""

        def whole(tick: Tick) -> bool:
            self.begun += 1 + tick.missed
            self._react(self._recorder.detected())
            continues = on_tick(tick)
            self._recorder.poll_if_due()
            return continues

        self.wait()
        begin_s, tick_Hz = self._run.clock.now(), 1 / (tick_s or self._tick_s)
        with self._links.working(), self._recorder.loop(tick_Hz):
            try:
                done = tick_loop(self._run, tick_Hz, longest_s, whole, self._between)
            except TooSlowError as late:
                if tick_s is not None and tick_s > self._tick_s:
                    late.hint = OWN_RATE.format(tick_Hz)
                raise
        self._next_tick_s = begin_s + done.ticks / tick_Hz
        self._loops.append(done)

    def wait(self) -> None:
        """Wait until the first tick of the next loop is due."""
        self._run.clock.sleep(max(0.0, self._next_tick_s - self._run.clock.now()))

    def _between(self, seconds: float) -> None:
        """Wait for the next tick, and react to what is detected meanwhile. The clock checks in it
        what it checks in every wait."""
        clock = self._run.clock
        until_s = clock.now() + seconds
        clock.sleep(0)
        while (left_s := until_s - clock.now()) > LEAST_WAIT_S:
            self._react(self._recorder.wait(left_s))

    def _react(self, found: list[Detection]) -> None:
        for one in found:
            self.on_detection(one)
