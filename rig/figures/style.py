"""How every figure looks and is kept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

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


def save(figure: Figure, run_file: Path, simulated: bool) -> list[Path]:
    """Write the figure as PNG and SVG beside its run file, marked where it is simulated."""
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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    png, svg = run_file.with_suffix(".png"), run_file.with_suffix(".svg")
    with mpl.rc_context(STYLE):
        _lay_out(figure)
        # The canvases themselves: `savefig` draws everything once more before each of them.
        canvas: Any = FigureCanvasAgg(figure)
        canvas.print_png(png)
        canvas = FigureCanvasSVG(figure)
        canvas.print_svg(svg, metadata={"Date": None})
    return [png, svg]


def import_matplotlib() -> None:
    """Import what every figure needs."""
    import matplotlib.backends.backend_agg
    import matplotlib.backends.backend_svg  # noqa: F401


def set_margins(figure: Figure, *, top: float = 0.35, between: float = 0.08) -> None:
    """Fixed margins: axes lie at the same place in every run's figure, and nothing is searched.

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


def decades(axes: Axes) -> None:
    """A logarithmic frequency axis with ticks at 1, 2 and 5: all nine take longer to draw than
    everything else in the figure."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_xlabel("Frequency (Hz)")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _lay_out(figure: Figure) -> None:
    """Find the margins once for all files: it takes as long as drawing one."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
