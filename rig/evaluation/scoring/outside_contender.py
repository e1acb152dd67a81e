"""A detector of another package that is to be scored, in a process of its own: it may end the
process in which it judges, and the scores of the others must not end with it."""

from __future__ import annotations

import ctypes
import os
import signal
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from typing import Any

from rig.core.errors import RigError
from rig.core.pool_workers import leave_signals_to_the_command
from rig.detector.checking import DetectorError
from rig.detector.notices import Notice
from rig.evaluation.scoring.contenders import DetectorContender, Floats
from rig.evaluation.scoring.outcomes import DetectorReport

ENDING_S = 1.0
"""Longest time in s in which a process that closed its connection may end."""
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class OutsideContender(DetectorContender):
    """A registered detector of another package."""

    _served: dict[int, _Served] = field(default_factory=dict, repr=False, compare=False)
    """The process in which it judges, by the number of the process that asks it: one that was
    forked from another needs its own."""

    def reports(
        self,
        volts: Floats,
        rate_Hz: float,
        factors: tuple[float, ...],
        notices: tuple[Notice, ...] = (),
    ) -> list[DetectorReport]:
        """Return the events that it detects at each threshold. Raises DetectorError where it fails
        or ends its process."""
        served = self._served.get(os.getpid())
        if served is None:
            served = self._served[os.getpid()] = _Served(super().reports)
        answer = served.ask((volts, rate_Hz, factors, notices))
        if isinstance(answer, str):
            del self._served[os.getpid()]
            reason = f"ended its process ({answer})"
            raise DetectorError(self.detector.name, self.detector.package, reason)
        if isinstance(answer, Exception):
            raise answer
        reports: list[DetectorReport] = answer
        return reports


class _Served:
    """A fork of this process that answers what it is asked, one question at a time."""

    def __init__(self, answer: Any):
        context = get_context("fork")
        self._here, there = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(answer, there, self._here), daemon=True
        )
        self._process.start()
        there.close()

    def ask(self, question: tuple[Any, ...]) -> Any:
        """Return the answer, an exception that was raised instead, or how the process ended, as
        text. Where this call is left by an exception, such as Ctrl-C, the process is killed."""
        ended = os.pidfd_open(self._process.pid)  # type: ignore[arg-type]  # it has been started
        try:
            self._here.send(question)
            # What the detector has started may hold the other end open for longer than it lives.
            if self._here in connection.wait([self._here, ended]):
                return self._here.recv()
        except (EOFError, OSError):
            pass
        except BaseException:
            self._process.kill()
            raise
        finally:
            os.close(ended)
        self._process.join(ENDING_S)
        self._here.close()
        return _how(self._process.exitcode)


def _serve(answer: Any, pipe: Connection, other_end: Connection) -> None:
    """Answer questions until the other end is closed (in the fork)."""
    other_end.close()
    # What ends the command ends this process as well, even within the detector's C code.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    leave_signals_to_the_command()
    with suppress(EOFError, OSError):
        while True:
            question = pipe.recv()
            try:
                pipe.send(answer(*question))
            except (RigError, ValueError) as error:
                pipe.send(error)


def _how(code: int | None) -> str:
    """Return an exit code in words."""
    if code is None:
        return "it closed its connection"
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"
