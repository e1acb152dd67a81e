r"""A short way to write the driver of a force sensor that sends one line of text a frame.

A driver states how the sensor talks and what a line means; all else of a `ForceSensor` is here:

    class Settings(LineForceSensorSettings):
        driver: Literal["acme-f10"] = "acme-f10"
        baudrate: Literal[115_200] = 115_200

    class F10(LineForceSensor):
        vendor, model = "ACME", "F10"
        axes, unit, full_scale, rates_S_s = "z", "N", 50.0, (100.0,)
        terminator, identify = b"\r\n", ("*I", r"ACME (?P<model>\S+) v(?P<firmware>\S+)")
        start_command, stop_command, acknowledges = "*C", "*S", False

        def parse(self, line: bytes) -> float:
            return float(FRAME.fullmatch(line)[0])

    ROLES, connect, make_safe = driver_members(F10)

The sensor needs commands that begin and end its stream, and a query that is answered while it does
not stream; where it acknowledges no command, also while it streams, because the query then follows
the command that begins the stream. Lines have no number here: a lost one is noticed by bench time
(`frames_behind`).
"""

from __future__ import annotations

import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from drivers.shared.force_stream import ForceStream
from drivers.shared.line_link import ECHO, ECHO_HINT, is_echo
from drivers.shared.line_stream import STREAM, LineStream
from drivers.shared.ports import READ_WAIT_S, SOCKET
from rig.core.clock import Clock
from rig.core.errors import ConfigurationError, InstrumentError, RigError
from rig.core.settings import Address, Settings, Wiring
from rig.core.units import counted
from rig.instruments.roles import ForceFrames, Identity, Limits

DEVICE = "force_sensor"
NEWTONS: Mapping[str, float] = {
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
    "gf": 9.80665e-3,
    "kgf": 9.80665,
    "lbf": 4.4482216152605,
}
"""Force in N by unit. Scales that show g or kg of a force mean gf or kgf."""
REQUIRED = (
    *("vendor", "model", "axes", "unit", "full_scale", "rates_S_s"),
    *("identify", "start_command", "stop_command"),
)
"""What every class has to state; the other members have defaults."""


class LineForceSensorSettings(Settings):
    """Settings of such a sensor in a bench file. A driver adds `driver`, changes defaults, and may
    add others."""

    port: Address[str] = Field(min_length=1)
    """Serial port, for example /dev/ttyUSB0 or COM5, or socket://HOST:PORT."""
    baudrate: int = Field(default=9600, ge=300, le=4_000_000)
    """Bits per second of a serial port; without meaning over TCP."""
    serial_format: Wiring[Literal["8N1", "8N2", "8E1", "8O1", "7N2", "7E1", "7O1"]] = "8N1"
    """Data bits, parity (none, even, odd) and stop bits of a serial port."""
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=10)
    """Longest wait for an answer."""
    max_force_N: float = Field(gt=0)
    """Largest force along any axis that a run may ask for."""


class LineForceSensor(ForceStream, ABC):
    """A `ForceSensor` whose class says how it talks. One thread reads; other threads may call the
    other methods meanwhile."""

    vendor: ClassVar[str]
    model: ClassVar[str]
    """The model that is expected, as the answer to `identify` has it."""
    axes: ClassVar[str]
    """The axes that a line has values of, in the order of x, y, z."""
    unit: ClassVar[str]
    """The unit of what `parse` returns, which run files state."""
    newtons_per_unit: ClassVar[float | None] = None
    """Force in N by `unit`, for a unit that `NEWTONS` does not have."""
    full_scale: ClassVar[float]
    """Reading, in `unit`, from which on a frame is saturated: the run ends there."""
    rates_S_s: ClassVar[tuple[float, ...]]
    """The frame rates that the sensor has, in frames/s."""
    rate_command: ClassVar[str] = ""
    """The command that sets the rate before each start, such as ``"RATE {rate:g}"``; empty for a
    sensor whose one rate is fixed."""
    terminator: ClassVar[bytes] = b"\r\n"
    """End of every line, of the stream, commands and answers."""
    identify: ClassVar[tuple[str, str]]
    """A query, and its answer as a regular expression that no frame has. Groups named ``vendor``,
    ``model``, ``serial_number`` and ``firmware`` become the identity."""
    start_command: ClassVar[str]
    stop_command: ClassVar[str]
    acknowledges: ClassVar[str | Literal[False]] = False
    """Regular expression of the answer to the commands above; False if they have none. Then the
    query of `identify` follows each of them, and its answer proves that they have arrived."""

    def __init_subclass__(cls, **given: Any):
        """Refuse a class that no sensor can have, with the reason. One without a `parse` of its own
        is the base of others and may be incomplete."""
        super().__init_subclass__(**given)
        if cls.parse is LineForceSensor.parse:
            return
        if missing := [name for name in REQUIRED if not hasattr(cls, name)]:
            raise TypeError(f"the class {cls.__name__} lacks {', '.join(missing)}")
        if cls.newtons_per_unit is None and cls.unit not in NEWTONS:
            known = ", ".join(NEWTONS)
            raise TypeError(
                f"{cls.__name__} has the unit {cls.unit!r}; known are {known}, and for any other "
                "unit the class must state newtons_per_unit"
            )
        if not cls.axes or cls.axes != "".join(axis for axis in "xyz" if axis in cls.axes):
            raise TypeError(f"{cls.__name__} has axes = {cls.axes!r}, which must be like 'z'")
        if not cls.rates_S_s or (len(cls.rates_S_s) > 1 and not cls.rate_command):
            raise TypeError(f"{cls.__name__} needs one rate, or several and a rate_command")
        if not (min(cls.rates_S_s) > 0 and cls.full_scale > 0 and cls.terminator):
            raise TypeError(
                f"{cls.__name__} needs rates_S_s and a full_scale above 0 and a terminator"
            )

    def __init__(self, settings: Any, clock: Clock):
        self._newtons = self.newtons_per_unit or NEWTONS[self.unit]
        super().__init__(clock, (self._newtons * np.eye(3)).tolist())
        self.settings = settings
        """The settings of the bench file's table."""
        query, form = self.identify
        self._then_identify = self.terminator.decode("ascii") + query
        self._link = LineStream(
            DEVICE,
            settings.port,
            settings.timeout_s,
            clock,
            terminator=self.terminator,
            baudrate=settings.baudrate,
            serial_format=settings.serial_format,
            resync=(self.stop_command + self._then_identify, form),
        )
        self._columns = ["xyz".index(axis) for axis in self.axes]
        self._streaming = False
        self._broken: InstrumentError | None = None
        self.identity = Identity(self.vendor, self.model, "", "")
        """The identity of the sensor as read when it was connected."""

    @abstractmethod
    def parse(self, line: bytes) -> float | Sequence[float]:
        """Return the reading of a line without its end, in `unit`: one number, or one for each of
        `axes`; ``math.inf`` or ``-math.inf`` for a line that states an overload.

        Whatever it raises means that the line is not a frame. A force that presses on the sensor
        has to be positive along z.
        """

    @classmethod
    def connect(cls, settings: Any, clock: Clock) -> Self:
        """Connect to the sensor, identify it and leave it silent: a driver's `connect`."""
        sensor = cls(settings, clock)
        try:
            sensor.prepare()
        except BaseException:
            sensor.close()
            raise
        return sensor

    def prepare(self) -> None:
        """End any stream and identify the sensor. Raises InstrumentError for another instrument,
        ConfigurationError for a force beyond what this one measures."""
        largest_N = self.full_scale * self._newtons
        if self.settings.max_force_N > largest_N * (1 + 1e-9):
            raise ConfigurationError(
                f"{DEVICE}: max_force_N = {self.settings.max_force_N:g} is beyond the "
                f"{largest_N:.5g} N that the {self.vendor} {self.model} measures",
                "lower max_force_N of [force_sensor] in the bench file",
            )
        self.stop()
        found = self.ask(*self.identify).groupdict()
        # A group that is optional and absent says nothing, as one that the form does not have.
        said = {name: text for name, text in found.items() if text is not None}
        self.identity = replace(self.identity, **said)
        if (self.identity.vendor, self.identity.model) != (self.vendor, self.model):
            raise self._link.error(
                self.identify[0],
                f"the sensor at {self.settings.port} is the {self.identity.vendor} "
                f"{self.identity.model}",
                f"the {self.vendor} {self.model} is expected; correct [force_sensor] in the bench "
                "file",
            )

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the link, less those of lines that `read` has not taken yet."""
        return self._link.bytes_consumed

    def limits(self) -> Mapping[str, Limits]:
        """Return the frame rates of the sensor, and the force that the bench file allows on an
        axis."""
        limited_by, limit = f"{DEVICE} {self.model}", self.settings.max_force_N
        return {
            "rate": Limits(min(self.rates_S_s), max(self.rates_S_s), "1/s", limited_by),
            "force": Limits(-limit, limit, "N", limited_by),
        }

    def start(self, rate_S_s: float) -> float:
        """Begin to stream at the nearest rate that the sensor has; return it in frames/s."""
        rate = min(self.rates_S_s, key=lambda own: abs(own - rate_S_s))
        self.stop()
        if self.rate_command:
            self.command(self.rate_command.format(rate=rate))
        self._broken, self._streaming = None, True
        self._begins()
        self.command(self.start_command)
        self._begun(rate)
        return rate

    def read(self) -> ForceFrames | None:
        """Return the frames that have arrived, or None; waits a few milliseconds at most.

        Raises InstrumentError for a line that is not a frame, now and until the stream is started
        again.
        """
        if self._broken is not None:
            raise self._broken
        if not (self._streaming or self._link.is_open):  # the next command opens the port again
            time.sleep(READ_WAIT_S)
            return None
        try:
            lines = self._link.collect()
            if not lines or not self._streaming:
                return None
            readings = np.array([self._reading(line) for line in lines])
        except InstrumentError as error:
            self._broken = error if self._streaming else None
            raise
        saturated = (np.abs(readings) >= self.full_scale).any(axis=1)
        overload = np.copysign(self.full_scale, readings)
        raw = np.zeros((len(lines), 3), np.float32)
        raw[:, self._columns] = np.where(np.isinf(readings), overload, readings)
        return self._frames(raw, saturated, self.unit)

    def stop(self) -> None:
        """End the stream; frames that were not read are dropped. Raises InstrumentError where the
        sensor continues to send."""
        self._ended()
        self._streaming, self._broken = False, None
        self.command(self.stop_command)
        self._link.fall_silent(self.stop_command)

    def make_safe(self) -> None:
        """Do nothing: a sensor drives nothing, and its stream guards the rest of the bench."""

    def close(self) -> None:
        """Close the port; a stream continues unread until the next connect ends it."""
        self._ended()
        self._link.close()

    def command(self, command: str) -> None:
        """Send a command and make sure that it has arrived: by its acknowledgement, or by the
        answer to `identify` after it. Raises InstrumentError where that does not come."""
        if self.acknowledges is False:
            self.ask(command + self._then_identify, self.identify[1])
        else:
            self.ask(command, self.acknowledges)

    def ask(self, command: str, answer: str) -> re.Match[str]:
        """Send a query and return its answer, the first line that matches the regular expression
        `answer`. Raises InstrumentTimeoutError where none comes in time."""
        return self._link.ask(command, answer)

    def _reading(self, line: bytes) -> list[float]:
        """Return the values of one line. Raises InstrumentError where it is not a frame."""
        try:
            parsed = self.parse(line)
            values = [float(value) for value in np.ravel(np.array(parsed, dtype=np.float64))]
        except RigError:
            raise
        except Exception as error:
            why = f"parse() raised {type(error).__name__}: {error}"
            raise self._no_frame(line, why) from error
        if len(values) != len(self.axes):
            why = f"parse() returned {counted(len(values), 'value')}, not {len(self.axes)}"
            raise self._no_frame(line, why)
        if np.isnan(values).any():
            raise self._no_frame(line, "parse() returned a value that is not a number")
        return values

    def _no_frame(self, line: bytes, why: str) -> InstrumentError:
        rates = [self.rate_command.format(rate=rate) for rate in self.rates_S_s]
        sent = [self.start_command, self.stop_command, self.identify[0], *rates]
        if is_echo("\n".join(filter(None, sent)), line.decode("latin-1")):
            cause = f"the line {line[:80]!r} is not a frame but {ECHO}"
            return self._link.error(STREAM, cause, ECHO_HINT)
        settings = self.settings
        checks = f"check the cable, and that nothing else talks to {settings.port}"
        if not settings.port.startswith(SOCKET):
            checks += (
                f", and baudrate ({settings.baudrate}) and serial_format "
                f"({settings.serial_format}) of [force_sensor] in the bench file"
            )
        return self._link.error(
            STREAM,
            f"the line {line[:80]!r} is not a frame of the {self.model} ({why})",
            f"{checks}; if the line is sound, correct parse() in {type(self).__module__}",
        )


def driver_members(
    sensor: type[LineForceSensor],
) -> tuple[tuple[str, ...], Callable[[Any, Clock], LineForceSensor], Callable[[Any], None]]:
    """Return what a driver's module has as ``ROLES``, ``connect`` and ``make_safe``."""
    return (DEVICE,), sensor.connect, _make_safe


def _make_safe(settings: Any) -> None:
    """Do nothing: a sensor drives nothing, and a program that still reads it may need it."""
