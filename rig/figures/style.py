"""The common style of all figures, and how they are saved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLE: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "tactile-rig",
    "svg.fonttype": "none",
    "figure.dpi": 150,
}

FREQUENCY_MARGIN = 1.15
"""Ratio of the axis' ends to the lowest and highest frequency."""
NUMBERED_SPAN = 1e3
"""Ratio of frequencies from which the numbers at 2 and 5 would touch each other."""


def import_ahead() -> None:
    """Import what every figure needs, which takes as long as drawing one."""
    import matplotlib.backends.backend_agg
    import matplotlib.backends.backend_svg
    import matplotlib.figure  # noqa: F401


def save(figure: Figure, run_file: Path, simulated: bool, pdf: bool = False) -> list[Path]:
    """Write the figure as PNG and SVG, and as PDF if asked to, next to its run file, with a mark if
    it is simulated; return the files."""
    import matplotlib as mpl

    if simulated:
        figure.text(
            0.5,
            0.5,
            "SIMULATED",
            fontsize=48,
            color="0.5",
            alpha=0.15,
            ha="center",
            va="center",
            rotation=20,
        )
    with mpl.rc_context(STYLE):
        _lay_out(figure)
        files = [_save_png(figure, run_file), _save_svg(figure, run_file)]
        return [*files, _save_pdf(figure, run_file)] if pdf else files


# The canvases themselves: `savefig` draws everything once more before each of them.


def _save_png(figure: Figure, run_file: Path) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)
    with replacing(run_file.with_suffix(".png"), durable=False, shared=True) as part:
        canvas.print_png(part)
    return run_file.with_suffix(".png")


def _save_svg(figure: Figure, run_file: Path) -> Path:
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    canvas: Any = FigureCanvasSVG(figure)
    with replacing(run_file.with_suffix(".svg"), durable=False, shared=True) as part:
        canvas.print_svg(part, metadata={"Date": None})
    return run_file.with_suffix(".svg")


def _save_pdf(figure: Figure, run_file: Path) -> Path:
    from matplotlib.backends.backend_pdf import FigureCanvasPdf

    canvas: Any = FigureCanvasPdf(figure)
    with replacing(run_file.with_suffix(".pdf"), durable=False, shared=True) as part:
        canvas.print_pdf(part, metadata={"CreationDate": None})
    return run_file.with_suffix(".pdf")


def set_margins(figure: Figure, *, top: float = 0.35, between: float = 0.08) -> None:
    """Set fixed margins, so that axes are in the same place in every figure and no layout is
    computed.

    ``top`` in inches; ``between`` stacked axes as a part of their height.
    """
    width, height = figure.get_size_inches()
    figure.subplots_adjust(
        left=0.85 / width,
        right=1 - 0.12 / width,
        bottom=0.5 / height,
        top=1 - top / height,
        hspace=between,
    )


def decades(axes: Axes, lowest_Hz: float, highest_Hz: float) -> None:
    """Make a logarithmic frequency axis from `lowest_Hz` to `highest_Hz`, with a margin.

    Ticks at 1, 2 and 5 (all nine take longer to draw than everything else in the figure), the
    latter two with numbers where there is room; evenly spaced ones over less than a decade.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

    axes.set_xscale("log")
    axes.set_xlabel("Frequency (Hz)")
    axes.set_xlim(lowest_Hz / FREQUENCY_MARGIN, highest_Hz * FREQUENCY_MARGIN)
    numbers = FuncFormatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_major_formatter(numbers)
    if highest_Hz < 10 * lowest_Hz:
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], prune="both"))
        axes.xaxis.set_minor_locator(NullLocator())
        return
    axes.xaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    roomy = highest_Hz < NUMBERED_SPAN * lowest_Hz
    axes.xaxis.set_minor_formatter(numbers if roomy else NullFormatter())


def show_at_least(axes: Axes, span: float) -> None:
    """Set limits of y at least `span` apart, so that noise does not fill the panel of a single
    point."""
    low, high = axes.get_ylim()
    if high - low < span:
        middle = (low + high) / 2
        axes.set_ylim(middle - span / 2, middle + span / 2)


def legend_above(axes: Axes) -> None:
    """Place a legend in one line above the axes' right corner, where it hides nothing."""
    handles, _ = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            frameon=False,
            fontsize=8,
            handlelength=1.2,
            borderaxespad=0.1,
        )


def _lay_out(figure: Figure) -> None:
    """Compute the margins once for all file formats: it takes as long as drawing one."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
