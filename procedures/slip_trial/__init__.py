"""Slide of the artificial skin on a plate at constant normal force: paper 4.1.

The skin hangs on the x-z stage above the plate, the plate lies on the force sensor. A trial goes
down until the plate is felt, brings the normal force up and holds it by a servo on z, rests, slides
along x, and lifts off. The strips are sampled all the while, gap by gap the same: what was lost
ends the trial.

Every tick takes what the force sensor and the DAQ have sent, records it, and moves z by what the
force asks for. Whatever ends a trial, x stops first, then z goes up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from procedures.pressed import layout as pressed_layout
from procedures.pressed.contact import contact_range_mm
from procedures.pressed.settings import (
    AFTER_S,
    DELAY_S,
    TOUCH_DRIFT,
    PressedSettings,
    arm_pressed,
    import_what_a_trial_needs,
    pressed_overhead_s,
    pressing_s,
    summary_of,
    trial_points,
    why_invalid,
)
from procedures.slip_trial import layout as slip_layout
from rig.bench.bench import Fixture, FixtureSettings
from rig.run.points import Move, Point, Reading

if TYPE_CHECKING:
    from rig.bench.bench import Bench
    from rig.run.context import Run

NAME = "slip-trial"
FIXTURES: tuple[Fixture, ...] = ("plate",)
LAYOUT = slip_layout.LAYOUT
STREAMS = pressed_layout.STREAMS
invalid = why_invalid
DRIFT = TOUCH_DRIFT

UNREHEARSED_mm = 0.0175
"""Travel within delay and tick up to which the servo holds the force through a slide that it has
not seen, whatever the friction (decision 0035)."""
SLID_ON_mm = 0.3
"""How far a slide goes on after a ramp, for the kinetic coefficient."""
FRICTION = 0.7
"""Expected of the skin on the plate: where a ramp slips."""
SEEN_S = 0.04
"""Expected from the end of a slide until it is seen."""


class Settings(PressedSettings):
    """What a slip trial may be asked for."""

    loading: Literal["slide", "ramp"] = "slide"
    """What drags the skin: a slide at constant speed, or a tangential force that rises evenly."""
    speed_mm_s: float = Field(default=0.5, gt=0)
    """Speed of the slide; of a ramp, its limit and the speed after gross slip."""
    distance_mm: float = Field(default=1.0, gt=0)
    """Length of the slide; of a ramp, the longest."""
    ramp_N_s: float = Field(default=2.0, gt=0)
    """Rate at which a ramp has the tangential force rise."""
    ramp_to_N: float = Field(default=10.0, gt=0)
    """Tangential force at which a ramp ends where nothing has slipped."""
    direction: Literal["+x", "-x"] = "+x"
    """Direction of the slide."""
    start_mm: float = 10.0
    """Position of the x stage at which a trial begins."""
    rehearsal: Literal["auto", "always", "never"] = "auto"
    """A first slide without a record, from which the servo learns; auto: where it is needed."""

    @model_validator(mode="after")
    def _ramp_fits(self) -> Settings:
        if self.loading == "ramp" and self.ramp_to_N >= self.largest_force_N:
            raise ValueError(
                f"ramp_to_N {self.ramp_to_N:g} is not below largest_force_N "
                f"{self.largest_force_N:g}"
            )
        return self

    @property
    def longest_slide_s(self) -> float:
        """What a slide or a ramp may take at most."""
        ramps_s = 2 * self.speed_mm_s / self.acceleration_mm_s2
        rise_s = self.ramp_to_N / self.ramp_N_s if self.loading == "ramp" else 0.0
        return rise_s + self.distance_mm / self.speed_mm_s + ramps_s + 1.0

    @property
    def slide_s(self) -> float:
        """What a slide or a ramp is expected to take."""
        way_s = self.distance_mm / self.speed_mm_s + self.speed_mm_s / self.acceleration_mm_s2
        if self.loading == "slide":
            return way_s + SEEN_S
        slips_N = min(self.ramp_to_N, FRICTION * self.normal_force_N)
        on_mm = SLID_ON_mm if slips_N < self.ramp_to_N else 0.0
        return slips_N / self.ramp_N_s + min(on_mm / self.speed_mm_s, way_s) + SEEN_S

    @property
    def updates_a_tick(self) -> int:
        """See `PressedSettings`."""
        return 2 if self.loading == "ramp" else 1

    def rehearsed(self, tick_s: float, delay_s: float = DELAY_S) -> bool:
        """Whether a series begins with a slide that only teaches the servo."""
        if self.rehearsal != "auto":
            return self.rehearsal == "always"
        return self.speed_mm_s * (delay_s + tick_s) > UNREHEARSED_mm

    @property
    def along(self) -> int:
        """Sign of the slide."""
        return 1 if self.direction == "+x" else -1

    @property
    def end_mm(self) -> float:
        """Where the slide ends."""
        return self.start_mm + self.along * self.distance_mm


# --- what will be done ------------------------------------------------------------------------


def points(settings: Settings) -> tuple[Point, ...]:
    """One point a trial."""
    motion_s = settings.slide_s
    rehearsal_s = pressing_s(settings) + motion_s + AFTER_S
    first_s = rehearsal_s if settings.rehearsed(settings.tick_s) else 0.0
    moves = (
        Move("stage_x.position", settings.start_mm),
        Move("stage_x.position", settings.end_mm),
        Move("stage_x.speed", settings.speed_mm_s),
    )
    return trial_points(settings, moves, motion_s, first_s)


def overhead_s(settings: Settings, fixture: FixtureSettings, homed: bool) -> float:
    """Bench time that the ways in z, homing and parking are expected to take."""
    presses = settings.trials + settings.rehearsed(settings.tick_s)
    return pressed_overhead_s(
        settings, fixture, homed, presses, settings.start_mm, settings.distance_mm
    )


def check(settings: Settings, bench: Bench) -> None:
    """Refuse a fixture that does not say where contact has to be felt."""
    contact_range_mm(bench)


def summarise(settings: Settings, readings: Sequence[Reading]) -> Mapping[str, Any]:
    """Friction and servo, means of the trials that count and their standard deviations, how many
    count, and why trials have no friction coefficients."""
    names = (
        "static_friction",
        "kinetic_friction",
        "force_error_rms_percent",
        "force_error_peak_percent",
        "overshoot_percent",
    )
    found = summary_of(readings, names)
    reasons = [str(why) for r in readings if (why := r.get("no_friction"))]
    if reasons:
        found["no_friction"] = [
            f"{len(reasons)} of {len(readings)} trials give no friction coefficients: {reasons[0]}"
        ]
    return found


# --- doing it ---------------------------------------------------------------------------------


def import_ahead() -> None:
    """See `rig.run.procedure`."""
    import_what_a_trial_needs()
    import procedures.slip_trial.trial  # noqa: F401


def arm(run: Run) -> None:
    """Watch the force; have the end of everything known before it begins; park."""
    from procedures.pressed.rates import pace_on
    from procedures.pressed.trial import scales_on
    from procedures.slip_trial.trial import Series

    run.state = run.state or Series(pace_on(run), scales_on(run))
    x = run.bench.stage_x
    arm_pressed(run, "slide", x.stop, x.make_safe)


def take(run: Run, point: Point) -> Reading:
    """One trial: down, hold, rest, slide, up; then what it shows."""
    from procedures.slip_trial.trial import Series, Trial

    series: Series = run.state
    pace = series.pace
    if run.settings.rehearsed(pace.tick_s, pace.delay_s) and series.shift is None:
        Trial(run, int(point.condition), series).rehearse()
    trial = Trial(run, int(point.condition), series)
    trial.make_ready(run.settings.start_mm)
    trial.record()
    trial.press()
    trial.slide()
    trial.end_record()
    trial.lift()
    return trial.reading()
