"""Importing without the garbage collector, and without what a library looks for in vain.

What is imported stays. A collector that runs meanwhile looks through all of it again and again and
finds nothing, which takes a seventh of the time of large imports; and a full collection that looks
through it later, in the middle of a run, lasts longer than a tick of the loop that holds a force.
"""

from __future__ import annotations

import gc
import sys
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


@contextmanager
def as_if_missing(name: str) -> Iterator[None]:
    """Import within as if the module `name` were not installed, unless it has been imported."""
    if name in sys.modules:
        yield
        return
    sys.modules[name] = None  # type: ignore[assignment] # where an import ends, says its reference
    try:
        yield
    finally:
        del sys.modules[name]
