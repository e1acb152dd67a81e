"""The style sheet of all figures: one column of a journal wide, colour-blind safe, and how a figure
is saved.

Every figure is `COLUMN_MM` wide, on paper and on a screen: what is legible in print at 84 mm is
legible at the 992 dots of its PNG, and no one needs a second version for a paper. Nothing is
written smaller than `SMALLEST_PT`, apart from the indices of symbols. Colours are those of Okabe
and Ito (2008), `PALETTE`, which people with any of the common colour deficiencies can distinguish;
maps are RdBu and viridis. Where it matters lines differ in their dashes as well.
"""

from __future__ import annotations

import string
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMN_MM = 84.0
"""Width of one column of a journal."""
MM_PER_INCH = 25.4
POINTS_PER_INCH = 72.0
TEXT_PT, SMALLEST_PT = 7.0, 6.0
"""Size of titles and labels of axes; of everything else that is written."""
LEFT, RIGHT, BOTTOM = 0.5, 0.1, 0.36
"""Margins around the axes in inches: of 84 mm the axes have 69 mm."""
HEADING_PT = 2.5
"""Space above the title and between it and what follows."""
LEGEND_LINE = 0.13
"""Height of a line of a legend in inches."""
LINE_SPACING = 1.25
"""Distance of lines of text, in sizes of the text."""

NO_BREAK = "\N{NO-BREAK SPACE}"
"""Space at which no line ends."""

BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, BLACK = PALETTE = (
    "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000",
)  # fmt: skip
"""Colours of Okabe and Ito without the yellow, which is too light for lines."""
GREY = "#666666"
"""Colour of what is drawn for comparison: limits, set points, zero."""

STYLE: Any = {
    "font.size": TEXT_PT,
    "axes.labelsize": TEXT_PT,
    "axes.titlesize": TEXT_PT,
    "figure.titlesize": TEXT_PT,
    "xtick.labelsize": SMALLEST_PT,
    "ytick.labelsize": SMALLEST_PT,
    "legend.fontsize": SMALLEST_PT,
    "legend.title_fontsize": SMALLEST_PT,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "legend.handletextpad": 0.4,
    "legend.columnspacing": 0.9,
    "legend.labelspacing": 0.25,
    "legend.borderaxespad": 0.3,
    "legend.borderpad": 0.2,
    "axes.labelpad": 2.0,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": f"cycler('color', {list(PALETTE)})",
    "grid.alpha": 0.3,
    "grid.linewidth": 0.4,
    "lines.linewidth": 0.8,
    "lines.markersize": 3.0,
    "patch.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.0,
    "ytick.major.size": 2.0,
    "xtick.minor.size": 1.2,
    "ytick.minor.size": 1.2,
    "xtick.major.pad": 2.0,
    "ytick.major.pad": 2.0,
    "svg.hashsalt": "tactile-rig",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
    "figure.dpi": 300,
}
"""What a figure function gives to `matplotlib.rc_context`. Fonts stay text in SVG and PDF."""

FREQUENCY_MARGIN = 1.15
"""Ratio of the axis' ends to the lowest and highest frequency."""
NUMBERED_SPAN = 1e2
"""Ratio of frequencies from which the numbers at 2 and 5 would touch each other."""


def import_ahead() -> None:
    """Import what every figure needs, which takes as long as drawing one."""
    import matplotlib.backends.backend_agg
    import matplotlib.backends.backend_svg
    import matplotlib.figure  # noqa: F401


def column_figure(height_mm: float) -> Figure:
    """Return an empty figure that is one column wide."""
    from matplotlib.figure import Figure

    return Figure(figsize=(COLUMN_MM / MM_PER_INCH, height_mm / MM_PER_INCH))


def save(figure: Figure, run_file: Path, simulated: bool, pdf: bool = False) -> list[Path]:
    """Write the figure as PNG and SVG, and as PDF if asked to, next to its run file, with a mark if
    it is simulated; return the files."""
    import matplotlib as mpl

    if simulated:
        mark_simulated(figure)
    with mpl.rc_context(STYLE):
        _lay_out(figure)
        files = [_save_png(figure, run_file), _save_svg(figure, run_file)]
        return [*files, _save_pdf(figure, run_file)] if pdf else files


def mark_simulated(figure: Figure) -> None:
    """Write SIMULATED across the figure, above its contents and faint enough to read them."""
    figure.text(
        0.5,
        0.5,
        "SIMULATED",
        fontsize=9 * float(figure.get_size_inches()[0]),
        color="0.5",
        alpha=0.15,
        ha="center",
        va="center",
        rotation=20,
    )


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


def set_margins(
    figure: Figure,
    *,
    top: float = 0.35,
    between: float = 0.08,
    gap_mm: float | None = None,
    left: float = LEFT,
) -> None:
    """Set fixed margins, so that axes are in the same place in every figure and no layout is
    computed.

    ``top`` and ``left`` in inches; ``between`` stacked axes as a part of their height, or
    ``gap_mm`` between them.
    """
    width, height = figure.get_size_inches()
    if gap_mm is not None:
        grid = figure.axes[0].get_gridspec()
        rows = 1 if grid is None else grid.nrows
        gap = gap_mm / MM_PER_INCH
        between = rows * gap / (height - top - BOTTOM - (rows - 1) * gap)
    figure.subplots_adjust(
        left=left / width,
        right=1 - RIGHT / width,
        bottom=BOTTOM / height,
        top=1 - top / height,
        hspace=between,
    )


def set_heading(figure: Figure, title: str, *details: str) -> float:
    """Write the title, and below it the details, each as a line of its own that is wrapped where it
    is too long; return their height in inches, for `set_margins`."""
    width, height = (POINTS_PER_INCH * inches for inches in figure.get_size_inches())
    room = width - 2 * TEXT_PT
    title = "\n".join(wrapped(title, TEXT_PT, room))
    below = [line for text in details if text for line in wrapped(text, SMALLEST_PT, room)]
    left = TEXT_PT / width
    figure.suptitle(
        title, x=left, y=1 - HEADING_PT / height, ha="left", va="top",
        fontsize=TEXT_PT, linespacing=LINE_SPACING, parse_math=False,
    )  # fmt: skip
    taken = HEADING_PT + LINE_SPACING * TEXT_PT * (title.count("\n") + 1)
    if below:
        figure.text(
            left, 1 - taken / height, "\n".join(below), ha="left", va="top", color=GREY,
            fontsize=SMALLEST_PT, linespacing=LINE_SPACING, parse_math=False,
        )  # fmt: skip
        taken += LINE_SPACING * SMALLEST_PT * len(below)
    return (taken + HEADING_PT) / POINTS_PER_INCH


def literal(text: str) -> str:
    """Return text from a file such that a label shows it as it is: between two dollar signs it
    would be read as a formula, and one that is not a formula cannot be drawn."""
    return text.replace("$", r"\$")


def wrapped(text: str, size_pt: float, width_pt: float) -> list[str]:
    """Return text as lines that are no wider than `width_pt` at that size. Lines end at spaces that
    are not `NO_BREAK`. What is wider between two of them ends at a `NO_BREAK`; a word that is
    wider, such as a long file name, is broken."""
    lines: list[str] = []
    for word in text.split(" "):
        line = f"{lines[-1]} {word}" if lines else word
        if lines and width_of(line, size_pt) <= width_pt:
            lines[-1] = line
            continue
        while width_of(word, size_pt) > width_pt:
            fits = next(
                n for n in range(len(word), 0, -1) if width_of(word[:n], size_pt) <= width_pt
            )
            blank = word.rfind(NO_BREAK, 1, fits + 1)
            end = blank if blank > 0 else fits
            lines.append(word[:end])
            word = word[end:].removeprefix(NO_BREAK)
        lines.append(word)
    return [line.replace(NO_BREAK, " ") for line in lines]


def width_of(text: str, size_pt: float) -> float:
    """Return the width of a line in points; symbols between dollars are set as formulas."""
    from matplotlib.textpath import text_to_path

    formula = text.count("$") > 1
    return float(
        text_to_path.get_text_width_height_descent(text, _font(size_pt), ismath=formula)[0]
    )


@cache
def _font(size_pt: float) -> Any:
    from matplotlib.font_manager import FontProperties

    return FontProperties(size=size_pt)


def letter(panels: Iterable[Axes]) -> None:
    """Write (a), (b), ... above the left corner of each panel, before what is written there."""
    for name, axes in zip(string.ascii_lowercase, panels, strict=False):
        said = axes.get_title(loc="left")
        text = f"({name}) {said}" if said else f"({name})"
        axes.set_title(text, loc="left", fontsize=SMALLEST_PT, pad=2.0)


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


def legend_above(axes: Axes, columns: int | None = None) -> float:
    """Place a legend above the axes' right corner, where it hides nothing: in one line, or in
    lines of so many `columns`. Return its height in inches, for `set_margins`."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return 0.0
    columns = columns or len(handles)
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=columns,
        borderaxespad=0.1,
    )
    # Entries fill one column after another; a line of the legend is as high as its highest entry.
    rows = -(-len(labels) // columns)
    lines = sum(max(text.count("\n") + 1 for text in labels[row::rows]) for row in range(rows))
    height: float = LEGEND_LINE * lines
    return height


def _lay_out(figure: Figure) -> None:
    """Compute the margins once for all file formats: it takes as long as drawing one."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
