"""What a run checks in every wait: what may end it, the guard's heartbeat, disk and clock."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from rig.core.errors import RigError
from rig.run.arming import BEAT_EVERY_S
from rig.run.phases import RunPhase
from rig.run.time_of_day import jump_in_words, sleep_in_words

if TYPE_CHECKING:
    from rig.run.making_safe.guard_link import GuardLink
    from rig.run.parts import RunParts

SLOW_DISK_S = 10.0
"""Time in s without an acknowledgement by the disk after which that is reported."""


class WaitChecks:
    """The checks of one run; each call of `each_slice` is a sign of life for the guard."""

    def __init__(self, parts: RunParts, guard: GuardLink, given_up: Callable[[RigError], None]):
        """`given_up` is called where the procedure has kept back whatever was to end the run, with
        the first of it."""
        self._run, self._phases, self._stop = parts.run, parts.phases, parts.stop
        self._recorder, self._journal = parts.recorder, parts.journal
        self._observers, self._guard, self._given_up = parts.observers, guard, given_up
        self._last_beat = 0.0
        self._guard_missed = False
        """True if it has been reported that the guard has died or does not react."""
        self._disk_missed = False
        """True if it has been reported that the disk does not take the journal."""

    def each_slice(self) -> None:
        """Raise what ends a wait. It is called before every slice of the wait, which is at most 20
        ms long."""
        now = time.monotonic()
        passing = self._phases.passing
        if (kept := passing.given_up) is not None:
            self._given_up(kept)
        due = now - self._last_beat >= BEAT_EVERY_S
        if due:
            self._last_beat = now
            self._guard.beat()
            if (zero := self._run.force_zero) is not None:
                self._guard.zero(zero)
            self._guard.limit(self._run.force_limit_N)
        if self._phases.now is RunPhase.MAKING_SAFE:
            return
        if due:
            self._miss_guard()
            self._miss_disk()
            self._notice_set_clock()
        measuring = self._phases.now is RunPhase.MEASURING
        with passing.watched() if measuring else contextlib.nullcontext():
            self._recorder.check()
            self._stop.check()
            self._run.interlocks.check()
            if measuring:
                self._run.check_watchers()

    def _miss_guard(self) -> None:
        """Report that the guard has died or does not react, and that it reacts again. The run
        continues: to end it would gain nothing."""
        trouble = self._guard.trouble()
        if (trouble is not None) is self._guard_missed:
            return
        self._guard_missed = trouble is not None
        if trouble is not None:
            level = "warning"
            text = f"the guard {trouble}: if this run dies as well, nothing makes the bench safe"
        else:
            level, text = "info", "the guard reads heartbeats again and watches this run"
        self._run.event(level, "guard", text)
        self._observers.event(level, text)

    def _miss_disk(self) -> None:
        """Report that the disk does not take what is recorded, and that it does again. The run
        continues: nothing is lost unless it dies meanwhile, and disks answer again."""
        waiting_s = self._recorder.unacknowledged_s
        if (waiting_s > SLOW_DISK_S) is self._disk_missed:
            return
        self._disk_missed = waiting_s > SLOW_DISK_S
        if self._disk_missed:
            level = "warning"
            text = (
                f"what was recorded {waiting_s:.0f} s ago is not on the disk yet: it is in memory "
                "only, and is lost if this run dies"
            )
        else:
            level, text = "info", "what was recorded is on the disk again; nothing was lost"
        self._run.event(level, "slow-disk", text)
        self._observers.event(level, text)

    def _notice_set_clock(self) -> None:
        """Record that the computer's clock was set, or the computer suspended."""
        now = self._journal.time_of_day
        if jump_s := now.jump_s():
            self._warn("clock-set", jump_in_words(jump_s))
        if slept_s := now.sleep_s():
            self._warn("suspended", sleep_in_words(slept_s))

    def _warn(self, code: str, text: str) -> None:
        self._run.event("warning", code, text)
        self._observers.event("warning", text)
