"""Names the code of a package that keeps the procedure from its next wait.

The procedure then gives no sign of life: drives get no keep-alives and stop by themselves, and the
guard kills the run. Neither of them can see what the procedure is doing, so a thread of the run
looks, and lets both know: the drives by the clock (`Clock.hung`), the guard by its pipe.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from types import FrameType, TracebackType
from typing import Self

from rig.core.clock import Clock
from rig.core.entry_points import place_of
from rig.core.threads import start_thread

LOOK_EVERY_S = 0.2
"""Interval of the looks. What hangs is named when two looks in a row have found it."""
OWN_CODE = ("rig", "procedures", "drivers")
"""Top modules of this program: a package that has called it is not what hangs."""


class HangWatch:
    """Looks, within ``with``, at what the thread that has entered it does while it gives no sign of
    life."""

    def __init__(
        self,
        clock: Clock,
        packages: Mapping[str, str],
        inform: Callable[[str], None],
        warn: Callable[[str], None],
    ):
        """Name what hangs by `packages`, which says whose code the top modules of other packages
        are, as the end of a sentence.

        `inform` takes what hangs, and where, each time; `warn` takes a warning, once for each
        function, in real time. Both are called from the watch's thread.
        """
        self._clock, self._packages = clock, packages
        self._inform, self._warn = inform, warn
        self._ident = 0
        self._ending = threading.Event()
        self._warned: set[str] = set()

    def __enter__(self) -> Self:
        self._ident = threading.get_ident()
        if self._packages:
            thread = threading.Thread(target=self._run, name="hang watch", daemon=True)
            start_thread(thread)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        raised: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ending.set()

    def _run(self) -> None:
        with self._clock.in_background():
            before, looked_s = "", time.monotonic()
            while not self._ending.wait(LOOK_EVERY_S):
                now_s = time.monotonic()
                late, looked_s = now_s - looked_s > 2 * LOOK_EVERY_S, now_s
                # Where this thread is late as well, the computer stood still.
                found = "" if late or self._clock.procedure_alive else self._what_hangs()
                if found and found == before:
                    self._report(found)
                before = found

    def _report(self, what: str) -> None:
        words = f"{what}{self._place()}"
        self._clock.hung = words, self._clock.now()
        self._inform(words)
        if what in self._warned or self._clock.is_virtual:
            return
        self._warned.add(what)
        self._warn(
            f"{words} keeps the run from its next wait: meanwhile no drive gets keep-alives, and "
            "one with a communication time-out stops by itself; compute in it what is quick, and "
            "the rest in an analysis (docs/add-an-analysis.md)"
        )

    def _what_hangs(self) -> str:
        """Return the function of a package that this program has called and that is at work; "" if
        its own code is, or none of a package."""
        name = ""
        module = ""
        frame = self._frame()
        while frame is not None:
            top = _top_module(frame)
            if top in OWN_CODE:
                break
            if top in self._packages:
                name, module = frame.f_code.co_name, top
            frame = frame.f_back
        return f"{name}() of {self._packages[module]}" if name else ""

    def _place(self) -> str:
        """Return where in its package the function is now, in brackets."""
        frame = self._frame()
        while frame is not None and (top := _top_module(frame)) not in OWN_CODE:
            if top in self._packages:
                return f" ({place_of(top, frame)})"
            frame = frame.f_back
        return ""

    def _frame(self) -> FrameType | None:
        return sys._current_frames().get(self._ident)


def _top_module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__")).split(".")[0]
