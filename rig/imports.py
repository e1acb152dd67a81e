"""Importing without the garbage collector.

What is imported stays. A collector that runs meanwhile looks through all of it again and again and
finds nothing, which takes a seventh of the time of large imports; and a full collection that looks
through it later, in the middle of a run, lasts longer than a tick of the loop that holds a force.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def importing() -> Iterator[None]:
    """Import within: nothing is collected, and what there is at the end never will be."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_on:
            gc.enable()
