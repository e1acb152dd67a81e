"""The process in which another package's detector runs during a trial (`rig.processing.live`).

It has no descriptor of the run but one socket. It consists of two processes: one that runs the
detector, and one that does nothing but watch. When the run has closed the connection or ended, or
the detector's process has ended, the watching one kills all that is left, also where the detector
hangs in C code or has started processes. It is the subreaper of these, so that one that has left
their session and lost its parent still is its descendant.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import select
import signal
import socket
import sys
import time
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path
from typing import Any

NICENESS = 10
"""Niceness of the detector: the run and the guard come first."""
ENDED_S = 1.0
"""Longest time in s in which what was killed may disappear; a dead disk holds a process for
longer."""
_PR_SET_CHILD_SUBREAPER = 36


def main() -> None:
    """Serve the run on the socket whose descriptor is the first argument; never returns."""
    connection = socket.socket(fileno=int(sys.argv[1]))
    connection.set_inheritable(False)
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # not inherited by the worker
    worker = os.fork()
    if worker:
        _watch(connection, worker)
    os.nice(NICENESS)
    with contextlib.suppress(OSError):  # where memory runs out the detector goes, not the run
        Path("/proc/self/oom_score_adj").write_text("1000")
    _limit_memory()
    _serve(connection)
    os._exit(0)


def _limit_memory() -> None:
    """Leave the run half of the memory that is free now: where a detector took all of it, the
    computer would stand still, and with it the run and a simulated bench."""
    with contextlib.suppress(OSError, ValueError, StopIteration):
        known = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free_kB = int(next(line for line in known if line.startswith("MemAvailable")).split()[1])
        present, most = resource.getrlimit(resource.RLIMIT_DATA)
        # Of data, not of addresses: libraries reserve more of these than they ever use.
        lower = [limit for limit in (present, most) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_DATA, (min([free_kB * 1024 // 2, *lower]), most))


def _watch(connection: socket.socket, worker: int) -> None:
    """Wait until the run has closed its end or the worker has ended; then end all."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    poller = select.poll()
    poller.register(connection, 0)  # nothing but the other end's going
    poller.register(os.pidfd_open(worker), select.POLLIN)
    poller.poll()
    ended = os.waitid(os.P_PID, worker, os.WEXITED | os.WNOHANG)
    status = 128 + signal.SIGKILL  # the run has ended, or needs it no more
    if ended is not None:
        by_signal = ended.si_code != os.CLD_EXITED
        status = ended.si_status + (128 if by_signal else 0)
    _kill_the_others()
    os._exit(status)


def _kill_the_others() -> None:
    """Kill all descendants of this process, whose exit code the run reads, until none is left: one
    that loses its parent becomes a child of this process."""
    until_s = time.monotonic() + ENDED_S
    while (left := _descendants(os.getpid())) and time.monotonic() < until_s:
        for pid in left:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        time.sleep(0.002)


def _descendants(of: int) -> list[int]:
    """Return the numbers of the processes that a process has started, and those these have."""
    children = defaultdict(list)
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with contextlib.suppress(OSError, IndexError, ValueError):
                parent = (entry / "stat").read_bytes().rpartition(b")")[2].split()[1]
                children[int(parent)].append(int(entry.name))
    found = list(children[of])
    for pid in found:
        found += children[pid]
    return found


def _serve(connection: socket.socket) -> None:
    """Make the detector, say that it is ready, and answer messages until one fails."""
    import numpy as np

    from rig.core.errors import ConfigurationError, RigError
    from rig.detector.notices import from_text
    from rig.detector.registered import chosen_detector
    from rig.processing import live

    order = json.loads(sys.stdin.buffer.read())
    name, rate_Hz = order["name"], order["rate_Hz"]
    try:
        try:
            chosen = chosen_detector(name, order["settings"])
            # The first rows may compile something; the run waits for that now, and not later.
            chosen.make(rate_Hz).add(np.zeros((64, 2)))
            detector = chosen.make(rate_Hz)
        except ValueError as error:
            raise ConfigurationError(f"detector {name}: {error}") from error
    except RigError as error:
        _answer(
            connection, live.FAILED, 0,
            {"message": error.message, "hint": error.hint, "code": int(error.code)},
        )  # fmt: skip
        return
    _answer(connection, live.READY, 0, asdict(live.identity_of(chosen)))
    while message := connection.recv(live.MOST_BYTES):
        asked, number, first = live.HEAD.unpack_from(message)
        try:
            if asked == live.BEGIN:
                detector, events = chosen.make(rate_Hz), []
            elif asked == live.ROWS:
                volts = np.frombuffer(message, np.float64, offset=live.HEAD.size).reshape(-1, 2)
                events = detector.add(volts, first)
            elif asked == live.NOTICE:
                (one,), events = from_text(message[live.HEAD.size :].decode()), []
                detector.notice(one)
            else:
                events = detector.finish()
            if len(events) > live.MOST_EVENTS:
                raise ValueError(f"{len(events)} events at once")
            content = [
                (one.kind, one.sample, one.time_s, one.confidence, one.reason, one.features)
                for one in events
            ]
            _answer(connection, live.DONE, number, content or None)
        except Exception as error:  # noqa: BLE001 - the run says what it was
            reason = getattr(error, "reason", f"{type(error).__name__}: {error}")
            _answer(connection, live.FAILED, number, str(reason))
            return


def _answer(connection: socket.socket, kind: int, number: int, content: Any) -> None:
    from rig.processing import live

    body = b"" if content is None else json.dumps(content).encode()
    with contextlib.suppress(BrokenPipeError):
        connection.send(live.HEAD.pack(kind, number, 0) + body)


if __name__ == "__main__":
    main()
