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
        self._first: RigError | None = None
        self._since_s = 0.0

    @property
    def given_up(self) -> RigError | None:
        """The first error that was kept back for so long that `KeptBackError` must have been kept
        back as well; None if there is none."""
        return self._first if self._late_s() > 2 * PASSES_WITHIN_S else None

    def passed(self) -> None:
        """Note that the hook of the procedure has ended, whatever it has raised."""
        self._first = None

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Note the first RigError that the block raises into the procedure. A later one is replaced
        by `KeptBackError` once the first has not passed within `PASSES_WITHIN_S`."""
        try:
            yield
        except RigError as error:
            if self._first is None:
                self._first, self._since_s = error, time.monotonic()
            elif self._late_s() > PASSES_WITHIN_S:
                raise KeptBackError(self._first) from error
            raise

    def _late_s(self) -> float:
        return 0.0 if self._first is None else time.monotonic() - self._since_s
