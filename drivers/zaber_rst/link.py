"""A conversation with one device on a Zaber chain that takes nothing for an answer but its answer.

What is sent and received, nothing about motion. The port is a serial one, or ``socket://host:port``
for a chain on the network. Every command is sent once: whether a repetition is harmless, only
the caller knows. An answer has the command's id, its device and axis, and a check that fits; a late
or doubled one has another id and is passed over. After a time-out, or a line that cannot be read,
the port is closed and the next command opens it again, with what had been left in it thrown away.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from drivers.shared.ports import Port, open_port
from drivers.shared.timeout_charge import TimeoutCharge
from drivers.zaber_rst import frames as zaber_frames
from drivers.zaber_rst.frames import Reply, ZaberFrameError
from rig.core.errors import InstrumentError, InstrumentTimeoutError, RigError

if TYPE_CHECKING:
    from rig.core.clock import Clock

LONGEST_LINE = 1024
"""Longest message: more bytes without a line's end are an error."""
TIMEOUTS_PER_ANSWER = 2
"""Longest wait for an answer, in time-outs: the port may have to be opened first."""


class ZaberLink:
    """One device's commands and replies; the time-out is wall time.

    `name` is the instrument's in errors. A lock is held for one transaction, never longer.
    """

    def __init__(
        self, name: str, port: str, baudrate: int, device: int, timeout_s: float, clock: Clock
    ):
        self.name = name
        self.where = f"device {device} at {port}"
        self.charge = TimeoutCharge(clock, timeout_s)
        self._path, self._baudrate = port, baudrate
        self._device = device
        self._timeout_s = timeout_s
        self._clock = clock
        self._lock = threading.RLock()
        self._port: Port | None = None
        self._input = bytearray()
        self._last_id = 0

    def ask(
        self,
        axis: int,
        words: str,
        charge: bool = True,
        permit: Callable[[], None] = lambda: None,
    ) -> Reply:
        """Send one command and return its reply, be it a rejection; `axis` 0 is the device itself.

        `charge` off: a time-out does not move the bench's clock. `permit` is called when it is this
        command's turn and nothing has been sent; what it raises keeps it from being sent.
        """
        what = words or "status"
        try:
            with (
                self._clock.answer_within(TIMEOUTS_PER_ANSWER * self._timeout_s, self.name),
                self._lock,
            ):
                permit()
                try:
                    return self._transact(axis, words)
                except BaseException:
                    self.close()
                    raise
        except TimeoutError as error:
            raise self._timed_out(what, charge) from error
        except ZaberFrameError as error:
            raise self._error(what, f"the answer cannot be read ({error})") from error
        except RigError:
            raise
        except Exception as error:  # pyserial and termios raise what they like where it breaks
            raise self._error(what, f"the connection failed ({error})") from error

    def close(self) -> None:
        """Close the port."""
        with self._lock:
            port, self._port = self._port, None
            self._input.clear()
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    # --- one transaction ---------------------------------------------------------------------

    def _transact(self, axis: int, words: str) -> Reply:
        if self._port is None:
            self._port = open_port(self._path, self._baudrate, self._timeout_s)
        deadline = time.monotonic() + self._timeout_s  # some adapters take a second to open
        self._last_id = (self._last_id + 1) % zaber_frames.IDS
        self._port.write(zaber_frames.command(self._device, axis, self._last_id, words))
        wanted = (self._device, axis, self._last_id)
        while True:
            reply = zaber_frames.reply(self._line(self._port, deadline))
            if reply is not None and (reply.device, reply.axis, reply.message_id) == wanted:
                return reply

    def _line(self, port: Port, deadline: float) -> bytes:
        """Return the next line; TimeoutError where none has come by the deadline."""
        while (end := self._input.find(b"\n")) < 0:
            if len(self._input) > LONGEST_LINE:
                raise ZaberFrameError(f"{len(self._input)} bytes without an end")
            if time.monotonic() > deadline:
                raise TimeoutError
            self._input += port.read()
        line = bytes(self._input[: end + 1])
        del self._input[: end + 1]
        return line

    # --- what goes wrong ---------------------------------------------------------------------

    def _timed_out(self, what: str, charge: bool) -> InstrumentTimeoutError:
        """Return the error of a time-out; with `charge` bench time passes for it first."""
        if charge:
            self.charge()
        return InstrumentTimeoutError(
            self.name, what, f"no answer within {self._timeout_s:g} s", self._remedy
        )

    def _error(self, what: str, cause: str) -> InstrumentError:
        return InstrumentError(self.name, what, cause, self._remedy)

    @property
    def _remedy(self) -> str:
        return (
            f"check that {self.where} is switched on and connected, that it speaks Zaber ASCII at "
            f"{self._baudrate} baud, and that nothing else talks to it"
        )
