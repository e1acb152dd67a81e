"""Ends the programs that use a bench, before it is made safe.

A program that only reads, such as `rig monitor`, may have a serial port for itself, or answers on a
line may reach it instead of the one who asks.

A run is asked to stop, as Ctrl-C does: it stops within 20 ms, lifts z and begins nothing more. If
its instruments were only stopped behind its back, it would move them again with its next command,
and where that ends its way up something would stay pressed.
"""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING

from rig.run.locks.bench_mark import BenchMark, read_marks
from rig.run.locks.lock import address_names, in_use, is_only_read, try_lock
from rig.run.locks.lock_holder import NotStoppedError, ask_to_stop, holder_of, lock_file
from rig.run.locks.shared_folder import SharedFolder

if TYPE_CHECKING:
    from rig.bench.plan import Restable

LOOK_EVERY_S = 0.02
GRACE_S = 0.5
"""Time in s that such a program gets to close its links; then it is killed. Making safe shall not
wait longer for it, and what it leaves is a sensor that sends, which drives nothing."""
LETS_GO_S = 2.0
"""Longest time in s that is waited for it in all."""
MADE_SAFE_S = 5.0
"""Longest time in s that is waited for a run to make its bench safe, which takes 1 to 3 s."""
SAVED_S = 15.0
"""Longest time in s that is waited for a run in all, once its bench is safe: it saves its data, and
may have a serial port for itself until then."""
ALONE_S = 10.0
"""Longest time in s that is waited for another `rig make-safe`, which takes 1 to 2 s where every
instrument answers."""
MAKING_SAFE_SUFFIX = ".making-safe"


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


def stop_users(plan: Restable) -> list[NotStoppedError]:
    """Ask every program that uses this bench to stop, and wait until it has let go; return why one
    could not be asked.

    The guard of a run that has died is asked nothing: it makes the bench safe, and is waited for
    as well. What has not let go within `MADE_SAFE_S`, or `SAVED_S` once its bench is safe, is
    left: `run_at_work` says whether it may still move something.
    """
    names = address_names(plan)
    asked: set[int] = set()
    failures = []
    for file in map(lock_file, names):
        holder = holder_of(file)
        if holder is None or holder.pid in asked:
            continue
        asked.add(holder.pid)
        try:
            ask_to_stop(file)
        except NotStoppedError as error:
            failures.append(error)
    begun_s = time.monotonic()
    while not failures and in_use(plan) is not None:
        safe = not any(mark.lives for mark in read_marks(names))
        if time.monotonic() - begun_s > (SAVED_S if safe else MADE_SAFE_S):
            break
        time.sleep(LOOK_EVERY_S)
    return failures


def take_turn(plan: Restable) -> None:
    """Wait until no other `rig make-safe` is at work on these instruments, at most `ALONE_S`, and
    keep others waiting until this program ends: on a serial line each would spoil the other's
    answers.

    Raises OSError or ConfigurationError if the files for it cannot be opened.
    """
    give_up_s = time.monotonic() + ALONE_S
    with SharedFolder() as folder:
        for name in address_names(plan):
            # It stays open: the lock ends with this program.
            file = folder.open_file(name + MAKING_SAFE_SUFFIX, create=True)
            while not try_lock(file) and time.monotonic() < give_up_s:
                time.sleep(LOOK_EVERY_S)


def run_at_work(plan: Restable) -> BenchMark | None:
    """Return the mark of a run that lives and has not made this bench safe, None if there is none:
    it may move it again."""
    for mark in read_marks(address_names(plan)):
        if mark.state == "running" and mark.run is not None and mark.run.lives:
            return mark
    return None
