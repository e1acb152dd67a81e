"""The run's link to its guard: it starts the guard and informs it, and can leave the bench to it.

What the guard does with that is in `rig.run.making_safe.guard`. Everything that the link needs is
imported with it: a run that is in trouble may be unable to read another module.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from rig.core.errors import RigError
from rig.run.making_safe.guard import longest_take_over_s
from rig.run.making_safe.guard_report import mark_reported

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan

SILENT_S = 5.0
"""Longest time in s for which a guard may leave heartbeats unread. After it the run reports that
the guard is stopped or gets no processor time, since it normally reads each at once."""
MOST_UNREAD_BYTES = 4096
"""Number of unread bytes from which nothing that may be repeated is sent. A pipe holds 65536 bytes,
and a write to a full one would wait for ever; so there is always room for the messages that the
bench is safe and that the run is done."""
ENDING_S = 5.0
"""Longest time in s that a guard with nothing left to do may take to end before it is killed."""


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
        self._unsent: dict[str, str] = {}
        """The latest zero and limit that were not sent yet."""
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
        self._send_if_read("beat")

    def zero(self, raw: Sequence[float]) -> None:
        """Send the force sensor's raw reading without force, if it is another than before. The
        guard needs it to say what is still pressed."""
        if raw != self._zero:
            self._zero = raw
            self._unsent["zero"] = json.dumps(list(raw))
        self._send_unsent()

    def limit(self, limit_N: float) -> None:
        """Send the force that the run watches for, if it is another than before: one above it that
        remains is not safe."""
        if limit_N != self._limit_N and math.isfinite(limit_N):
            self._limit_N = limit_N
            self._unsent["limit"] = repr(limit_N)
        self._send_unsent()

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

    def hangs(self, what: str) -> None:
        """Send what keeps the run from its next heartbeat. From any thread; a heartbeat that comes
        after all ends it."""
        self._send_if_read(f"hangs {json.dumps(what)}")

    def kill(self) -> NoReturn:
        """Have the guard kill this run and make the bench safe. This process ends as well if the
        guard does not react."""
        self._send_unsent(needed=True)
        self._send("kill")
        self._process.send_signal(signal.SIGCONT)  # one that was stopped is needed now
        if not self.died:
            time.sleep(ENDING_S)
        os.kill(os.getpid(), signal.SIGKILL)
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
        `judged`. The data are the run's to save."""
        assert self._process.stdin is not None
        self._send_unsent(needed=True)
        self._send("saves")
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
            mark_reported(self._report, report)
        return judged(report, over_limit)

    def _unread_bytes(self) -> int:
        assert self._process.stdin is not None
        count = fcntl.ioctl(self._process.stdin, termios.FIONREAD, struct.pack("i", 0))
        return int(struct.unpack("i", count)[0])

    def _send_if_read(self, word: str) -> None:
        """Send a message, unless the guard has left many unread."""
        if self._unread_bytes() < MOST_UNREAD_BYTES:
            self._send(word)

    def _send_unsent(self, *, needed: bool = False) -> None:
        """Send the latest zero and limit where the guard does not have them: unless it has left
        many messages unread, or if they are `needed` now."""
        if self._unsent and (needed or self._unread_bytes() < MOST_UNREAD_BYTES):
            for word, value in self._unsent.items():
                self._send(f"{word} {value}")
            self._unsent.clear()

    def _send(self, word: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # A run continues without its guard rather than fail.
            self._process.stdin.write(word.encode() + b"\n")
            self._process.stdin.flush()
