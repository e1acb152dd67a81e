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
from typing import TYPE_CHECKING, Any

from procedures.pressed.contact import contact_range_mm
from procedures.pressed.rates import rates_for, warn_of_slow_links
from procedures.pressed.settings import (
    TOUCH_DRIFT,
    arm_pressed,
    import_what_a_trial_needs,
    pressed_overhead_s,
    pressing_s,
    summary_of,
    trial_points,
    why_invalid,
)
from procedures.roll_trial import layout as roll_layout
from procedures.roll_trial.settings import (
    HOMING_ROTARY_S,
    NUDGED_S,
    NUDGES,
    SETTLED_S,
    RollTrialSettings,
)
from rig.bench.bench import Fixture, FixtureSettings, require
from rig.core.errors import ConfigurationError
from rig.run.points import Move, Point, Reading

if TYPE_CHECKING:
    from rig.bench.bench import Bench
    from rig.run.context import Run

NAME = "roll-trial"
FIXTURES: tuple[Fixture, ...] = ("semi-spherical-object",)
FIGURE = "roll_trial"
LAYOUT = roll_layout.LAYOUT
STREAMS = roll_layout.STREAMS
invalid = why_invalid
DRIFT = TOUCH_DRIFT

Settings = RollTrialSettings


# --- what will be done ------------------------------------------------------------------------


def points(settings: RollTrialSettings) -> tuple[Point, ...]:
    """One point a trial."""
    motion_s = settings.profile.duration_s + SETTLED_S
    aligned = settings.alignment != "none"
    first_s = pressing_s(settings) + 2 * len(NUDGES) * NUDGED_S if aligned else 0.0
    moves = (
        Move("rotary.speed", settings.turn_speed_deg_s),
        Move("rotary.acceleration", settings.turn_acceleration_deg_s2),
    )
    return trial_points(settings, moves, motion_s, first_s)


def overhead_s(settings: RollTrialSettings, fixture: FixtureSettings, homed: bool) -> float:
    """Bench time that the ways in z, homing and parking are expected to take."""
    presses = settings.trials + (settings.alignment != "none")
    x_mm = (fixture.centre_mm or 0.0) + settings.start_mm
    rotary_s = 0.0 if homed else HOMING_ROTARY_S
    return rotary_s + pressed_overhead_s(settings, fixture, homed, presses, x_mm)


def summarise(settings: RollTrialSettings, readings: Sequence[Reading]) -> Mapping[str, Any]:
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


def check(settings: RollTrialSettings, bench: Bench) -> None:
    """Refuse a fixture that does not say where the object is, or a roll beyond a stage's limits."""
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
    import procedures.roll_trial.trial  # noqa: F401 - with numpy: not for `rig --help`


def arm(run: Run) -> None:
    """Watch the force; have the end of everything known before it begins; park, then find the
    object's reference, the skin being clear of it."""
    # Imported by import_ahead(), and not at the top: numpy would slow `rig --help`.
    from procedures.pressed.series import load_scales_for
    from procedures.roll_trial.trial import RollSeries

    if run.state is None:
        rates = rates_for(run.bench, run.settings)
        warn_of_slow_links(run, rates)
        run.state = RollSeries(rates, load_scales_for(run))
    if run.settings.alignment == "none":
        run.event("warning", "alignment", "how far the rotary axis is off is not known")
    rotary, x = run.bench.rotary, run.bench.stage_x
    run.arm("x", x.stop, at_once=x.make_safe)
    tick_Hz = run.state.rates.tick_Hz
    arm_pressed(run, "roll", lambda: _stand(run), rotary.make_safe, tick_Hz)
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
    # As in arm().
    from procedures.roll_trial.trial import AlignmentTrial, RollSeries, RollTrialRun

    series: RollSeries = run.state
    if run.settings.alignment != "none" and series.offset is None:
        series.offset = AlignmentTrial(run, series).measure()
    trial = RollTrialRun(run, int(point.condition), series)
    trial.bring_upright()
    trial.make_ready(trial.start_mm)
    trial.start_recording()
    trial.press()
    trial.roll()
    trial.stop_recording()
    trial.lift()
    return trial.reading()
