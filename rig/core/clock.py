"""Bench time: the one clock that procedures, drivers and the runner wait on.

Two clocks share one way of waiting. `WallClock` runs in real time, on hardware or on a simulated
bench that runs by itself. `SlavedClock` advances the virtual time of a simulated bench: nothing
moves there unless this clock advances, which makes a run repeatable to the bit and as fast as the
computer allows.

A wait is cut into slices of at most 20 ms. Before each slice the registered callbacks run: the
check for a stop request, the heartbeat, the check of the link workers for failures. They run in the
procedure's threads only; a thread that works in the background waits without them.

Every slice is also a sign of life of the procedure. `procedure_alive` is true while the latest is
recent. Drives with a communication time-out get keep-alives only then, so they stop by themselves
when the procedure hangs. A link that waits for an answer states the longest time that this may take
(`answer_within`); the procedure may give no sign of life for that time.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from rig.core.errors import InstrumentError

WAIT_SLICE_S = 0.02
"""Longest time between two checks for stop requests and keep-alives."""

STREAM_SLICE_S = 0.01
"""Longest advance while an instrument streams: its pty can buffer that much without loss."""

STREAM_PATIENCE_S = 3.0
"""Wall time that a stream reader may take to consume what the simulated bench has sent: less than
the heartbeat time-out of the guard."""

BEAT_S = 1.0
"""Interval between the signs of life of a thread that waits for the simulated bench to compute."""

SIGN_OF_LIFE_S = 0.5
"""Time without a sign of life, outside the waits for an answer, after which the procedure is
considered to hang. A busy computer stalls for less."""

CONTROL_TIMEOUT_S = 60.0
"""Wall time that the simulated bench may take to answer an advance; only a dead one takes
longer."""

Unregister = Callable[[], None]


def suspended_s() -> float:
    """Return for how long the computer has been suspended since it was started, in s: the monotonic
    clock, and with it bench time, stands still meanwhile."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()


class StreamConsumer(Protocol):
    """A reader that takes the bytes of a stream off its link."""

    def bytes_handled(self) -> int:
        """Return the number of bytes whose samples have been processed."""
        ...

    def await_bytes(self, count: int, patience_s: float) -> int:
        """Wait until `count` bytes have been handled, the reader has ended, or `patience_s` of wall
        time have passed. Return how many bytes have been handled."""
        ...


class Clock(ABC):
    """Measures bench time, and waits in slices between which callbacks run."""

    is_virtual = False
    """True if time stops while an instrument answers."""

    def __init__(self) -> None:
        self._callbacks: list[Callable[[], None]] = []
        self._background = threading.local()
        self._alive_until = time.monotonic() + SIGN_OF_LIFE_S
        self.overdue: tuple[str, float] | None = None
        """The instrument for whose answer the procedure has waited longer than it may take, and
        for how long; the latest such wait."""
        self.hung: tuple[str, float] | None = None
        """What has kept the procedure from its next wait, and the bench time in s at which that was
        found; the latest such case (`rig.run.hang_watch`)."""

    @abstractmethod
    def now(self) -> float:
        """Return the bench time in seconds."""

    @abstractmethod
    def _pass(self, seconds: float) -> None:
        """Wait for at most `seconds` of bench time, without callbacks."""

    def each_slice(self, callback: Callable[[], None]) -> Unregister:
        """Call `callback` before every wait slice until the returned function is called."""
        self._callbacks.append(callback)

        def unregister() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return unregister

    @contextlib.contextmanager
    def in_background(self) -> Iterator[None]:
        """Mark the calling thread as one in the background within the block: its waits run no
        callbacks and are not signs of life of the procedure."""
        self._background.here = True
        try:
            yield
        finally:
            self._background.here = False

    def sign_of_life(self) -> None:
        """Note that the procedure is running; does nothing in a background thread."""
        if not getattr(self._background, "here", False):
            self._alive_until = time.monotonic() + SIGN_OF_LIFE_S

    @contextlib.contextmanager
    def answer_within(self, seconds: float, instrument: str = "") -> Iterator[None]:
        """Mark the block as a wait for an answer of this instrument of at most `seconds` of wall
        time; for that time the procedure is not considered to hang.

        Every link encloses its transactions in it. Does nothing in a background thread.
        """
        background = getattr(self._background, "here", False)
        begun_s = time.monotonic()
        if not background:
            self._alive_until = begun_s + seconds + SIGN_OF_LIFE_S
        try:
            yield
        finally:
            self.sign_of_life()
            waited_s = time.monotonic() - begun_s
            if not background and waited_s > seconds + SIGN_OF_LIFE_S:
                self.overdue = instrument, waited_s

    @property
    def procedure_alive(self) -> bool:
        """True if the procedure gave a sign of life recently, or waits for an answer that is not
        overdue."""
        return time.monotonic() < self._alive_until

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of bench time; an exception from a callback ends the wait."""
        deadline = self.now() + seconds
        while True:
            if not getattr(self._background, "here", False):
                self.sign_of_life()
                for callback in tuple(self._callbacks):
                    callback()
            remaining = deadline - self.now()
            if remaining <= 0:
                return
            self._pass(min(remaining, WAIT_SLICE_S))

    def sleep_unless(self, woken: threading.Event, seconds: float) -> None:
        """Wait as `sleep` does, but end the wait when another thread sets `woken`."""
        deadline = self.now() + seconds
        while True:
            self.sleep(0)
            remaining = deadline - self.now()
            if remaining <= 0 or woken.wait(min(remaining, WAIT_SLICE_S)):
                return

    def charge(self, seconds: float) -> None:
        """Let bench time pass for the `seconds` of wall time that a link's time-out took, unless it
        has passed already. Callbacks run as in any wait."""
        self.sleep(seconds)

    def announce(self, run: int, point: int) -> None:  # noqa: B027 - hardware need not know
        """Announce to a simulated bench which point comes next; run and point seed the point's
        noise."""

    def while_computing(self, beat: Callable[[], None]) -> None:  # noqa: B027 - hardware does not
        """Call `beat` about once a second while a simulated bench computes, as a sign of life."""

    def beat(self) -> None:  # noqa: B027 - real time passes by itself
        """Give the sign of life of `while_computing`, in a wait while bench time stands still."""

    def act(self, do: str, **values: object) -> bool:
        """Make a simulated bench do what a person would do to a real one, such as ``weigh``.
        Returns whether there is such a bench: on a real one a person has to do it."""
        return False

    def truth(self) -> dict[str, Any]:
        """Return what really happened on a simulated bench since `announce`, with times in us of
        bench time; an empty dict on a real bench."""
        return {}

    def follow_stream(self, name: str, reader: StreamConsumer) -> Unregister:
        """Make waits last until the reader of stream `name` has handled all bytes that the
        simulated bench has sent; does nothing in real time."""
        return lambda: None

    def set_free(self) -> None:  # noqa: B027 - real time passes by itself
        """Let the time of a simulated bench pass by itself from now on: another program acts on
        it. No one may wait on this clock any more."""

    def close(self) -> None:  # noqa: B027 - nothing to release in real time
        """Release the resources of the clock."""


class WallClock(Clock):
    """A clock in real time, from a monotonic source."""

    def __init__(self) -> None:
        super().__init__()
        self._start = time.monotonic()

    def now(self) -> float:
        """Return seconds since the clock was made."""
        return time.monotonic() - self._start

    def charge(self, seconds: float) -> None:
        """Do nothing: real time has passed already."""
        self.sleep(0)

    def _pass(self, seconds: float) -> None:
        time.sleep(seconds)


class SlavedClock(Clock):
    """A clock that advances the virtual time of a simulated bench through its control socket.

    Only the procedure's thread may sleep on it. After each advance it waits until every stream
    reader has consumed the bytes that the bench says it has sent, so what a reader has seen at a
    given bench time never depends on the host's scheduling.
    """

    is_virtual = True

    def __init__(self, control: ControlLink):
        super().__init__()
        self._control = control
        self._now_us = 0
        self._followed: dict[str, tuple[StreamConsumer, int]] = {}
        """Readers by stream, and the number of bytes that the bench had sent before each began."""

    def now(self) -> float:
        """Return seconds of bench time since the bench started."""
        return self._now_us * 1e-6

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of bench time, rounded to whole microseconds."""
        remaining_us = max(0, round(seconds * 1e6))
        while True:
            for callback in tuple(self._callbacks):
                callback()
            if remaining_us == 0:
                return
            slice_s = STREAM_SLICE_S if self._followed else WAIT_SLICE_S
            step_us = min(remaining_us, round(slice_s * 1e6))
            self._advance(step_us)
            remaining_us -= step_us

    def sleep_unless(self, woken: threading.Event, seconds: float) -> None:
        """Wait as `sleep` does: no other thread works while this time passes."""
        if not woken.is_set():
            self.sleep(seconds)

    def follow_stream(self, name: str, reader: StreamConsumer) -> Unregister:
        """Make `sleep` wait for the reader of stream `name`.

        Bytes that the bench sent before are not waited for; call it while nothing streams.
        """
        streams = self._control.request("advance", us=0)["streams"]
        self._followed[name] = reader, int(streams.get(name, 0)) - reader.bytes_handled()
        return lambda: self._followed.pop(name, None) and None

    def while_computing(self, beat: Callable[[], None]) -> None:
        """Call `beat` during each request to the bench."""
        self._control.beat = beat

    def beat(self) -> None:
        """Give the sign of life of `while_computing`."""
        self._control.beat()

    def act(self, do: str, **values: object) -> bool:
        """Make the simulated bench do it, and return True."""
        self._control.request(do, **values)
        return True

    def truth(self) -> dict[str, Any]:
        """Return the bench's own record of what happened; an empty dict if its World records
        none."""
        answer = self._control.request("truth")
        del answer["now_us"]
        return answer

    def announce(self, run: int, point: int) -> None:
        """Announce to the bench which point comes next."""
        self._control.request("point", run=run, point=point)

    def set_free(self) -> None:
        """Let bench time follow real time from now on."""
        self._control.request("free")

    def close(self) -> None:
        """End the bench this clock drives."""
        self._control.stop()

    def _pass(self, seconds: float) -> None:
        self._advance(round(seconds * 1e6))

    def _advance(self, step_us: int) -> None:
        reply = self._control.request("advance", us=step_us)
        self._now_us = int(reply["now_us"])
        for name, sent in reply.get("streams", {}).items():
            if name in self._followed:
                try:
                    self._wait_for_reader(name, int(sent))
                except BaseException:
                    # Raised once: a shutdown action may still have to wait on this clock.
                    self._followed.pop(name, None)
                    raise

    def _wait_for_reader(self, name: str, sent: int) -> None:
        reader, before = self._followed[name]
        got = before + reader.await_bytes(sent - before, STREAM_PATIENCE_S)
        if got < sent:
            raise InstrumentError(
                name,
                "stream",
                f"{sent - got} of {sent} bytes did not arrive within {STREAM_PATIENCE_S:g} s",
                "the reader or the link is stuck; check the cable and start again",
            )


class PacedClock(SlavedClock):
    """A slaved clock that advances no faster than real time, for a bench that a person operates."""

    def __init__(self, control: ControlLink):
        super().__init__(control)
        self._due_s = time.monotonic()

    def _advance(self, step_us: int) -> None:
        """Advance, and wait for the rest of the step in real time; time lost by a slow bench is not
        caught up."""
        self._due_s = max(self._due_s + step_us * 1e-6, time.monotonic())
        super()._advance(step_us)
        time.sleep(max(0.0, self._due_s - time.monotonic()))


class ControlLink:
    """The control socket of a simulated bench: one JSON line for a request, one for its answer."""

    def __init__(self, port: int, host: str = "127.0.0.1"):
        try:
            self._socket = socket.create_connection((host, port), timeout=BEAT_S)
        except OSError as error:
            raise _control_failed("connect", error) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received = b""
        self.beat: Callable[[], None] = lambda: None
        """Function that is called about once a second while an answer is awaited."""

    def request(self, do: str, **values: object) -> dict[str, Any]:
        """Send one request, return the bench's answer. Raises InstrumentError if it has ended."""
        try:
            self._socket.sendall(json.dumps({"do": do, **values}).encode() + b"\n")
            line = self._line()
        except OSError as error:
            raise _control_failed(do, error) from error
        if line is None:
            raise _control_failed(do, "the bench process has ended")
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError as error:
            raise _control_failed(do, f"the answer {line[:40]!r} is not JSON") from error
        if "error" in answer:
            raise _control_failed(do, str(answer["error"]))
        return answer

    def _line(self) -> bytes | None:
        """Return the next line from the bench without its line end; None if the bench has ended."""
        give_up = time.monotonic() + CONTROL_TIMEOUT_S
        while b"\n" not in self._received:
            try:
                data = self._socket.recv(65536)
            except TimeoutError:
                if time.monotonic() > give_up:
                    raise
                self.beat()
                continue
            if not data:
                return None
            self._received += data
        line, _, self._received = self._received.partition(b"\n")
        return line

    def stop(self) -> None:
        """Ask the bench to end, and close the socket; a bench that has ended already is not an
        error."""
        try:
            self.request("stop")
        except InstrumentError:
            pass
        finally:
            self._socket.close()


def _control_failed(do: str, cause: object) -> InstrumentError:
    return InstrumentError(
        "simulated bench", f"control request {do!r}", str(cause), "start the command again"
    )
