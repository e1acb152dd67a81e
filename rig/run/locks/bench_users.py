"""Ends the programs that use a bench, before it is made safe.

A program that only reads, such as `rig monitor`, may have a serial port for itself, or answers on a
line may reach it instead of the one who asks.

A run is asked to stop, as Ctrl-C does: it stops within 20 ms, lifts z and begins nothing more. If
its instruments were only stopped behind its back, it would move them again with its next command,
and where that ends its way up something would stay pressed.

A bench is given by the names of its addresses (`rig.run.locks.lock.address_names`). They are found
once by who calls, because that may ask a name server.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rig.run.locks.bench_mark import BenchMark, read_marks
from rig.run.locks.lock import is_only_read, names_in_use, run_named_in, try_lock
from rig.run.locks.lock_holder import (
    NotStoppedError,
    ask_to_stop,
    holder_of,
    lock_file,
    locked_inodes,
)
from rig.run.locks.shared_folder import SharedFolder, user_name

LOOK_EVERY_S = 0.05
GRACE_S = 0.5
"""Time in s that such a program gets to close its links; then it is killed. Making safe shall not
wait longer for it, and what it leaves is a sensor that sends, which drives nothing."""
LETS_GO_S = 2.0
"""Longest wait in s for it in all."""
GUARDED_S = 25.0
"""Longest wait in s for a run to make its bench safe. 1 to 3 s are usual, a long way
up may take 20 s. One that hangs is killed by its guard, which then makes the bench safe."""
UNGUARDED_S = 5.0
"""The same for a run without a guard, or that has failed to make the bench safe: nothing else
acts."""
GUARD_ACTS_S = 40.0
"""Longest wait in s for the guard of a run that has died: it may lift z for 35 s."""
SAVED_S = 15.0
"""Longest wait in s for a run whose bench is safe: it saves its data, and may have a
serial port for itself until then."""
ALONE_S = 10.0
"""Longest wait in s for another `rig make-safe`, which takes 1 to 2 s where every
instrument answers."""
MAKING_SAFE_SUFFIX = ".making-safe"


def end_readers(names: Sequence[str]) -> int | None:
    """End the program that only reads this bench, and wait until it has let go; return its process
    id, or None if there is none.

    One that has not let go within `LETS_GO_S` is left: what follows may still succeed. Raises
    NotStoppedError for another user's.
    """
    asked, begun = None, time.monotonic()
    signals = [(0.0, signal.SIGTERM), (GRACE_S, signal.SIGKILL)]
    for name in names:
        while is_only_read(name) and (waited := time.monotonic() - begun) < LETS_GO_S:
            if signals and waited >= signals[0][0]:
                asked = ask_to_stop(lock_file(name), signals.pop(0)[1]).pid
            time.sleep(LOOK_EVERY_S)
    return asked


@dataclass(frozen=True)
class StopRequests:
    """The programs that were asked to stop."""

    pids: set[int] = field(default_factory=set)
    """Their process ids."""
    runs: set[Path] = field(default_factory=set)
    """Journals of their latest runs, where they have had one."""
    failures: list[NotStoppedError] = field(default_factory=list)
    """Why a program could not be asked."""


def ask_users(names: Sequence[str], requests: StopRequests) -> None:
    """Ask every program that uses this bench to stop, and add it to `requests`. The guard of a run
    that has died is asked nothing: it makes the bench safe."""
    for name in names:
        file = lock_file(name)
        holder = holder_of(file)
        if holder is None or holder.pid in requests.pids or is_only_read(name):
            continue
        try:
            requests.pids.add(ask_to_stop(file).pid)
        except NotStoppedError as error:
            requests.failures.append(error)
        else:
            if (journal := run_named_in(name)) is not None:
                requests.runs.add(journal)


def await_users(names: Sequence[str], requests: StopRequests) -> None:
    """Wait until the programs that were asked, and guards at work, have let this bench go.

    A program that could not be asked is not waited for, nor one that takes longer than what it
    does may take: `still_at_work` says whether something may still move.
    """
    begun_s = time.monotonic()
    while not requests.failures and names_in_use(names) is not None:
        if time.monotonic() - begun_s > _patience_s(names):
            break
        time.sleep(LOOK_EVERY_S)


def _patience_s(names: Sequence[str]) -> float:
    marks = read_marks(names)
    if at_work := [mark for mark in marks if mark.lives]:
        guarded = any(mark.guard is not None and mark.guard.lives for mark in at_work)
        return GUARDED_S if guarded else UNGUARDED_S
    if any(mark.state == "unsafe" for mark in marks):
        return UNGUARDED_S
    if any(holder_of(lock_file(name)) is not None for name in names):
        return SAVED_S
    return GUARD_ACTS_S if any(_has_writer(mark) for mark in marks) else UNGUARDED_S


def _has_writer(mark: BenchMark) -> bool:
    """Return whether the process that wrote the mark lives: a guard, where nothing else does."""
    return mark.run is not None and mark.run.lives


def take_turn(names: Sequence[str]) -> None:
    """Wait at most `ALONE_S` until no other `rig make-safe` is active on these instruments, and
    keep others waiting until this program ends: on a serial line each would spoil the other's
    answers.

    Raises OSError or ConfigurationError if the files for it cannot be opened.
    """
    give_up_s = time.monotonic() + ALONE_S
    with SharedFolder() as folder:
        for name in names:
            # It stays open: the lock ends with this program.
            file = folder.open_file(name + MAKING_SAFE_SUFFIX, create=True)
            while not try_lock(file) and time.monotonic() < give_up_s:
                time.sleep(LOOK_EVERY_S)


def still_at_work(names: Sequence[str], requests: StopRequests) -> tuple[str, str] | None:
    """Return which program may still move something on this bench, and what can be done about it;
    None if there is none.

    One that was asked to stop and whose bench is safe begins nothing more, and may hold the locks
    while it saves its data.
    """
    for mark in read_marks(names):
        if mark.lives and mark.run is not None:
            return _in_words(f"the run of {mark.user}", mark.run.pid, mark.user)
    locked = locked_inodes()
    for name in names:
        file = lock_file(name)
        if names_in_use([name]) is None or is_only_read(name):
            continue
        holder = holder_of(file, locked)
        if holder is None:
            what = "a program that cannot be seen (a guard, or another user's)"
            return what, "find out who uses it"
        if holder.pid not in requests.pids:
            return _in_words(f"a program of {holder.user}", holder.pid, holder.user)
    return None


def _in_words(what: str, pid: int, user: str) -> tuple[str, str]:
    who = "" if user == user_name(os.geteuid()) else f"have {user} or an administrator "
    return f"{what} (process {pid})", f"{who}end it (kill -9 {pid})"
