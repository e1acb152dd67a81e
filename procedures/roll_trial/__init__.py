"""Roll a spherical head over the skin and back at constant normal force (paper 5).

The object stands on the rotary stage, the rotary stage on the force sensor; the skin hangs on the
x-z stage above it. A trial lowers the skin until the head is felt, brings the normal force up and
holds it by a servo on z, rests, and turns the object from upright to an angle and back, so that the
head rolls along the skin. The start position decides between the two patterns of Figure 19.

The head rolls without sliding only if the rotary axis passes through the point of contact. An axis
at height h above it drags the skin by h times the angle; a first press measures h, and x
compensates for it while the object turns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from procedures.pressed.arming import arm_pressed
from procedures.pressed.points import (
    pressed_overhead_s,
    pressing_s,
    refuse_below_contact,
    trial_points,
)
from procedures.pressed.trial_procedure import TrialProcedure
from procedures.roll_trial import layout as roll_layout
from procedures.roll_trial.settings import (
    HOMING_ROTARY_S,
    NUDGED_S,
    NUDGES,
    SETTLED_S,
    NUDGE_deg,
    NUDGE_mm,
    RollTrialSettings,
    TURN_deg_s,
)
from rig.bench.limits import require
from rig.bench.settings import FixtureSettings
from rig.core.errors import ConfigurationError, LimitError
from rig.run.points import Move, Point, Reading, as_option, remedy

if TYPE_CHECKING:
    from procedures.pressed.rates import ServoRates
    from procedures.roll_trial.trial import RollSeries
    from rig.analysis.trial.load_rate import LoadScale
    from rig.bench.connected import Bench
    from rig.run.context import Run


SLIP_PEAK_mV = 16.0
"""Peak of v_d above 100 Hz when ridge 3 of the reference skin slips as a whole: computed by the
model with its assumed friction (decision 0020), not measured."""


class RollTrial(TrialProcedure):
    """Roll a spherical head over the skin and back at constant normal force (paper 5)."""

    name = "roll-trial"
    fixtures = ("semi-spherical-object",)
    force_axes = "xz"
    Settings = RollTrialSettings
    layout = roll_layout.LAYOUT
    streams = roll_layout.STREAMS
    summary_keys = (
        "peak_1_mV",
        "peak_2_mV",
        "high_roll_rms_mV",
        "high_rest_rms_mV",
        "largest_tangential_N",
        "angle_error_deg",
        "force_error_rms_percent",
        "force_error_peak_percent",
    )

    summary_labels = MappingProxyType(
        {
            **TrialProcedure.summary_labels,
            "mean_peak_1_mV": "strip 1, peak in the roll",
            "mean_peak_2_mV": "strip 2, peak in the roll",
            "mean_largest_tangential_N": "largest tangential force",
            "mean_angle_error_deg": "error of the angle at rest",
            "mean_high_roll_rms_mV": "v_d above 100 Hz in the roll, rms, mean",
            "mean_high_rest_rms_mV": "v_d above 100 Hz at rest, rms, mean",
        }
    )
    not_in_brief = TrialProcedure.not_in_brief | {
        *("mean_high_roll_rms_mV", "mean_high_rest_rms_mV", "axis_offset_mm"),
        *("axis_offset_error_mm", "simulated_ridge_lifted"),
    }

    settings: RollTrialSettings
    _series: RollSeries | None

    # --- planning -------------------------------------------------------------------------------

    def import_ahead(self) -> None:
        """Import what a trial needs: never while something is switched on."""
        super().import_ahead()
        import procedures.roll_trial.trial  # noqa: F401 - with numpy: not for `--help`

    def points(self) -> tuple[Point, ...]:
        """Return one point per trial."""
        settings = self.settings
        tick_Hz = 1 / settings.tick_s  # at most: the links of the stages are not known here
        motion_s = settings.profile_at(tick_Hz).duration_s + SETTLED_S
        aligned = settings.alignment != "none"
        first_s = pressing_s(settings) + 2 * len(NUDGES) * NUDGED_S if aligned else 0.0
        moves = (
            Move("rotary.speed", settings.turn_speed_at_deg_s(tick_Hz), ("turn_speed_deg_s",)),
            Move(
                "rotary.acceleration",
                settings.turn_acceleration_deg_s2,
                ("turn_acceleration_deg_s2",),
            ),
        )
        refuse_below_contact(self.name, settings.normal_force_N)
        return trial_points(settings, moves, motion_s, first_s)

    def overhead_s(self, fixture: FixtureSettings, homed: bool) -> float:
        """Return the expected bench time of the travel in z, homing and parking, in s."""
        settings = self.settings
        presses = settings.trials + (settings.alignment != "none")
        x_mm = (fixture.centre_mm or 0.0) + settings.start_mm
        rotary_s = 0.0 if homed else HOMING_ROTARY_S
        return rotary_s + pressed_overhead_s(settings, fixture, homed, presses, x_mm)

    def check(self, bench: Bench) -> None:
        """Refuse a fixture that does not state where the object is, or a roll beyond a stage's
        limits.

        Raises ConfigurationError for the fixture, LimitError for the roll.
        """
        super().check(bench)
        fixture, settings = bench.settings.fixture, self.settings
        if fixture.centre_mm is None or fixture.upright_deg is None:
            raise ConfigurationError(
                f"{bench.plan.source}: [fixture] does not state where the object stands",
                "add centre_mm, position of x at which the middle of the skin is above it, and "
                "upright_deg, angle of the rotary stage at which it stands upright",
            )
        self._require_on_the_skin(bench)
        curve = bool(settings.profile_times_s)
        angle = "profile_angles_deg" if curve else "angle_deg"
        for angle_deg in settings.angles_deg:
            self._require(
                bench,
                "rotary.angle",
                fixture.upright_deg + angle_deg,
                f"{as_option(settings, angle)} puts the object at",
                f"{fixture.upright_deg:g} deg upright {angle_deg:+g} deg",
            )
        self._require(
            bench,
            "stage_x.position",
            fixture.centre_mm + settings.start_mm,
            f"{as_option(settings, 'start_mm')} puts the skin at",
            f"{fixture.centre_mm:g} mm in the middle {settings.start_mm:+g} mm",
        )
        if curve:
            turns = settings.profile_at(1 / settings.tick_s).turns(settings.tick_s)
            fastest = max((turn.speed_deg_s for turn in turns), default=0.0)
            named = f"{as_option(settings, 'profile_times_s')} with {as_option(settings, angle)}"
            self._require(bench, "rotary.speed", fastest, f"{named} turns at", "its fastest part")
        if settings.alignment != "none":
            self._require_nudges(bench, fixture.centre_mm + settings.start_mm, fixture.upright_deg)

    def _require_nudges(self, bench: Bench, start_mm: float, upright_deg: float) -> None:
        """Raise LimitError where the nudges that measure the axis would leave the limits of a
        stage, which would be found only with the skin pressed."""
        alignment = as_option(self.settings, "alignment")
        for way in (-1, 1):
            self._require(
                bench,
                "stage_x.position",
                start_mm + way * NUDGE_mm,
                f"{alignment} nudges x to",
                f"{start_mm:g} mm, where the roll begins, {way * NUDGE_mm:+g} mm",
            )
            self._require(
                bench,
                "rotary.angle",
                upright_deg + way * NUDGE_deg,
                f"{alignment} nudges the object to",
                f"{upright_deg:g} deg upright {way * NUDGE_deg:+g} deg",
            )

    def _require_on_the_skin(self, bench: Bench) -> None:
        """Raise LimitError where the roll would begin beside the ridges: z would go down to the end
        of the contact range before the approach finds that nothing is there, or press the object
        on the skin's edge."""
        half_mm = bench.skin.ridges_extent_mm / 2
        if abs(self.settings.start_mm) > half_mm:
            raise LimitError(
                f"{as_option(self.settings, 'start_mm')} from the middle is beside the ridges of "
                f"the skin, which extend from {-half_mm:g} to {half_mm:g} mm ([skin] "
                f"ridges_extent_mm = {bench.skin.ridges_extent_mm:g} mm)",
                f"choose a start between {-half_mm:g} and {half_mm:g} mm, or correct "
                "ridges_extent_mm in the bench file",
            )

    def _require(
        self, bench: Bench, quantity: str, value: float, given: str, reckoned: str
    ) -> None:
        """Raise LimitError unless the bench can reach a value. The message says what was `given`
        and how the value was `reckoned` from it."""
        limits = bench.limits()[quantity]
        try:
            require(quantity.replace(".", " "), value, limits)
        except LimitError as error:
            raise LimitError(
                f"{given} {value:g} {limits.unit} ({reckoned}); the {limits.limited_by} allows "
                f"{limits.low:g} to {limits.high:g} {limits.unit}",
                remedy(error, bench),
            ) from None

    # --- doing it -------------------------------------------------------------------------------

    def arm(self, run: Run) -> None:
        """Watch the force; register the end of everything before it begins; park, then find the
        object's reference, the skin being clear of it."""
        self.start_series(run)
        assert self._series is not None
        tick_Hz = self._series.rates.tick_Hz
        speed_deg_s = self.settings.turn_speed_at_deg_s(tick_Hz)
        if self.settings.turn_speed_deg_s is None and speed_deg_s < TURN_deg_s:
            run.event(
                "warning",
                "turn-speed",
                f"the object is turned at {speed_deg_s:.3g} deg/s and not at {TURN_deg_s:g} deg/s, "
                f"since the servo holds the force at {tick_Hz:.3g} Hz; --turn-speed sets another",
            )
        if self.settings.alignment == "none":
            run.event("warning", "alignment", "the offset of the rotary axis is not known")
        rotary, x = run.bench.rotary, run.bench.stage_x
        run.arm("x", x.stop, emergency=x.make_safe, done="x stage stopped")
        stopped = "rotary stage stopped"
        arm_pressed(run, "roll", lambda: _stand(run), rotary.make_safe, stopped, tick_Hz)
        if not rotary.homed():  # Now, while the skin is clear of the object.
            rotary.home()

    def new_series(self, rates: ServoRates, scales: dict[str, LoadScale]) -> RollSeries:
        """Return what the trials share: the offset of the rotary axis."""
        # Imported by import_ahead(), and not at the top: numpy would slow a command's `--help`.
        from procedures.roll_trial.trial import RollSeries

        return RollSeries(rates, scales)

    def take(self, run: Run, point: Point) -> Reading:
        """Take one trial: down, hold, rest, roll there and back, up; then its results. Before the
        first one the axis is measured."""
        # As in new_series().
        from procedures.roll_trial.trial import AlignmentTrial, RollTrialRun

        series = self._series
        assert series is not None, "arm() comes first"
        if self.settings.alignment != "none" and series.offset is None:
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

    # --- afterwards -----------------------------------------------------------------------------

    def summarise(self, readings: Sequence[Reading]) -> Mapping[str, Any]:
        """Return means of patterns, forces and angle over the valid trials, how many are valid,
        and how the roll's high frequencies compare with the noise and with a slip."""
        found = dict(super().summarise(readings))
        roll_mV, rest_mV = (found.get(f"mean_high_{part}_rms_mV") for part in ("roll", "rest"))
        if roll_mV is not None and rest_mV is not None:
            found["high_frequencies"] = [_compared(roll_mV, rest_mV)]
        if readings:
            found["axis_offset_mm"] = readings[-1].get("axis_offset_mm")
            found["axis_offset_error_mm"] = readings[-1].get("axis_offset_error_mm")
        lifted = [r["ridge_lifted"] for r in readings if r.get("ridge_lifted") is not None]
        if lifted:
            found["simulated_ridge_lifted"] = int(sum(float(v or 0) for v in lifted))
        return found


def _stand(run: Run) -> None:
    """Stop the object, then x, even if stopping the object fails."""
    try:
        run.bench.rotary.stop()
    finally:
        run.bench.stage_x.stop()


def _compared(roll_mV: float, rest_mV: float) -> str:
    """Return v_d above 100 Hz in the roll, with what it has at rest and in a slip, in words."""
    return (
        f"v_d above 100 Hz: measured {roll_mV:.3g} mV rms in the roll and {rest_mV:.3g} mV at rest;"
        f" a slip of the whole ridge has a peak of about {SLIP_PEAK_mV:g} mV there (computed with "
        "the reference skin, whose friction is ASSUMED)."
    )
