"""A Modbus RTU line with AZ drives: one request at a time, each with the answer that belongs to it.

Knows how to write and read, nothing about motion. Every request is sent once: only the caller knows
whether a repetition is harmless. The drives of one RS-485 line share one `AzLine` in a process;
each has its own `AzLink` on it, with its own time-out and its own name in errors.

RTU answers say neither which request nor which moment they belong to. What keeps a late, doubled or
foreign answer from being mistaken for the expected one:

* bytes that wait in the port are dropped before a request; nothing is sent before the line has been
  silent for `GAP_S` after the last answer, nor before that answer can have been on the wire;
* unit, function, length, checksum and what a write echoes have to be right; a whole frame that is
  right but for its unit, function or length belongs to another request and is skipped;
* after a time-out or a broken answer the line is listened to for as long as the missing answer may
  take, and the drive is not trusted until it has echoed a number that was never used before
  (function 8): an answer that was still to come came before the echo.

pymodbus's serial clients are not used: neither can be drained or made to synchronise, and the
synchronous one sleeps for milliseconds (decision 0042). Frames: Modbus over Serial Line V1.02;
times: HP-5142E p. 236-237.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from drivers.shared.request_log import RequestLog
from drivers.shared.timeout_charge import TimeoutCharge
from rig.core.errors import InstrumentError, InstrumentLinkError, InstrumentTimeoutError, RigError

if TYPE_CHECKING:
    from rig.core.clock import Clock

READ, ECHO, WRITE = 3, 8, 16
GAP_S = 0.003
"""Silence in s that a drive needs after its answer; its own C3.5 is 2.5 ms from 19200 baud on."""
SLOW_GAP_S = 0.005
"""The same below 19200 baud."""
RESPONSE_WAIT_S = 0.003
"""Time in s from a request to the beginning of its answer, with the factory setting of the drive's
parameter."""
BITS_A_BYTE = 11
"""Start, eight data, parity or a second stop, stop."""
MOST_SHOWN = 64
"""Bytes without an answer among them that a message shows; more are a stream."""
READ_WAIT_S = 0.005
HELD_UP_S = 0.1
"""Longest wait in s for the line in normal operation. A longer wait has another cause, such as
another instrument's time-out, and the line's drives need keep-alives meanwhile."""
TIMEOUTS_PER_ANSWER = 2
"""Longest wait for an answer, in time-outs: a drive may have to echo before it is asked."""
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "slave error: out of range, or not executable now",
}


def crc16(data: bytes) -> int:
    """Return the checksum of a frame; over a whole frame it is 0."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def _crc_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ 0xA001 if byte & 1 else byte >> 1
    return byte


_CRC_TABLE = tuple(_crc_of(byte) for byte in range(256))


@dataclass(frozen=True)
class AzRequest:
    """One frame to a drive, and how its answer begins and how long it is."""

    unit: int
    pdu: bytes
    answer_begins: bytes
    """First bytes of the answer's PDU."""
    answer_bytes: int
    """Length of the answer's frame."""

    @property
    def frame(self) -> bytes:
        """The request as bytes on the wire."""
        body = bytes([self.unit]) + self.pdu
        return body + struct.pack("<H", crc16(body))

    def answered_by(self, frame: bytes) -> bool:
        """Return whether a whole frame is the answer, or the drive's refusal."""
        if frame[0] != self.unit:
            return False
        if frame[1] == self.pdu[0] | 0x80:
            return True
        begins = frame[1 : 1 + len(self.answer_begins)] == self.answer_begins
        return begins and len(frame) == self.answer_bytes


def reading(unit: int, address: int, count: int) -> AzRequest:
    """Return the request to read `count` registers from `address` on."""
    pdu = struct.pack(">BHH", READ, address, count)
    return AzRequest(unit, pdu, bytes((READ, 2 * count)), 5 + 2 * count)


def writing(unit: int, address: int, words: Sequence[int]) -> AzRequest:
    """Return the request to write consecutive registers; the answer repeats address and count."""
    head = struct.pack(">BHH", WRITE, address, len(words))
    body = struct.pack(f">B{len(words)}H", 2 * len(words), *words)
    return AzRequest(unit, head + body, head, 8)


def echoing(unit: int, number: int) -> AzRequest:
    """Return the request for an echo of a number; nothing else happens."""
    pdu = struct.pack(">BHH", ECHO, 0, number)
    return AzRequest(unit, pdu, pdu, 8)


class NoAnswerError(Exception):
    """No answer, or no complete answer, came within the time-out."""


class BrokenAnswerError(Exception):
    """Bytes that are not a frame, or a port that failed."""


class AzLine:
    """One serial port with drives on it; any thread may ask.

    Waits of the line's own are on the bench's clock, where the caller may wait on it: so a bench
    whose time is slaved has the pace of a real line.
    """

    _open: ClassVar[dict[str, AzLine]] = {}
    _opening = threading.Lock()

    def __init__(self, path: str, baudrate: int, parity: str, clock: Clock):
        self.path = path
        self._waits: dict[object, float] = {}
        """Callers that wait for the line, and since when."""
        self.requests = RequestLog(clock)
        """When something was asked on the line."""
        self._baudrate, self._parity = baudrate, parity
        self._clock = clock
        self._gap_s = GAP_S if baudrate >= 19_200 else SLOW_GAP_S
        self._lock = threading.Lock()
        self._port: Any = None
        self._users = 0
        self._free_at_s = 0.0
        """Bench time before which nothing may be sent."""
        self._listen_until_s = 0.0
        """Wall time until which an answer may still come that has been given up."""
        self._trusted: set[int] = set()
        """Units that have echoed since the port was opened and have owed no answer since; any other
        has to echo before it is believed."""
        self._numbers = itertools.cycle(range(1, 0x10000))
        self._heard_s: dict[int, float] = {}
        self._watched: dict[int, tuple[str, float]] = {}
        self._reported: set[int] = set()

    @classmethod
    def shared(cls, path: str, baudrate: int, parity: str, clock: Clock, device: str) -> AzLine:
        """Return the line at `path`, which all its drives share; each gives it up by `release`.

        Raises InstrumentError if it is in use with other settings.
        """
        with cls._opening:
            line = cls._open.get(path)
            if line is None:
                line = cls._open[path] = cls(path, baudrate, parity, clock)
            elif (line._baudrate, line._parity) != (baudrate, parity):
                raise InstrumentError(
                    device,
                    "open the line",
                    f"{path} is in use at {line._baudrate} baud with parity {line._parity}, not "
                    f"{baudrate} baud with parity {parity}",
                    "give all drives on the line the same baudrate and parity in the bench file",
                )
            line._users += 1
            return line

    def release(self) -> None:
        """Remove one user of the line; the last one closes the port."""
        with AzLine._opening:
            self._users -= 1
            if self._users <= 0:
                self.close()
                if AzLine._open.get(self.path) is self:
                    del AzLine._open[self.path]

    def close(self) -> None:
        """Close the port; the next request opens it again."""
        with self._lock:
            self._close()

    # --- who has been heard -------------------------------------------------------------------

    def forget(self, unit: int) -> None:
        """Stop watching this drive for silence."""
        self._watched.pop(unit, None)

    def watch(self, unit: int, device: str, patience_s: float) -> None:
        """Let `silent_peer` watch this drive from now on."""
        self._watched[unit] = device, patience_s
        self._heard_s[unit] = self._clock.now()

    def silent_peer(self) -> tuple[str, float] | None:
        """Return a watched drive that has not answered for longer than its communication time-out
        while another one has, which feeds both, and for how many s; None where all answer. Each
        silence is reported once."""
        now_s = self._clock.now()
        last_s = max(self._heard_s.values(), default=now_s)
        for unit, (device, patience_s) in tuple(self._watched.items()):
            silent_s = now_s - self._heard_s[unit]
            if silent_s <= patience_s:
                self._reported.discard(unit)
            elif now_s - last_s <= patience_s and unit not in self._reported:
                self._reported.add(unit)
                return device, silent_s
        return None

    # --- one request --------------------------------------------------------------------------

    @property
    def free(self) -> bool:
        """True if a request may be sent now."""
        return self._clock.now() >= self._free_at_s

    @property
    def waiting(self) -> bool:
        """True if a caller waits for the line to be free, and for no longer than `HELD_UP_S`."""
        now_s = self._clock.now()
        return any(now_s - since_s <= HELD_UP_S for since_s in tuple(self._waits.values()))

    def wait_until_free(self) -> None:
        """Wait on the bench's clock until the line's silence is over."""
        wait = object()
        self._waits[wait] = self._clock.now()
        try:
            while (left_s := self._free_at_s - self._clock.now()) > 1e-6:
                self._clock.sleep(left_s)
        finally:
            del self._waits[wait]

    def exchange(
        self,
        request: AzRequest,
        timeout_s: float,
        trusting: bool = False,
        permit: Callable[[], None] = lambda: None,
    ) -> bytes:
        """Send a request and return the PDU of its answer; what is left of the line's silence
        passes in wall time.

        A drive that owes an answer echoes first, unless `trusting`: then the request is sent in any
        case, and any answer of its kind is taken. `permit` is called last, when nothing but the
        request itself is left to be sent; what it raises is raised. Otherwise raises NoAnswerError
        or BrokenAnswerError.
        """
        with self._lock:
            try:
                self._open_port()
                if not trusting and request.unit not in self._trusted:
                    self._synchronise(request.unit, timeout_s)
                permit()
                return self._ask(request, timeout_s)
            except NoAnswerError:
                self._trusted.discard(request.unit)
                self._listen_until_s = time.monotonic() + self._wire_s(request)
                raise
            except BrokenAnswerError:
                self._trusted.discard(request.unit)
                raise
            except RigError:
                raise
            except Exception as error:  # pyserial and termios raise what they like where it breaks
                self._close()
                raise BrokenAnswerError(f"{type(error).__name__}: {error}") from error

    def _synchronise(self, unit: int, timeout_s: float) -> None:
        """Make the drive echo a new number, and drop all that comes before the echo."""
        while time.monotonic() < self._listen_until_s:
            self._port.read(self._port.in_waiting or 1)
        request = echoing(unit, next(self._numbers))
        coming = self._bytes_until(self._send(request) + timeout_s)
        got = b""
        while request.frame not in got:
            got += next(coming)
        self._answered(request)
        self._trusted.add(unit)

    def _ask(self, request: AzRequest, timeout_s: float) -> bytes:
        coming = self._bytes_until(self._send(request) + timeout_s)
        got = b""
        while True:
            frame, got = _first_frame(got)
            if frame is None:
                got += next(coming)
            elif request.answered_by(frame):
                self._answered(request)
                return frame[1:-2]

    def _send(self, request: AzRequest) -> float:
        """Send the bytes and return the wall time at which they were sent."""
        time.sleep(max(0.0, self._free_at_s - self._clock.now()))
        self._port.reset_input_buffer()
        self._free_at_s = self._clock.now() + self._wire_s(request) + self._gap_s
        sent = time.monotonic()
        self.requests.note()
        self._port.write(request.frame)
        return sent

    def _bytes_until(self, give_up: float) -> Iterator[bytes]:
        """Yield the bytes that come, without an end and waiting a little for each. After the
        deadline they are yielded once more: on a busy computer the answer may have waited in the
        port. Then raises NoAnswerError, or BrokenAnswerError where bytes keep coming, as from an
        instrument that streams on this port."""
        came = b""
        while True:
            late = time.monotonic() > give_up
            data: bytes = self._port.read(self._port.in_waiting or 1)
            came += data
            yield data
            if late and len(came) > MOST_SHOWN:
                raise BrokenAnswerError(f"{len(came)} bytes came, none of them its answer")
            if late:
                raise NoAnswerError(f"only {came.hex(' ')} came" if came else "")

    def _answered(self, request: AzRequest) -> None:
        now_s = self._clock.now()
        self._heard_s[request.unit] = now_s
        self._free_at_s = max(self._free_at_s, now_s + self._gap_s)

    def _wire_s(self, request: AzRequest) -> float:
        """Return the time in s that request and answer take on the line."""
        on_wire = len(request.pdu) + 3 + request.answer_bytes
        return on_wire * BITS_A_BYTE / self._baudrate + RESPONSE_WAIT_S

    def exchange_s(self, request: AzRequest) -> float:
        """Return the time in s that an exchange takes in all, until the next request may be
        sent."""
        return self._wire_s(request) + self._gap_s

    # --- the port -----------------------------------------------------------------------------

    def _open_port(self) -> None:
        if self._port is not None:
            return
        import serial

        self._trusted.clear()
        self._port = serial.Serial(
            self.path,
            self._baudrate,
            parity=self._parity,
            timeout=READ_WAIT_S,
            write_timeout=1.0,
        )

    def _close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()


def _first_frame(got: bytes) -> tuple[bytes | None, bytes]:
    """Return the frame at the front and the rest; None while it is not whole. BrokenAnswerError for
    bytes that begin none."""
    if len(got) < 2:
        return None, got
    code = got[1]
    if code & 0x80:
        length = 5
    elif code in (6, ECHO, WRITE):
        length = 8
    elif code == READ:
        length = 5 + got[2] if len(got) > 2 else 5
    else:
        raise BrokenAnswerError(f"{got[:16].hex(' ')} is not an answer")
    if len(got) < length:
        return None, got
    if crc16(got[:length]):
        raise BrokenAnswerError(f"the checksum of {got[:length][:16].hex(' ')} is wrong")
    return got[:length], got[length:]


class AzLink:
    """One drive on a line. `device` is the name used in errors; the time-out is wall time."""

    def __init__(self, device: str, line: AzLine, unit_id: int, timeout_s: float, clock: Clock):
        self.device = device
        self.line = line
        self.where = f"unit {unit_id} on {line.path}"
        self.charge = TimeoutCharge(clock, timeout_s)
        self.failures = 0
        """Number of exchanges that have failed."""
        self._unit, self._timeout_s, self._clock = unit_id, timeout_s, clock
        self._closed = False

    def read(self, address: int, count: int, waits: bool = True) -> list[int]:
        """Return `count` holding registers. `waits` off: the bench's clock is not waited on."""
        if waits:
            self.line.wait_until_free()
        pdu = self._ask(f"read register {address:04X}h", reading(self._unit, address, count), waits)
        return list(struct.unpack(f">{count}H", pdu[2:]))

    def write(
        self,
        address: int,
        words: Sequence[int],
        charge: bool = True,
        urgent: bool = False,
        permit: Callable[[], None] = lambda: None,
    ) -> None:
        """Write consecutive registers in one request, without waiting on the bench's clock: call
        `line.wait_until_free` before, where that may be.

        `charge` off: a time-out does not move that clock. `urgent`: sent whatever the drive owes;
        what came of it has to be read. `permit` is called when it is this request's turn and
        nothing has been sent; what it raises keeps the request from being sent.
        """
        request = writing(self._unit, address, words)
        self._ask(f"write register {address:04X}h", request, charge, urgent, permit)

    def read_value(self, address: int) -> int:
        """Return a signed 32-bit value, upper register first."""
        upper, lower = self.read(address, 2)
        return signed(upper << 16 | lower)

    def set_value(self, address: int, value: int) -> None:
        """Write a 32-bit value where it differs, and verify that it reads back the same.

        Raises InstrumentError if it reads back another value.
        """
        if self.read_value(address) == value:
            return
        self.line.wait_until_free()
        self.write(address, halves(value))
        kept = self.read_value(address)
        if kept != value:
            raise InstrumentError(
                self.device,
                f"write register {address:04X}h",
                f"set to {value} but reads back {kept}",
                "something else configures the drive, or the value is outside its range",
            )

    def close(self) -> None:
        """Release the line."""
        if not self._closed:
            self._closed = True
            self.line.forget(self._unit)
            self.line.release()

    @contextlib.contextmanager
    def _line_errors(self, what: str, charge: bool) -> Iterator[None]:
        """Turn the line's failures into InstrumentErrors."""
        try:
            yield
        except NoAnswerError as nothing:
            self.failures += 1
            if charge:
                self.charge()
            came = f": {nothing}" if str(nothing) else ""
            raise InstrumentTimeoutError(
                self.device,
                what,
                f"no answer within {self._timeout_s:g} s{came}",
                f"check that {self.where} is switched on, and its baudrate and parity",
            ) from nothing
        except BrokenAnswerError as broken:
            self.failures += 1
            raise InstrumentLinkError(
                self.device,
                what,
                f"the connection failed ({broken})",
                f"check the cable, and baudrate and parity of {self.where}",
            ) from broken

    def _ask(
        self,
        what: str,
        request: AzRequest,
        charge: bool,
        trusting: bool = False,
        permit: Callable[[], None] = lambda: None,
    ) -> bytes:
        waiting = self._clock.answer_within(TIMEOUTS_PER_ANSWER * self._timeout_s, self.device)
        with self._line_errors(what, charge), waiting:
            pdu = self.line.exchange(request, self._timeout_s, trusting, permit)
        if pdu[0] & 0x80:
            code = pdu[1]
            raise AzRefusalError(
                self.device,
                what,
                f"the drive refused it (Modbus exception {code}: {EXCEPTIONS.get(code, '?')})",
                f"check the settings and the state of {self.where}",
                code,
            )
        return pdu


class AzRefusalError(InstrumentError):
    """The drive answered with an exception: it refused the request."""

    def __init__(self, device: str, command: str, cause: str, hint: str, exception: int):
        super().__init__(device, command, cause, hint)
        self.exception = exception


def signed(value: int) -> int:
    """Return the signed number that an unsigned one of 32 bits stands for (two's complement)."""
    return value - (1 << 32) if value >> 31 else value


def halves(value: int) -> tuple[int, int]:
    """Return a 32-bit value, upper register first."""
    return value >> 16 & 0xFFFF, value & 0xFFFF
