"""A Modbus TCP conversation with a CMMT drive that sends nothing twice and trusts nothing late.

What is written and read, nothing about motion. Every request is sent once: the library's own
retries are off, because only the caller knows whether a repetition is harmless. After a time-out or
a broken answer the connection is closed and the next request opens a new one, so that a late answer
dies with its connection.

Register addresses and the parameter mailbox: the vendor's client festo-edcon 0.14.12,
``edrive/com_modbus.py``.
"""

from __future__ import annotations

import contextlib
import logging
import struct
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from pymodbus.client import ModbusTcpClient

from drivers.shared.request_log import RequestLog
from drivers.shared.timeout_charge import TimeoutCharge
from rig.core.errors import InstrumentError, InstrumentLinkError, InstrumentTimeoutError, RigError

if TYPE_CHECKING:
    from rig.core.clock import Clock

OUTPUT_IMAGE = 0
INPUT_IMAGE = 100
COMMUNICATION_TIMEOUT = 400
MAILBOX_PARAMETER = 500
MAILBOX_SUBINDEX = 501
MAILBOX_ELEMENTS = 502
MAILBOX_EXECUTE = 503
MAILBOX_LENGTH = 504
MAILBOX_DATA = 510

# The library reports on its logger what is raised here anyway; without a handler of the program's
# own, Python would print it.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

TIMEOUTS_PER_ANSWER = 2
"""Longest wait for an answer, in time-outs: the connection may have to be opened first."""

_READ, _WRITE, _DONE = 1, 2, 0x10
_BASIC, _REGULAR = 1, 2


class CmmtLink:
    """One drive's Modbus TCP connection; the time-out is wall time.

    `device` is the name used in errors. A lock is held for one transaction, never longer.
    """

    def __init__(
        self, device: str, host: str, port: int, unit_id: int, timeout_s: float, clock: Clock
    ):
        self.device = device
        self.where = f"{host}:{port}"
        self.charge = TimeoutCharge(clock, timeout_s)
        self._host, self._port, self._unit_id = host, port, unit_id
        self._timeout_s = timeout_s
        self._clock = clock
        self.requests = RequestLog(clock)
        """When the drive was asked something."""
        self._lock = threading.RLock()
        self._client: Any = None
        self._selected = (0, 0)
        """Parameter and number of elements that the mailbox names, as far as this program knows."""
        self._watchdog_ms = 0
        """The communication time-out that every new connection sets; 0 leaves the drive's."""

    def identification(self) -> dict[int, str]:
        """Return the device identification objects 0 to 5 by their numbers: vendor, product code,
        revision, URL, product name, model (function 43/14, read codes 1 and 2, as the vendor's
        client asks).

        Raises InstrumentError if an object is missing.
        """
        found: dict[int, str] = {}
        for code in (_BASIC, _REGULAR):
            for number, text in self._objects(code).items():
                if isinstance(text, bytes):
                    found[int(number)] = text.decode("ascii", "replace")
        if not {0, 1, 2, 3, 4, 5} <= set(found):
            raise self.garbage("read device identification", found, "six objects")
        return found

    def read(self, address: int, count: int, charge: bool = True) -> list[int]:
        """Return `count` holding registers. `charge` off: a time-out does not move the bench's
        clock.

        Raises InstrumentError for an answer with another number of registers.
        """
        what = f"read register {address}"
        reply = self._ask(
            what,
            lambda client: client.read_holding_registers(
                address, count=count, device_id=self._unit_id
            ),
            charge,
        )
        registers = list(getattr(reply, "registers", ()))
        if len(registers) != count:
            raise self.garbage(what, f"{len(registers)} registers", f"{count} registers")
        return registers

    def write(
        self,
        address: int,
        values: Sequence[int],
        charge: bool = True,
        permit: Callable[[], None] = lambda: None,
    ) -> None:
        """Write consecutive registers in one request; the drive acknowledges address and count.

        `permit` is called when it is this request's turn and nothing has been sent; what it raises
        keeps the request from being sent.
        """
        what = f"write register {address}"
        reply = self._ask(
            what,
            lambda client: client.write_registers(address, list(values), device_id=self._unit_id),
            charge,
            permit,
        )
        if (reply.address, reply.count) != (address, len(values)):
            raise self.garbage(what, (reply.address, reply.count), (address, len(values)))

    def write_one(self, address: int, value: int) -> None:
        """Write one register; the drive echoes it. Raises InstrumentError for another echo."""
        what = f"write register {address}"
        reply = self._ask(
            what, lambda client: client.write_register(address, value, device_id=self._unit_id)
        )
        if (reply.address, list(reply.registers)) != (address, [value]):
            raise self.garbage(what, (reply.address, list(reply.registers)), (address, [value]))

    def watch(self, timeout_ms: int) -> None:
        """Set the time without a request after which the drive stops by itself, and read it back.

        Every connection opened later does the same first: it is unconfirmed whether the drive
        keeps the time-out beyond the connection that set it.
        """
        self._watchdog_ms = timeout_ms
        self._ask("set the communication time-out", self._watch)

    def parameter(self, number: int, elements: int = 1) -> bytes:
        """Return the raw little-endian bytes of a drive parameter (PNU); raises InstrumentError if
        refused."""
        self._mailbox(number, elements)
        self._execute(_READ, f"read parameter {number}")
        (length,) = self.read(MAILBOX_LENGTH, 1)
        if not 0 < length <= 200:
            raise self.garbage(f"read parameter {number}", f"{length} bytes", "a parameter")
        registers = self.read(MAILBOX_DATA, (length + 1) // 2)
        return struct.pack(f"<{len(registers)}H", *registers)[:length]

    def watched_parameter(self, number: int) -> bytes:
        """Return the four bytes of a parameter that is read again and again.

        Three requests: the mailbox keeps the number of the latest parameter, which is read back
        with the result, so that another client's choice is not taken for this one.
        """
        if self._selected != (number, 1):
            return self.parameter(number)
        self.write_one(MAILBOX_EXECUTE, _READ)
        named, subindex, elements, result, length = self.read(MAILBOX_PARAMETER, 5)
        if (named, subindex, elements, result, length) != (number, 0, 1, _DONE, 4):
            return self.parameter(number)
        return struct.pack("<2H", *self.read(MAILBOX_DATA, 2))

    def set_parameter(self, number: int, raw: bytes) -> None:
        """Write a drive parameter and verify that it reads back the same.

        Raises InstrumentError if it reads back another value.
        """
        self._mailbox(number, 1)
        self.write_one(MAILBOX_LENGTH, len(raw))
        padded = raw + b"\0" * (len(raw) % 2)
        self.write(MAILBOX_DATA, struct.unpack(f"<{len(padded) // 2}H", padded))
        self._execute(_WRITE, f"write parameter {number}")
        kept = self.parameter(number)
        if kept != raw:
            raise InstrumentError(
                self.device,
                f"write parameter {number}",
                f"set to {raw.hex()} but reads back {kept.hex()}",
                "something else configures the drive, or the value is outside its range",
            )

    def close(self) -> None:
        """Close the connection; the next request opens a new one."""
        with self._lock:
            client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):  # the link is going away whatever it says
                client.close()

    def garbage(self, what: str, got: object, wanted: object) -> InstrumentError:
        """Close the link over an answer that is not what was asked for; the error to raise."""
        self.close()
        shown = str(got)
        shown = shown if len(shown) <= 80 else shown[:77] + "..."
        return InstrumentLinkError(
            self.device,
            what,
            f"the answer {shown} is not {wanted}",
            f"check the network and that {self.where} is the drive",
        )

    def _objects(self, code: int) -> dict[int, Any]:
        reply = self._ask(
            "read device identification",
            lambda client: client.read_device_information(
                read_code=code, object_id=0, device_id=self._unit_id
            ),
        )
        return getattr(reply, "information", {})

    def _mailbox(self, number: int, elements: int) -> None:
        self._selected = (0, 0)
        self.write_one(MAILBOX_PARAMETER, number)
        self.write_one(MAILBOX_SUBINDEX, 0)
        self.write_one(MAILBOX_ELEMENTS, elements)
        self._selected = (number, elements)

    def _execute(self, code: int, what: str) -> None:
        self.write_one(MAILBOX_EXECUTE, code)
        (result,) = self.read(MAILBOX_EXECUTE, 1)
        if result != _DONE:
            raise ParameterRefusedError(
                self.device,
                what,
                f"refused with result {result:#x}",
                "the firmware may not know this parameter, or it cannot be changed now",
            )

    def _ask(
        self,
        what: str,
        request: Callable[[Any], Any],
        charge: bool = True,
        permit: Callable[[], None] = lambda: None,
    ) -> Any:
        """Make one transaction, which is sent once; every failure closes the link and names its
        cause."""
        failed: Exception | None = None
        with (
            self._clock.answer_within(TIMEOUTS_PER_ANSWER * self._timeout_s, self.device),
            self._lock,
        ):
            permit()
            self.requests.note()
            begun = time.monotonic()
            try:
                reply = request(self._opened(what))
            except RigError:
                self.close()
                raise
            except Exception as error:  # noqa: BLE001 - pymodbus may raise anything over bad bytes
                self.close()  # before another thread opens a new connection
                failed, took_s = error, time.monotonic() - begun
        if failed is not None:
            if took_s >= 0.9 * self._timeout_s:
                raise self._timed_out(what, charge) from failed
            raise self._broken(what, f"{type(failed).__name__}: {failed}") from failed
        if reply.isError():
            raise CmmtRefusalError(
                self.device,
                what,
                f"the drive refused it (Modbus exception {reply.exception_code})",
                f"check the firmware and the settings of the drive at {self.where}",
            )
        return reply

    def _opened(self, what: str) -> Any:
        if self._client is None:
            client: Any = ModbusTcpClient(
                self._host, port=self._port, timeout=self._timeout_s, retries=0
            )
            if not client.connect():
                raise self._broken(what, "it cannot be opened")
            self._client = client
            if self._watchdog_ms and self._watch(client).isError():
                raise self._broken(what, "the communication time-out cannot be set")
        return self._client

    def _watch(self, client: Any) -> Any:
        """Set the communication time-out and return the drive's last reply, which may be a refusal.
        Raises InstrumentError where another time-out is read back."""
        wanted = self._watchdog_ms
        reply = client.write_registers(COMMUNICATION_TIMEOUT, [wanted, 0], device_id=self._unit_id)
        if reply.isError():
            return reply
        reply = client.read_holding_registers(
            COMMUNICATION_TIMEOUT, count=1, device_id=self._unit_id
        )
        if not reply.isError() and list(reply.registers) != [wanted]:
            kept = ", ".join(f"{register} ms" for register in reply.registers)
            raise InstrumentError(
                self.device,
                "set the communication time-out",
                f"set to {wanted} ms but reads back {kept}",
                "choose a communication_timeout_ms that the drive accepts",
            )
        return reply

    def _timed_out(self, what: str, charge: bool) -> InstrumentTimeoutError:
        """Return the error for a time-out; with `charge` bench time passes for it first."""
        if charge:
            self.charge()
        return InstrumentTimeoutError(
            self.device,
            what,
            f"no answer within {self._timeout_s:g} s",
            f"check that {self.where} is switched on and reachable",
        )

    def _broken(self, what: str, cause: str) -> InstrumentError:
        return InstrumentLinkError(
            self.device,
            what,
            f"the connection failed ({cause})",
            f"check that {self.where} is switched on and reachable",
        )


class CmmtRefusalError(InstrumentError):
    """The drive answered with an exception: it refused the request."""


class ParameterRefusedError(InstrumentError):
    """The drive answered, and would not read or write the parameter."""
