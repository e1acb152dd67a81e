"""The terminal of a jogging session: keys as they are pressed, and a line with the state."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import sys
import termios
import time
import tty
from typing import TYPE_CHECKING, Any, Self

from rig.core.errors import ConfigurationError
from rig.core.text import printable
from rig.jog.keys import Key
from rig.run.stopping import StopRequestedError

if TYPE_CHECKING:
    from rig.jog.keys import JogAxis
    from rig.jog.session import JogStatus

ESCAPE_S = 0.05
"""Time after which an escape character that nothing has followed is the key Esc."""
SHOW_EVERY_S = 0.1
KEYS: dict[bytes, Key] = {
    **dict.fromkeys((b"\x1b[A", b"\x1b[D", b"\x1bOA", b"\x1bOD", b"-"), Key.LESS),
    **dict.fromkeys((b"\x1b[B", b"\x1b[C", b"\x1bOB", b"\x1bOC", b"+", b"="), Key.MORE),
    b"\t": Key.NEXT_AXIS,
    b"h": Key.HOME,
    b"y": Key.CONFIRM,
    b"q": Key.LEAVE,
    b"\x1b": Key.LEAVE,
}
"""Bytes that terminals send (ECMA-48, and the application mode of VT100 cursor keys): up and left
mean less, down and right mean more. Everything else stops."""
HELP = (
    "Up/Left/-: towards smaller position (z: up)   Down/Right/+: towards larger",
    "Tab: next axis   h: home   space or any other key: stop   q/Esc: leave",
)
"""Lines that fit a terminal of 80 columns."""
_CLEAR = "\r\x1b[K"


class Keyboard:
    """Bytes of a terminal in, keys out; no I/O. A sequence may come in parts."""

    def __init__(self) -> None:
        self._begun = b""
        self._begun_s = 0.0

    def feed(self, typed: bytes, now_s: float) -> list[Key]:
        """Return the keys typed since the last call; the time distinguishes Esc from a sequence."""
        if typed and not self._begun:
            self._begun_s = now_s
        rest, self._begun = self._begun + typed, b""
        keys = []
        while rest:
            length = _sequence_length(rest)
            if length is None and now_s - self._begun_s < ESCAPE_S:
                self._begun = rest
                break
            sequence, rest = rest[:length], rest[length or len(rest) :]
            keys.append(KEYS.get(sequence, Key.STOP))
        return keys


def _sequence_length(typed: bytes) -> int | None:
    """Return the number of bytes of the first key; None if more may follow."""
    if typed[0] != 0x1B:
        return 1
    if len(typed) == 1:
        return None
    if typed[1:2] == b"O":
        return 3 if len(typed) > 2 else None
    if typed[1:2] != b"[":
        return 1 if typed[1] == 0x1B else 2  # Esc, Esc; or Alt with a key
    ends = (n for n, byte in enumerate(typed[2:], 3) if 0x40 <= byte <= 0x7E)
    return next(ends, None)


class Terminal:
    """stdin, key by key, and stderr; a context manager that restores the terminal's mode.

    Flow control is off, so that Ctrl-S cannot block the program. Raises ConfigurationError if stdin
    is not a terminal.
    """

    def __init__(self) -> None:
        self._file = 0
        if not os.isatty(self._file):
            raise ConfigurationError(
                "stdin is not a terminal, so a motion could not be stopped",
                "run it in a terminal, without a pipe or a redirection",
            )
        self._keyboard = Keyboard()
        self._before: list[Any] = []
        self._shown_s = 0.0

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self._file)
        tty.setcbreak(self._file, termios.TCSAFLUSH)
        mode = termios.tcgetattr(self._file)
        mode[0] &= ~termios.IXON
        termios.tcsetattr(self._file, termios.TCSAFLUSH, mode)
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(termios.error, OSError):  # it may be gone
            termios.tcsetattr(self._file, termios.TCSAFLUSH, self._before)
        self._write(_CLEAR)

    def keys(self) -> list[Key]:
        """Return the keys pressed since the last call.

        Raises StopRequestedError if the terminal has closed.
        """
        typed = b""
        if select.select([self._file], [], [], 0)[0]:
            try:
                typed = os.read(self._file, 1024)
            except OSError:
                typed = b""
            if not typed:
                raise StopRequestedError(signal.SIGHUP, ": the terminal has closed")
        return self._keyboard.feed(typed, time.monotonic())

    def forget(self) -> None:
        """Drop the keys that were typed and not read."""
        with contextlib.suppress(termios.error, OSError):  # keys() reports it
            termios.tcflush(self._file, termios.TCIFLUSH)
        self._keyboard = Keyboard()

    def say(self, text: str) -> None:
        """Show a line that stays, above the line with the state."""
        clear = _CLEAR if sys.stderr.isatty() else ""
        self._write(f"{clear}{printable(text)}\n")
        self._shown_s = 0.0

    def show(self, status: JogStatus) -> None:
        """Update the line with the state, a few times a second and on a terminal only."""
        now = time.monotonic()
        if now - self._shown_s < SHOW_EVERY_S or not sys.stderr.isatty():
            return
        self._shown_s = now
        columns = shutil.get_terminal_size().columns
        self._write(_CLEAR + in_a_line(status)[: columns - 1])

    def _write(self, text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


def in_a_line(status: JogStatus) -> str:
    """Return the state as a line: the chosen axis, the force, then the other axes, so that a narrow
    terminal cuts off the least important part."""
    parts = [_axis_in_words(status.chosen, status)]
    if status.force_N is not None:
        over = " OVER THE LIMIT" if status.pressed else ""
        values = " ".join(
            f"{axis} {value:+.2f}" for axis, value in zip("xyz", status.force_N, strict=True)
        )
        parts.append(f"force {values} N{over} (not tared)")
    parts += [_axis_in_words(axis, status) for axis in status.axes if axis is not status.chosen]
    return " | ".join(parts)


def _axis_in_words(axis: JogAxis, status: JogStatus) -> str:
    place = status.places[axis.name]
    homed = "" if place.homed else " (not homed)"
    moves = " moving" if axis is status.moving else ""
    return f"{axis.name} {place.position:.3f} {axis.unit}{homed}{moves}"
