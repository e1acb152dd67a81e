"""What is switched on, and how it is switched off again, whatever happens.

Each armed thing registers its off *before* it is switched on: an off that had nothing to do is
harmless, an on whose off was never registered is not. Offs run in reverse order, each isolated
from the others' failures and each with a deadline.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from rig.core.errors import RigError

BEAT_EVERY_S = 0.2
"""How often a run says that it is alive."""

OFF_DEADLINE_S = 3.0
"""Wall time one off action may take, besides waits for a link that is broken."""


@dataclass(frozen=True)
class Armed:
    """One thing that has to be switched off."""

    name: str
    off: Callable[[], None]
    deadline_s: float
    at_once: Callable[[], None] | None
    """What a watcher does first, from another thread and without waiting on the bench clock."""
    watches: bool = False
    """Drives nothing, only looks: stays on while a run is on hold."""


@dataclass(frozen=True)
class OffFailure:
    """An off action that did not work."""

    name: str
    reason: str
    watches: bool = False
    """It drives nothing: the bench is safe although this goes on."""


class Arming:
    """The register of offs of one run."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._armed: list[Armed] = []
        """Replaced, never changed: who runs through it needs no lock."""

    @property
    def names(self) -> tuple[str, ...]:
        """What is armed, in the order of arming."""
        return tuple(armed.name for armed in self._armed)

    def register(
        self,
        name: str,
        off: Callable[[], None],
        deadline_s: float = OFF_DEADLINE_S,
        at_once: Callable[[], None] | None = None,
        watches: bool = False,
    ) -> None:
        """Remember `off` under `name`; registering a name again replaces its off."""
        with self._lock:
            others = [armed for armed in self._armed if armed.name != name]
            self._armed = [*others, Armed(name, off, deadline_s, at_once, watches)]

    def act_at_once(self) -> list[str]:
        """From a watcher's thread: what stops the bench now, each isolated; what failed, in words.

        Nothing is forgotten: the offs themselves still run at the exit.
        """
        failures = []
        for armed in reversed(self._armed):
            if armed.at_once is None:
                continue
            try:
                armed.at_once()
            except RigError as error:
                failures.append(f"{armed.name}: {error.one_line()}")
            except Exception as error:  # noqa: BLE001 - the others still have to be stopped
                failures.append(f"{armed.name}: {type(error).__name__}: {error}")
        return failures

    def make_safe(
        self, beat: Callable[[], None] = lambda: None, watch_on: bool = False
    ) -> list[OffFailure]:
        """Run every off in reverse order; returns those that failed and forgets the others.

        `beat` is called before every off and again and again while it runs: a clean-up within its
        deadline is a sign of life, and nobody may kill a stage that is on its way up. With
        `watch_on` what only watches stays on.
        """
        failures = []
        for armed in reversed(self._armed):
            if watch_on and armed.watches:
                continue
            beat()
            reason = _run_off(armed, beat)
            if reason is not None:
                failures.append(OffFailure(armed.name, reason, armed.watches))
            else:  # what another thread has armed meanwhile stays armed
                with self._lock:
                    self._armed = [other for other in self._armed if other is not armed]
        return failures


def _run_off(armed: Armed, beat: Callable[[], None]) -> str | None:
    """Why the off did not work, or None. A daemon thread, so that a stuck one holds up nothing."""
    outcome: list[str | None] = []

    def act() -> None:
        try:
            armed.off()
            outcome.append(None)
        except RigError as error:
            outcome.append(error.one_line())
        except Exception as error:  # noqa: BLE001 - one off's bug must not stop the others
            outcome.append(f"{type(error).__name__}: {error}")

    thread = threading.Thread(target=act, name=f"off {armed.name}", daemon=True)
    thread.start()
    give_up = time.monotonic() + armed.deadline_s
    while thread.is_alive() and (left := give_up - time.monotonic()) > 0:
        thread.join(min(left, BEAT_EVERY_S))
        beat()
    if not outcome:
        return f"not done within {armed.deadline_s:g} s"
    return outcome[0]
