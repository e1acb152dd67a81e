"""One slip trial under way: the slide or the ramp under the held force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from procedures.pressed.settings import AFTER_S
from procedures.pressed.trial import PressedSeries, PressedTrial
from procedures.slip_trial import SLID_ON_mm
from procedures.slip_trial.reading import SlipTaken, reading_of
from rig.control.force_ramp import ForceRamp
from rig.control.force_servo import ContactShift

if TYPE_CHECKING:
    from procedures.slip_trial import Settings
    from rig.control.tick_loop import Tick
    from rig.run.context import Run
    from rig.run.points import Reading

MOVING_EVERY_S = 0.05
"""Between two looks whether x has arrived."""


@dataclass
class Series(PressedSeries):
    """What the trials of a series have taught the ones that follow."""

    shift: ContactShift | None = None
    """What the first slide, which had none to go by, has shown."""


class Trial(PressedTrial):
    """One trial under way."""

    series: Series
    settings: Settings
    taken: SlipTaken

    def __init__(self, run: Run, number: int, series: Series):
        super().__init__(run, number, series, SlipTaken(number, series.pace.tick_Hz))
        self._moving_every = max(1, round(self._pace.tick_Hz * MOVING_EVERY_S))
        self._moving_looks = 0
        """Looks before in the slide under way."""
        self._arrived = False
        """Whether x has."""

    def rehearse(self) -> None:
        """The same without a record: the servo learns what the slide does to the normal force."""
        self.make_ready(self.settings.start_mm)
        self.press()
        self.slide()
        self.lift()

    def slide(self) -> None:
        """Drag the skin along x under the held normal force, and hold it a moment longer."""
        settings, taken = self.settings, self.taken
        self._x_commanded, self._in_motion = settings.end_mm, True
        pull = self._ramp() if settings.loading == "ramp" else self._steadily
        self._await_tick()
        taken.motion_from_s = self._since_s()
        self._servo.slide_begins(self.series.shift)
        self._moving_looks, self._arrived = 0, False
        self._loop(settings.longest_slide_s, pull)
        taken.motion_to_s = self._since_s()
        if self.series.shift is None:
            self.series.shift = self._servo.shift
        self.x.stop()
        self._loop(AFTER_S, self._hold)
        self._in_motion = False

    def _steadily(self, tick: Tick) -> bool:
        """Have x slide to its end; hold F_n."""
        self._hold(tick)
        if tick.number == 0:
            self._move_x(self.settings.speed_mm_s)
        return self._still_moving(tick)

    def _ramp(self) -> Callable[[Tick], bool]:
        """Have the tangential force rise until the skin slips as a whole and a little further, or
        to where the ramp is to end; hold F_n."""
        settings, along = self.settings, self.settings.along
        tick_s, delay_s = self._pace.tick_s, self._pace.delay_s
        ramp = ForceRamp(settings.ramp_N_s, settings.speed_mm_s, tick_s, delay_s)
        first_mm, first_N, begin_s = self._x_seen.is_mm, self._tangential_N, 0.0
        slipped_mm = speed_mm_s = 0.0

        def pull(tick: Tick) -> bool:
            nonlocal begin_s, slipped_mm, speed_mm_s
            self._hold(tick)
            if tick.number == 0:
                begin_s = tick.began_s
            seen, since_s = self._x_seen, tick.began_s - begin_s
            travel_mm = along * (seen.is_mm - first_mm)
            force_N = along * (self._tangential_N - first_N)
            seen_s, felt_s = seen.at_s - begin_s, self._felt_s - begin_s
            asked_mm_s = ramp.step(since_s, seen_s, travel_mm, felt_s, force_N)
            if asked_mm_s != speed_mm_s:
                speed_mm_s = asked_mm_s
                self._move_x(speed_mm_s)
            if ramp.follows:
                self.taken.ramp_to_s = self._since_s()
            if ramp.slipped:
                return travel_mm - slipped_mm <= SLID_ON_mm and self._still_moving(tick)
            slipped_mm = travel_mm
            return ramp.wanted_N(since_s) < settings.ramp_to_N and self._still_moving(tick)

        return pull

    def _still_moving(self, tick: Tick) -> bool:
        """Whether x has not arrived; looked at now and then."""
        looks = (tick.number + 1) // self._moving_every
        due, self._moving_looks = looks != self._moving_looks, looks
        if due:
            self._link_x.ask("arrived", self._look_whether_arrived)
        return not self._arrived

    def _look_whether_arrived(self) -> None:
        self._arrived = not self.x.moving()

    def _move_x(self, speed_mm_s: float) -> None:
        """On to the end of the slide."""
        self._link_x.ask("target", lambda: self.x.start_move(self.settings.end_mm, speed_mm_s))

    def reading(self) -> Reading:
        """Figures of the trial, and why it does not count if it does not."""
        return reading_of(self.run, self.taken) | self._load_rates()
