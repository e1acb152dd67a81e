"""The links that a trial uses while its ticks run.

A tick never waits for a link. Each instrument has a worker that carries out what is asked of it,
one request after the other, in a background thread in real time and at once in virtual time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.bench.link_worker import LinkWorker
    from rig.run.context import Run


class TrialLinks:
    """The workers of a trial's links, by the role of the instrument at the other end."""

    def __init__(self, run: Run):
        self._bench_links = run.bench.links
        self._workers: dict[str, LinkWorker] = {}

    def add(self, role: str) -> None:
        """Use the link to the instrument of this role."""
        self._workers[role] = self._bench_links[role]

    @contextlib.contextmanager
    def working(self) -> Iterator[None]:
        """Let the links' workers carry out requests within the block (in real time).

        At its end the block waits for the requests, unless it has raised: then those that have not
        begun are dropped.
        """
        with contextlib.ExitStack() as stack:
            for worker in self._workers.values():
                stack.enter_context(worker)
            yield

    def ask(self, role: str, what: str, work: Callable[[], None]) -> None:
        """Request `work` on a link. It replaces an earlier request for `what` that has not begun.

        Raises the exception of an earlier request on this link.
        """
        self._workers[role].ask(what, work)

    def settle(self, *roles: str) -> None:
        """Wait until everything asked of these links is done; raise what it has raised."""
        for role in roles:
            self._workers[role].settle()

    def check(self) -> None:
        """Raise what a request on any of the links has raised."""
        for worker in self._workers.values():
            worker.check()

    def is_idle(self, role: str) -> bool:
        """Return whether everything asked of a link is done."""
        return self._workers[role].idle

    def silent_s(self, role: str) -> float:
        """Return for how long the request under way on a link has been waiting for its answer."""
        return self._workers[role].silent_s
