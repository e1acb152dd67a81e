"""Ends the programs that only read a bench, such as `rig monitor`, before it is made safe.

Such a program may have a serial port for itself, or answers on a line may reach it instead of the
one who asks.
"""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING

from rig.run.locks.lock import address_names, is_only_read
from rig.run.locks.lock_holder import ask_to_stop, lock_file

if TYPE_CHECKING:
    from rig.bench.plan import Restable

LOOK_EVERY_S = 0.02
GRACE_S = 0.5
"""Time in s that such a program gets to close its links; then it is killed. Making safe shall not
wait longer for it, and what it leaves is a sensor that sends, which drives nothing."""
LETS_GO_S = 2.0
"""Longest time in s that is waited for it in all."""


def end_readers(plan: Restable) -> int | None:
    """End the program that only reads this bench, and wait until it has let go; return its process
    id, or None if there is none.

    One that has not let go within `LETS_GO_S` is left: what follows may still succeed. Raises
    NotStoppedError for another user's.
    """
    asked, begun = None, time.monotonic()
    signals = [(0.0, signal.SIGTERM), (GRACE_S, signal.SIGKILL)]
    for name in address_names(plan):
        while is_only_read(name) and (waited := time.monotonic() - begun) < LETS_GO_S:
            if signals and waited >= signals[0][0]:
                asked = ask_to_stop(lock_file(name), signals.pop(0)[1]).pid
            time.sleep(LOOK_EVERY_S)
    return asked
