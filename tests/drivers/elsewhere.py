"""Calls from another thread than the procedure's, as a watcher or a link makes them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def elsewhere(act: Callable[[], object]) -> None:
    """`act` in a thread of its own, waited for; raises what it raises."""
    with ThreadPoolExecutor(1) as one:
        one.submit(act).result()
