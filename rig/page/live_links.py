"""The instruments of a bench without a run, each read again and again in a thread of its own.

Nothing moves, nothing is switched and no stage is set: force sensor and DAQ are connected as for a
run, stages are opened by their driver's reader (`rig.instruments.roles.OffersReader`). The
generator is left alone. A link that fails is closed, says so, and is opened again; the others do
not wait for it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import TypeVar

import numpy as np

from rig.bench.apply_calibrations import apply_calibrations
from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.driver_settings import channels_of, communication_timeout
from rig.bench.plan import BenchPlan, InstrumentPlan
from rig.core.clock import WallClock
from rig.core.errors import RigError
from rig.core.threads import start_thread
from rig.instruments.calibration import CalibrationFiles
from rig.instruments.roles import Acquisition, InputChannel, OffersReader, StageStatus
from rig.page.terminal import BAR_BINS, DRAWN_EVERY_S

STAGE_UNITS = {"stage_z": "mm", "stage_x": "mm", "rotary": "deg"}
"""Unit of the position of each stage, by role."""
FORCE_S_S = 100.0
DAQ_S_S = 1000.0
AXES = ("x", "y", "z")
RETRY_S = 2.0
"""Time in s after which a link that has failed is opened again."""
MARGIN_S = 0.25
"""Time in s by which a silence is longer than the longest communication time-out."""
ENDING_S = 5.0
"""Longest time in s that links are waited for at the end."""
T = TypeVar("T")


@dataclass
class Value:
    """The latest value of a channel, with those before it."""

    units: str
    latest: float
    history: deque[float | None] = field(default_factory=lambda: deque(maxlen=BAR_BINS))

    def add(self, value: float) -> None:
        """Add a value."""
        self.latest = value
        self.history.append(value)


class Silence:
    """Leaves drives alone for long enough that a communication time-out of theirs can expire.

    A request may restart the time-out of the drive, or of all drives on its line, whoever sends it.
    An axis that another program has set going, and whose program has died, would then not stop by
    itself while it is watched. So once an axis is seen in motion no stage is asked anything for
    longer than the longest time-out: it stops at most one time-out later than unwatched.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic):
        self._now_s = now_s
        self._lock = threading.Lock()
        self._timeouts_s: dict[str, float] = {}
        self._until_s = 0.0

    def note_timeout(self, role: str, timeout_s: float) -> None:
        """Take note of the communication time-out of a stage."""
        with self._lock:
            self._timeouts_s[role] = timeout_s

    def begin(self) -> None:
        """Begin a silence, since an axis moves; none is needed where no drive has a time-out."""
        with self._lock:
            longest_s = max(self._timeouts_s.values(), default=0.0)
            if longest_s > 0:
                self._until_s = max(self._until_s, self._now_s() + longest_s + MARGIN_S)

    @property
    def retry_s(self) -> float:
        """Time in s until a link that has failed may be tried again: what is asked may reach the
        drive although its answers do not come."""
        with self._lock:
            return max(RETRY_S, MARGIN_S + max(self._timeouts_s.values(), default=0.0))

    def left_s(self) -> float:
        """Return for how many seconds nothing may be asked."""
        with self._lock:
            return max(0.0, self._until_s - self._now_s())


class LiveLink(ABC):
    """One instrument that is read until `end`; `failure` says why it is not read just now."""

    def __init__(self, part: InstrumentPlan):
        self.part = part
        self.lock = threading.Lock()
        """Held while values are changed or drawn."""
        self.failure = ""
        self.simulated = False
        """True once the instrument has said that it is simulated."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"read {part.role}", daemon=True)

    @property
    def role(self) -> str:
        """Role of the instrument."""
        return self.part.role

    def start(self) -> None:
        """Begin to read. Raises RigError if the computer has no thread left."""
        start_thread(self._thread)

    def end(self) -> None:
        """Ask the thread to close the link and end."""
        self._ended.set()

    def join(self, timeout_s: float) -> None:
        """Wait until the link is closed, for `timeout_s` at most."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                self._read_until_ended()
            except RigError as error:
                self._fail(error.one_line())
            except Exception as error:  # noqa: BLE001 - a driver's defect must not end the others
                self._fail(f"{type(error).__name__}: {error}")

    def _fail(self, why: str) -> None:
        with self.lock:
            self.failure = why
            self._forget()
        self._ended.wait(self._retry_s())

    def _retry_s(self) -> float:
        return RETRY_S

    @abstractmethod
    def _read_until_ended(self) -> None:
        """Open the link, read until `_ended` is set and close it. Raises RigError if it fails."""

    @abstractmethod
    def _forget(self) -> None:
        """Drop the values, which are no longer those of the instrument; `lock` is held."""


class StageLink(LiveLink):
    """A stage, read by its driver's reader."""

    def __init__(self, part: InstrumentPlan, silence: Silence):
        super().__init__(part)
        self.status: StageStatus | None = None
        self._silence = silence
        stated = communication_timeout(part.settings)
        self._bench_file_s = 0.0 if stated is None else stated.seconds
        silence.note_timeout(part.role, self._bench_file_s)

    @property
    def units(self) -> str:
        """Unit of its position."""
        return STAGE_UNITS[self.role]

    def _read_until_ended(self) -> None:
        module = self.part.driver
        assert isinstance(module, OffersReader)
        if self._ended.wait(self._silence.left_s()):
            return
        with contextlib.closing(module.open_reader(self.part.settings, WallClock())) as reader:
            self._silence.note_timeout(self.role, reader.timeout_s)
            self.simulated = reader.identity.simulated
            while not self._ended.is_set():
                if self._silence.left_s() == 0:
                    status = reader.read()
                    if status.moving:
                        self._silence.begin()
                    with self.lock:
                        self.failure, self.status = "", status
                self._ended.wait(DRAWN_EVERY_S)

    def _retry_s(self) -> float:
        return self._silence.retry_s

    def _forget(self) -> None:
        self.status = None


class SensorLink(LiveLink):
    """A force sensor or a DAQ, of which each drawing has the mean since the one before."""

    def __init__(self, part: InstrumentPlan, plan: BenchPlan):
        super().__init__(part)
        self.values: dict[str, Value] = {}
        calibrations = plan.settings.calibrations
        own = CalibrationFiles()
        if part.role == "force_sensor":
            own = own.model_copy(update={"force_sensor": calibrations.force_sensor})
        settings = plan.settings.model_copy(update={"calibrations": own})
        self._plan = replace(plan, settings=settings, instruments=(part,))

    def _read_until_ended(self) -> None:
        with contextlib.closing(connect(self._plan, WallClock())) as bench:
            apply_calibrations(bench, datetime.now().astimezone(), allow_expired=True)
            self.simulated = bench.simulated
            with self._streaming(bench):
                while not self._ended.wait(DRAWN_EVERY_S):
                    means = self._means(bench)
                    with self.lock:
                        self.failure = ""
                        for name, units, mean in means:
                            self.values.setdefault(name, Value(units, mean)).add(mean)

    def _forget(self) -> None:
        self.values.clear()

    @contextlib.contextmanager
    def _streaming(self, bench: Bench) -> Iterator[None]:
        """Have the sensor send within the block."""
        sensor = bench.force_sensor if self.role == "force_sensor" else bench.daq
        with contextlib.ExitStack() as at_the_end:
            at_the_end.callback(sensor.stop)
            if self.role == "force_sensor":
                bench.force_sensor.start(FORCE_S_S)
            else:
                bench.daq.start(_acquisition(bench))
            yield

    def _means(self, bench: Bench) -> list[tuple[str, str, float]]:
        """Take in everything that has come; name, unit and mean of each channel."""
        if self.role == "force_sensor":
            frames = [batch.force_N for batch in come(bench.force_sensor.read)]
            if not frames:
                return []
            mean = np.concatenate(frames).mean(axis=0)
            return [
                (f"force {axis}", "N", float(force_N))
                for axis, force_N in zip(AXES, mean, strict=True)
            ]
        blocks = list(come(bench.daq.read))
        return [
            (channel, "V", float(np.concatenate([one.volts(channel) for one in blocks]).mean()))
            for channel in (blocks[-1].scaling.channels if blocks else ())
        ]


def links_of(plan: BenchPlan) -> tuple[list[LiveLink], list[str]]:
    """Return a link for each instrument that can be read without being changed, and the roles of
    the stages whose driver offers no reader."""
    silence = Silence()
    links: list[LiveLink] = []
    unreadable = []
    for part in plan.instruments:
        if part.role in ("force_sensor", "daq"):
            links.append(SensorLink(part, plan))
        elif part.role in STAGE_UNITS and isinstance(part.driver, OffersReader):
            links.append(StageLink(part, silence))
        elif part.role in STAGE_UNITS:
            unreadable.append(part.role)
    return links, unreadable


@contextlib.contextmanager
def reading(links: list[LiveLink]) -> Iterator[None]:
    """Read all links within the block; at its end each is closed, whatever another one does."""
    try:
        for link in links:
            link.start()
        yield
    finally:
        for link in links:
            link.end()
        until_s = time.monotonic() + ENDING_S
        for link in links:
            with contextlib.suppress(RuntimeError):  # it was never started
                link.join(max(0.0, until_s - time.monotonic()))


def _acquisition(bench: Bench) -> Acquisition:
    part = next(part for part in bench.plan.instruments if part.role == "daq")
    names = tuple(channels_of(part.settings))
    widest_V = bench.daq.ranges_V()[-1]
    channels = tuple(InputChannel(name, widest_V) for name in names)
    return Acquisition(channels, DAQ_S_S, round(DAQ_S_S * DRAWN_EVERY_S / 2))


def come(read: Callable[[], T | None]) -> Iterator[T]:
    """Yield what `read` returns until it returns None; no longer than one drawing takes, since on a
    busy computer something new may come before every reading."""
    until_s = time.monotonic() + DRAWN_EVERY_S
    while (one := read()) is not None:
        yield one
        if time.monotonic() > until_s:
            return
