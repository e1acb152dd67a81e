"""Figures of the skin model: a trial, the 4.2 history, the deformed skin, the design map.

Everything drawn here is simulated and marked so in its title. The functions draw arrays; they open
no file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from rig.figures.style import STYLE
from rig.physics.contact.stepper import SLIP_MINUS, STICK, Statuses
from rig.physics.design_map import DesignMap
from rig.physics.loading_history import History
from rig.physics.skin.elasticity import STRESSES, strip_areas
from rig.physics.skin.field import DeformedSkin
from rig.physics.skin.settings import SkinSettings
from rig.physics.trials import SkinTrial

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

SIMULATED = "simulated (model)"
STATUS_COLOURS = ("#f2f2f2", "#4477aa", "#ee6677")
STATUS_NAMES = ("apart", "stick", "slip")
LARGEST_SHOWN_MM = 0.8
"""Largest displacement in the picture of a magnified section; grooves are 0.6 mm wide."""


def draw_trial(
    trial: SkinTrial, ridge_of_node: NDArray[np.int64], watched: int, title: str
) -> Figure:
    """Draw v_1, v_2, v_d, forces and the stick-slip map over time; ridge `watched` is 1 for the
    leftmost."""
    figure, (volts, difference, forces, sticks) = _panels(
        (9, 9.5), 4, f"{title}, {SIMULATED}", (1, 1.3, 1, 2)
    )
    for channel, name in enumerate(("v_1", "v_2")):
        volts.plot(trial.sample_time_s, trial.sampled[:, channel] * 1e3, lw=0.9, label=f"${name}$")
    volts.set_ylabel(f"strips of ridge {watched}\n(mV)")
    volts.legend(loc="upper left", ncols=2, frameon=False)
    difference.plot(trial.sample_time_s, trial.v_d * 1e3, lw=0.9, color="k")
    difference.set_ylabel("$v_d = v_1 - v_2$\n(mV)")
    _mark_events(difference, trial, watched)
    _forces(forces, trial.time_s, trial.block.normal_force_N, trial.block.tangential_force_N)
    _stick_slip(sticks, trial.time_s, trial.block.status, ridge_of_node)
    start = max(0.0, trial.motion_s - 0.05)
    for axis in (volts, difference):
        shown = trial.sample_time_s >= start
        _headroom(axis, trial.sampled[shown] * 1e3 if axis is volts else trial.v_d[shown] * 1e3)
    sticks.set_xlim(start, trial.time_s[-1])
    sticks.set_xlabel(f"time (s); the motion starts at {trial.motion_s:g} s")
    return figure


def draw_history(history: History, watched: int, title: str) -> Figure:
    """Draw Figures 12 and 13 of the paper: forces, stress difference, its rate, and the slipping
    ridges."""
    figure, (forces, difference, rate, sticks) = _panels(
        (9, 9.5), 4, f"{title}, {SIMULATED}", (1.2, 1, 1.2, 2)
    )
    step = history.step
    _forces(forces, step, history.normal_force_N, history.tangential_force_N)
    forces.plot(
        step, history.friction_force_N, lw=0.9, ls="--", label="$F_t$ transmitted to the plate"
    )
    _legend_above(forces)
    difference.plot(step, history.difference * 1e3, lw=0.9, color="k")
    difference.set_ylabel(f"$σ(S_1) - σ(S_2)$\nridge {watched} (kPa)")
    fast = np.gradient(history.difference * 1e3)
    rate.plot(step, fast, lw=0.6, color="0.7", label="each step")
    rate.plot(step, _running_mean(fast, 21), lw=1.3, color="k", label="mean of 21 steps")
    rate.set_ylabel("its rate\n(kPa per step)")
    rate.legend(loc="lower left", ncols=2, frameon=False)
    whole = history.truth.whole_slip_s[watched - 1]
    if np.isfinite(whole):
        at = whole * 1e6
        for axis in (difference, rate):
            axis.axvline(at, color="#ee6677", lw=0.9)
        difference.annotate(
            f"all of ridge {watched} slips ", (at, 0.06), xycoords=("data", "axes fraction"),
            ha="right", color="#ee6677",
        )  # fmt: skip
    _stick_slip(sticks, step.astype(float), history.status, history.ridge_of_node)
    sticks.set_xlim(0, step[-1])
    sticks.set_xlabel("step (1e-6 s each)")
    return figure


def draw_deformed(
    instants: list[tuple[str, DeformedSkin]], settings: SkinSettings, component: int, title: str
) -> Figure:
    """Draw the deformed section with one stress (0, 1, 2 for σ_xx, σ_yy, σ_xy) at some instants."""
    largest = max(np.abs(skin.displacement_mm).max() for _, skin in instants)
    magnified = (
        float(np.floor(LARGEST_SHOWN_MM / largest)) if 0 < largest < LARGEST_SHOWN_MM else 1.0
    )
    values = np.concatenate([skin.stress_MPa[:, component] for _, skin in instants]) * 1e3
    limit = float(np.percentile(np.abs(values), 99.0)) or 1.0
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 0.6 + 2.5 * len(instants)), layout="constrained")
        axes = figure.subplots(len(instants), 1, sharex=True, squeeze=False)
        for axis, (name, skin) in zip(axes[:, 0], instants, strict=True):
            quads = skin.corners_mm + magnified * skin.displacement_mm
            patches = PolyCollection(
                list(quads), array=skin.stress_MPa[:, component] * 1e3, cmap="RdBu_r",
                clim=(-limit, limit), edgecolors="none", antialiaseds=False, rasterized=True,
            )  # fmt: skip
            axis.add_collection(patches)
            for ridge in range(settings.ridges):
                for area in strip_areas(settings, ridge):
                    size = (area.right_mm - area.left_mm, area.top_mm - area.bottom_mm)
                    axis.add_patch(
                        Rectangle(
                            (area.left_mm, area.bottom_mm), *size, fill=False, lw=0.5, ec="0.3"
                        )
                    )
            axis.set_facecolor("0.82")
            axis.set_aspect("equal")
            axis.autoscale_view()
            axis.grid(False)
            axis.set_ylabel("y (mm)")
            axis.set_title(name, fontsize=9, loc="left")
        axes[-1, 0].set_xlabel(
            "x (mm); thin rectangles: the strips $S_1$, $S_2$ of each ridge, at rest"
        )
        figure.colorbar(
            patches, ax=list(axes[:, 0]), shrink=0.8, extend="both",
            label=f"$σ_{{{STRESSES[component]}}}$ (kPa)",
        )  # fmt: skip
        figure.suptitle(f"{title}, {SIMULATED}; displacement × {magnified:g}")
    return figure


def draw_map(found: DesignMap, ridge: int) -> Figure:
    """Draw hump and HF peak of one ridge over the strips' position, and of all ridges at the best
    one."""
    settings, names = found.settings, [f"$σ_{{{c}}}$" for c in found.components]
    quantities = (("hump", found.hump_V, "RdBu_r"), ("HF peak", found.peak_V, "viridis"))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10, 8.5), layout="constrained")
        grid = figure.add_gridspec(3, 3, height_ratios=(1, 1, 0.9))
        for row, (quantity, values, colours) in enumerate(quantities):
            shown = values[ridge - 1] * 1e3
            limit = float(np.abs(shown).max())
            for column, name in enumerate(names):
                axis = figure.add_subplot(grid[row, column])
                _table(axis, shown[:, :, column], settings, colours, limit, row == 0)
                axis.set_title(f"{quantity} in {name}, ridge {ridge} (mV)", fontsize=9)
                axis.set_xlabel("distance of the strips from the axis (mm)")
                if column == 0:
                    axis.set_ylabel("lower edge above the foot (mm)")
        ridges = np.arange(1, settings.skin.ridges + 1)
        for column, name in enumerate(names):
            axis = figure.add_subplot(grid[2, column])
            for _, values, _ in quantities:
                at = np.unravel_index(
                    np.abs(values[ridge - 1, ..., column]).argmax(), values.shape[1:3]
                )
                where = f"{settings.offsets_mm[at[1]]:g}, {settings.bottoms_mm[at[0]]:g} mm"
                label = f"{'hump' if values is found.hump_V else 'HF peak'} at {where}"
                axis.plot(ridges, values[:, at[0], at[1], column] * 1e3, "o-", ms=3, label=label)
            axis.set_title(f"best position of ridge {ridge} in {name} (mV)", fontsize=9)
            axis.set_xlabel("ridge")
            axis.set_xticks(ridges)
            axis.set_ylim(top=1.35 * axis.get_ylim()[1])
            axis.legend(frameon=False, fontsize=7.5, loc="upper left")
        figure.suptitle(f"$v_d$ in a slide, by strip position, {SIMULATED}")
    return figure


def _table(
    axis: Axes, values: Floats, settings: Any, colours: str, limit: float, signed: bool
) -> None:
    axis.imshow(
        values, cmap=colours, vmin=-limit if signed else 0.0, vmax=limit, origin="lower",
        aspect="auto",
    )  # fmt: skip
    for (row, column), value in np.ndenumerate(values):
        dark = abs(value) > 0.6 * limit if signed else value < 0.5 * limit
        axis.text(
            column, row, f"{value:.1f}", ha="center", va="center", fontsize=8,
            color="w" if dark else "k",
        )  # fmt: skip
    axis.set_xticks(range(len(settings.offsets_mm)), [f"{o:g}" for o in settings.offsets_mm])
    axis.set_yticks(range(len(settings.bottoms_mm)), [f"{b:g}" for b in settings.bottoms_mm])
    axis.grid(False)


def _panels(
    size: tuple[float, float], rows: int, title: str, heights: tuple[float, ...]
) -> tuple[Figure, Any]:
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, 1, sharex=True, gridspec_kw={"height_ratios": heights})
        figure.suptitle(title)
    return figure, axes


def _forces(axis: Axes, time: Floats | NDArray[np.int64], normal: Floats, along: Floats) -> None:
    axis.plot(time, normal, lw=1.1, label="$F_n$")
    axis.plot(time, along, lw=1.1, label="$F_t$")
    axis.set_ylabel("force (N)")
    _legend_above(axis)


def _stick_slip(
    axis: Axes, time: Floats, status: Statuses, ridge_of_node: NDArray[np.int64]
) -> None:
    """Draw one band per ridge and one line per node: separated, sticking or slipping."""
    every = max(1, status.shape[0] // 2000)
    seen = np.minimum(status[::every], STICK + 1).astype(np.int8)
    seen[status[::every] == SLIP_MINUS] = STICK + 1
    ridges = int(ridge_of_node.max()) + 1
    axis.imshow(
        seen.T, aspect="auto", origin="lower", interpolation="nearest",
        cmap=ListedColormap(STATUS_COLOURS), vmin=0, vmax=2,
        extent=(float(time[0]), float(time[-1]), 0.5, ridges + 0.5),
    )  # fmt: skip
    for border in range(1, ridges):
        axis.axhline(border + 0.5, color="w", lw=1.5)
    axis.set_yticks(range(1, ridges + 1))
    axis.set_ylabel("ridge (1 is the leftmost),\nits nodes from left to right upwards")
    axis.grid(False)
    handles = [
        Patch(fc=colour, ec="0.5", lw=0.5, label=name)
        for colour, name in zip(STATUS_COLOURS, STATUS_NAMES, strict=True)
    ]
    _legend_above(axis, handles)


def _legend_above(axis: Axes, handles: list[Patch] | None = None) -> None:
    """Place a legend above the axes' right corner, where it hides nothing."""
    axis.legend(
        **({} if handles is None else {"handles": handles}),
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8, frameon=False,
        handlelength=1.2, borderaxespad=0.2,
    )  # fmt: skip


def _mark_events(axis: Axes, trial: SkinTrial, watched: int) -> None:
    """Mark the slip of all of the neighbouring and the watched ridge, and gross slip."""
    truth = trial.truth
    events = [(truth.whole_slip_s[watched - 1], f"all of ridge {watched} slips", 0.06)]
    if watched > 1:
        events.append((truth.whole_slip_s[watched - 2], f"all of ridge {watched - 1} slips", 0.06))
    events.append((truth.gross_slip_s, "gross slip", 0.06))
    for at, text, height in events:
        if np.isfinite(at):
            axis.axvline(at, color="#ee6677", lw=0.9)
            axis.annotate(
                f"{text} ", (at, height), xycoords=("data", "axes fraction"), ha="right",
                color="#ee6677", fontsize=8,
            )  # fmt: skip


def _headroom(axis: Axes, values: Floats) -> None:
    low, high = float(values.min()), float(values.max())
    room = 0.15 * (high - low or 1.0)
    axis.set_ylim(low - room, high + 2 * room)


def _running_mean(values: Floats, width: int) -> Floats:
    """Return the centred running mean, whose window is shorter at the ends."""
    summed = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(values.size)
    low = np.maximum(at - width // 2, 0)
    high = np.minimum(at + width // 2 + 1, values.size)
    mean: Floats = (summed[high] - summed[low]) / (high - low)
    return mean
