"""A SCPI conversation over VISA that checks every answer and never trusts a stale one. Any number
of threads may use it: one message and its answer at a time.

What is sent and what comes back, nothing about any instrument. A set and the error query that
belongs to it travel as one message, because a raw socket answers a write followed by a query 44 ms
late (Nagle's algorithm meets delayed acknowledgement) and because one message has one outcome.

After a time-out or a broken answer the late reply may still arrive and would be taken for the
answer to the next question. The link is therefore closed at once and opened again by the next call:
old replies die with the old connection.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import pyvisa
import pyvisa_py  # noqa: F401 - up to a second, not to be spent while a drive waits for a word
from pyvisa.constants import StatusCode

from rig.core.errors import InstrumentError, InstrumentTimeoutError, RigError
from rig.instruments.roles import Identity

if TYPE_CHECKING:
    from rig.core.clock import Clock

_ERROR_REPLY = re.compile(r'^([+-]?\d+),"(.*)"$')
_SMALLEST_BLOCK_REPLY = len(b"#10")
_STREAM = re.compile(r"^ASRL|::SOCKET$", re.IGNORECASE)
"""Resources that deliver bytes, not messages."""
_LINE_ENDS = (b"", b"\n", b"\r\n")
_LONGEST_ERROR_QUEUE = 32
_FIRST_USE = threading.Lock()
"""The library makes its one resource manager without asking who else is about to."""
TIMEOUTS_PER_ANSWER = 2
"""Longest wait for an answer, in time-outs: the connection may have to be opened first."""


class VisaLink:
    """One instrument's SCPI connection: `resource` in VISA notation, time-out in wall seconds."""

    def __init__(self, device: str, resource: str, timeout_s: float, clock: Clock):
        self.device = device
        self.resource = resource
        self._timeout_s = timeout_s
        self._clock = clock
        self._session: Any = None
        self._reopening = False
        self._exchange = threading.RLock()
        """Held for one message and its answer."""

    def identify(self) -> Identity:
        """Return the answer to ``*IDN?``. Raises InstrumentError where it has not four fields."""
        reply = self.query("*IDN?")
        fields = [field.strip() for field in reply.split(",")]
        if len(fields) != 4:
            raise self._garbage("*IDN?", reply, "four fields separated by commas")
        return Identity(*fields)

    def query(self, message: str) -> str:
        """Send one message and return its one-line reply without the line end.

        A reply without one was cut off (IEEE 488.2, 8.5: NL and END): the half of a number is one.
        Raises InstrumentError for a reply without one, and if the instrument does not answer.
        """
        with self._conversation(message) as session:
            session.write(message)
            reply: bytes = session.read_raw()
            if not reply.endswith(b"\n"):
                raise self._garbage(message, reply, "a whole line")
            return reply.decode("ascii").strip("\r\n")

    def query_block(self, message: str, content_bytes: int) -> bytes:
        """Send a query answered by a definite-length block of exactly `content_bytes` bytes."""
        with self._conversation(message) as session:
            session.write(message)
            # One read takes the whole message where it is not longer than the chunk: USBTMC in
            # pyvisa-py ends a read_raw() at the chunk size, so the chunk must hold it all.
            session.chunk_size = content_bytes + 64
            raw: bytes = session.read_raw()
            while self._is_cut_at_line_end(raw, content_bytes):
                raw += session.read_raw()
            return self._block_content(message, raw, content_bytes)

    def command(self, *commands: str, then: tuple[str, ...] = ()) -> list[str]:
        """Send commands, the queries `then` and an error query as one message.

        Returns the replies to `then`; raises InstrumentError where the instrument reports an
        error or the replies do not match the questions.
        """
        message = ";:".join((*commands, *then, "SYST:ERR?"))
        reply = self.query(message)
        answers = reply.split(";", len(then))
        if len(answers) != len(then) + 1:
            raise self._garbage(message, reply, f"{len(then) + 1} answers")
        self._check_error(message, answers[-1])
        return answers[:-1]

    def number(self, query: str, reply: str) -> float:
        """Return the number in a reply. Raises InstrumentError, which shows what came instead."""
        try:
            return float(reply)
        except ValueError:
            raise self._garbage(query, reply, "a number") from None

    def close(self) -> None:
        """Close the connection; a broken one is closed all the same."""
        session, self._session = self._session, None
        if session is not None:
            with contextlib.suppress(Exception):  # the link is going away whatever it says
                session.close()

    @contextlib.contextmanager
    def _conversation(self, message: str) -> Iterator[Any]:
        """Give the block an open session; any failure closes it and becomes an InstrumentError."""
        with self._exchange:
            try:
                with self._clock.answer_within(TIMEOUTS_PER_ANSWER * self._timeout_s, self.device):
                    if self._session is None:
                        self._session = self._open(message)
                    yield self._session
            except pyvisa.errors.VisaIOError as error:
                self.close()
                if error.error_code == StatusCode.error_timeout:
                    self._charge_timeout()
                    raise InstrumentTimeoutError(
                        self.device,
                        _first(message),
                        f"no answer within {self._timeout_s:g} s",
                        f"check that {self.resource} is switched on and reachable",
                    ) from error
                raise self._broken(message, str(error)) from error
            except UnicodeDecodeError as error:
                raise self._garbage(message, error.object, "text") from error
            except RigError:
                self.close()
                raise
            except Exception as error:
                # What pyvisa-py raises over bytes that it does not expect is of any type: a flipped
                # bit in a HiSLIP header is an AssertionError, a KeyError or a MemoryError.
                self.close()
                raise self._broken(message, f"{type(error).__name__}: {error}") from error

    def _open(self, message: str) -> Any:
        """Return a new session; `message` is what it is wanted for."""
        wait_ms = round(self._timeout_s * 1000)
        try:
            with _FIRST_USE:
                manager = pyvisa.ResourceManager("@py")
            session: Any = manager.open_resource(self.resource, open_timeout=wait_ms)
        except pyvisa.errors.VisaIOError:
            raise
        except Exception as error:  # pyvisa-py raises anything here, down to a bare Exception
            raise self._broken(message, f"{type(error).__name__}: {error}") from error
        session.timeout = wait_ms
        session.write_termination = "\n"
        session.read_termination = "\n"
        if self._reopening:
            session.write("*CLS")  # what the broken conversation left behind blames no new command
        self._reopening = True
        return session

    def _charge_timeout(self) -> None:
        """Let the bench's clock pass for a time-out, which takes wall time."""
        with contextlib.suppress(InstrumentError):  # the time-out itself is the news
            self._clock.charge(self._timeout_s)

    def _check_error(self, message: str, reply: str) -> None:
        """Raise where the queue held errors; all are taken out, so that none blames the next
        command."""
        errors: list[str] = []
        while (entry := self._error_entry(message, reply)) is not None:
            errors.append(entry)
            if len(errors) == _LONGEST_ERROR_QUEUE:
                break
            reply = self.query("SYST:ERR?")
        if errors:
            raise InstrumentError(
                self.device,
                _first(message),
                "; ".join(_each_once(errors)),
                "check the value against its manual",
            )

    def _error_entry(self, message: str, reply: str) -> str | None:
        match = _ERROR_REPLY.match(reply)
        if match is None:
            raise self._garbage(message, reply, "an error-queue entry")
        code, text = int(match[1]), match[2]
        if code == 0:
            return None
        if code == -222:
            text += " (the instrument clipped the value and applied the clipped one)"
        return f"error {code}: {text}"

    def _is_cut_at_line_end(self, raw: bytes, expected: int) -> bool:
        """Return whether a read has ended within a block, at a byte of it that is a line end.

        A raw socket or a serial line has no other mark of the end of a message. One with a mark
        (USBTMC, HiSLIP, VXI-11) delivers the message whole, and a short one is broken.
        """
        if not _STREAM.search(self.resource):
            return False
        digits = int(raw[1:2]) if raw[1:2].isdigit() else 0
        header = b"#%d%0*d" % (digits, digits, expected)
        return raw.startswith(header) and len(raw) <= len(header) + expected

    def _block_content(self, message: str, raw: bytes, expected: int) -> bytes:
        if len(raw) < _SMALLEST_BLOCK_REPLY or raw[:1] != b"#" or not raw[1:2].isdigit():
            raise self._garbage(message, raw[:40], "a definite-length block")
        digits = int(raw[1:2])
        length_field = raw[2 : 2 + digits]
        if digits == 0 or not length_field.isdigit():
            raise self._garbage(message, raw[:40], "a definite-length block")
        announced = int(length_field)
        content = raw[2 + digits : 2 + digits + announced]
        if announced != expected or len(content) != expected:
            raise self._garbage(
                message,
                f"{len(content)} of {announced} announced bytes",
                f"{expected} bytes",
            )
        rest = raw[2 + digits + announced :]
        if rest not in _LINE_ENDS:
            raise self._garbage(message, rest[:40], "the end of a block")
        return content

    def _garbage(self, message: str, got: object, wanted: str) -> InstrumentError:
        self.close()
        shown = repr(got)
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        return InstrumentError(
            self.device,
            _first(message),
            f"the answer {shown} is not {wanted}",
            f"check the cable and that nothing else talks to {self.resource}",
        )

    def _broken(self, message: str, cause: str) -> InstrumentError:
        return InstrumentError(
            self.device,
            _first(message),
            f"the connection failed ({cause})",
            f"check that {self.resource} is switched on and reachable",
        )


def _each_once(errors: Sequence[str]) -> Iterator[str]:
    """Yield each entry, with how often it was there."""
    for entry, count in Counter(errors).items():
        yield entry if count == 1 else f"{entry} ({count} times)"


def _first(message: str) -> str:
    """Return what is shown of a message: its first command, and whether it had more."""
    first, separator, _ = message.partition(";")
    return first + (" ..." if separator else "")
