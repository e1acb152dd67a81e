"""What is made of runs while the bench waits: compiled files, detector, figures.

``python -m rig.batch.execute.postprocess`` takes one JSON object a line on its standard input and
gives one a line on its standard output:

    {"journal": PATH, "figures": true, "detect": true}
    {"journal": PATH, "file": PATH, "processed": PATH, "figures": [PATH, ...], "warnings": [],
     "error": ""}

Jobs are done one after the other, each in its turn by a worker process
(`rig.batch.execute.postprocess_worker`) of the lowest priority. The lines ``hold`` and ``go`` have
the worker stand still, in the middle of whatever it is at, and go on: it costs nothing while a run
needs the computer. A worker that dies over a file costs that file, and the next one gets another
worker.

The input's end: what was given is still done. SIGTERM, or a parent that has died: the file under
way is still done. The worker of a steward that was killed goes on to its file's end, too. Nothing
that it leaves is half a file, and a job that is given again does no harm.

This module is imported by the batch for `Afterwards` and is the steward's program: it imports
nothing of weight.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

LOOK_S = 1.0
"""How often the steward looks whether it is to end."""
LONGEST_JOB_S = 3600.0
"""Of work, standing still not counted: a file over which the worker hangs is given up."""
ONE_THREAD = dict.fromkeys(
    (
        *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
        *("VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS"),
    ),
    "1",
)
"""One thread of linear algebra: a second processor may be the tick loop's."""
NICENESS = 19
PR_SET_PDEATHSIG = 1
"""prctl(2): the signal that a process gets when its parent dies."""
KILLED_S = 5.0
"""What is waited for a process that was killed."""


@dataclass(frozen=True)
class Job:
    """A run to be worked on."""

    journal: Path
    """Its journal, or where that was before it was compiled."""
    figures: bool = True
    detect: bool = True


@dataclass(frozen=True)
class Answer:
    """What came of a job."""

    journal: Path | None
    """None where the job could not be understood."""
    file: Path | None = None
    """The run file."""
    processed: Path | None = None
    """What the detector found; None of a run without strips."""
    figures: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    """What could not be drawn, detected or trusted."""
    error: str = ""
    """Why there is no run file."""

    def as_line(self) -> str:
        """It as a line of JSON."""
        return json.dumps(asdict(self), default=str) + "\n"


def answer_of(told: Mapping[str, Any]) -> Answer:
    """An answer from its JSON object."""
    return Answer(
        journal=_path(told["journal"]),
        file=_path(told["file"]),
        processed=_path(told["processed"]),
        figures=tuple(Path(figure) for figure in told["figures"]),
        warnings=tuple(told["warnings"]),
        error=told["error"],
    )


def job_of(line: str) -> Job:
    """A job from its line; ValueError where it is none."""
    try:
        told = json.loads(line)
        journal, others = told.pop("journal"), {"figures", "detect"}
        if not isinstance(journal, str) or not all(
            name in others and isinstance(value, bool) for name, value in told.items()
        ):
            raise TypeError
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ValueError(f"no job: {line[:200]!r}") from None
    return Job(Path(journal), **told)


def _path(told: str | None) -> Path | None:
    return None if told is None else Path(told)


# --- the batch's side -------------------------------------------------------------------------


class Afterwards:
    """The steward as its batch has it. Nothing here waits, but for `close`, and nothing raises for
    a steward that has died: `lost` says so."""

    def __init__(self, held: Sequence[int] = ()) -> None:
        """`held`: files that steward and worker keep open as long as they live, the batch's lock:
        two of them would disturb each other over one file."""
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rig.batch.execute.postprocess"],
            pass_fds=held,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a terminal's Ctrl-C is the batch's
        )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._buffer = b""
        self._held = False

    @property
    def pid(self) -> int:
        """Of the steward."""
        return self._process.pid

    @property
    def lost(self) -> bool:
        """Whether it has died."""
        return self._process.poll() is not None

    def give(self, job: Job) -> None:
        """Have a run worked on after those given before."""
        self._tell(json.dumps(asdict(job), default=str))

    def hold(self) -> None:
        """Stand still: a run needs the computer."""
        if not self._held:
            self._held = True
            self._tell("hold")

    def go(self) -> None:
        """Go on: the bench waits."""
        if self._held:
            self._held = False
            self._tell("go")

    def answers(self) -> list[Answer]:
        """What has been finished since the last call."""
        assert self._process.stdout is not None
        with contextlib.suppress(BlockingIOError, ValueError):
            while chunk := os.read(self._process.stdout.fileno(), 65536):
                self._buffer += chunk
        *lines, self._buffer = self._buffer.split(b"\n")
        return [answer_of(json.loads(line)) for line in lines]

    def close(self, within_s: float) -> list[Answer]:
        """Have it finish what was given, so long at most, then only the file under way, so long
        again; the answers until then. What is without an answer can be given another time."""
        assert self._process.stdin is not None
        self.go()
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        answers = self._answers_until_end(within_s)
        if not self.lost:
            self._process.terminate()
            answers += self._answers_until_end(within_s)
        if not self.lost:
            self._process.kill()
            self._process.wait(KILLED_S)
        answers += self.answers()
        assert self._process.stdout is not None
        self._process.stdout.close()
        return answers

    def _answers_until_end(self, within_s: float) -> list[Answer]:
        """A pipe that nobody empties would keep it from ending."""
        assert self._process.stdout is not None
        answers: list[Answer] = []
        deadline_s = time.monotonic() + within_s
        while not self.lost and (left_s := deadline_s - time.monotonic()) > 0:
            select.select([self._process.stdout], [], [], min(left_s, LOOK_S))
            answers += self.answers()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.01)
        return answers

    def _tell(self, line: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(f"{line}\n".encode())
            self._process.stdin.flush()


# --- the steward's side -----------------------------------------------------------------------


def _become_worker() -> None:
    """In the new process, before its program begins: run only where nothing else wants to
    (`SCHED_IDLE` where the system has it: Linux, which derives the disk's priority from it). If the
    steward is killed while the worker stands still, have it go on to its file's end (Linux)."""
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGCONT))


class _Worker:
    """A worker process and the job that it has; the steward waits for it, never it for the
    steward."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rig.batch.execute.postprocess_worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | ONE_THREAD,
            close_fds=False,  # the batch's lock is the worker's as well
            preexec_fn=_become_worker,  # the steward has no thread that could hold a lock
        )
        assert self.process.stdout is not None
        self.output = self.process.stdout.fileno()
        self._buffer = b""
        self._worked_s = 0.0
        self._since_s: float | None = None
        self._stands = False

    def begin(self, line: str) -> None:
        """Give it its next job."""
        assert self.process.stdin is not None
        self._worked_s, self._since_s = 0.0, time.monotonic()
        with contextlib.suppress(OSError):  # it has died: its output ends
            self.process.stdin.write(f"{line}\n".encode())
            self.process.stdin.flush()

    def stand(self, still: bool) -> None:
        """Have it stand still, or go on."""
        if still == self._stands:
            return
        self._stands = still
        self._worked_s, self._since_s = self.worked_s, None if still else time.monotonic()
        self.process.send_signal(signal.SIGSTOP if still else signal.SIGCONT)

    @property
    def worked_s(self) -> float:
        """On its job, standing still not counted."""
        return self._worked_s + (time.monotonic() - self._since_s if self._since_s else 0.0)

    def answer(self) -> str | None:
        """A line of its output, where one is complete; EOFError where it has died."""
        chunk = os.read(self.output, 65536)
        if not chunk:
            raise EOFError
        self._buffer += chunk
        line, end, rest = self._buffer.partition(b"\n")
        if not end:
            return None
        self._buffer = rest
        return line.decode()

    def end(self) -> int:
        """Have it end with its job; its exit code."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        return self.process.wait()

    def kill(self) -> None:
        """Have it end at once."""
        self.process.kill()
        self.process.wait(KILLED_S)


class Steward:
    """Takes lines, has a worker do the jobs, gives answers."""

    def __init__(self) -> None:
        self._jobs: deque[Job] = deque()
        self._under_way: Job | None = None
        self._worker: _Worker | None = None
        self._held = self._ending = self._all_given = False
        self._buffer = b""
        self._parent = os.getppid()

    def serve(self) -> None:
        """Until everything given is done, or the end is asked for."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
            signal.signal(number, self._end_soon)
        while not self._is_over():
            self._begin_next()
            self._wait()
        if self._worker is not None:
            self._worker.stand(still=False)
            self._worker.end()

    def _end_soon(self, *_: object) -> None:
        self._ending = True

    def _is_over(self) -> bool:
        self._ending = self._ending or os.getppid() != self._parent
        if self._under_way is not None:
            return False
        return self._ending or (self._all_given and not self._jobs)

    def _begin_next(self) -> None:
        still = self._held and not (self._ending or self._all_given)
        if self._worker is not None:
            self._worker.stand(still)
        if self._under_way is not None or still or not self._jobs or self._ending:
            return
        self._under_way = self._jobs.popleft()
        if self._worker is None:
            self._worker = _Worker()
        self._worker.begin(json.dumps(asdict(self._under_way), default=str))

    def _wait(self) -> None:
        """For lines, for the worker, or for `LOOK_S`."""
        sources = [] if self._all_given else [sys.stdin.fileno()]
        if self._worker is not None:
            sources.append(self._worker.output)
        ready, _, _ = select.select(sources, [], [], LOOK_S)
        if self._worker is not None:
            if self._worker.output in ready:
                self._take_answer(self._worker)
            elif self._under_way is not None and self._worker.worked_s > LONGEST_JOB_S:
                self._worker.kill()
                self._give_up(f"was not done with it after {LONGEST_JOB_S:g} s and was killed")
        if sys.stdin.fileno() in ready:
            self._take_lines()

    def _take_lines(self) -> None:
        chunk = os.read(sys.stdin.fileno(), 65536)
        self._all_given = not chunk
        *lines, self._buffer = (self._buffer + chunk).split(b"\n")
        for line in lines:
            self._take_line(line.decode(errors="replace").strip())

    def _take_line(self, line: str) -> None:
        if line in ("hold", "go"):
            self._held = line == "hold"
        elif line:
            try:
                self._jobs.append(job_of(line))
            except ValueError as error:
                self._say(Answer(None, error=str(error)).as_line())

    def _take_answer(self, worker: _Worker) -> None:
        try:
            line = worker.answer()
        except EOFError:
            self._give_up(f"died over it with exit code {worker.end()}")
            return
        if line is not None:
            self._under_way = None
            self._say(line + "\n")

    def _give_up(self, how: str) -> None:
        """The worker is gone, and so is its job; the next one gets another worker."""
        job, self._under_way, self._worker = self._under_way, None, None
        if job is not None:
            self._say(Answer(job.journal, error=f"{job.journal}: the worker {how}").as_line())

    def _say(self, line: str) -> None:
        try:
            sys.stdout.write(line)
            sys.stdout.flush()
        except OSError:  # nobody listens any more, also not when Python ends
            self._ending = True
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    Steward().serve()
