"""A conversation in lines with an instrument that also sends lines by itself, such as frames.

Commands and answers are those of `LineLink`. An answer is known by its form: lines of the stream
may come before it and stay where they are, to be collected later.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable

from drivers.shared.line_link import (
    ECHO,
    ECHO_HINT,
    LONGEST_LINE,
    TIMEOUTS_PER_ANSWER,
    LineLink,
    is_echo,
)
from drivers.shared.ports import Port

GIVES_WAY_S = 0.001
"""Time in s for which `collect` leaves the link to a command that waits for it."""
STREAM = "stream"
"""The command that errors of what comes by itself are named after."""


class LineStream(LineLink):
    """The link to an instrument that streams lines; any thread may call any method.

    `resync` is needed as with a `LineLink`; its query has to end the stream first.
    """

    _asking = False
    """True while a command waits for its turn or its answer."""
    _last_line = ""
    """The last line that came in place of an answer."""

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the link since it was made, less those that `collect` has not
        returned."""
        taken = self._taken  # first: what comes between the two makes the result too small
        return taken - len(self._input)

    @property
    def is_open(self) -> bool:
        """True while the port is open: from the first command until one fails or `close`."""
        return self._port is not None

    def collect(self) -> list[bytes]:
        """Return the lines that have come since the last call, without their ends, oldest first;
        waits for a few milliseconds if there are none.

        Raises InstrumentError where the connection fails or is closed.
        """
        if self._asking:
            time.sleep(GIVES_WAY_S)
        with self._lock, self._closing_what_fails(STREAM):
            if self._port is None:
                raise self.error(STREAM, "the port is closed")
            if self._terminator not in self._input:
                self._receive(self._port)
            *lines, rest = bytes(self._input).split(self._terminator)
            if len(rest) > LONGEST_LINE:
                raise ValueError(f"{len(rest)} bytes without the end of a line")
            self._input[:] = rest
            return lines

    def ask(
        self,
        command: str,
        answer: str = ".*",
        *,
        charge: bool = True,
        permit: Callable[[], None] = lambda: None,
    ) -> re.Match[str]:
        """See `LineLink`. A thread that collects without a pause gives way."""
        # A lock is not fair: who has just released it mostly gets it again.
        self._asking = True
        try:
            return super().ask(command, answer, charge=charge, permit=permit)
        finally:
            self._asking = False

    def fall_silent(self, command: str) -> None:
        """Drop what was not collected, and what comes until nothing has come for 20 ms: `command`
        has ended the stream.

        Raises InstrumentError where the instrument continues to send for the time-out.
        """
        with (
            self._clock.answer_within(TIMEOUTS_PER_ANSWER * self._timeout_s, self._device),
            self._lock,
            self._closing_what_fails(command),
        ):
            if self._port is not None:
                self._fall_silent(self._port, command, self._deadline())

    def _exchange(self, command: str, answer: re.Pattern[str]) -> re.Match[str]:
        self._last_line = ""  # an earlier command's would be a wrong cause of this one's time-out
        return super()._exchange(command, answer)

    def _answer(
        self, port: Port, command: str, answer: re.Pattern[str], deadline: float
    ) -> re.Match[str]:
        """Return the answer: the first line that matches. Those before it are left in place."""
        begin, self._last_line = 0, ""
        while True:
            end = self._input.find(self._terminator, begin)
            if end < 0:
                if len(self._input) - begin > LONGEST_LINE:
                    raise ValueError(f"{len(self._input) - begin} bytes without the end of a line")
                if time.monotonic() > deadline:
                    raise TimeoutError
                self._receive(port)
                continue
            after = end + len(self._terminator)
            line = self._input[begin:end].decode("latin-1")
            if (found := answer.fullmatch(line)) is not None:
                del self._input[begin:after]
                return found
            begin, self._last_line = after, line

    def _no_answer(self, command: str) -> tuple[str, str]:
        """See `LineLink`."""
        cause, hint = super()._no_answer(command)
        if not self._last_line:
            return cause, hint
        last = f"the last line that came is {self._last_line[:80]!r}"
        cause = f"no answer of the expected form within {self._timeout_s:g} s; {last}"
        if is_echo(command, self._last_line):
            return f"{cause}, {ECHO}", ECHO_HINT
        return cause, hint
