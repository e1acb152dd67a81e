"""Common parts of the figures of trials with the skin pressed on an object."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.analysis.trial.force_error import averaged, judged
from rig.figures.circumstances import circumstances
from rig.figures.slip_instants import Detections, detections_of
from rig.figures.style import BLACK, BLUE, GREY, ORANGE, SKY, VERMILLION, set_heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rig.files.runfile.reader import RunFile, Waveform

TRIALS_SHOWN = 20
"""Largest number of trials with a figure; the file contains all trials."""
BEFORE_S = 0.3
"""Time shown before the contact; the file contains all of the record."""
MARGIN = 0.08
"""Room above and below what an axis is scaled to, as a share of its span."""
UNJUDGED = "#999999"
"""Colour of what is shown and not judged: lighter than `GREY`, which the limits have."""
LEAST_FORCE = 0.1
"""Fraction of the normal force from which the object is considered touched."""


def a_figure_a_trial(
    run: RunFile, draw: Callable[[RunFile, int, str, Detections], Figure]
) -> dict[str, Figure]:
    """Draw the first `TRIALS_SHOWN` trials of a run with `draw`, which gets the file, the number of
    the trial, its point and what a detector found in it. Return the figures by the ending that
    their files add to the run's name, which is empty for the first."""
    points = run.point_ids()[:TRIALS_SHOWN]
    found = detections_of(run)
    return {
        "" if number == 0 else f"-{point}": draw(run, number, point, found.get(point, Detections()))
        for number, point in enumerate(points)
    }


def seconds(waveform: Waveform) -> NDArray[np.float64]:
    """Return the times of the rows of an equally spaced record, in s since its start, (n,)."""
    first = next(iter(waveform.counts.values()))
    return np.arange(len(first)) / (waveform.rate_Hz or 1.0)


def squeezes_of(run: RunFile, number: int) -> list[dict[str, Any]]:
    """Return the steps by which a grip raised the normal force in a trial, in order; none in files
    from before there was a grip."""
    if "squeeze_record" not in run.columns():
        return []
    found: list[dict[str, Any]] = json.loads(str(run.column("squeeze_record")[number]) or "[]")
    return found


def set_points_N(  # noqa: N802 - the unit keeps its capital
    run: RunFile, number: int, t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the set point of the normal force in N at the times `t` (n,) in s of the record."""
    wanted = np.full(t.shape, float(run.column("set_normal_force")[number]))
    for one in squeezes_of(run, number):
        wanted[t >= one["decided_s"]] = one["to_N"]
    return wanted


def shade(panels: Iterable[Axes], begin_s: float, end_s: float, what: str) -> None:
    """Shade the time of the motion in every panel, with a label in the first."""
    for number, axes in enumerate(panels):
        label = None if number else what
        axes.axvspan(begin_s, end_s, color=GREY, alpha=0.12, linewidth=0, label=label)


def draw_strips(axes: Axes, t: NDArray[np.float64], signals: Waveform) -> None:
    """Draw the signals of both strips in mV over the times `t`."""
    for colour, name in ((ORANGE, "v_1"), (SKY, "v_2")):
        axes.plot(t, 1e3 * signals.values(name), linewidth=0.6, color=colour, label=f"${name}$")
    axes.set_ylabel("Strips (mV)")


def draw_difference(axes: Axes, t: NDArray[np.float64], signals: Waveform) -> None:
    """Draw v_d in mV over the times `t`."""
    label = "$v_d = v_1 - v_2$"
    axes.plot(t, 1e3 * signals.values("v_d"), linewidth=0.7, color=BLUE, label=label)
    axes.set_ylabel("$v_d$ (mV)")


def draw_forces(axes: Axes, t: NDArray[np.float64], force: Waveform) -> None:
    """Draw the normal and the tangential force over the times `t`."""
    for colour, name in ((BLUE, "F_n"), (VERMILLION, "F_t")):
        axes.plot(t, force.values(name), color=colour, label=f"${name}$")
    axes.set_ylabel("Force (N)")


def draw_force_error(
    axes: Axes, run: RunFile, number: int, force: Waveform, motion_s: tuple[float, float]
) -> None:
    """Draw the error of the normal force in the motion as the trial is judged by it: of the mean
    over 5 ms, with what follows a squeeze in grey because it is not judged; and the rms error above
    which a trial is invalid."""
    t = seconds(force)
    mean_N = averaged(force.values("F_n"), force.rate_Hz or 1.0)
    error = 100 * (mean_N / set_points_N(run, number, t) - 1)
    moving = judged(t, motion_s, [])
    counted = judged(t, motion_s, [one["decided_s"] for one in squeezes_of(run, number)])
    if (moving & ~counted).any():
        axes.plot(
            t[moving], error[moving], linewidth=0.6, color=UNJUDGED, label="squeeze, not judged"
        )
    axes.plot(t, np.where(counted, error, np.nan), linewidth=0.6, color=BLACK)
    axes.set_ylabel("$F_n$ error (%)")
    allowed = float(run.settings.get("force_error_rms_percent", 0.0))
    if allowed:
        # Lines, not a band: the limit is on the rms, the curve shows the error at each time.
        label = f"validity limit: rms ≤ {allowed:g} %"
        axes.axhline(allowed, color=GREY, linewidth=0.8, linestyle=":", label=label)
        axes.axhline(-allowed, color=GREY, linewidth=0.8, linestyle=":")


def scale_to(axes: Axes, values: Iterable[NDArray[np.float64]]) -> None:
    """Scale an axis to the extremes of these values, with a margin, unless there are none."""
    every = np.concatenate(list(values))
    every = every[np.isfinite(every)]
    if every.size and (span := float(np.ptp(every))) > 0:
        axes.set_ylim(float(every.min()) - MARGIN * span, float(every.max()) + MARGIN * span)


def from_touch_on(
    axes: Axes, t: NDArray[np.float64], pressing_N: NDArray[np.float64], wanted_N: float
) -> None:
    """Begin the time axis shortly before the object is touched."""
    touched = t[pressing_N > LEAST_FORCE * wanted_N]
    if touched.size:
        axes.set_xlim(max(0.0, float(touched[0]) - BEFORE_S), float(t[-1]))


def heading(figure: Figure, run: RunFile, number: int, point: str) -> float:
    """Write title, circumstances, file, and why the trial is invalid if it is; return their height
    in inches."""
    doubt = str(run.column("invalid")[number])
    of = f"trial {number + 1} of {len(run.column('invalid'))}"
    force = f"{run.column('set_normal_force')[number]:g} N normal force"
    title = run.header.marked(f"{run.header.procedure.removesuffix('-trial')} {of}, {force}")
    invalid = f"invalid: {doubt}" if doubt else ""
    return set_heading(figure, title, circumstances(run), run.path.name, invalid)
