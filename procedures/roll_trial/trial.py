"""The run of one roll trial: the measurement of the rotary axis, and the roll itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

from procedures.pressed.approach.way_down import travel_mm_s
from procedures.pressed.axes import Look
from procedures.pressed.record.positions import AxisRows
from procedures.pressed.series import PressedSeries
from procedures.pressed.settings import AFTER_S
from procedures.pressed.trial import PressedTrial
from procedures.roll_trial.profile import Profile, ThereAndBack
from procedures.roll_trial.reading import RollTrialRecord, reading_of
from procedures.roll_trial.settings import NUDGES, SETTLED_S, NUDGE_deg, NUDGE_mm
from rig.analysis.trial.axis_offset import NudgeForce, Reals, axis_offset
from rig.core.errors import InstrumentError, LimitError

if TYPE_CHECKING:
    from procedures.pressed.links import TrialLinks
    from procedures.roll_trial.profile import Turn
    from procedures.roll_trial.settings import RollTrialSettings
    from rig.analysis.estimate import Estimate
    from rig.control.tick_loop import Tick
    from rig.instruments.roles import Limits
    from rig.run.context import Run
    from rig.run.points import Reading

UPRIGHT = (10.0, 100.0)
"""Speed in deg/s and acceleration in deg/s^2 at which the object is brought upright, with the skin
clear of it."""
NUDGE_mm_s, NUDGE_deg_s, NUDGE_deg_s2 = 0.2, 2.0, 20.0
RESTED_S = 0.25
"""Time after a nudge until the force has been measured: the rubber comes to rest first."""
MEASURED_S = 0.1
"""Length of the force record at the end of this time that is averaged."""
NUDGED_SHARE = 0.5
"""Largest error of the way of a nudge, as a share of it: an axis that did not follow would be taken
for an offset. Drives may end a motion some µm beside its target; the way is measured."""
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
        self._slowest_deg_s = self.stage.limits()["speed"].low

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
        """Request, on the stage's link worker, a turn or a change of the turn under way.

        Set points on both sides of a peak of a curve can be as good as the same: the turn between
        them has the slowest speed that the stage allows.
        """
        to_deg = self.upright_deg + turn.to_deg
        speeds = (max(turn.speed_deg_s, self._slowest_deg_s), turn.acceleration_deg_s2)
        self._links.ask(self.role, "turn", partial(self.stage.start_turn, to_deg, *speeds))

    def row(self) -> tuple[Look, tuple[float, float]]:
        """Return the latest look with its angle and commanded angle in deg, for the record."""
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
        self.rotary.stage.turn_to(self.rotary.upright_deg, *self.how_fast(*UPRIGHT))
        self.rotary.poll()

    def how_fast(self, speed_deg_s: float, acceleration_deg_s2: float) -> tuple[float, float]:
        """Return this speed in deg/s and acceleration in deg/s^2, or the nearest that the rotary
        stage allows."""
        limits = self.rotary.stage.limits()
        speed, acceleration = limits["speed"], limits["acceleration"]
        return speed.nearest(speed_deg_s), acceleration.nearest(acceleration_deg_s2)


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
        x_mm, rotary_deg = self.x.stage.position_mm(), self.rotary.stage.angle_deg()
        along_x = [self._nudge_x(x_mm, side * NUDGE_mm) for side in NUDGES]
        turned = [self._nudge_object(rotary_deg, side * NUDGE_deg) for side in NUDGES]
        self.lift()
        offset = axis_offset(along_x, turned)
        self.run.event("info", "alignment", in_words(offset))
        compensated = self.settings.alignment == "compensate"
        require_small_offset(offset, compensated, self.settings.largest_offset_mm)
        if compensated:
            rates, limits = self.series.rates, self.x.stage.limits()
            profile = self.settings.profile_at(rates.tick_Hz)
            require_way_of_x(offset.value, profile, rates.tick_s, self.start_mm, limits)
        return offset

    def _nudge_x(self, from_mm: float, by_mm: float) -> NudgeForce:
        stage = self.x.stage
        speed_mm_s = stage.limits()["speed"].nearest(NUDGE_mm_s)
        stage.start_move(self.start_mm + by_mm, speed_mm_s)
        force_N = self._force_at_rest(NUDGE_mm / speed_mm_s)
        went_mm = stage.position_mm() - from_mm
        require_nudged("stage_x", went_mm, by_mm, NUDGE_mm, "mm")
        return NudgeForce(went_mm, force_N)

    def _nudge_object(self, from_deg: float, by_deg: float) -> NudgeForce:
        stage, to_deg = self.rotary.stage, self.rotary.upright_deg + by_deg
        how = self.how_fast(NUDGE_deg_s, NUDGE_deg_s2)
        stage.start_turn(to_deg, *how)
        force_N = self._force_at_rest(ThereAndBack(NUDGE_deg, *how, stay_s=0.0).way_s)
        went_deg = stage.angle_deg() - from_deg
        require_nudged("rotary", went_deg, by_deg, NUDGE_deg, "deg")
        return NudgeForce(math.radians(went_deg), force_N)

    def _force_at_rest(self, way_s: float) -> Reals:
        """Return the frames of the tangential force, (n,), once a nudge that takes so long is over
        and the rubber is at rest."""
        self.hold(way_s + RESTED_S)
        force_N: Reals = self.run.force.latest_N(MEASURED_S)[:, 0]
        return force_N


def in_words(offset: Estimate) -> str:
    """Return where the rotary axis lies, for a person."""
    side = "below" if offset.value < 0 else "above"
    return (
        f"the rotary axis lies {abs(offset.value):.2f} mm {side} the point of contact, standard "
        f"error {offset.standard_error:.2f} mm"
    )


def require_small_offset(offset: Estimate, compensated: bool, largest_mm: float) -> None:
    """Raise LimitError where too much of an offset of the rotary axis remains, whether x
    compensates for it or not."""
    left_mm, why = abs(offset.value), "x is not to compensate for it"
    remedy = "mount the object again, the top of its head on the axis of the rotary stage"
    if compensated:
        left_mm = max(left_mm - LARGEST_COMPENSATED_mm, 0.0)
        why = f"x compensates {LARGEST_COMPENSATED_mm:g} mm at most"
    else:
        remedy += ", or have x compensate for it with --alignment compensate"
    if left_mm > largest_mm:
        raise LimitError(
            f"rotary: {in_words(offset)}; {why}, so {left_mm:.2f} mm remain, more than "
            f"--largest-offset {largest_mm:g} mm",
            remedy,
        )


def require_nudged(device: str, went: float, by: float, nudge: float, unit: str) -> None:
    """Raise InstrumentError unless an axis has gone about as far as a nudge has sent it from where
    it stood before the first one."""
    if abs(went - by) > NUDGED_SHARE * nudge:
        raise InstrumentError(
            device,
            "measure the rotary axis",
            f"it has gone {went:.3g} {unit} for a nudge of {by:g} {unit}",
            "check what blocks or slows it",
        )


def require_way_of_x(
    offset_mm: float, profile: Profile, tick_s: float, start_mm: float, limits: Mapping[str, Limits]
) -> None:
    """Raise LimitError where x, with these limits, cannot follow a roll to compensate for an offset
    of the rotary axis: it would stop in the middle of the roll."""
    count = math.ceil(profile.duration_s / tick_s) + 1
    ways_mm = [shift_mm(offset_mm, profile.at_deg(tick * tick_s)) for tick in range(count)]
    fastest_mm_s = CATCH_UP * max(abs(b - a) for a, b in pairwise(ways_mm)) / tick_s
    fastest_mm_s = max(fastest_mm_s, limits["speed"].low)  # x goes no slower, see _take_back
    for what, value in (
        ("position", start_mm + min(ways_mm)),
        ("position", start_mm + max(ways_mm)),
        ("speed", fastest_mm_s),
    ):
        limit = limits[what]
        if not limit.holds(value):
            raise LimitError(
                f"stage_x: to compensate for the offset of the rotary axis, {offset_mm:.2f} mm, "
                f"the roll needs a {what} of {value:.4g} {limit.unit}; the {limit.limited_by} "
                f"allows {limit.low:g} to {limit.high:g} {limit.unit}",
                "choose a smaller angle, a slower turn or another --start, or mount the object "
                "again, the top of its head on the axis of the rotary stage",
            )


def shift_mm(offset_mm: float, angle_deg: float) -> float:
    """Return how far x has to go from the start to compensate for an offset of the rotary axis."""
    return -offset_mm * math.sin(math.radians(angle_deg))


class RollTrialRun(HeadTrial):
    """A roll trial: the object turns, and x compensates for the offset of the rotary axis."""

    def __init__(self, run: Run, number: int, series: RollSeries):
        super().__init__(run, number, series)
        self._offset_mm = 0.0
        """Offset of the rotary axis that x compensates for."""
        if series.offset is not None and self.settings.alignment == "compensate":
            self._offset_mm = series.offset.value
        self._x_speeds = self.x.stage.limits()["speed"]
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
        target_mm = self.start_mm + shift_mm(self._offset_mm, self._profile.at_deg(soon_s))
        speed_mm_s = CATCH_UP * abs(target_mm - self.x.commanded_mm) / tick_s
        self.x.start_move(target_mm, self._x_speeds.nearest(max(speed_mm_s, SLOWEST_mm_s)))

    def reading(self) -> Reading:
        """Return the results of the trial, and why it is invalid if it is."""
        return reading_of(self.run, self.record, self.series.offset) | self.record_load_rates()
