"""The guard: a separate process that makes the bench safe when its run cannot.

It runs in a session of its own and listens on a pipe. The run sends it the bench file, heartbeats,
and a message when the bench is safe and when the run is done. If the pipe closes before that, the
run has died: the guard acts. If a heartbeat is late, the run hangs (or was suspended): the guard
kills it, then acts. To act, it connects to every instrument of the bench and calls its driver's
`make_safe`, each isolated from the others' failures, measures what is still pressed, lifts z off it
where nothing speaks against that (`rig.run.making_safe.lift`), compiles the journal, and writes a
report of what was done. On a bench that others use it leaves a mark (`rig.run.locks.bench_mark`),
which the next command reports; that of an unsafe bench refuses it.

This module is the program as well (``python -m rig.run.making_safe.guard``); it imports the rest of
the project only when it has to act, so a guard costs a few milliseconds.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import queue
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from rig.core.atomic import write_text
from rig.core.errors import RigError

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan
    from rig.run.arming import Arming
    from rig.run.making_safe.still_pressed import PressedState


GUARD_SUFFIX = ".guard.json"
"""Suffix of a report next to its run file, for a bench that ended with the run."""
COMPILED_S = 30.0
"""Longest time in s that a run which waits for its guard allows for the compilation of its data."""
SILENT_S = 5.0
"""Longest time in s for which a guard may leave heartbeats unread. After it the run reports that
the guard is stopped or gets no processor time, since it normally reads each at once."""
PRESSED_S = 25.0
"""Time in s after which the guard no longer lifts z; it then stands within `REST_S` and the time
that a last measurement takes."""
MOST_UNREAD_BYTES = 4096
"""Number of unread bytes from which no further heartbeats are sent. A pipe holds 65536 bytes, and a
write to a full one would wait for ever; so there is always room for the messages that the bench is
safe and that the run is done."""
ENDING_S = 5.0
"""Longest time in s that a guard with nothing left to do may take to end before it is killed."""
AGAIN_S, AGAIN_EVERY_S = 5.0, 0.5
"""Time in s for which the guard tries again what did not answer, and the pause before each try: a
switch that restarts, or an adapter that was unplugged, answers again within a few seconds."""
SHOWN_S = 0.3
"""Longest time in s that a last word at the terminal of a killed run may take."""
REST_S = 10.0
"""Longest time in which an axis comes to rest, in addition to the waits for its answers."""


def report_path(results: Path, bench_name: str) -> Path:
    """Return the path of the report of a bench's guard."""
    return results / f"guard-{bench_name}.json"


def takeover_notice(path: Path) -> str | None:
    """Return, once, a sentence on what the guard did when the run of a simulated bench of its own
    died, from its report. Returns None for a guard that is still acting, and for one that could not
    make the bench safe: that bench has ended."""
    try:
        report = json.loads(path.read_text())
        if report["safe"] is not True or report.get("told") or "file" not in report:
            return None
        notice = _in_words(report)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    _mark_reported(path, report)
    return notice


def _in_words(report: dict[str, Any]) -> str:
    """Return what the guard has done, as a sentence."""
    words = (
        f"the guard of an earlier run had to act at {report['time']}: {report['cause']}; "
        "everything was stopped and switched off"
    )
    for role in report["failures"] if report["safe"] else ():
        words += f"; {role} did not answer, which drives nothing"
    if report.get("pressed"):
        words += f", {report['pressed']}"
    if report["journal"] is not None and "file" in report:
        words += f"; data: {report['file']}; continue with: rig resume {report['journal']}"
    return words


def _mark_reported(path: Path, report: dict[str, Any]) -> None:
    with contextlib.suppress(OSError):
        _write(path, report | {"told": True})


class TakenOver(NamedTuple):
    """Result of the guard's try to make a bench safe after its run could not."""

    safe: bool
    summary: str
    """The result as a sentence."""
    released: bool = False
    """True if the guard has seen z stand clear of contact."""


def judged(report: dict[str, Any], over_limit: Sequence[str] = ()) -> TakenOver:
    """Return what a guard's report says of the bench that a run has left to it.

    `over_limit` names what the run has found pressed over its limit. To stop everything does not
    release it, so it is safe only where the guard has then seen z stand clear.
    """
    if not report["safe"]:
        failures = "; ".join(f"{role}: {why}" for role, why in report["failures"].items())
        return TakenOver(False, f"the guard could not make the bench safe either: {failures}")
    released = report.get("released") is True
    pressed = f", {report['pressed']}" if report["pressed"] else ""
    if over_limit and not released:
        return TakenOver(
            False,
            f"the guard has stopped everything{pressed}; {' and '.join(over_limit)} may still be "
            "over the limit: move the stage away by hand, then run: rig make-safe",
        )
    return TakenOver(True, f"the guard then made the bench safe{pressed}", released)


class GuardLink:
    """The run's side of the guard: starts it and keeps it informed."""

    def __init__(
        self,
        plan: BenchPlan,
        journal: Path | None,
        report: Path,
        held: Sequence[int] = (),
        marks: Sequence[str] = (),
        lifts: bool = True,
    ):
        """Start the guard.

        `journal` is the run's journal, None if nothing is recorded. `held` are the lock files of
        the bench, which the guard keeps open as long as it runs. `marks` are the names of the
        bench's addresses, whose marks it writes; none for a bench that belongs to the run alone.
        `lifts` off: a person is at the bench, so the guard stops z and does not lift it. Raises
        RigError if the guard cannot be started.
        """
        self._report = report.resolve()
        self._journal = None if journal is None else str(journal.resolve())
        order = {
            "run_pid": os.getpid(),
            "journal": self._journal,
            "report": str(self._report),
            "bench": plan.settings.name,
            "marks": list(marks),
            "bench_toml": plan.text,
            "bench_source": plan.source,
            "heartbeat_timeout_s": plan.settings.heartbeat_timeout_s,
            "lifts": lifts,
        }
        self._take_over_s = longest_take_over_s(plan)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "rig.run.making_safe.guard"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                pass_fds=held,
            )
        except OSError as error:
            raise RigError(
                f"the guard cannot be started: {error}; the limit on processes, files or memory is "
                "reached",
                "end other programs, or raise the limit (ulimit -u, ulimit -n), and start again",
            ) from error
        self._zero: Sequence[float] | None = None
        self._limit_N = math.inf
        self._heard_s = time.monotonic()
        """Time at which the guard had last read everything that was sent to it."""
        self._send(json.dumps(order))

    @property
    def pid(self) -> int:
        """The guard's process id."""
        return self._process.pid

    def trouble(self) -> str | None:
        """Return what is wrong with the guard, as the end of a sentence that begins with "the
        guard"; None while it is well."""
        if self._process.poll() is not None:
            return "has died"
        silent_s = time.monotonic() - self._heard_s
        if silent_s < SILENT_S:
            return None
        pid = self._process.pid
        return (
            f"(process {pid}) has not read a heartbeat for {silent_s:.0f} s, it is stopped or gets "
            f"no processor time (to continue it: kill -CONT {pid})"
        )

    def beat(self) -> None:
        """Send a heartbeat, unless the guard has left many unread; never waits."""
        unread = self._unread_bytes()
        if unread == 0:
            self._heard_s = time.monotonic()
        if unread < MOST_UNREAD_BYTES:
            self._send("beat")

    def zero(self, raw: Sequence[float]) -> None:
        """Send the force sensor's raw reading without force, if it is another than before. The
        guard needs it to say what is still pressed."""
        if raw != self._zero:
            self._zero = raw
            self._send(f"zero {json.dumps(list(raw))}")

    def limit(self, limit_N: float) -> None:
        """Send the force that the run watches for, if it is another than before: one above it that
        remains is not safe."""
        if limit_N != self._limit_N and math.isfinite(limit_N):
            self._limit_N = limit_N
            self._send(f"limit {limit_N!r}")

    def safe(self) -> None:
        """Report that everything is off, so that a slow compilation does not make the guard act."""
        self._send("safe")

    @property
    def died(self) -> bool:
        """True if the guard has ended."""
        return self._process.poll() is not None

    def cause(self, text: str) -> None:
        """Send why the guard has to act, or may have to: a sentence for its report."""
        self._send(f"cause {json.dumps(text)}")

    def kill(self) -> NoReturn:
        """Have the guard kill this run and make the bench safe. This process ends as well if the
        guard does not react."""
        self._send("kill")
        self._process.send_signal(signal.SIGCONT)  # one that was stopped is needed now
        if not self.died:
            time.sleep(ENDING_S)
        _kill(os.getpid())
        raise AssertionError("a process that was killed still runs")

    def done(self) -> None:
        """Report that the run is done, and wait for the guard to end."""
        self._send("done")
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            # A stopped guard would keep the locks of the bench until it is continued.
            self._process.kill()
            self._process.wait()

    def take_over(self, over_limit: Sequence[str] = (), cause: str = "") -> TakenOver:
        """Leave the bench to the guard for this cause, and return the result of its try; see
        `judged`."""
        assert self._process.stdin is not None
        if cause:
            self.cause(cause)
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        self._process.send_signal(signal.SIGCONT)  # one that was stopped is needed now
        try:
            self._process.wait(timeout=self._take_over_s)
            report = json.loads(self._report.read_text())
        except subprocess.TimeoutExpired:
            return TakenOver(
                False,
                f"the guard has not reported within {self._take_over_s:.0f} s: look at the bench; "
                f"its report will be in {self._report}",
            )
        except (OSError, ValueError) as error:
            return TakenOver(False, f"the guard did not report: {error}")
        own = (os.getpid(), self._journal)
        if (report["run_pid"], report["journal"]) != own:  # Left by an earlier run.
            code = self._process.returncode
            return TakenOver(False, f"the guard did not report: it ended with code {code}")
        if report["safe"]:
            _mark_reported(self._report, report)
        return judged(report, over_limit)

    def _unread_bytes(self) -> int:
        assert self._process.stdin is not None
        count = fcntl.ioctl(self._process.stdin, termios.FIONREAD, struct.pack("i", 0))
        return int(struct.unpack("i", count)[0])

    def _send(self, word: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # A run continues without its guard rather than fail.
            self._process.stdin.write(word.encode() + b"\n")
            self._process.stdin.flush()


@dataclass
class _Watch:
    """State of the run as the guard knows it."""

    order: dict[str, Any]
    safe: bool = False
    done: bool = False
    kill: bool = False
    """True if the run has asked to be killed: it cannot end in order."""

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
    while watch is None or not watch.kill:
        patience = watch.order["heartbeat_timeout_s"] if watch and not watch.safe else None
        ready, _, _ = select.select([pipe], [], [], patience)
        if not ready and watch:
            watch.order["cause"] = f"no sign of life for {patience:g} s; the run was killed"
            return watch, True
        chunk = os.read(pipe, 65536)
        if not chunk:
            return watch, False
        *lines, buffer = (buffer + chunk).split(b"\n")
        for line in lines:
            watch = _understand(line, watch)
    # A guard that was stopped meanwhile finds a run that has killed itself, and its number may be
    # another process's by now.
    ready, _, _ = select.select([pipe], [], [], 0.0)
    return watch, not ready or os.read(pipe, 65536) != b""


class _Terminal:
    """Where the run that is about to be killed shows its messages, its stderr, for a last word.

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
        line += f" Data: {report['file']}"
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
    report["file"] = None if journal is None else _compile(Path(journal))
    _publish(order, report)
    return report


def _add_what_is_pressed(order: dict[str, Any], report: dict[str, Any]) -> None:
    """Measure what is still pressed, and lift z off it where that may be done. A force over its
    limit that remains makes the bench unsafe, since only a person can release it."""
    found: list[PressedState] = []

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
    thread.start()
    thread.join(PRESSED_S + REST_S)
    if not found:
        report["pressed"] = (
            "not known whether something is still pressed: the instruments gave no answer within "
            f"{PRESSED_S + REST_S:g} s"
        )
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
            marks.stopped(_in_words(report), report["released"])
        else:
            marks.unsafe(report["failures"])
    with contextlib.suppress(OSError):
        _write(Path(order["report"]), report)


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
    failures and each with a deadline. What failed is tried again for `again_s` seconds.

    An instrument whose driver or settings cannot be used is reported as a failure; the others are
    made safe. Raises ConfigurationError if the text describes no instrument at all.
    """
    from rig.bench.plan import parse_to_make_safe
    from rig.instruments.roles import MEASURING_ROLES
    from rig.run.arming import Arming

    described = parse_to_make_safe(bench_toml, source)
    arming = Arming()
    for part in reversed(described.instruments):
        off = partial(part.driver.make_safe, part.settings)
        arming.register(part.role, off, longest_make_safe_s(part.settings))
    failed = _make_safe(arming)
    give_up_s = time.monotonic() + again_s
    while failed and time.monotonic() < give_up_s:
        time.sleep(AGAIN_EVERY_S)
        failed = _make_safe(arming)  # what has worked is not armed any more
    safe = not described.failures and all(role in MEASURING_ROLES for role in failed)
    return MadeSafe(failed | described.failures, safe)


def _make_safe(arming: Arming) -> dict[str, str]:
    """Run what is armed; return the reasons of what failed, by role."""
    return {f.name: f.reason.removeprefix(f"{f.name}: ") for f in arming.make_safe()}


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
    watch.safe = watch.safe or line == b"safe"
    watch.done = watch.done or line == b"done"
    watch.kill = watch.kill or line == b"kill"
    return watch


def _kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def _write(path: Path, report: dict[str, Any]) -> None:
    write_text(path, json.dumps(report, indent=1) + "\n", durable=False)


if __name__ == "__main__":
    main()
    os._exit(0)  # a thread that waits for an instrument would keep the guard, and with it the locks
