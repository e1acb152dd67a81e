"""The guard: a separate process that makes the bench safe when its run cannot.

It runs in a session of its own and listens on a pipe. The run sends it the bench file, heartbeats,
and a message when the bench is safe and when the run is done. If the pipe closes before that, the
run has died: the guard acts. If a heartbeat is late, the run hangs (or was suspended): the guard
kills it, then acts. To act, it connects to every instrument of the bench and calls its driver's
`make_safe`, each isolated from the others' failures, measures what is still pressed, lifts z off it
where nothing speaks against that (`rig.run.making_safe.lift`), compiles the journal, and writes a
report of what was done. On a bench that others use it leaves a mark (`rig.run.locks.bench_mark`),
which the next command reports; that of an unsafe bench refuses it.

This module is the program as well (``python -m rig.run.making_safe.guard``). At its start it
imports its report's module and a few small ones of `rig.core`; it imports the rest of the project
only when it has to act, so a guard costs a few milliseconds. The run's side of the pipe is
`rig.run.making_safe.guard_link`, which the guard never imports.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import select
import signal
import sys
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.core.errors import RigError
from rig.core.text import in_shell
from rig.run.making_safe.guard_report import in_words, write

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan
    from rig.run.arming import Act, Arming
    from rig.run.making_safe.still_pressed import PressedState


COMPILED_S = 30.0
"""Longest time in s that a run which waits for its guard allows for the compilation of its data."""
PRESSED_S = 25.0
"""Time in s after which the guard no longer lifts z; it then stands within `REST_S` and the time
that a last measurement takes."""
AGAIN_S, AGAIN_EVERY_S = 5.0, 0.5
"""Time in s for which the guard tries again what did not answer, and the pause before each try: a
switch that restarts, or an adapter that was unplugged, answers again within a few seconds."""
SHOWN_S = 0.3
"""Longest time in s that a last word at the terminal of a killed run may take."""
REST_S = 10.0
"""Longest time in which an axis comes to rest, in addition to the waits for its answers."""


@dataclass
class _Watch:
    """State of the run as the guard knows it."""

    order: dict[str, Any]
    safe: bool = False
    done: bool = False
    kill: bool = False
    """True if the run has asked to be killed: it cannot end in order."""
    hangs: str = ""
    """What keeps the run from its next heartbeat, if that is known."""

    @property
    def cause(self) -> str:
        """Why the guard has to act, where the run does not hang."""
        return str(self.order.get("cause", "the run ended without saying so"))


def main() -> None:
    """Listen until the run is done, has died or hangs; act in the latter two cases."""
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    watch, lives = _listen(sys.stdin.fileno())
    if watch is None or watch.done:
        return
    if not lives:
        act(watch.order, watch.cause, already_safe=watch.safe)
        return
    terminal = _Terminal(watch.order["run_pid"])
    terminal.show(f"error: {watch.cause}; its guard makes the bench safe ...")
    _kill(watch.order["run_pid"])
    terminal.show(_closing(act(watch.order, watch.cause, already_safe=watch.safe)))


def _listen(pipe: int) -> tuple[_Watch | None, bool]:
    """Follow the run until there is nothing more to hear. Return what is known of it, and whether
    it lives and has to be killed: it hangs, or has asked for it."""
    buffer = b""
    watch: _Watch | None = None
    beat_s = time.monotonic()
    while watch is None or not watch.kill:
        patience = watch.order["heartbeat_timeout_s"] if watch and not watch.safe else None
        left_s = None if patience is None else max(0.0, beat_s + patience - time.monotonic())
        ready, _, _ = select.select([pipe], [], [], left_s)
        if not ready and watch:
            why = f": it waited for {watch.hangs}" if watch.hangs else ""
            watch.order["cause"] = f"no sign of life for {patience:g} s{why}; the run was killed"
            return watch, True
        chunk = os.read(pipe, 65536)
        if not chunk:
            return watch, False
        *lines, buffer = (buffer + chunk).split(b"\n")
        for line in lines:
            watch = _understand(line, watch)
            if not watch.hangs:
                beat_s = time.monotonic()
    # A guard that was stopped meanwhile finds a run that has killed itself, and its number may be
    # another process's by now.
    ready, _, _ = select.select([pipe], [], [], 0.0)
    return watch, not ready or os.read(pipe, 65536) != b""


class _Terminal:
    """The stderr of the run that is about to be killed, for a last message to its user.

    A terminal that is held (Ctrl-S) or a folder on a broken network would make a write wait for
    ever: nothing here waits longer than `SHOWN_S`.
    """

    def __init__(self, run_pid: int):
        self._path = f"/proc/{run_pid}/fd/2"
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._shown = threading.Semaphore(0)
        with contextlib.suppress(RuntimeError):  # no thread can be started: no last word
            threading.Thread(target=self._run, name="last words", daemon=True).start()

    def show(self, line: str) -> None:
        """Show a line if that can be done at once."""
        self._lines.put(line)
        self._shown.acquire(timeout=SHOWN_S)

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            flags = os.O_WRONLY | os.O_APPEND | os.O_NOCTTY | os.O_NONBLOCK
            stderr = os.open(self._path, flags)
            start = b"\r" if os.isatty(stderr) else b""
            while True:
                os.write(stderr, start + self._lines.get().encode() + b"\n")
                self._shown.release()


def _closing(report: dict[str, Any]) -> str:
    """Return what a person at the terminal of a killed run has to know, as one line."""
    if report["safe"]:
        pressed = f"; {report['pressed']}" if report["pressed"] else ""
        line = f"Bench was made safe by the guard{pressed}."
    else:
        reasons = "; ".join(f"{role}: {why}" for role, why in report["failures"].items())
        line = f"Bench is NOT safe: {reasons}. Switch it off by hand and find out why."
    if report["journal"] is not None and "file" in report:
        line += f" Data: {report['file']}. Resume with: rig resume {in_shell(report['journal'])}"
    return line


def act(order: dict[str, Any], cause: str, already_safe: bool = False) -> dict[str, Any]:
    """Make the bench safe, compile the journal, write the report; return the report."""
    made = MadeSafe() if already_safe else _make_safe_as_ordered(order)
    report: dict[str, Any] = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "run_pid": order["run_pid"],
        "cause": cause,
        "safe": made.safe,
        "stopped": made.safe,
        "pressed": "",
        "released": False,
        "failures": made.failures,
        "journal": order["journal"],
    }
    # Published after each step: the next run must see the state of the bench at once.
    _publish(order, report)
    if not already_safe and made.safe:
        _add_what_is_pressed(order, report)
        _publish(order, report)
    journal = order["journal"]
    if journal is not None and not order.get("saves"):
        report["file"] = _compile(Path(journal))
    else:
        report["file"] = None if journal is None else "left to the run"
    _publish(order, report)
    return report


def _add_what_is_pressed(order: dict[str, Any], report: dict[str, Any]) -> None:
    """Measure what is still pressed, and lift z off it where that may be done. A force over its
    limit that remains makes the bench unsafe, since only a person can release it."""
    found: list[PressedState] = []
    why = f"the instruments gave no answer within {PRESSED_S + REST_S:g} s"

    def measure() -> None:
        from rig.run.making_safe.still_pressed import Orders, pressed_state

        zero = order.get("zero")
        orders = Orders(
            zero=zero and tuple(zero),
            limit_N=order.get("limit", math.inf),
            lasting=bool(order["marks"]),
            lifts=order.get("lifts", True),
            within_s=PRESSED_S,
        )
        found.append(pressed_state(order["bench_toml"], order["bench_source"], orders))

    # An instrument that hangs must not prevent the compilation of the data. A lift ends itself
    # before this gives up: nothing moves when the guard has ended and its locks are free.
    thread = threading.Thread(target=measure, name="still pressed", daemon=True)
    try:
        thread.start()
    except RuntimeError:  # the limit on threads is reached: without the deadline, but lifted
        try:
            measure()
        except Exception as error:  # noqa: BLE001 - the data come next
            why = f"{type(error).__name__}: {error}"
    else:
        thread.join(PRESSED_S + REST_S)
    if not found:
        report["pressed"] = f"not known whether something is still pressed: {why}"
        return
    report["pressed"], report["released"] = found[0].text, found[0].released
    if found[0].over_limit is not None:
        report["safe"] = False
        report["failures"] |= {"stage_z": found[0].over_limit}


def _publish(order: dict[str, Any], report: dict[str, Any]) -> None:
    """Mark the bench and write the report. What cannot be written must not prevent the rest: the
    mark that the run has written then stays, and refuses the bench."""
    from rig.run.locks.bench_mark import BenchMarks

    with contextlib.suppress(RigError):
        marks = BenchMarks(order["marks"], order["bench"], order["journal"])
        if report["safe"]:
            marks.stopped(in_words(report), report["released"])
        else:
            marks.unsafe(report["failures"])
    with contextlib.suppress(OSError):
        write(Path(order["report"]), report)


class MadeSafe(NamedTuple):
    """Result of making every instrument of a bench safe."""

    failures: dict[str, str] = {}  # noqa: RUF012 - never changed
    """Reasons why instruments could not be made safe, by role."""
    safe: bool = True
    """True if nothing moves or is switched on: an instrument that drives nothing may have failed to
    answer."""


def longest_make_safe_s(settings: Any) -> float:
    """Return the longest time in s that an instrument's `make_safe` may take."""
    from rig.bench.plan import longest_call_s

    return REST_S + longest_call_s(settings)


def longest_take_over_s(plan: BenchPlan) -> float:
    """Return the longest time in s that the guard of a bench may take to act."""
    each_s = [longest_make_safe_s(part.settings) for part in plan.instruments]
    return 2 * sum(each_s) + AGAIN_S + PRESSED_S + REST_S + COMPILED_S


def make_bench_safe(bench_toml: str, source: str, again_s: float = 0.0) -> MadeSafe:
    """Call every driver's `make_safe` in the order of the roles, each isolated from the others'
    failures and each with a deadline. What failed is tried again for `again_s` seconds. Where the
    computer's limit on threads is reached, those for which none is left are called one after the
    other and without a deadline.

    An instrument whose driver or settings cannot be used is reported as a failure; the others are
    made safe. Raises ConfigurationError if the text describes no instrument at all.
    """
    from rig.bench.plan import parse_to_make_safe
    from rig.instruments.roles import MEASURING_ROLES
    from rig.run.arming import Arming

    described = parse_to_make_safe(bench_toml, source)
    arming = Arming()
    without_thread: dict[str, Act] = {}
    for part in reversed(described.instruments):
        off = partial(part.driver.make_safe, part.settings)
        try:
            arming.register(part.role, off, longest_make_safe_s(part.settings))
        except RigError:
            without_thread[part.role] = off
    failed = _make_safe(arming) | _make_safe_here(without_thread)
    give_up_s = time.monotonic() + again_s
    while failed and time.monotonic() < give_up_s:
        time.sleep(AGAIN_EVERY_S)
        # What has worked is not armed any more.
        failed = _make_safe(arming) | _make_safe_here(without_thread)
    safe = not described.failures and all(role in MEASURING_ROLES for role in failed)
    return MadeSafe(failed | described.failures, safe)


def _make_safe(arming: Arming) -> dict[str, str]:
    """Run what is armed; return the reasons of what failed, by role."""
    return {f.name: f.reason.removeprefix(f"{f.name}: ") for f in arming.make_safe()}


def _make_safe_here(calls: dict[str, Act]) -> dict[str, str]:
    """Make these calls in the present thread, the latest first, and forget those that have worked;
    return the reasons of the others, by role."""
    from rig.run.arming import Task

    failed = {}
    for role in reversed(tuple(calls)):
        task = Task(calls[role])
        task.run()
        if task.reason is None:
            del calls[role]
        else:
            failed[role] = task.reason.removeprefix(f"{role}: ")
    return failed


def _make_safe_as_ordered(order: dict[str, Any]) -> MadeSafe:
    """Make the bench safe; any exception becomes a failure, for the report."""
    try:
        return make_bench_safe(order["bench_toml"], order["bench_source"], AGAIN_S)
    except Exception as error:  # noqa: BLE001 - the report keeps the next run from starting
        return MadeSafe({"bench": f"{type(error).__name__}: {error}"}, False)


def _compile(journal: Path) -> str:
    from rig.core.errors import RigError
    from rig.files.runfile.recover import recover

    try:
        return str(recover(journal))
    except (RigError, OSError) as error:
        return f"not compiled: {error}"


def _understand(line: bytes, watch: _Watch | None) -> _Watch:
    if watch is None:
        return _Watch(json.loads(line))
    for word in ("zero", "limit", "cause"):
        if line.startswith(word.encode() + b" "):
            watch.order[word] = json.loads(line[len(word) :])
    watch.hangs = json.loads(line[len(b"hangs ") :]) if line.startswith(b"hangs ") else ""
    if line == b"saves":
        watch.order["saves"] = True
    watch.safe = watch.safe or line == b"safe"
    watch.done = watch.done or line == b"done"
    watch.kill = watch.kill or line == b"kill"
    return watch


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    main()
    os._exit(0)  # a thread that waits for an instrument would keep the guard, and with it the locks
