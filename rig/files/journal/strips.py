"""Where v_1 and v_2, the signals of the two strips, are in a run."""

from __future__ import annotations

from rig.files.journal.layout import Layout

STRIPS = ("v_1", "v_2")


def stream_of_strips(layout: Layout) -> str | None:
    """Return the stream that holds v_1 and v_2 according to the file's own layout, or None."""
    return next(
        (trace.stream for trace in layout.traces if set(STRIPS) <= set(trace.channels())), None
    )
