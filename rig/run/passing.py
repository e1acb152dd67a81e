"""What ends a run has to pass through its procedure: a watch over one that keeps it back.

A stop, a trip or an open interlock contact is raised from the procedure's next wait. A procedure
that catches it there, as ``except Exception`` around a wait in a loop does, would stay in its loop
with the bench pressed, and each of its waits would be a sign of life to the guard. So the wait is
given up in two steps: first by an exception that such code does not catch, then by leaving the
bench to the guard.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

from rig.core.errors import RigError

PASSES_WITHIN_S = 5.0
"""Wall time within which what ends a run has to have passed through the procedure: much longer than
code needs that closes something of its own and raises again."""


class KeptBackError(BaseException):
    """Raised from a wait in place of an error that the procedure has caught and not raised again.
    ``except Exception`` does not catch it."""

    def __init__(self, cause: RigError):
        """`cause` is the first error that was kept back."""
        super().__init__(cause.message)
        self.cause = cause


class Passing:
    """Whether the errors that waits raise pass through the procedure that waits."""

    def __init__(self) -> None:
        self._first: Exception | None = None
        self._since_s = 0.0
        self._insists_since_s: float | None = None

    @property
    def given_up(self) -> RigError | None:
        """The first error, where `KeptBackError` has been kept back as well; None if there is none.
        Code has `PASSES_WITHIN_S` for each of the two."""
        since_s = self._insists_since_s
        if since_s is None or time.monotonic() - since_s <= PASSES_WITHIN_S:
            return None
        return self._cause()

    def passed(self) -> None:
        """Note that the hook of the procedure has ended, whatever it has raised."""
        self._first = self._insists_since_s = None

    @contextlib.contextmanager
    def first_raised(self) -> Iterator[None]:
        """Raise the first error that a wait has raised in the block, which calls a hook, also where
        the hook raises another one instead, or returns as if there had been none."""
        try:
            yield
        except Exception as error:
            if self._first is None or self._first is error:
                raise
            raise self._first from error
        if self._first is not None:
            raise self._first

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Note the first exception that the block raises into the procedure. Once it has not passed
        within `PASSES_WITHIN_S`, every block raises `KeptBackError`, also one that raises nothing:
        a trip is raised once."""
        try:
            yield
        except Exception as error:
            if self._first is None:
                self._first, self._since_s = error, time.monotonic()
            self._insist(error)
            raise
        self._insist(None)

    def _insist(self, error: Exception | None) -> None:
        if self._first is None or time.monotonic() - self._since_s <= PASSES_WITHIN_S:
            return
        if self._insists_since_s is None:
            self._insists_since_s = time.monotonic()
        raise KeptBackError(self._cause()) from error

    def _cause(self) -> RigError:
        if isinstance(self._first, RigError):
            return self._first
        return RigError(f"{type(self._first).__name__}: {self._first}")
