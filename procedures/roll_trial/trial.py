"""One roll trial under way: the measurement of the rotary axis, and the roll itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.contact import TRAVEL_mm_s
from procedures.pressed.settings import AFTER_S
from procedures.pressed.trial import PressedSeries, PressedTrial
from procedures.roll_trial import NUDGED_S, NUDGES, SETTLED_S
from procedures.roll_trial.reading import RollTaken, reading_of
from rig.analysis.trial.axis_offset import Look, axis_offset
from rig.core.errors import LimitError

if TYPE_CHECKING:
    from procedures.roll_trial import Settings
    from procedures.roll_trial.profile import Turn
    from rig.analysis.estimate import Estimate
    from rig.control.tick_loop import Tick
    from rig.run.context import Run
    from rig.run.points import Reading

UPRIGHT_deg_s, UPRIGHT_deg_s2 = 10.0, 100.0
"""How the object is brought upright, the skin being clear of it."""
NUDGE_mm, NUDGE_deg = 0.02, 0.5
"""By how much x and the object are moved to either side to measure the axis: far below a slip."""
NUDGE_mm_s, NUDGE_deg_s, NUDGE_deg_s2 = 0.2, 2.0, 20.0
LOOKED_S = 0.1
"""The stretch of force at the end of a nudge's rest that is looked at."""
LOOKS_Hz = 50.0
"""How often three axes and the DAQ are asked at most: a hundred times would fill every tick."""
LARGEST_COMPENSATED_mm = 8.0
"""Beyond, the object stands wrong: x would have to follow as fast as the head rolls."""
SLOWEST_mm_s = 0.02
CATCH_UP = 1.02
"""How much faster than the turn wants it x goes: it fills its ticks, and is there in time."""


@dataclass(frozen=True)
class Turned:
    """A look at the rotary stage; angles from upright."""

    at_s: float = 0.0
    """When it was, on the run's clock."""
    angle_deg: float = 0.0
    commanded_deg: float = 0.0


@dataclass
class Series(PressedSeries):
    """What the trials of a series have taught the ones that follow."""

    offset: Estimate | None = None
    """How far the rotary axis lies above where the head touches, mm; None where not measured."""


class _OnHead(PressedTrial):
    """A trial on an object that the rotary stage carries."""

    EVENLY = True
    series: Series
    settings: Settings
    taken: RollTaken

    def __init__(self, run: Run, number: int, series: Series):
        super().__init__(run, number, series, RollTaken(number, series.pace.tick_Hz))
        self._rotary = run.bench.rotary
        fixture = run.bench.settings.fixture
        assert fixture.centre_mm is not None
        assert fixture.upright_deg is not None, "arm() has seen to both"
        self._upright_deg = fixture.upright_deg
        self._start_mm = fixture.centre_mm + self.settings.start_mm
        self._commanded_deg = 0.0
        self._rotary_seen = Turned()
        self._link_rotary = run.bench.links["rotary"]
        self._links["rotary"] = self._link_rotary
        self._looks_Hz = min(self._looks_Hz, LOOKS_Hz)

    def make_ready(self, start_mm: float | None = None) -> None:
        """Up, the object upright, x to where the roll begins; zero the force in free air."""
        self.z.move_to(self.fixture.parked_mm, TRAVEL_mm_s)
        self._rotary.turn_to(self._upright_deg, UPRIGHT_deg_s, UPRIGHT_deg_s2)
        self._look_at_rotary()
        super().make_ready(self._start_mm if start_mm is None else start_mm)

    def _look_at_rotary(self) -> None:
        commanded_deg, asked_s = self._commanded_deg, self.run.clock.now()
        angle_deg = self._rotary.angle_deg() - self._upright_deg
        at_s = (asked_s + self.run.clock.now()) / 2
        self._rotary_seen = Turned(at_s, angle_deg, commanded_deg)


class AlignTrial(_OnHead):
    """A press that measures how far the rotary axis is off: nothing is recorded."""

    def __init__(self, run: Run, series: Series):
        super().__init__(run, 0, series)

    def measure(self) -> Estimate:
        """Nudge x, then the object, to either side and back, and see what each does to the
        tangential force; LimitError for an offset of which too much would be left."""
        self.make_ready()
        self.press()
        along_x = [self._nudged(side * NUDGE_mm, self._nudge_x) for side in NUDGES]
        turned = [
            self._nudged(side * math.radians(NUDGE_deg), self._nudge_object) for side in NUDGES
        ]
        self.lift()
        offset = axis_offset(along_x, turned)
        told = f"the rotary axis lies {offset.value:.2f} mm above where the head touches"
        error = f"standard error {offset.standard_error:.2f} mm"
        self.run.event("info", "alignment", f"{told}, {error}")
        compensated, left_mm = self.settings.alignment == "compensate", abs(offset.value)
        if compensated:
            left_mm = max(left_mm - LARGEST_COMPENSATED_mm, 0.0)
        if left_mm > self.settings.largest_offset_mm:
            why = "x is not to take it back"
            if compensated:
                why = f"x takes back {LARGEST_COMPENSATED_mm:g} mm at most"
            raise LimitError(
                f"rotary: {told}, {error}; {why}, and {left_mm:.2f} mm are more than the "
                f"{self.settings.largest_offset_mm:g} mm that may be left (largest_offset_mm)",
                "mount the object anew, the top of its head on the axis of the rotary stage, or "
                "have x take it back with --alignment compensate",
            )
        return offset

    def _nudged(self, by: float, nudge: Callable[[float], None]) -> Look:
        nudge(by)
        self._loop(NUDGED_S, self._hold)
        frames = self.run.force.latest_N(LOOKED_S)
        return Look(by, frames[:, 0])

    def _nudge_x(self, by_mm: float) -> None:
        self.x.start_move(self._start_mm + by_mm, NUDGE_mm_s)

    def _nudge_object(self, by_rad: float) -> None:
        to_deg = self._upright_deg + math.degrees(by_rad)
        self._rotary.start_turn(to_deg, NUDGE_deg_s, NUDGE_deg_s2)


class Trial(_OnHead):
    """One trial under way."""

    def __init__(self, run: Run, number: int, series: Series):
        super().__init__(run, number, series)
        self._offset_mm = 0.0
        """Of the axis, as far as x takes it back."""
        if series.offset is not None and self.settings.alignment == "compensate":
            self._offset_mm = series.offset.value
        self._profile = self.settings.profile
        self._turns = list(self._profile.turns(self._pace.tick_s))

    def roll(self) -> None:
        """Turn the object along the profile under the held normal force, x taking back what the
        axis is off; hold it a moment longer."""
        taken = self.taken
        self._await_tick()
        taken.motion_from_s = self._since_s()
        self._servo.slide_begins()
        self._in_motion = True
        self._loop(self._profile.duration_s + SETTLED_S, self._roll_on)
        taken.motion_to_s = self._since_s()
        self._loop(AFTER_S, self._hold)
        self._rotary.stop()
        self.x.stop()
        self._in_motion = False
        taken.end_deg = self._rotary.angle_deg() - self._upright_deg

    def _roll_on(self, tick: Tick) -> bool:
        """Tell the rotary stage what is due, have x follow, hold F_n."""
        since_s = tick.began_s - self.taken.begun_s - self.taken.motion_from_s
        while self._turns and self._turns[0].at_s <= since_s + self._pace.tick_s / 2:
            turn = self._turns.pop(0)
            self._link_rotary.ask("turn", partial(self._turn, turn))
        self._commanded_deg = self._profile.at_deg(since_s)
        self._hold(tick)
        if self._offset_mm:
            self._take_back(since_s)
        return True

    def _take_back(self, since_s: float) -> None:
        """Move x by what the turn will have dragged the skin by at the next tick."""
        soon_s = since_s + self._pace.tick_s + self._pace.delay_s
        shift_mm = -self._offset_mm * math.sin(math.radians(self._profile.at_deg(soon_s)))
        target_mm = self._start_mm + shift_mm
        speed_mm_s = CATCH_UP * abs(target_mm - self._x_commanded) / self._pace.tick_s
        self._x_commanded = target_mm
        speed_mm_s = max(speed_mm_s, SLOWEST_mm_s)
        self._link_x.ask("target", lambda: self.x.start_move(target_mm, speed_mm_s))

    def _turn(self, turn: Turn) -> None:
        to_deg = self._upright_deg + turn.to_deg
        self._rotary.start_turn(to_deg, turn.speed_deg_s, turn.acceleration_deg_s2)

    def _ask_where(self) -> None:
        super()._ask_where()
        if self._in_motion:  # else it stands where it was brought
            self._link_rotary.ask("look", self._look_at_rotary)

    def _seen_last_s(self) -> float:
        return max(super()._seen_last_s(), self._rotary_seen.at_s)

    def _record_seen(self, since_s: float) -> None:
        seen = self._rotary_seen
        self.taken.rotation.append((since_s, seen.angle_deg, seen.commanded_deg))
        super()._record_seen(since_s)

    def _record_places(self) -> None:
        first, rows = self._recorded_rows, np.array(self.taken.rotation[self._recorded_rows :])
        super()._record_places()
        if len(rows):
            self.run.put("rotation", first, rows[:, 1:], None, units="deg")

    def reading(self) -> Reading:
        """Figures of the trial, and why it does not count if it does not."""
        return reading_of(self.run, self.taken, self.series.offset) | self._load_rates()
