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
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray

from rig.figures.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SKY,
    SMALLEST_PT,
    STYLE,
    TEXT_PT,
    VERMILLION,
    column_figure,
    wrapped,
)
from rig.physics.contact.stepper import SLIP_MINUS, STICK, Statuses
from rig.physics.design_map import DesignMap
from rig.physics.loading_history import History
from rig.physics.skin.elasticity import STRESSES, strip_areas
from rig.physics.skin.field import DeformedSkin
from rig.physics.skin.settings import SkinSettings
from rig.physics.trials import SkinTrial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

Floats = NDArray[np.float64]

SIMULATED = "simulated (model)"
STATUS_COLOURS = ("#f2f2f2", BLUE, VERMILLION)
STATUS_NAMES = ("apart", "stick", "slip")
EDGE_POINTS = 9
"""Points of each edge of a strip."""
TITLE_PT = 225.0
"""Width of a title."""
LARGEST_SHOWN_MM = 0.8
"""Largest displacement in the picture of a magnified section; grooves are 0.6 mm wide."""


@mpl.rc_context(STYLE)
def draw_trial(
    trial: SkinTrial, ridge_of_node: NDArray[np.int64], watched: int, title: str
) -> Figure:
    """Draw v_1, v_2, v_d, forces and the stick-slip map over time; ridge `watched` is 1 for the
    leftmost."""
    figure, (volts, difference, forces, sticks) = _panels(
        150, 4, f"{title}, ridge {watched}, {SIMULATED}", (1, 1.3, 1, 2)
    )
    for channel, (name, colour) in enumerate((("v_1", ORANGE), ("v_2", SKY))):
        volts.plot(
            trial.sample_time_s, trial.sampled[:, channel] * 1e3, color=colour, label=f"${name}$"
        )
    volts.set_ylabel("Strips (mV)")
    _legend_above(volts)
    difference.plot(trial.sample_time_s, trial.v_d * 1e3, lw=0.8, color=BLACK)
    difference.set_ylabel("$v_d$ (mV)")
    _mark_events(difference, trial, watched)
    _forces(forces, trial.time_s, trial.block.normal_force_N, trial.block.tangential_force_N)
    _stick_slip(sticks, trial.time_s, trial.block.status, ridge_of_node)
    start = max(0.0, trial.motion_s - 0.05)
    for axis in (volts, difference):
        shown = trial.sample_time_s >= start
        _headroom(axis, trial.sampled[shown] * 1e3 if axis is volts else trial.v_d[shown] * 1e3)
    sticks.set_xlim(start, trial.time_s[-1])
    sticks.set_xlabel(f"Time (s); the motion starts at {trial.motion_s:g} s")
    return figure


@mpl.rc_context(STYLE)
def draw_history(history: History, watched: int, title: str) -> Figure:
    """Draw Figures 12 and 13 of the paper: forces, stress difference, its rate, and the slipping
    ridges."""
    figure, (forces, difference, rate, sticks) = _panels(
        150, 4, f"{title}, ridge {watched}, {SIMULATED}", (1.2, 1, 1.2, 2)
    )
    step = history.step
    _forces(forces, step, history.normal_force_N, history.tangential_force_N)
    forces.plot(
        step,
        history.friction_force_N,
        lw=0.8,
        ls="--",
        color=BLACK,
        label="$F_t$ transmitted",
    )
    _legend_above(forces)
    difference.plot(step, history.difference * 1e3, lw=0.8, color=BLACK)
    difference.set_ylabel("$σ(S_1) - σ(S_2)$ (kPa)")
    fast = np.gradient(history.difference * 1e3)
    rate.plot(step, fast, lw=0.6, color=GREY, alpha=0.6, label="each step")
    rate.plot(step, _running_mean(fast, 21), lw=1.3, color=BLACK, label="mean of 21 steps")
    rate.set_ylabel("Rate (kPa/step)")
    _legend_above(rate)
    whole = history.truth.whole_slip_s[watched - 1]
    if np.isfinite(whole):
        at = whole * 1e6
        for axis in (difference, rate):
            axis.axvline(at, color=VERMILLION, lw=0.9)
        _name_line(difference, at, f"ridge {watched} slips")
    _stick_slip(sticks, step.astype(float), history.status, history.ridge_of_node)
    sticks.set_xlim(0, step[-1])
    sticks.set_xlabel("Step (1e-6 s each)")
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
        figure = _constrained(26 + 24 * len(instants))
        axes = figure.subplots(len(instants), 1, sharex=True, squeeze=False)
        for axis, (name, skin) in zip(axes[:, 0], instants, strict=True):
            quads = skin.corners_mm + magnified * skin.displacement_mm
            patches = PolyCollection(
                list(quads), array=skin.stress_MPa[:, component] * 1e3, cmap="RdBu_r",
                clim=(-limit, limit), edgecolors="none", antialiaseds=False, rasterized=True,
            )  # fmt: skip
            axis.add_collection(patches)
            for outline in _strip_outlines(settings, skin, magnified):
                axis.add_patch(Polygon(outline, fill=False, lw=0.4, ec=BLACK))
            axis.set_facecolor("0.82")
            axis.set_aspect("equal")
            axis.autoscale_view()
            axis.grid(False)
            axis.set_ylabel("y (mm)")
            axis.set_title(name, loc="left")
        axes[-1, 0].set_xlabel("x (mm); outlined: the strips $S_1$, $S_2$ of each ridge")
        figure.colorbar(
            patches, ax=list(axes[:, 0]), location="bottom", shrink=0.9, aspect=40, extend="both",
            label=f"$σ_{{{STRESSES[component]}}}$ (kPa)",
        )  # fmt: skip
        heading = f"{title}, {SIMULATED}; displacement × {magnified:g}"
        figure.suptitle("\n".join(wrapped(heading, TEXT_PT, TITLE_PT)))
    return figure


def _strip_outlines(settings: SkinSettings, skin: DeformedSkin, magnified: float) -> list[Floats]:
    """Return the outlines of all strips where the deformed mesh has them, (points, 2) each."""
    from scipy.interpolate import LinearNDInterpolator

    # Corners that elements share are given once: the interpolation is of nodes.
    corners, first = np.unique(skin.corners_mm.reshape(-1, 2).round(9), axis=0, return_index=True)
    moved = LinearNDInterpolator(corners, skin.displacement_mm.reshape(-1, 2)[first])
    outlines = []
    for ridge in range(settings.ridges):
        for area in strip_areas(settings, ridge):
            x = np.linspace(area.left_mm, area.right_mm, EDGE_POINTS)
            y = np.linspace(area.bottom_mm, area.top_mm, EDGE_POINTS)
            low, high = np.full(EDGE_POINTS, area.bottom_mm), np.full(EDGE_POINTS, area.top_mm)
            left, right = np.full(EDGE_POINTS, area.left_mm), np.full(EDGE_POINTS, area.right_mm)
            rest = np.concatenate(
                [
                    np.column_stack([x, low]),
                    np.column_stack([right, y]),
                    np.column_stack([x[::-1], high]),
                    np.column_stack([left, y[::-1]]),
                ]
            )
            outlines.append(rest + magnified * moved(rest))
    return outlines


def draw_map(found: DesignMap, ridge: int) -> Figure:
    """Draw hump and HF peak of one ridge over the strips' position, and of all ridges at the best
    one."""
    settings, names = found.settings, [f"$σ_{{{c}}}$" for c in found.components]
    quantities = (("hump", found.hump_V, "RdBu_r"), ("HF peak", found.peak_V, "viridis"))
    with mpl.rc_context(STYLE):
        figure = _constrained(190)
        panels = figure.subplots(4, 2, gridspec_kw={"height_ratios": (1, 1, 1, 0.9)}, squeeze=False)
        for column, (quantity, values, colours) in enumerate(quantities):
            shown = values[ridge - 1] * 1e3
            limit = float(np.abs(shown).max()) or 1.0
            for row, name in enumerate(names):
                axis = panels[row, column]
                image = _table(axis, shown[:, :, row], settings, colours, limit, column == 0)
                axis.set_title(f"{quantity} in {name}", loc="left")
                if column == 0:
                    axis.set_ylabel("Lower edge (mm)")
            panels[2, column].set_xlabel("Distance from axis (mm)")
            figure.colorbar(
                image, ax=list(panels[:3, column]), location="bottom", aspect=25,
                label=f"{quantity} of ridge {ridge} (mV)",
            )  # fmt: skip
            _over_ridges(panels[3, column], values, settings, ridge, names)
            panels[3, column].set_title(f"{quantity}, best place", loc="left")
        panels[3, 0].set_ylabel("$v_d$ (mV)")
        title = f"$v_d$ in a slide, by strip position, {SIMULATED}"
        figure.suptitle(title)
    return figure


def _over_ridges(axis: Axes, values: Floats, settings: Any, ridge: int, names: list[str]) -> None:
    """Draw the values of all ridges with the strips where those of `ridge` are largest."""
    ridges = np.arange(1, settings.skin.ridges + 1)
    for component, name in enumerate(names):
        largest = np.abs(values[ridge - 1, ..., component]).argmax()
        at = np.unravel_index(largest, values.shape[1:3])
        where = f"{settings.offsets_mm[at[1]]:g}, {settings.bottoms_mm[at[0]]:g} mm"
        axis.plot(ridges, values[:, at[0], at[1], component] * 1e3, "o-", label=f"{name}: {where}")
    axis.set_xlabel("Ridge")
    axis.set_xticks(ridges)
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.8 * (high - low))
    axis.legend(loc="upper left")


def _table(
    axis: Axes, values: Floats, settings: Any, colours: str, limit: float, signed: bool
) -> AxesImage:
    image = axis.imshow(
        values, cmap=colours, vmin=-limit if signed else 0.0, vmax=limit, origin="lower",
        aspect="auto",
    )  # fmt: skip
    for (row, column), value in np.ndenumerate(values):
        dark = abs(value) > 0.6 * limit if signed else value < 0.5 * limit
        axis.text(
            column, row, f"{value:.1f}".replace("-", "−"), ha="center", va="center",
            fontsize=SMALLEST_PT, color="w" if dark else "k",
        )  # fmt: skip
    axis.set_xticks(range(len(settings.offsets_mm)), [f"{o:g}" for o in settings.offsets_mm])
    axis.set_yticks(range(len(settings.bottoms_mm)), [f"{b:g}" for b in settings.bottoms_mm])
    axis.grid(False)
    return image


def _panels(
    height_mm: float, rows: int, title: str, heights: tuple[float, ...]
) -> tuple[Figure, Any]:
    with mpl.rc_context(STYLE):
        figure = _constrained(height_mm)
        axes = figure.subplots(rows, 1, sharex=True, gridspec_kw={"height_ratios": heights})
        figure.suptitle("\n".join(wrapped(title, TEXT_PT, TITLE_PT)))
    return figure, axes


def _constrained(height_mm: float) -> Figure:
    """Return a figure of one column whose axes are placed by their contents."""
    figure = column_figure(height_mm)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    return figure


def _forces(axis: Axes, time: Floats | NDArray[np.int64], normal: Floats, along: Floats) -> None:
    axis.plot(time, normal, color=BLUE, label="$F_n$")
    axis.plot(time, along, color=VERMILLION, label="$F_t$")
    axis.set_ylabel("Force (N)")
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
    axis.set_ylabel("Ridge (1: leftmost)")
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
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.2,
    )  # fmt: skip


def _mark_events(axis: Axes, trial: SkinTrial, watched: int) -> None:
    """Mark the slip of all of the neighbouring and the watched ridge, and gross slip."""
    truth = trial.truth
    events = [(truth.whole_slip_s[watched - 1], f"ridge {watched} slips")]
    if watched > 1:
        events.append((truth.whole_slip_s[watched - 2], f"ridge {watched - 1} slips"))
    events.append((truth.gross_slip_s, "gross slip"))
    for at, text in events:
        if np.isfinite(at):
            axis.axvline(at, color=VERMILLION, lw=0.8)
            _name_line(axis, at, text)


def _name_line(axis: Axes, at: float, text: str) -> None:
    """Write along a vertical line what happens there."""
    axis.annotate(
        text, (at, 0.04), (-1.5, 0), xycoords=("data", "axes fraction"),
        textcoords="offset points", rotation=90, ha="right", va="bottom", color=VERMILLION,
        fontsize=SMALLEST_PT,
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
