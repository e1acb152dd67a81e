"""The common base of this project's procedures whose points are trials with a pressed skin.

A procedure of your own begins with `procedures.pressed.PressedProcedure`, which decides more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import TYPE_CHECKING, Any, ClassVar

from procedures.pressed.approach.contact import contact_range_mm
from procedures.pressed.approach.torque_limit import require_torque_limit
from procedures.pressed.approach.way_down import held_speed_bound, require_possible
from procedures.pressed.arming import arm_pressed
from procedures.pressed.grip_summary import grip_summary
from procedures.pressed.rates import ServoRates, rates_for, warn_of_slow_links
from procedures.pressed.record.layout import STREAMS
from procedures.pressed.settings import PressedSettings
from procedures.pressed.summary import SUMMARY_LABELS, TOUCH_DRIFT, summary_of, truth_of
from rig.core.units import counted
from rig.run.in_brief import DEVIATION, MEAN, single_values
from rig.run.points import Reading
from rig.run.procedure import DriftFigure, Procedure, StreamPlan

if TYPE_CHECKING:
    from procedures.pressed.series import PressedSeries
    from rig.analysis.trial.load_rate import LoadScale
    from rig.bench.connected import Bench
    from rig.run.context import Run


FIRST_SLIPS = 5
"""Slips whose times are shown in brief."""
DIGITS = 3
"""Significant digits of a value of a single trial, which has no error, in brief."""


class TrialProcedure(Procedure):
    """A procedure whose points are trials with the skin pressed on an object."""

    streams: ClassVar[tuple[StreamPlan, ...]] = STREAMS
    drift: ClassVar[Mapping[str, DriftFigure]] = TOUCH_DRIFT
    stated_in_title: ClassVar[str] = "normal_force_N"
    summary_labels: ClassVar[Mapping[str, str]] = SUMMARY_LABELS
    point_name = ("trial", "trials")
    method = (
        "Counts, and means and standard deviations over the valid trials; the error of a mean is "
        "that of the trials' scatter, of a single trial its own. Slips are those that the detector "
        "of the settings found during the trials, with the low-passed v_d (P_A) and the largest "
        "high-passed v_d (P_B) at the sample of its decision"
    )
    summary_keys: ClassVar[tuple[str, ...]] = (
        "force_error_rms_percent",
        "force_error_peak_percent",
    )
    """Keys of the reading whose mean and standard deviation the summary has."""
    not_in_brief: ClassVar[Set[str]] = frozenset(
        {
            *("trials", "valid_trials", "tick_Hz", "force_zero_N"),
            *("mean_touch_gain_1_dB", "mean_touch_gain_2_dB"),
        }
    )
    """Values of the summary that are no results of the run, or that another line contains; of a
    mean the standard deviation is left out with it."""

    put_in_label = "each point of the simulated contact"
    """The friction that is put in is that of each point; the whole contact begins to slide at a
    lower F_t/F_n, because its points slip one after another."""

    settings: PressedSettings
    _series: PressedSeries | None

    def __init__(self, settings: Any):
        super().__init__(settings)
        self._series = None
        """State that trials pass on to later ones; None before the first arming."""

    def import_ahead(self) -> None:
        """Import what a trial needs and try its detector, which takes a minute on the first use on
        a computer: never while something is switched on. Raises RigError for a detector that cannot
        be used."""
        import scipy.ndimage
        import scipy.special  # noqa: F401

        from procedures.pressed.record.detection import try_detector

        try_detector(self.settings.detector)

    def check(self, bench: Bench) -> None:
        """Refuse a fixture that does not state where contact has to be felt, and a contact so stiff
        that z cannot go down slowly enough."""
        contact_range_mm(bench)
        require_torque_limit(bench)
        settings = self.settings
        require_possible(bench, settings.largest_force_N, settings.largest_held_N)

    def why_invalid(self, reading: Reading) -> str:
        """Return why a trial is invalid; "" for a valid one."""
        return str(reading.get("invalid") or "")

    def retries_of_invalid(self) -> int:
        """Return the setting ``retry_invalid``."""
        return self.settings.retry_invalid

    def start_series(self, run: Run) -> None:
        """Make the series at the first arming; it lasts through holds and trips."""
        # Imported by import_ahead(), and not at the top: numpy would slow a command's `--help`.
        from procedures.pressed.record.detection import start_detection
        from procedures.pressed.series import load_scales_for

        if self._series is None:
            rates = rates_for(run.bench, self.settings)
            warn_of_slow_links(run, rates)
            settings = self.settings
            bound = held_speed_bound(run.bench, settings.largest_force_N, settings.normal_force_N)
            run.event("info", "servo", f"z follows the force at up to {bound.in_words()}")
            _say_what_is_not_measured(run)
            series = self.new_series(rates, load_scales_for(run))
            # Before anything is switched on: a detector of another package takes seconds to start.
            series.detection = start_detection(run)
            self._series = series
        self._series.way_is_clear = False  # during a hold something may have been put in the way

    def _arm_with_x(self, run: Run, what: str) -> None:
        """Arm a trial in which x moves under the held force; `what` names that motion. Whatever
        ends the run, x stops first, then z goes up."""
        self.start_series(run)
        assert self._series is not None, "start_series() has made it"
        x, tick_Hz = run.bench.stage_x, self._series.rates.tick_Hz
        arm_pressed(run, what, x.stop, x.make_safe, "x stage stopped", tick_Hz)

    def new_series(self, rates: ServoRates, scales: dict[str, LoadScale]) -> PressedSeries:
        """Return what the trials of a run share, before the first one."""
        from procedures.pressed.series import PressedSeries

        return PressedSeries(rates, scales)

    def summarise(self, readings: Sequence[Reading]) -> Mapping[str, Any]:
        """Return how many trials are valid, the means and standard deviations of the `summary_keys`
        over the valid ones, and what the grip did."""
        return summary_of(readings, self.summary_keys) | grip_summary(readings)

    def in_brief(self, summary: Mapping[str, Any], put_in: Mapping[str, Any]) -> Sequence[str]:
        """Return how many trials are valid and when slips were found, then the single values."""
        lines = []
        if "valid_trials" in summary:
            of = f"{summary['valid_trials']} of {counted(summary['trials'], *self.point_name)}"
            tick_Hz = summary.get("tick_Hz")
            lines.append(f"valid: {of}" + (f", {tick_Hz:g} ticks a second" if tick_Hz else ""))
        slips = summary.get("slips", {})
        found = list(zip(slips.get("trial", ()), slips.get("time_s", ()), strict=True))
        if found:
            first = ", ".join(f"{time_s:.3f} s" for _, time_s in found[:FIRST_SLIPS])
            more = f" and {len(found) - FIRST_SLIPS} more" if len(found) > FIRST_SLIPS else ""
            lines.append(f"alarms of incipient slip during the trials at {first}{more}")
        left_out = self.not_in_brief | {
            name.replace(MEAN, DEVIATION, 1) for name in self.not_in_brief if name.startswith(MEAN)
        }
        others = {name: one for name, one in summary.items() if name not in left_out}
        values = single_values(
            others, put_in, self.summary_labels, self.put_in_label,
            digits=DIGITS, of_one_trial=summary.get("valid_trials") == 1,
        )  # fmt: skip
        return [*lines, *values]

    def put_in(self, readings: Sequence[Reading], summary: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the friction of the simulated skin, with what was recovered of it."""
        known = truth_of(readings)
        return {
            name: known[there]
            for name, there in (
                ("mean_static_friction", "static_coefficient"),
                ("mean_kinetic_friction", "kinetic_coefficient"),
            )
            if name in summary and there in known
        }


def _say_what_is_not_measured(run: Run) -> None:
    """Report forces along axes that the sensor lacks; the file has no numbers for them."""
    # As in start_series().
    from rig.instruments.roles import axes_of

    sensor, names = run.bench.force_sensor, {"x": "F_t", "y": "F_y"}
    there = axes_of(sensor)
    missing = [name for axis, name in names.items() if axis not in there]
    if missing:
        run.event(
            "warning",
            "force-axes",
            f"the force sensor {sensor.identity.model} measures {' and '.join(there)} only: "
            f"{' and '.join(missing)} are not measured and have no numbers (NaN) in the file",
        )
