"""The links that a trial talks on while its ticks run.

A tick never waits for a link. Each instrument has a worker that carries out what is asked of it,
one request after the other, in a background thread in real time and at once in virtual time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rig.run.aside import Aside

if TYPE_CHECKING:
    from rig.run.context import Run


class TrialLinks:
    """The workers of a trial's links, by the role of the instrument at the other end."""

    def __init__(self, run: Run):
        self._clock, self._keep_alives = run.clock, run.bench.keep_alives
        self._workers: dict[str, Aside] = {}

    def add(self, role: str, name: str) -> None:
        """Give the link to the instrument of this role a worker; `name` is its thread's."""
        self._workers[role] = Aside(name, self._clock)

    @contextlib.contextmanager
    def working(self) -> Iterator[None]:
        """Within it, requests are carried out in background threads (in real time).

        Keep-alives are left to a link's worker as long as it is talking. Leaving it waits for
        what was asked, unless something was raised: then what has not begun is dropped.
        """
        with contextlib.ExitStack() as stack:
            for worker in self._workers.values():
                stack.enter_context(worker)
            talking = {role: worker.talking for role, worker in self._workers.items()}
            stack.enter_context(self._keep_alives.left_to(talking))
            yield

    def ask(self, role: str, what: str, work: Callable[[], None]) -> None:
        """Have `work` done on a link. It replaces an earlier request for `what` that has not begun.

        Raises what an earlier request on this link has raised.
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
