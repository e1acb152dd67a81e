"""Ends the programs that only read a bench, such as `rig monitor`, before it is made safe.

Such a program may have a serial port for itself, or answers on a line may reach it instead of the
one who asks.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rig.run.lock import LOOK_EVERY_S, address_names, is_only_read
from rig.run.lock_holder import ask_to_stop, lock_file

if TYPE_CHECKING:
    from rig.bench.plan import Restable

LETS_GO_S = 3.0
"""Longest time in s that such a program gets to let go of the bench."""


def end_readers(plan: Restable) -> int | None:
    """End the program that only reads this bench, and wait until it has let go; return its process
    id, or None if there is none.

    One that has not let go within `LETS_GO_S` is left: what follows may still succeed. Raises
    NotStoppedError for another user's.
    """
    asked = None
    until = time.monotonic() + LETS_GO_S
    for name in address_names(plan):
        while is_only_read(name) and time.monotonic() < until:
            if asked is None:
                asked = ask_to_stop(lock_file(name)).pid
            time.sleep(LOOK_EVERY_S)
    return asked
