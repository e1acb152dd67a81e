"""A detector that runs during a trial: blocks of rows in, events out, and the caller never waits.

A detector of this project is compiled, takes microseconds and runs where it is called. One of
another package is imported only in a process of its own (`rig.processing.live_child`), niced,
without any descriptor of this one. Blocks go to it over a socket that is never waited for. One that
raises, ends, answers nonsense or falls behind is not used any more: `dropped` says why, and the
trial continues.

In virtual time a block takes no time, so that "too late" has no meaning: the answer of a patient
detector is waited for, and its events are those of the file, whatever the computer's load.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.entry_points import DETECTORS, packages_of
from rig.core.errors import LONGEST_REASON, ConfigurationError, ExitCode, RigError, shortened
from rig.detector.checking import event_fault
from rig.detector.events import SlipEvent
from rig.detector.notices import Notice, to_text
from rig.detector.registered import ChosenDetector, chosen_detector, is_own

Reals = NDArray[np.float64]

LONGEST_LAG_S = 0.1
"""Age in s of the oldest block without an answer at which a detector is dropped. An alarm that late
is of no use to a grip, and a niced process on a busy computer waits for some ten ms."""
PATIENCE_S = 10.0
"""Longest time in s for which the answer of a patient detector is waited for."""
BEAT_S = 0.2
"""Interval in s of the signs of life meanwhile: the guard kills a run after 1 s or more without."""
START_S = 120.0
"""Longest time in s that a detector may take to be imported and compiled."""
ENDED_S = 2.0
"""Longest time in s in which a process that has ended, or was killed, may disappear."""
MOST_ROWS = 2048
"""Rows in one message: 32 kB, of which a socket takes several."""
MOST_EVENTS = 256
"""Maximum number of events in one answer; a detector with more is broken."""
MOST_BYTES = 1 << 18
"""Longest answer."""
CHECK_EVERY_ms = 20
"""Interval at which the age of the oldest block is checked."""

BEGIN, ROWS, FINISH, NOTICE = range(4)
"""What a message asks: to begin a recording, to judge rows, to end the recording, to know what
the bench knows of the rows to come."""
DONE, FAILED, READY = range(3)
"""What an answer is: events in JSON (empty for none), a reason, or the detector's identity."""
HEAD = struct.Struct("<BQq")
"""Head of a message and of its answer: what it is, its number, and the index of its first row."""

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Libraries shall not start a thread for each processor next to a servo."""


@dataclass(frozen=True)
class LiveEvent:
    """An event, and how long after its rows were handed over it was known."""

    event: SlipEvent
    latency_s: float
    """Real time from the hand-over of the block in which it was decided."""


@dataclass(frozen=True)
class DetectorIdentity:
    """What a record states of the detector that judged it."""

    name: str
    version: str
    package: str
    package_version: str
    settings: str
    """Parameters of the detector, as JSON."""


class LiveDetector(ABC):
    """A detector that runs during a trial. Only starting and closing it may take time.

    `begin`, `add`, `finish` and `close` are called from one thread, `take` and `dropped` from any.
    """

    identity: DetectorIdentity
    """What a record states of it."""

    def __init__(self, name: str, woken: Callable[[], None]):
        self._called, self._woken = f"detector {name}", woken
        self._events: deque[LiveEvent] = deque()
        self._reason: str | None = None
        self.in_use = True
        """False once it was dropped or closed."""

    @abstractmethod
    def begin(self) -> None:
        """Begin a new recording: rows are counted from 0 again."""

    @abstractmethod
    def add(self, volts: Reals, first_sample: int) -> None:
        """Hand over rows (n, 2) of v_1 and v_2 in V, the first of which has this index. Raises
        nothing and, unless the detector is patient, waits for nothing."""

    @abstractmethod
    def notice(self, given: Notice) -> None:
        """Say what the bench knows of the rows to come (`rig.detector.contract.Detector.notice`).
        Raises nothing and waits like `add`."""

    @abstractmethod
    def finish(self) -> None:
        """Say that the recording has ended; what the detector reports of it follows."""

    @abstractmethod
    def settle(self, at_most_s: float) -> None:
        """Wait until all that was handed over is judged, or the detector is dropped; no longer
        than this."""

    @abstractmethod
    def close(self) -> None:
        """End it. May be called twice."""

    def take(self) -> list[LiveEvent]:
        """Return the events that came since the last call, in order."""
        events = []
        while self._events:
            events.append(self._events.popleft())
        return events

    def dropped(self) -> str | None:
        """Return, once, why it is not used any more, as a sentence; None otherwise."""
        reason, self._reason = self._reason, None
        return reason

    def _found(self, events: list[SlipEvent], handed_over_s: float) -> None:
        latency_s = time.monotonic() - handed_over_s
        self._events.extend(LiveEvent(event, latency_s) for event in events)
        if events:
            self._woken()

    def _drop(self, reason: str) -> None:
        """Stop using it; only the first reason is reported."""
        if self.in_use:
            self.in_use = False
            self._reason = f"{self._called} {reason}: no longer used"
            self._woken()


def start(
    name: str,
    rate_Hz: float,
    *,
    settings: str = "",
    patient: bool = False,
    longest_lag_s: float = LONGEST_LAG_S,
    woken: Callable[[], None] = lambda: None,
    beat: Callable[[], None] = lambda: None,
) -> LiveDetector:
    """Start a registered detector for recordings at a rate. It is done before anything moves: the
    first use of a compiled one on a computer takes up to a minute.

    `settings` are its parameters as JSON, its own ones if left out. `patient`: in virtual time.
    `woken` is called, from any thread, whenever `take` or `dropped` has something to return. `beat`
    is called in the caller's thread, every 0.2 s while the answer of a patient one is waited for.

    Raises RigError where the detector is unknown, cannot be used, or does not judge this rate.
    """
    if is_own(name):
        return _Direct(name, rate_Hz, settings, woken)
    return _InChild(name, rate_Hz, settings, patient, longest_lag_s, woken, beat)


def identity_of(chosen: ChosenDetector) -> DetectorIdentity:
    """Return what a record states of a detector."""
    return DetectorIdentity(
        chosen.name,
        chosen.version,
        chosen.package,
        chosen.package_version,
        chosen.settings.model_dump_json(),
    )


class _Direct(LiveDetector):
    """A detector that runs where it is called."""

    def __init__(self, name: str, rate_Hz: float, settings: str, woken: Callable[[], None]):
        super().__init__(name, woken)
        self._chosen, self._rate_Hz = chosen_detector(name, settings), rate_Hz
        try:
            self._chosen.make(rate_Hz).add(np.zeros((1, 2)))  # compiled now, not at the first block
        except ValueError as error:
            raise ConfigurationError(f"detector {name}: {error}") from error
        self.identity = identity_of(self._chosen)
        self.begin()

    def begin(self) -> None:
        self._detector = self._chosen.make(self._rate_Hz)

    def add(self, volts: Reals, first_sample: int) -> None:
        self._ask(lambda: self._detector.add(volts, first_sample))

    def notice(self, given: Notice) -> None:
        def give() -> list[SlipEvent]:
            self._detector.notice(given)
            return []

        self._ask(give)

    def finish(self) -> None:
        self._ask(self._detector.finish)

    def settle(self, at_most_s: float) -> None:
        pass

    def close(self) -> None:
        self.in_use = False

    def _ask(self, judge: Callable[[], list[SlipEvent]]) -> None:
        if not self.in_use:
            return
        begun_s = time.monotonic()
        try:
            self._found(judge(), begun_s)
        except Exception as error:  # noqa: BLE001 - whatever it is, the trial continues
            self._drop(f"failed ({type(error).__name__}: {error})")


def _called(name: str, package: str) -> str:
    return f"detector {name} of the package {package}" if package else f"detector {name}"


@dataclass(frozen=True)
class _Sent:
    """A message without an answer."""

    number: int
    first: int
    end: int
    sent_s: float


class _InChild(LiveDetector):
    """A detector in a process of its own."""

    def __init__(
        self,
        name: str,
        rate_Hz: float,
        settings: str,
        patient: bool,
        longest_lag_s: float,
        woken: Callable[[], None],
        beat: Callable[[], None],
    ):
        super().__init__(name, woken)
        self._called = _called(name, " and ".join(packages_of(DETECTORS, name)))
        self._rate_Hz, self._patient, self._beat = rate_Hz, patient, beat
        self._longest_lag_s = PATIENCE_S if patient else longest_lag_s
        self._sent: deque[_Sent] = deque()
        self._numbers, self._answered, self._rows = 0, -1, 0
        self._news = threading.Condition()
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, tempfile.TemporaryFile() as order:
            wanted = {"name": name, "settings": settings, "rate_Hz": rate_Hz}
            order.write(json.dumps(wanted).encode())
            order.seek(0)
            try:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "rig.processing.live_child", str(theirs.fileno())],
                    stdin=order,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=(theirs.fileno(),),
                    env=os.environ | _ONE_THREAD,
                    start_new_session=True,  # no Ctrl-C of the terminal; killed with its children
                )
            except OSError as error:
                self._socket.close()
                raise RigError(f"{self._called} cannot be started: {error}") from error
        try:
            self.identity = self._first_answer()
        except BaseException:
            self.close()
            raise
        self._called = _called(name, self.identity.package)
        self._reader = threading.Thread(target=self._read, name=f"detector {name}", daemon=True)
        self._reader.start()

    def begin(self) -> None:
        self._rows = 0
        self._send(BEGIN, 0, 0)

    def add(self, volts: Reals, first_sample: int) -> None:
        rows = np.ascontiguousarray(volts, dtype=np.float64)
        for begin in range(0, len(rows), MOST_ROWS):
            part = rows[begin : begin + MOST_ROWS]
            first = first_sample + begin
            self._rows = first + len(part)
            self._send(ROWS, first, self._rows, part.tobytes())

    def notice(self, given: Notice) -> None:
        self._send(NOTICE, self._rows, self._rows, to_text([given]).encode())

    def finish(self) -> None:
        self._send(FINISH, 0, self._rows)

    def settle(self, at_most_s: float) -> None:
        latest = self._numbers - 1
        with self._news:
            self._news.wait_for(lambda: self._answered >= latest or not self.in_use, at_most_s)

    def close(self) -> None:
        self.in_use = False
        self._kill()  # the reader wakes
        reader = getattr(self, "_reader", None)
        if reader is not None and reader is not threading.current_thread():
            reader.join(ENDED_S)
        self._socket.close()
        if self._process.returncode is None:
            self._how_it_ended()
            # What is left where the watching process has been stopped or killed. No one has asked
            # for its exit code before, so its number still is that of its session.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(ENDED_S)

    def _send(self, asked: int, first: int, end: int, content: bytes = b"") -> None:
        if not self.in_use:
            return
        number, self._numbers = self._numbers, self._numbers + 1
        self._sent.append(_Sent(number, first, end, time.monotonic()))
        try:
            message = HEAD.pack(asked, number, first) + content
            self._socket.send(message, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except BlockingIOError:  # the socket is full of blocks that it has not read
            self._drop_as_late()
        except OSError:
            pass  # it has ended; the reader finds out how
        if self._patient:
            self._await_answer()

    def _await_answer(self) -> None:
        """Wait until all that was handed over is judged or the detector is dropped, with signs of
        life."""
        until_s = time.monotonic() + PATIENCE_S
        self.settle(BEAT_S)
        while self.in_use and self._answered < self._numbers - 1 and time.monotonic() < until_s:
            self._beat()
            self.settle(BEAT_S)

    def _first_answer(self) -> DetectorIdentity:
        """Return the identity of the detector that is ready. Raises RigError where it is not."""
        called = self._called
        self._socket.settimeout(START_S)
        try:
            answer = self._socket.recv(MOST_BYTES)
        except TimeoutError:
            raise RigError(f"{called} was not ready within {START_S:g} s") from None
        self._socket.setblocking(True)
        if not answer:
            raise RigError(f"{called}: its process ended ({self._how_it_ended()})")
        kind, _, _ = HEAD.unpack_from(answer)
        said = json.loads(answer[HEAD.size :])
        if kind != READY:
            raise RigError(said["message"], said["hint"], ExitCode(said["code"]))
        return DetectorIdentity(**said)

    def _read(self) -> None:
        """Read answers until the detector is dropped or closed (the body of a thread)."""
        poller = select.poll()
        poller.register(self._socket, select.POLLIN)
        reset = False
        while self.in_use:
            try:
                if poller.poll(CHECK_EVERY_ms):
                    self._take_answer(self._socket.recv(MOST_BYTES, socket.MSG_DONTWAIT))
            except BlockingIOError:
                continue
            except ConnectionResetError:
                # It has ended without reading all that was sent. Linux reports that once, ahead of
                # the answers that wait, and the last of these may say why it has ended.
                if reset:
                    self._take_answer(b"")
                reset = True
                continue
            except OSError:
                self._take_answer(b"")
            oldest = self._sent[0] if self._sent else None
            if oldest and time.monotonic() - oldest.sent_s > self._longest_lag_s:
                self._drop_as_late()
        with self._news:
            self._news.notify_all()

    def _take_answer(self, answer: bytes) -> None:
        if not answer:
            self._drop(f"ended ({self._how_it_ended()})")
            self._kill()
            return
        try:
            kind, number, _ = HEAD.unpack_from(answer)
            if not self._sent or number != self._sent[0].number:
                raise ValueError("an answer to nothing that was asked")
            if kind == FAILED:
                reason = shortened(json.loads(answer[HEAD.size :]), LONGEST_REASON)
                self._drop(f"failed ({reason})")
                self._kill()
                return
            sent = self._sent[0]
            events = self._events_of(answer[HEAD.size :], sent)
        except (ValueError, TypeError, struct.error) as error:
            self._drop(f"gave no usable answer ({shortened(str(error), LONGEST_REASON)})")
            self._kill()
            return
        self._sent.popleft()
        self._found(events, sent.sent_s)
        with self._news:
            self._answered = number
            self._news.notify_all()

    def _events_of(self, content: bytes, sent: _Sent) -> list[SlipEvent]:
        """Return the events of an answer. ValueError or TypeError for anything else: the process
        runs code that is not trusted."""
        events = [SlipEvent(*one) for one in json.loads(content)] if content else []
        for event in events:
            fault = event_fault(event, sent.first, sent.end, self._rate_Hz)
            if fault is not None:
                raise ValueError(fault)
        return events

    def _drop_as_late(self) -> None:
        """Stop using a detector whose answers come too late, or not at all."""
        late_s = time.monotonic() - self._sent[0].sent_s
        self._drop(f"fell behind by {1e3 * late_s:.0f} ms")
        self._kill()

    def _kill(self) -> None:
        """Let its watching process kill it with all that it started; wait for nothing."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _how_it_ended(self) -> str:
        """Return how its process ended, waiting for that, but leave its exit code to `close`."""
        until_s = time.monotonic() + ENDED_S
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        ended: Any = None
        while ended is None and time.monotonic() < until_s:
            ended = os.waitid(os.P_PID, self._process.pid, options)
            if ended is None:
                time.sleep(0.01)
        if ended is None:
            return "it closed its connection"
        if ended.si_code == os.CLD_EXITED and ended.si_status < 128:
            return f"exit code {ended.si_status}"
        number = ended.si_status - 128 if ended.si_code == os.CLD_EXITED else ended.si_status
        return signal.Signals(number).name
