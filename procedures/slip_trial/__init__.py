"""Slide the artificial skin on a plate at constant normal force (paper 4.1).

The skin hangs on the x-z stage above the plate, the plate lies on the force sensor. A trial lowers
the skin until the plate is felt, brings the normal force up and holds it by a servo on z, rests,
slides along x, and lifts off. The strips are sampled without gaps all the time: lost samples end
the trial.

Every tick reads the new data of force sensor and DAQ, records them, and moves z as the force servo
requires. Whatever ends a trial, x stops first, then z goes up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from procedures.pressed.points import (
    pressed_overhead_s,
    pressing_s,
    refuse_below_contact,
    trial_points,
)
from procedures.pressed.settings import AFTER_S
from procedures.pressed.trial_procedure import TrialProcedure
from procedures.slip_trial import layout as slip_layout
from procedures.slip_trial.settings import SlipTrialSettings
from rig.bench.settings import FixtureSettings
from rig.core.units import counted
from rig.run.points import Move, Point, Reading

if TYPE_CHECKING:
    from procedures.pressed.rates import ServoRates
    from procedures.slip_trial.trial import SlipSeries
    from rig.analysis.trial.load_rate import LoadScale
    from rig.run.context import Run


class SlipTrial(TrialProcedure):
    """Slide the artificial skin on a plate at constant normal force (paper 4.1)."""

    name = "slip-trial"
    fixtures = ("plate",)
    force_axes = "xz"
    Settings = SlipTrialSettings
    layout = slip_layout.LAYOUT
    summary_keys = (
        "static_friction",
        "kinetic_friction",
        "force_error_rms_percent",
        "force_error_peak_percent",
        "overshoot_percent",
    )
    summary_labels = MappingProxyType(
        {
            **TrialProcedure.summary_labels,
            "mean_overshoot_percent": "overshoot of the normal force",
        }
    )

    settings: SlipTrialSettings
    _series: SlipSeries | None

    # --- planning -------------------------------------------------------------------------------

    def import_ahead(self) -> None:
        """Import what a trial needs: never while something is switched on."""
        super().import_ahead()
        import procedures.slip_trial.trial  # noqa: F401 - with numpy: not for `--help`

    def points(self) -> tuple[Point, ...]:
        """Return one point per trial."""
        settings = self.settings
        motion_s = settings.slide_s
        rehearsal_s = pressing_s(settings) + motion_s + AFTER_S
        first_s = rehearsal_s if settings.rehearsed(settings.tick_s) else 0.0
        moves = (
            Move("stage_x.position", settings.start_mm, ("start_mm",)),
            Move("stage_x.position", settings.end_mm, ("start_mm", "distance_mm", "direction")),
            Move("stage_x.speed", settings.speed_mm_s, ("speed_mm_s",)),
        )
        refuse_below_contact(self.name, settings.normal_force_N)
        return trial_points(settings, moves, motion_s, first_s)

    def overhead_s(self, fixture: FixtureSettings, homed: bool) -> float:
        """Return the expected bench time of the travel in z, homing and parking, in s."""
        settings = self.settings
        presses = settings.trials + settings.rehearsed(settings.tick_s)
        return pressed_overhead_s(
            settings, fixture, homed, presses, settings.start_mm, settings.distance_mm
        )

    # --- doing it -------------------------------------------------------------------------------

    def arm(self, run: Run) -> None:
        """Watch the force; register the end of everything before it begins; park."""
        self._arm_with_x(run, "slide")

    def new_series(self, rates: ServoRates, scales: dict[str, LoadScale]) -> SlipSeries:
        """Return what the trials share: the first slide teaches the servo."""
        # Imported by import_ahead(), and not at the top: numpy would slow a command's `--help`.
        from procedures.slip_trial.trial import SlipSeries

        return SlipSeries(rates, scales)

    def take(self, run: Run, point: Point) -> Reading:
        """Take one trial: down, hold, rest, slide, up; then its results."""
        # As in new_series().
        from procedures.slip_trial.trial import SlipTrialRun

        series = self._series
        assert series is not None, "arm() comes first"
        trial = SlipTrialRun(run, int(point.condition), series)
        if trial.needs_rehearsal:
            trial.rehearse()
            trial = SlipTrialRun(run, int(point.condition), series)
        trial.make_ready(self.settings.start_mm)
        trial.start_recording()
        with trial.longer_blocks_if_too_slow():
            trial.press()
            trial.slide()
            trial.stop_recording()
        trial.lift()
        return trial.reading()

    # --- afterwards -----------------------------------------------------------------------------

    def summarise(self, readings: Sequence[Reading]) -> Mapping[str, Any]:
        """Return the summary of the series, friction and servo: means and standard deviations of
        the valid trials, how many are valid, and why trials have no friction coefficients."""
        found = dict(super().summarise(readings))
        reasons = [str(why) for r in readings if (why := r.get("no_friction"))]
        if reasons:
            found["no_friction"] = [
                f"no friction coefficients in {len(reasons)} of "
                f"{counted(len(readings), 'trial')}: {reasons[0]}"
            ]
        return found
