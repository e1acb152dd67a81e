"""A conversation in lines: a command is sent, and its answer is one line.

For instruments that answer every command (`drivers.shared.line_stream` is for one that sends lines
by itself as well). What is sent and received, nothing about any instrument.
After a time-out, or a line that cannot be read, the connection is closed, and the next command
opens it again. On TCP a late answer dies with its connection. On a serial line it may still come:
`resync` is a query with an answer of its own form, which is asked again after a failure, and
everything before its answer is thrown away. The same is done where it is the first command of a
link: a program that used the line before may have left an answer to come.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from drivers.shared.ports import SOCKET, USUAL_FORMAT, Port, open_port
from drivers.shared.timeout_charge import TimeoutCharge
from rig.core.errors import InstrumentError, InstrumentTimeoutError, RigError

if TYPE_CHECKING:
    from rig.core.clock import Clock

LONGEST_LINE = 1 << 16
"""More bytes without a line's end are an error."""
TIMEOUTS_PER_ANSWER = 2
"""Longest wait for an answer, in time-outs: before it, a connection may have to be made, or on a
serial line the place to be found again."""
QUIET_S = 0.02
"""Time in s for which a serial line has to be silent after a failure before it is used again."""

ECHO = "the command itself: it is echoed"
ECHO_HINT = "switch off the echo of the instrument or its adapter, and check their connection"
"""Cause and hint where a command comes back in place of an answer."""


class LineLink:
    """One instrument's commands and answers; any thread may call any method.

    `device` is the instrument's role, for errors. `place` is a serial port or
    ``socket://host:port``. A lock is held for one exchange.

    Each step of a command has a bound of its own, in wall time: to open the port may take
    `timeout_s` over TCP, and on a serial line as long as the computer takes, which nothing here can
    cut short; to find the place again after a failure, until the line is silent, `timeout_s` from
    then on; and the answer `timeout_s` from the moment at which its command is sent.
    """

    def __init__(
        self,
        device: str,
        place: str,
        timeout_s: float,
        clock: Clock,
        *,
        terminator: bytes = b"\n",
        baudrate: int = 9600,
        serial_format: str = USUAL_FORMAT,
        resync: tuple[str, str] | None = None,
    ):
        self._device, self._place, self._timeout_s = device, place, timeout_s
        self._clock, self._terminator = clock, terminator
        self._baudrate, self._serial_format = baudrate, serial_format
        self._resync = None if resync is None else (resync[0], re.compile(resync[1]))
        self._lock = threading.RLock()
        self._port: Port | None = None
        self._input = bytearray()
        """What has come and is not used yet."""
        self._taken = 0
        """Bytes that have come since the link was made."""
        self._charge = TimeoutCharge(clock, timeout_s)
        self._failed = False
        self._used = False

    def ask(
        self,
        command: str,
        answer: str = ".*",
        *,
        charge: bool = True,
        permit: Callable[[], None] = lambda: None,
    ) -> re.Match[str]:
        """Send a command and return its answer, which has to match the regular expression `answer`.

        `charge` off: a time-out does not let bench time pass, for `make_safe`. `permit` is called
        when it is this command's turn and nothing has been sent; what it raises keeps it from being
        sent. Raises InstrumentTimeoutError where no answer comes in time, InstrumentError where it
        does not match or the connection fails.
        """
        try:
            with (
                self._clock.answer_within(TIMEOUTS_PER_ANSWER * self._timeout_s, self._device),
                self._lock,
            ):
                permit()
                with self._closing_what_fails(command):
                    return self._exchange(command, re.compile(answer))
        except TimeoutError:
            raise self._timed_out(command, charge) from None

    def close(self) -> None:
        """Close the port; the next command opens it again."""
        with self._lock:
            port, self._port = self._port, None
            self._input.clear()
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    def error(self, command: str, cause: str, hint: str = "") -> InstrumentError:
        """Return an error of this instrument; its hint names the port unless another is given."""
        usual = f"check that {self._place} is switched on and that nothing else talks to it"
        return InstrumentError(self._device, _shown(command), cause, hint or usual)

    def _settings_hint(self, state: str) -> str:
        """Return what to check at an instrument whose answers are missing or wrong: that it is in
        this state, and on a serial line the settings of the port."""
        check = f"check that {self._place} {state}"
        if self._place.startswith(SOCKET):
            return check
        return (
            f"{check}, and that the instrument has the baud rate of this link, {self._baudrate}, "
            f"and its format, {self._serial_format}"
        )

    @contextlib.contextmanager
    def _closing_what_fails(self, command: str) -> Iterator[None]:
        """Close the port where the block fails, and name the device and the command; a TimeoutError
        stays one."""
        try:
            yield
        except BaseException as error:
            self._failed = True
            self.close()
            if isinstance(error, (TimeoutError, RigError)) or not isinstance(error, Exception):
                raise
            # Pyserial and termios raise what they like where it breaks.
            raise self.error(command, f"the connection failed ({error})") from error

    # --- one exchange -------------------------------------------------------------------------

    def _exchange(self, command: str, answer: re.Pattern[str]) -> re.Match[str]:
        if self._port is None:
            self._port = open_port(
                self._place, self._baudrate, self._timeout_s, self._serial_format
            )
            if self._resync is not None and not self._place.startswith(SOCKET):
                begins = not self._used and command == self._resync[0]
                if self._failed or begins:
                    self._find_again(self._port)
        self._failed, self._used = False, True
        deadline = self._deadline()
        self._port.write(command.encode("ascii") + self._terminator)
        return self._answer(self._port, command, answer, deadline)

    def _deadline(self) -> float:
        """Return the wall time by which a step that begins now has to be done."""
        return time.monotonic() + self._timeout_s

    def _answer(
        self, port: Port, command: str, answer: re.Pattern[str], deadline: float
    ) -> re.Match[str]:
        """Return the answer: the next line, which has to match."""
        line = self._line(port, deadline)
        found = answer.fullmatch(line)
        if found is None:
            raise self._unexpected(command, line)
        return found

    def _unexpected(self, command: str, line: str) -> InstrumentError:
        if is_echo(command, line):
            return self.error(command, f"the answer {line[:80]!r} is {ECHO}", ECHO_HINT)
        return self.error(
            command,
            f"the answer {line[:80]!r} is not what was expected",
            self._settings_hint("is switched on and that nothing else talks to it"),
        )

    def _find_again(self, port: Port) -> None:
        """Throw away what is left of earlier commands."""
        assert self._resync is not None
        deadline = self._deadline()
        query, answer = self._resync
        port.write(query.encode("ascii") + self._terminator)
        line = None
        try:
            while answer.fullmatch(line := self._line(port, deadline)) is None:
                pass
        except TimeoutError:
            if line is None:
                raise
            raise self._unexpected(query, line) from None
        self._fall_silent(port, query, max(deadline, time.monotonic() + 2 * QUIET_S))

    def _fall_silent(self, port: Port, command: str, deadline: float) -> None:
        """Throw away what comes until nothing has come for `QUIET_S`. Raises InstrumentError where
        something still comes after the deadline."""
        self._input.clear()
        heard_s = time.monotonic()
        while True:
            looks_s = time.monotonic()
            if self._receive(port):
                if looks_s > deadline:
                    shown = self._input[-80:].decode("latin-1")
                    raise self.error(command, f"the instrument continues to send: {shown!r}")
                heard_s = time.monotonic()
                self._input.clear()
            elif looks_s - heard_s >= QUIET_S:  # not later: a busy computer may stand in between
                return

    def _receive(self, port: Port) -> int:
        """Take what has come off the port, with a short wait; return the number of bytes."""
        data = port.read()
        self._input += data
        self._taken += len(data)
        return len(data)

    def _line(self, port: Port, deadline: float) -> str:
        """Return the next line; TimeoutError where none has come by the deadline."""
        while (end := self._input.find(self._terminator)) < 0:
            if len(self._input) > LONGEST_LINE:
                raise ValueError(f"{len(self._input)} bytes without the end of a line")
            if time.monotonic() > deadline:
                raise TimeoutError
            self._receive(port)
        line = bytes(self._input[:end])
        del self._input[: end + len(self._terminator)]
        return line.decode("latin-1")

    def _timed_out(self, command: str, charge: bool) -> InstrumentTimeoutError:
        """Return the error of a time-out; with `charge` bench time passes for it first."""
        if charge:
            self._charge()
        return InstrumentTimeoutError(
            self._device,
            _shown(command),
            *self._no_answer(command),
        )

    def _no_answer(self, command: str) -> tuple[str, str]:
        """Return the cause of a command's time-out in words, and the remedy."""
        hint = self._settings_hint("is switched on and connected")
        return f"no answer within {self._timeout_s:g} s", hint


def is_echo(command: str, line: str) -> bool:
    """Return whether a line is a command, or one of several lines that are sent as one: it is not
    an answer, and comes from an instrument, an adapter or a plug that sends back what it gets."""
    return line.strip() in map(str.strip, command.splitlines())


def _shown(command: str) -> str:
    """Return a command, or several lines that are sent as one, for a message of one line."""
    return ", ".join(command.splitlines())
