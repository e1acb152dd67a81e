"""The run of one roll trial: the measurement of the rotary axis, and the roll itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from procedures.pressed.approach.way_down import travel_mm_s
from procedures.pressed.axes import Look
from procedures.pressed.record.positions import AxisRows
from procedures.pressed.series import PressedSeries
from procedures.pressed.settings import AFTER_S
from procedures.pressed.trial import PressedTrial
from procedures.roll_trial.reading import RollTrialRecord, reading_of
from procedures.roll_trial.settings import NUDGED_S, NUDGES, SETTLED_S
from rig.analysis.trial.axis_offset import NudgeForce, axis_offset
from rig.core.errors import LimitError

if TYPE_CHECKING:
    from procedures.pressed.links import TrialLinks
    from procedures.roll_trial.profile import Turn
    from procedures.roll_trial.settings import RollTrialSettings
    from rig.analysis.estimate import Estimate
    from rig.control.tick_loop import Tick
    from rig.run.context import Run
    from rig.run.points import Reading

UPRIGHT_deg_s, UPRIGHT_deg_s2 = 10.0, 100.0
"""Speed and acceleration at which the object is brought upright, with the skin clear of it."""
NUDGE_mm, NUDGE_deg = 0.02, 0.5
"""Moves of x and of the object to either side that measure the axis: far too small for a slip."""
NUDGE_mm_s, NUDGE_deg_s, NUDGE_deg_s2 = 0.2, 2.0, 20.0
MEASURED_S = 0.1
"""Length of the force record at the end of a nudge's rest that is averaged."""
MOST_POLLS_Hz = 50.0
"""Highest rate at which three axes and the DAQ are polled: 100 Hz would fill every tick."""
LARGEST_COMPENSATED_mm = 8.0
"""Largest offset that x compensates: beyond it x would have to follow as fast as the head rolls,
which means that the object is mounted wrongly."""
SLOWEST_mm_s = 0.02
CATCH_UP = 1.02
"""Speed of x relative to the speed that the turn requires: its moves fill the ticks and end in
time."""


@dataclass(frozen=True)
class RotaryPoll(Look):
    """The rotary stage's answer to where it is; angles from upright."""

    angle_deg: float = math.nan
    commanded_deg: float = 0.0


class PolledRotary:
    """The rotary stage of a trial, with the object on it, by its angle from upright."""

    role = "rotary"

    def __init__(self, run: Run, upright_deg: float, links: TrialLinks):
        links.add(self.role)
        self.stage, self.upright_deg = run.bench.rotary, upright_deg
        self.commanded_deg = 0.0
        self.in_motion = False
        self.latest = RotaryPoll()
        self._links, self._clock = links, run.clock

    @property
    def looked(self) -> Look:
        """See `PolledAxis`."""
        return self.latest

    @property
    def angle_deg(self) -> float:
        """Return the measured angle from upright, queried from the stage in the calling thread."""
        return self.stage.angle_deg() - self.upright_deg

    def poll(self) -> None:
        """Poll the stage in the calling thread."""
        commanded_deg, asked_s = self.commanded_deg, self._clock.now()
        angle_deg = self.angle_deg
        self.latest = RotaryPoll(asked_s, self._clock.now(), angle_deg, commanded_deg)

    def ask_poll(self) -> None:
        """See `PolledAxis`."""
        self._links.ask(self.role, "poll", self.poll)

    def ask_turn(self, turn: Turn) -> None:
        """Request, on the stage's link worker, a turn or a change of the turn under way."""
        to_deg = self.upright_deg + turn.to_deg
        speeds = (turn.speed_deg_s, turn.acceleration_deg_s2)
        self._links.ask(self.role, "turn", partial(self.stage.start_turn, to_deg, *speeds))

    def row(self) -> tuple[Look, tuple[float, float]]:
        """Return the latest look with its angle and commanded angle, for the record."""
        look = self.latest
        return look, (look.angle_deg, look.commanded_deg)


@dataclass
class RollSeries(PressedSeries):
    """State that the trials of a series pass on to later ones."""

    offset: Estimate | None = None
    """Height of the rotary axis above the point of contact in mm; None if not measured."""


class HeadTrial(PressedTrial):
    """Base of a trial on an object with a head that the rotary stage carries."""

    even_moves = True
    series: RollSeries
    settings: RollTrialSettings
    record: RollTrialRecord

    def __init__(self, run: Run, number: int, series: RollSeries):
        record = RollTrialRecord(
            number, series.rates.tick_Hz, run.force.rate_S_s, run.settings.normal_force_N
        )
        super().__init__(run, series, record, MOST_POLLS_Hz)
        fixture = run.bench.settings.fixture
        assert fixture.centre_mm is not None
        assert fixture.upright_deg is not None, "check() has refused a fixture without them"
        self.start_mm = fixture.centre_mm + self.settings.start_mm
        """Position of x at which the roll begins."""
        self.rotary = PolledRotary(run, fixture.upright_deg, self.links)
        self.recorder.add_axis(
            AxisRows(self.rotary, "rotation", "deg", record.rotation, self.rotary.row)
        )

    def bring_upright(self) -> None:
        """Move z up, so that the skin is clear of the object, and turn the object upright."""
        parked_mm = self.run.bench.settings.fixture.parked_mm
        self.z.stage.move_to(parked_mm, travel_mm_s(self.z.stage))
        self.rotary.stage.turn_to(self.rotary.upright_deg, UPRIGHT_deg_s, UPRIGHT_deg_s2)
        self.rotary.poll()


class AlignmentTrial(HeadTrial):
    """A press that measures the offset of the rotary axis; nothing is recorded."""

    def __init__(self, run: Run, series: RollSeries):
        super().__init__(run, 0, series)

    def measure(self) -> Estimate:
        """Nudge x, then the object, to either side and back, and compare the effects on the
        tangential force. Returns the offset of the rotary axis; raises LimitError if too much of it
        would remain."""
        self.bring_upright()
        self.make_ready(self.start_mm)
        self.press()
        along_x = [self._nudged(side * NUDGE_mm, self._nudge_x) for side in NUDGES]
        turned = [
            self._nudged(side * math.radians(NUDGE_deg), self._nudge_object) for side in NUDGES
        ]
        self.lift()
        offset = axis_offset(along_x, turned)
        found = f"the rotary axis lies {offset.value:.2f} mm above the point of contact"
        error = f"standard error {offset.standard_error:.2f} mm"
        self.run.event("info", "alignment", f"{found}, {error}")
        compensated, left_mm = self.settings.alignment == "compensate", abs(offset.value)
        if compensated:
            left_mm = max(left_mm - LARGEST_COMPENSATED_mm, 0.0)
        if left_mm > self.settings.largest_offset_mm:
            why = "x is not to compensate for it"
            if compensated:
                why = f"x compensates {LARGEST_COMPENSATED_mm:g} mm at most"
            raise LimitError(
                f"rotary: {found}, {error}; {why}, and {left_mm:.2f} mm are more than the "
                f"{self.settings.largest_offset_mm:g} mm that may remain (--largest-offset)",
                "mount the object again, the top of its head on the axis of the rotary stage, or "
                "have x compensate for it with --alignment compensate",
            )
        return offset

    def _nudged(self, by: float, nudge: Callable[[float], None]) -> NudgeForce:
        nudge(by)
        self.hold(NUDGED_S)
        frames = self.run.force.latest_N(MEASURED_S)
        return NudgeForce(by, frames[:, 0])

    def _nudge_x(self, by_mm: float) -> None:
        self.x.stage.start_move(self.start_mm + by_mm, NUDGE_mm_s)

    def _nudge_object(self, by_rad: float) -> None:
        to_deg = self.rotary.upright_deg + math.degrees(by_rad)
        self.rotary.stage.start_turn(to_deg, NUDGE_deg_s, NUDGE_deg_s2)


class RollTrialRun(HeadTrial):
    """A roll trial: the object turns, and x compensates for the offset of the rotary axis."""

    def __init__(self, run: Run, number: int, series: RollSeries):
        super().__init__(run, number, series)
        self._offset_mm = 0.0
        """Offset of the rotary axis that x compensates for."""
        if series.offset is not None and self.settings.alignment == "compensate":
            self._offset_mm = series.offset.value
        self._profile = self.settings.profile_at(series.rates.tick_Hz)
        self._turns = list(self._profile.turns(series.rates.tick_s))

    def roll(self) -> None:
        """Turn the object along the profile under the held normal force while x compensates for the
        offset of the axis; then hold the force a moment longer."""
        self.begin_motion()
        self.x.in_motion = self.rotary.in_motion = True
        self.run_ticks(self._profile.duration_s + SETTLED_S, self._roll_on)
        self.end_motion()
        self.hold(AFTER_S)
        self.rotary.stage.stop()
        self.x.stop()
        self.x.in_motion = self.rotary.in_motion = False
        self.record.end_deg = self.rotary.angle_deg

    def _roll_on(self, tick: Tick) -> bool:
        """Request the turns that are due, have x follow, and hold F_n."""
        since_s = tick.began_s - self.record.begun_s - self.record.motion_from_s
        while self._turns and self._turns[0].at_s <= since_s + self.series.rates.tick_s / 2:
            self.rotary.ask_turn(self._turns.pop(0))
        self.rotary.commanded_deg = self._profile.at_deg(since_s)
        self.hold_tick(tick)
        if self._offset_mm:
            self._take_back(since_s)
        return True

    def _take_back(self, since_s: float) -> None:
        """Move x by the distance that the turn will have dragged the skin at the next tick."""
        tick_s = self.series.rates.tick_s
        soon_s = since_s + tick_s + self.delay_s
        shift_mm = -self._offset_mm * math.sin(math.radians(self._profile.at_deg(soon_s)))
        target_mm = self.start_mm + shift_mm
        speed_mm_s = CATCH_UP * abs(target_mm - self.x.commanded_mm) / tick_s
        self.x.start_move(target_mm, max(speed_mm_s, SLOWEST_mm_s))

    def reading(self) -> Reading:
        """Return the results of the trial, and why it is invalid if it is."""
        return reading_of(self.run, self.record, self.series.offset) | self.record_load_rates()
