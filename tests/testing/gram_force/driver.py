"""GF-ONE: one axis, 400 frames/s in gram-force, ASCII over TCP. Frame: "#0007,+00123.45"."""

import contextlib
import re
import socket
import threading
import time
from typing import Literal

import numpy as np
from pydantic import Field

from rig.core.errors import InstrumentError, InstrumentTimeoutError
from rig.core.settings import Address, Wiring
from rig.core.settings import Settings as BaseSettings
from rig.instruments.roles import ForceFrames, Identity, Limits

ROLES = ("force_sensor",)
DEVICE = "force_sensor"
RATE_S_s = 400.0
GRAM_FORCE_N = 0.00980665
RANGE_gf = 5000.0
FRAME, FRAME_BYTES = re.compile(rb"#(\d{4}),([+-]\d{5}\.\d{2})"), 17


class Settings(BaseSettings):
    """Where the sensor is, and which force it may see."""

    driver: Literal["gf-one"] = "gf-one"
    host: Address[str] = Field(min_length=1)
    """Host name or IP address."""
    tcp_port: Address[int] = Field(default=4001, ge=1, le=65535)
    """TCP port."""
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=10)
    """Longest wait for an answer."""
    max_force_N: float = Field(default=40.0, gt=0, le=RANGE_gf * GRAM_FORCE_N)
    """Largest force that a run may ask for."""


class GfOne:
    axes = "z"

    def __init__(self, settings, clock):
        self._settings, self._clock = settings, clock
        self._place = f"{settings.host}:{settings.tcp_port}"
        self._lock = threading.RLock()
        self._socket, self._rest, self._taken = None, b"", 0
        self._answers, self._frames, self._bad = [], [], None
        self._matrix, self._zero = GRAM_FORCE_N * np.eye(3), np.zeros(3)
        self._next, self._started_s = 0, None
        self.identity = Identity("GF", "ONE", "", "")

    def prepare(self):
        self._command(b"STOP", rb"OK")
        found = self._command(b"ID?", rb"(\w+)-(\S+),(\w+),(\S+)")
        self._forget()
        vendor, model, number, firmware = (part.decode() for part in found.groups())
        if (vendor, model) != ("GF", "ONE"):
            raise self._error("ID?", f"it is a {vendor} {model}; a GF ONE is expected")
        self.identity = Identity(vendor, model, number, firmware)

    @property
    def bytes_consumed(self):
        return self._taken - len(self._rest) - FRAME_BYTES * len(self._frames)

    @property
    def frames_behind(self):
        if self._started_s is None:
            return 0.0
        return (self._clock.now() - self._started_s) * RATE_S_s - self._next

    def limits(self):
        limited_by, limit = f"{DEVICE} GF-ONE", self._settings.max_force_N
        return {
            "rate": Limits(RATE_S_s, RATE_S_s, "1/s", limited_by),
            "force": Limits(-limit, limit, "N", limited_by),
        }

    def start(self, rate_S_s):
        self.stop()
        self._next = 0
        self._command(b"START", rb"OK")
        self._started_s = self._clock.now()
        return RATE_S_s

    def stop(self):
        self._started_s = None
        self._command(b"STOP", rb"OK")
        self._forget()

    def read(self):
        with self._failing("stream"), self._lock:
            if self._socket is None:
                raise self._error("stream", "the connection is closed")
            if not self._frames:
                self._take(0.01)
            if self._bad is not None and self._started_s is not None:
                raise self._error("stream", f"{self._bad!r} is not a frame")
            frames, self._frames = self._frames, []
        if not frames:
            return None
        for offset, (count, _) in enumerate(frames):
            if count != (due := (self._next + offset) % 10_000):
                raise self._error("stream", f"frame {count} came where {due} is due")
        raw = np.zeros((len(frames), 3), np.float32)
        raw[:, 2] = [value for _, value in frames]
        first, self._next = self._next, self._next + len(frames)
        force = (raw.astype(np.float64) - self._zero) @ self._matrix.T
        return ForceFrames(first, raw, force, np.abs(raw[:, 2]) >= RANGE_gf, raw_unit="gf")

    def calibrate(self, matrix_N_mV_V):
        self._matrix = np.array(matrix_N_mV_V, np.float64)

    def tare(self, zero_mV_V):
        self._zero = np.array(zero_mV_V, np.float64)
        return tuple(float(force) for force in self._matrix @ self._zero)

    def make_safe(self):
        """A sensor drives nothing."""

    def close(self):
        with self._lock:
            sock, self._socket = self._socket, None
        if sock is not None:
            with contextlib.suppress(OSError):
                sock.close()

    def _command(self, line, answer):
        timeout_s = self._settings.timeout_s
        with self._clock.answer_within(2 * timeout_s), self._failing(line.decode()), self._lock:
            if self._socket is None:
                self._socket = socket.create_connection(
                    (self._settings.host, self._settings.tcp_port), timeout_s
                )
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._rest = b""
            self._answers.clear()
            self._socket.settimeout(timeout_s)
            self._socket.sendall(line + b"\r\n")
            deadline = time.monotonic() + timeout_s
            while not self._answers:
                if time.monotonic() > deadline:
                    self.close()
                    raise InstrumentTimeoutError(
                        DEVICE,
                        line.decode(),
                        f"no answer within {timeout_s:g} s",
                        f"check that the GF-ONE at {self._place} is switched on",
                    )
                self._take(0.01)
            got = self._answers.pop(0)
            if not (match := re.fullmatch(answer, got)):
                raise self._error(line.decode(), f"the answer is {got!r}")
            return match

    def _take(self, wait_s):
        self._socket.settimeout(wait_s)
        try:
            data = self._socket.recv(65536)
        except TimeoutError:
            return
        if not data:
            raise ConnectionError("the sensor closed it")
        self._taken += len(data)
        *lines, self._rest = (self._rest + data).split(b"\r\n")
        for line in lines:
            if frame := FRAME.fullmatch(line):
                self._frames.append((int(frame[1]), float(frame[2])))
            elif line.startswith(b"#"):
                self._bad = line
            else:
                self._answers.append(line)

    def _forget(self):
        with self._lock:
            self._frames, self._bad = [], None

    @contextlib.contextmanager
    def _failing(self, command):
        try:
            yield
        except InstrumentTimeoutError:
            with contextlib.suppress(InstrumentError):
                self._clock.charge(self._settings.timeout_s)
            raise
        except OSError as error:
            self.close()
            raise self._error(command, f"the connection failed ({error})") from error

    def _error(self, command, cause):
        return InstrumentError(DEVICE, command, cause, f"check the cable and {self._place}")


def connect(settings, clock):
    sensor = GfOne(settings, clock)
    try:
        sensor.prepare()
    except BaseException:
        sensor.close()
        raise
    return sensor


def make_safe(settings):
    """A sensor drives nothing."""
