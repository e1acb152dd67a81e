"""Common parts of the figures of trials with the skin pressed on an object."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.evaluation.simulated_truth import times_of
from rig.files.describe import bench_name, mounted_on

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
LEAST_FORCE = 0.1
"""Fraction of the normal force from which the object is considered touched."""


def a_figure_a_trial(
    run: RunFile, draw: Callable[[RunFile, int, str], Figure]
) -> dict[str, Figure]:
    """Draw the first `TRIALS_SHOWN` trials of a run with `draw`, which is given the file, the
    number of the trial and its point; return the figures by what their files add to the run's name:
    nothing for the first."""
    points = run.point_ids()[:TRIALS_SHOWN]
    return {
        "" if number == 0 else f"-{point}": draw(run, number, point)
        for number, point in enumerate(points)
    }


def seconds(waveform: Waveform) -> NDArray[np.float64]:
    """Return the times of the rows of an equally spaced record, since its start."""
    first = next(iter(waveform.counts.values()))
    return np.arange(len(first)) / (waveform.rate_Hz or 1.0)


def shade(panels: Iterable[Axes], begin_s: float, end_s: float, what: str) -> None:
    """Shade the time of the motion in every panel, with a label in the first."""
    for number, axes in enumerate(panels):
        label = None if number else what
        axes.axvspan(begin_s, end_s, color="C2", alpha=0.07, linewidth=0, label=label)


WHOLE_RIDGE = "whole ridge slips"
"""The slip of the ridge that holds the strips, which incipient slip means here."""
SLIPS = {
    "first node slips": ("node_slip_s", "C3", ":"),
    WHOLE_RIDGE: ("ridge_slip_s", "C3", "--"),
    "gross slip": ("gross_slip_s", "C4", "-."),
}
"""Slips that the World of a simulated bench records, with their colours and lines."""


def slips_of_the_world(run: RunFile, number: int, record_s: float) -> dict[str, float]:
    """Return the times in s at which a trial slipped by the World's account, by their names in
    `SLIPS`; empty on a real bench. `record_s` is the length of the record."""
    times = times_of(run.readings()[number], record_s)
    found = {name: times.get(key) for name, (key, _, _) in SLIPS.items()}
    return {name: at_s for name, at_s in found.items() if at_s is not None}


def mark_slips(panels: Sequence[Axes], slips: Mapping[str, float]) -> None:
    """Draw a line for each slip through the panels, with its label in the last one."""
    for number, axes in enumerate(panels, 1):
        for name, at_s in slips.items():
            _, colour, line = SLIPS[name]
            label = f"{name} (World)" if number == len(panels) else None
            axes.axvline(at_s, color=colour, linestyle=line, linewidth=0.8, label=label)


def show_allowed_error(axes: Axes, run: RunFile) -> None:
    """Draw the rms error above which a trial is invalid."""
    allowed = float(run.settings.get("force_error_rms_percent", 0.0))
    if allowed:
        # Lines, not a band: the limit is on the rms, the curve shows the instantaneous error.
        label = f"validity limit: rms ≤ {allowed:g} %"
        axes.axhline(allowed, color="0.5", linewidth=0.8, linestyle=":", label=label)
        axes.axhline(-allowed, color="0.5", linewidth=0.8, linestyle=":")


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


def circumstances(run: RunFile) -> str:
    """Return in one line what a figure needs to be understood without its file: object, speed,
    start, sample, bench and date, as far as the run states them."""
    header, settings = run.header, run.settings
    parts = [f"object: {settings.get('object') or mounted_on(header) or 'not stated'}"]
    if (speed := settings.get("speed_mm_s")) is not None:
        parts.append(f"{speed:g} mm/s")
    if (angle := settings.get("angle_deg")) is not None and not settings.get("profile_times_s"):
        parts.append(f"{angle:g} deg")
    if (start := settings.get("start_mm")) is not None:
        parts.append(f"start {start:g} mm")
    if header.sample.name:
        parts.append(f"sample {header.sample.name}")
    parts.append(bench_name(header))
    parts.append(str(header.start_time or "")[:16].replace("T", " "))
    return ", ".join(part for part in parts if part)


def heading(figure: Figure, run: RunFile, number: int, point: str) -> int:
    """Write title, circumstances, file, and why the trial is invalid if it is; return the number of
    lines."""
    doubt = str(run.column("invalid")[number])
    invalid = f"\ninvalid: {doubt}" if doubt else ""
    of = f"trial {number + 1} of {len(run.column('invalid'))}"
    force = f"{run.settings['normal_force_N']:g} N normal force"
    title = run.header.marked(f"{run.header.procedure.removesuffix('-trial')} {of}, {force}")
    lines = f"{title}\n{circumstances(run)}\n{run.path.name}{invalid}"
    figure.suptitle(lines, fontsize=9, parse_math=False)
    return lines.count("\n") + 1
