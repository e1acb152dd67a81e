"""The figure of a low-pass filter, as the paper's Figure 14: gain, phase, group delay, step
response."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from rig.detector.low_pass import HALF_POWER_dB
from rig.figures.style import (
    GREY,
    STYLE,
    VERMILLION,
    column_figure,
    decades,
    legend_above,
    letter,
    set_heading,
    set_margins,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rig.analysis.low_pass_curves import LowPassCurves, LowPassSummary

BELOW_STOP_BAND_dB = 40.0
"""Range of gain shown below the specified attenuation."""


def draw_low_pass(
    name: str, asked_dB: float, curves: LowPassCurves, summary: LowPassSummary
) -> Figure:
    """Draw the four curves; phase and group delay end at the lobes, where they have no meaning."""
    f = curves.frequency_Hz
    passed = f < summary.lobes_from_Hz
    with mpl.rc_context(STYLE):
        figure = column_figure(168)
        gain, phase, delay, step = figure.subplots(4, 1)
        gain.plot(f, curves.gain_dB)
        reached = "never" if summary.stop_Hz is None else f"from {summary.stop_Hz:.1f} Hz"
        gain.axhline(
            -asked_dB, color=GREY, linestyle="--", linewidth=0.8,
            label=f"-{asked_dB:g} dB {reached}, largest lobe {summary.largest_lobe_dB:.1f} dB",
        )  # fmt: skip
        gain.plot(
            summary.half_power_Hz, HALF_POWER_dB, "o", markersize=3, color=VERMILLION,
            label=f"-3 dB at {summary.half_power_Hz:.2f} Hz",
        )  # fmt: skip
        gain.set_ylim(-asked_dB - BELOW_STOP_BAND_dB, 5.0)
        gain.set_ylabel("Gain (dB)")
        phase.plot(f, np.where(passed, curves.phase_deg, np.nan))
        phase.plot(
            summary.lag_Hz, -summary.lag_deg, "o", markersize=3, color=VERMILLION,
            label=f"{-summary.lag_deg:.2f} deg at {summary.lag_Hz:g} Hz",
        )  # fmt: skip
        phase.set_ylabel("Phase (deg)")
        delay.plot(f, np.where(passed, curves.group_delay_ms, np.nan))
        delay.plot(
            summary.lag_Hz, summary.delay_ms, "o", markersize=3, color=VERMILLION,
            label=f"{summary.delay_ms:.1f} ms at {summary.lag_Hz:g} Hz",
        )  # fmt: skip
        delay.set_ylabel("Group delay (ms)")
        for axes in (gain, phase, delay):
            decades(axes, float(f[0]), float(f[-1]))
        step.plot(curves.time_ms, curves.step_response)
        step.plot(
            summary.step_half_ms, 0.5, "o", markersize=3, color=VERMILLION,
            label=f"one half after {summary.step_half_ms:.1f} ms, "
            f"overshoot {summary.overshoot_percent:.1f} %",
        )  # fmt: skip
        step.set_ylabel("Step response")
        step.set_xlabel("Time since the step (ms)")
        for axes in (gain, phase, delay, step):
            legend_above(axes, columns=1)
        letter((gain, phase, delay, step))
        top = set_heading(
            figure, f"Low-pass filter '{name}': {summary.taps} taps at {summary.rate_Hz:g} Hz"
        )
        set_margins(figure, top=top + 0.24, gap_mm=12.0)
        figure.align_ylabels((gain, phase, delay, step))
    return figure
