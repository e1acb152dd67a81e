"""Roll of an object with a head over the artificial skin at constant normal force: paper 5.

The object stands on the rotary stage, the rotary stage on the force sensor; the skin hangs on the
x-z stage above it. A trial goes down until the head is felt, brings the normal force up and holds
it by a servo on z, rests, and turns the object from upright to an angle and back: the head rolls
along the skin. Where it begins decides between the two patterns of Figure 19.

It rolls purely only if the rotary axis lies where the head touches. An axis h above that drags the
skin by h times the angle; a first press measures h, and x takes it back while the object turns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from procedures.pressed.contact import contact_range_mm
from procedures.pressed.settings import (
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
from procedures.roll_trial import layout as roll_layout
from procedures.roll_trial.profile import Curve, Profile, ThereAndBack
from rig.bench.bench import Fixture, FixtureSettings
from rig.core.errors import ConfigurationError
from rig.run.points import Move, Point, Reading

if TYPE_CHECKING:
    from rig.bench.bench import Bench
    from rig.run.context import Run

NAME = "roll-trial"
FIXTURES: tuple[Fixture, ...] = ("semi-spherical-object",)
LAYOUT = roll_layout.LAYOUT
STREAMS = roll_layout.STREAMS
invalid = why_invalid
DRIFT = TOUCH_DRIFT

NUDGES = (0, 1, 0, -1, 0)
NUDGED_S = 0.35
"""For a nudge, which measures the axis, and until the rubber is at rest."""
SETTLED_S = 0.05
"""What a stage may be late at the end of its profile."""
HOMING_ROTARY_S = 1.0
"""Expected of a rotary stage without a reference, and of bringing the object upright."""


class Settings(PressedSettings):
    """What a roll trial may be asked for."""

    angle_deg: float = 3.5
    """Angle that is rolled from upright and back (paper 5); positive rolls towards +x."""
    turn_speed_deg_s: float = Field(default=12.0, gt=0)
    """Largest speed of the turn."""
    turn_acceleration_deg_s2: float = Field(default=60.0, gt=0)
    """Of the turn."""
    stay_s: float = Field(default=0.3, ge=0, le=60)
    """Stay at the angle, before the way back."""
    profile_times_s: tuple[float, ...] = ()
    """Times of a curve of angles that is rolled instead, from 0."""
    profile_angles_deg: tuple[float, ...] = ()
    """Its angles, from 0 back to 0."""
    start_mm: float = -5.0
    """Place on the skin, from its middle, at which the roll begins: -5 mm rolls over the third
    ridge (Figure 19 b), -6.5 mm up to it (19 a)."""
    alignment: Literal["compensate", "measure", "none"] = "compensate"
    """Before the first trial: measure how far the rotary axis is off and have x take it back; only
    measure it; or neither."""
    largest_offset_mm: float = Field(default=1.0, gt=0)
    """Offset of the axis, as measured, that is left uncompensated and refused: 2 mm drag the skin
    by half of what makes it slip."""
    angle_error_deg: float = Field(default=0.02, gt=0)
    """Error of the angle at the ends of the roll beyond which a trial does not count."""
    force_error_rms_percent: float = Field(default=3.0, gt=0)
    """Error of the normal force during the roll, rms, beyond which a trial does not count."""
    force_error_peak_percent: float = Field(default=10.0, gt=0)
    """Its largest error beyond which a trial does not count."""

    @model_validator(mode="after")
    def _can_be_rolled(self) -> Settings:
        times, angles = self.profile_times_s, self.profile_angles_deg
        if len(times) != len(angles):
            raise ValueError(
                f"profile_times_s has {len(times)} values, profile_angles_deg has {len(angles)}: "
                "each time needs its angle"
            )
        if times and (len(times) < 3 or times[0] != 0 or sorted(set(times)) != list(times)):
            raise ValueError("profile_times_s has to ascend from 0 and to hold at least 3 times")
        if angles and (angles[0] != 0 or angles[-1] != 0):
            raise ValueError("profile_angles_deg has to begin and to end with 0 deg, upright")
        return self

    @property
    def profile(self) -> Profile:
        """What is rolled."""
        if self.profile_times_s:
            own = (self.profile_times_s, self.profile_angles_deg)
            return Curve(*own, acceleration_deg_s2=self.turn_acceleration_deg_s2)
        return ThereAndBack(
            self.angle_deg, self.turn_speed_deg_s, self.turn_acceleration_deg_s2, self.stay_s
        )

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Between which it is rolled."""
        angles = self.profile_angles_deg or (0.0, self.angle_deg)
        return min(angles), max(angles)

    @property
    def updates_a_tick(self) -> int:
        """See `PressedSettings`: x may follow the turn."""
        return 2 if self.alignment == "compensate" else 1


# --- what will be done ------------------------------------------------------------------------


def points(settings: Settings) -> tuple[Point, ...]:
    """One point a trial."""
    motion_s = settings.profile.duration_s + SETTLED_S
    aligned = settings.alignment != "none"
    first_s = pressing_s(settings) + 2 * len(NUDGES) * NUDGED_S if aligned else 0.0
    moves = (
        Move("rotary.speed", settings.turn_speed_deg_s),
        Move("rotary.acceleration", settings.turn_acceleration_deg_s2),
    )
    return trial_points(settings, moves, motion_s, first_s)


def overhead_s(settings: Settings, fixture: FixtureSettings, homed: bool) -> float:
    """Bench time that the ways in z, homing and parking are expected to take."""
    presses = settings.trials + (settings.alignment != "none")
    x_mm = (fixture.centre_mm or 0.0) + settings.start_mm
    rotary_s = 0.0 if homed else HOMING_ROTARY_S
    return rotary_s + pressed_overhead_s(settings, fixture, homed, presses, x_mm)


def summarise(settings: Settings, readings: Sequence[Reading]) -> Mapping[str, Any]:
    """Patterns, forces and angle, means of the trials that count, and how many count."""
    names = (
        "peak_1_mV",
        "peak_2_mV",
        "above_100_Hz_percent",
        "largest_tangential_N",
        "angle_error_deg",
        "force_error_rms_percent",
        "force_error_peak_percent",
    )
    found = summary_of(readings, names)
    if readings:
        found["axis_offset_mm"] = readings[-1]["axis_offset_mm"]
        found["axis_offset_error_mm"] = readings[-1]["axis_offset_error_mm"]
    lifted = [r["ridge_lifted"] for r in readings if r.get("ridge_lifted") is not None]
    if lifted:
        found["simulated_ridge_lifted"] = int(sum(float(v or 0) for v in lifted))
    return found


def check(settings: Settings, bench: Bench) -> None:
    """Refuse a fixture that does not say where the object is, or a roll beyond a stage's limits."""
    from rig.bench.bench import require

    contact_range_mm(bench)
    fixture = bench.settings.fixture
    if fixture.centre_mm is None or fixture.upright_deg is None:
        raise ConfigurationError(
            f"{bench.plan.source}: [fixture] does not say where the object stands",
            "add centre_mm, position of x at which the middle of the skin is above it, and "
            "upright_deg, angle of the rotary stage at which it stands upright",
        )
    reach = bench.rotary.reach()
    for angle_deg in settings.angles_deg:
        require("angle of the roll", fixture.upright_deg + angle_deg, reach["angle"])
    start_mm = fixture.centre_mm + settings.start_mm
    require("start of the roll", start_mm, bench.stage_x.reach()["position"])
    if settings.profile_times_s:
        turns = settings.profile.turns(settings.tick_s)
        fastest = max((turn.speed_deg_s for turn in turns), default=0.0)
        require("speed of the profile", fastest, reach["speed"])


# --- doing it ---------------------------------------------------------------------------------


def import_ahead() -> None:
    """See `rig.run.procedure`."""
    import_what_a_trial_needs()
    import procedures.roll_trial.trial  # noqa: F401


def arm(run: Run) -> None:
    """Watch the force; have the end of everything known before it begins; park, then find the
    object's reference, the skin being clear of it."""
    from procedures.pressed.rates import pace_on
    from procedures.pressed.trial import scales_on
    from procedures.roll_trial.trial import Series

    run.state = run.state or Series(pace_on(run), scales_on(run))
    if run.settings.alignment == "none":
        run.event("warning", "alignment", "how far the rotary axis is off is not known")
    rotary, x = run.bench.rotary, run.bench.stage_x
    run.arm("x", x.stop, at_once=x.make_safe)
    arm_pressed(run, "roll", lambda: _stand(run), rotary.make_safe)
    if not rotary.homed():  # the skin is clear of the object
        rotary.home()


def _stand(run: Run) -> None:
    """Stop the object, and x whatever comes of that."""
    try:
        run.bench.rotary.stop()
    finally:
        run.bench.stage_x.stop()


def take(run: Run, point: Point) -> Reading:
    """One trial: down, hold, rest, roll there and back, up; then what it shows. Before the first
    the axis is measured."""
    from procedures.roll_trial.trial import AlignTrial, Series, Trial

    series: Series = run.state
    if run.settings.alignment != "none" and series.offset is None:
        series.offset = AlignTrial(run, series).measure()
    trial = Trial(run, int(point.condition), series)
    trial.make_ready()
    trial.record()
    trial.press()
    trial.roll()
    trial.end_record()
    trial.lift()
    return trial.reading()
