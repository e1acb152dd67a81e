"""What a journal would send a figure back for, found in what matplotlib has laid out."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

WIDTH_MM = 84.0
LEAST_PT = 6.0
TOUCHING_PT = 0.6
"""Overlap of two boxes that nobody sees: they include the space of accents and descenders."""
WATERMARK = "SIMULATED"


def faults(figure: Figure) -> list[str]:
    """Return a sentence for everything that is wrong with a figure in print at 84 mm: its width,
    text that is too small, outside of the picture, on other text, or, in a legend, on a curve."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    found = []
    width_mm = 25.4 * figure.get_size_inches()[0]
    if abs(width_mm - WIDTH_MM) > 0.1:
        found.append(f"it is {width_mm:.1f} mm wide")
    texts = [text for text in shown(figure) if text.get_text() != WATERMARK]
    found += [
        f"{text.get_text()!r} is set in {text.get_fontsize():g} pt"
        for text in texts
        if text.get_fontsize() < LEAST_PT
    ]
    # Of an annotation itself the extent includes its arrow.
    boxes = [(text.get_text(), Text.get_window_extent(text, renderer)) for text in texts]
    page, touching = figure.bbox, TOUCHING_PT * figure.dpi / 72
    for text, box in boxes:
        beyond = (page.x0 - box.x0, page.y0 - box.y0, box.x1 - page.x1, box.y1 - page.y1)
        if max(beyond) > 0:
            found.append(f"{text!r} leaves the picture by {max(beyond) * 72 / figure.dpi:.1f} pt")
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        if _overlap(a, b, touching):
            found.append(f"{one!r} is written on {other!r}")
    for axes in figure.axes:
        found += _curves_in_legend(axes, renderer)
    return found


def shown(figure: Figure) -> list[Text]:
    """Return the texts of a figure that are drawn: numbers of an axis only within its limits."""
    numbers = {id(text): drawn for axes in figure.axes for text, drawn in _numbers(axes)}
    return [
        text
        for text in figure.findobj(Text)
        if text.get_text().strip() and text.get_visible() and numbers.get(id(text), True)
    ]


def words(figure: Figure) -> str:
    """Return all texts of a figure that are drawn, one in a line."""
    FigureCanvasAgg(figure).draw()
    return "\n".join(text.get_text() for text in shown(figure))


def _numbers(axes: Axes) -> Iterator[tuple[Text, bool]]:
    """Yield the numbers of both axes, and whether each is drawn."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = sorted(axis.get_view_interval())
        for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
            inside = low <= tick.get_loc() <= high
            yield tick.label1, inside and tick.label1.get_visible()
            yield tick.label2, inside and tick.label2.get_visible()


def _overlap(a: Bbox, b: Bbox, touching: float) -> bool:
    wide = min(a.x1, b.x1) - max(a.x0, b.x0)
    high = min(a.y1, b.y1) - max(a.y0, b.y0)
    return wide > touching and high > touching


def _curves_in_legend(axes: Axes, renderer: object) -> list[str]:
    legend = axes.get_legend()
    if legend is None:
        return []
    boxes = [text.get_window_extent(renderer) for text in legend.get_texts()]
    clipped = axes.get_window_extent(renderer)
    found = []
    for line in axes.get_lines():
        # Between two points a curve is straight on paper: a few points of it between them do.
        path = line.get_transform().transform_path(line.get_path())
        for x, y in path.interpolated(4).vertices:
            if clipped.contains(x, y) and any(box.contains(x, y) for box in boxes):
                found.append(
                    f"a curve runs through the legend {legend.get_texts()[0].get_text()!r}"
                )
                break
    return found
