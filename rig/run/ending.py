"""What is known of how a run's bench is made safe, and of how it is left."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rig.core.errors import InstrumentTimeoutError, RigError


class Ending:
    """How the bench of a run is made safe: what has worked, what has not, and how it is left.

    Shutdown actions report here. Nothing that is said while they act waits or raises: neither may
    come before the bench is safe.
    """

    def __init__(self, record: Callable[[str, str, str], None]):
        """Record with `record`, which takes the level, the code and the text of an event."""
        self._record = record
        self.warn_at_once: Callable[[str], None] = lambda message: None
        """Shows a warning to the operator without waiting for anything, from any thread."""
        self.failures: list[RigError] = []
        """Failures that were reported to `fail`."""
        self.lost: tuple[InstrumentTimeoutError, ...] = ()
        """Calls to instruments that did not answer, if the run has ended because of them."""
        self.silent: frozenset[str] = frozenset()
        """Roles of these instruments, and of those that share a link with one of them."""
        self._left: list[str] = []
        self._doubts: list[str] = []
        self.made_safe: list[str] = []
        """Effects of the shutdown actions on what has not been switched on again, in their order,
        as parts of a sentence: "generator off". An action that failed in part is not included."""
        self._not_safe_said = False
        self.under_way = False
        """True while shutdown actions run."""

    def noting(self, off: Callable[[], None], done: str) -> Callable[[], None]:
        """Return the shutdown action, extended so that it adds `done` to `made_safe` if nothing
        failed. Takes `done` out of it first: this is about to be switched on."""
        self.made_safe = [other for other in self.made_safe if other != done]

        def shutdown() -> None:
            before = len(self.failures), len(self._doubts)
            off()
            if (len(self.failures), len(self._doubts)) == before:
                self.made_safe.append(done)

        return shutdown

    @property
    def left(self) -> tuple[str, ...]:
        """How z was left where it could not be moved clear, or where that is not known, as parts of
        a sentence."""
        return (*self._left, *self._doubts)

    @contextlib.contextmanager
    def making_safe(self) -> Iterator[None]:
        """Have shutdown actions run in the block. What was said, and was not known, when the bench
        was last made safe is forgotten; what was done then stays done until it is armed again."""
        self._not_safe_said = False
        self._doubts.clear()
        self.under_way = True
        try:
            yield
        finally:
            self.under_way = False

    def announce(self) -> None:
        """Record that the run ends and is about to make the bench safe, for who follows it."""
        self._note("info", "making-safe", "the bench is being made safe")

    def say_not_safe(self, text: str) -> None:
        """Say and record at once, while the bench is being made safe, that a part of that has not
        worked yet; the first time only."""
        if self._not_safe_said:
            return
        self._not_safe_said = True
        self.warn_at_once(text)
        self._note("info", "not-safe-yet", text)

    def fail(self, error: RigError, left: str = "") -> None:
        """Report a failure without raising it: for a shutdown action that could be done only in
        part. The run has failed; the error is reported at the end, after what failed before. `left`
        says for the closing lines how z stands there, as part of a sentence: "the skin may still be
        pressed"."""
        self.failures.append(error)
        if left and left not in self._left:
            self._left.append(left)
        self._note("error", type(error).__name__, error.one_line())

    def doubt(self, left: str, text: str) -> None:
        """Warn of a shutdown action that was done, and of which it is not known whether it had its
        effect; `left` is as in `fail`: "it is not known whether the skin is still pressed"."""
        self._doubts.append(left)
        self._note("warning", "pressed", text)

    def try_to_record(self, put: Callable[[], None]) -> None:
        """Call `put`, which records something; whatever it raises is not raised."""
        with contextlib.suppress(Exception):  # a failed recorder is reported when it is closed
            put()

    def _note(self, level: str, code: str, text: str) -> None:
        self.try_to_record(lambda: self._record(level, code, text))
