"""One simulated instrument on its own transport, without a World: what a driver is tested against.

Its time is set by hand, and nothing is random. The contract of the roles (``rig.testing``) finds it
through the entry point of the simulated bench.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import FaultPlan, ReplyFault
from drivers.simulated.faults.wire import FaultyLink, WireFaults
from drivers.simulated.instruments.core import InstrumentCore
from drivers.simulated.ports import Excitation
from drivers.simulated.task_log import TaskLog
from drivers.simulated.transports.serial_server import PtyServer
from drivers.simulated.transports.serial_tcp import InstrumentTcpServer

LOOP_TIMEOUT_S = 10.0
"""Wall time that the servers' thread may take for one thing."""

ForceLaw = Callable[[Any], npt.NDArray[Any]]
"""The force in N along x, y, z, (n, 3), at bench times (n,) in seconds."""
Wave = Callable[[int, Any], Any]
"""The volts of a terminal (101 or 102) at bench times (n,) in seconds."""


class CountedFaults(WireFaults):
    """Faults of a device that remember which requests there were."""

    def __init__(self, plan: FaultPlan, device: str):
        super().__init__(plan, device)
        self.heard: list[bytes] = []
        self.answered: list[bool] = []
        """One entry for each request: True if it has an answer."""

    @property
    def requests(self) -> int:
        """Number of requests so far."""
        return len(self.heard)

    def fault_for(self, request: bytes, reply: bytes | None) -> ReplyFault | None:
        """Count a request; return the fault that disturbs its reply, or None."""
        self.heard.append(request)
        self.answered.append(reply is not None)
        return super().fault_for(request, reply)


class LineFaults(CountedFaults):
    """Faults of one line: answers and stream are counted together and keep their order."""

    def __init__(self, plan: FaultPlan, device: str):
        super().__init__(plan, device)
        self._line = FaultyLink(self)

    def link(self) -> FaultyLink:
        """Return the one line."""
        return self._line


class LoneBench:
    """The place of one instrument, whatever its role, on a bench whose time is set by hand.

    A known force acts on it, its terminals carry known volts, and nothing resists its motion.
    """

    noise_key = (3, 0, 0)

    def __init__(self, force_law: ForceLaw, wave: Wave):
        self.entries: list[tuple[str, str, object, str]] = []
        self.tasks = TaskLog()
        self.excitations: dict[int, Excitation] = {}
        """Signal of each channel of a generator, once it has been set."""
        self._force_law, self._wave = force_law, wave
        self._acquisitions = 0
        self._at_us = 0
        self._free_from_ns: int | None = None

    @property
    def now_us(self) -> int:
        """The time, set by hand or passing by itself from where it stood."""
        if self._free_from_ns is None:
            return self._at_us
        return self._at_us + (time.monotonic_ns() - self._free_from_ns) // 1000

    @now_us.setter
    def now_us(self, value: int) -> None:
        self._at_us = value

    @contextmanager
    def free(self) -> Iterator[None]:
        """Let time pass by itself until the block ends."""
        self._free_from_ns = time.monotonic_ns()
        try:
            yield
        finally:
            self._at_us, self._free_from_ns = self.now_us, None

    def force_N(self, times_s: Any) -> npt.NDArray[Any]:  # noqa: N802 - the unit keeps its capital
        """Return the true force (n, 3) in N."""
        return self._force_law(times_s)

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force on a carriage: none."""
        return 0.0

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        """Keep what a generator's channel carries from now on."""
        self.excitations[channel] = excitation

    def begin_acquisition(self) -> int:
        """Return a fresh number."""
        self._acquisitions += 1
        self.tasks.begin("daq", self.now_us)
        return self._acquisitions

    def volts(
        self,
        acquisition: int,
        terminals: tuple[int, ...],
        start_us: int,
        rate_S_s: float,
        first: int,
        count: int,
        skew_s: tuple[float, ...],
    ) -> npt.NDArray[np.float64]:
        """Return the volts of the terminals at the samples' instants, (count, len(terminals))."""
        times_s = start_us * 1e-6 + (first + np.arange(count)) / rate_S_s
        pairs = zip(terminals, skew_s, strict=True)
        return np.stack([self._wave(one, times_s + skew) for one, skew in pairs], axis=1)

    def input_high(self, device: str, line: str) -> bool:
        """Return the level of a digital input: low."""
        return False

    def log(self, device: str, what: str, value: object, by: str) -> None:
        """Write down who commanded what."""
        self.entries.append((device, what, value, by))


class LoneInstrument:
    """A core on its transport, and what a test asks of it."""

    def __init__(
        self,
        core: Callable[..., InstrumentCore],
        role: str,
        limits: tuple[float, float] | None,
        bench: LoneBench,
        faults: FaultPlan,
    ):
        self.bench = bench
        self.core = core(bench, bench, role)
        if limits is not None:
            self.core.limits = limits  # type: ignore[attr-defined]
        # On TCP what is held back is lost with its connection; a line has no connections.
        self.faults = (LineFaults if self.core.link == "serial" else CountedFaults)(faults, "it")
        kind = PtyServer if self.core.link == "serial" else InstrumentTcpServer
        self.server: Any = kind(
            self.core, self.bench, slaved=True, faults=self.faults, stream_faults=self.faults
        )
        self.loop = asyncio.new_event_loop()

    @property
    def place(self) -> str:
        """Place of the instrument, as its core's `bench_settings` takes it."""
        if self.core.link == "serial":
            path: str = self.server.path
            return path
        return f"socket://127.0.0.1:{self.server.port}"

    def connections(self) -> int:
        """Return how many connections clients hold open."""
        if self.core.link == "serial":
            return clients_of(self.place)
        return len(self.server.transports)

    def in_loop(self, act: Callable[[], None]) -> None:
        """Do something in the servers' thread, once they have dealt with all that has been sent to
        them, and then send what has fallen due."""
        done = threading.Event()

        def acted() -> None:
            act()
            self.server.pump()
            done.set()

        # In the turn after the next: in the next one the servers read what was sent before.
        self.loop.call_soon_threadsafe(self.loop.call_soon, acted)
        assert done.wait(LOOP_TIMEOUT_S), "the thread of the simulated instrument stands"


@contextmanager
def alone(
    core: Callable[..., InstrumentCore],
    role: str,
    faults: Sequence[Mapping[str, Any]],
    force_law: ForceLaw,
    wave: Wave,
    limits: tuple[float, float] | None = None,
) -> Iterator[LoneInstrument]:
    """Serve one core in a role until the block ends. `faults` are entries of a fault plan for the
    device "it", `limits` the travel of a stage."""
    plan = FaultPlan.model_validate({"fault": list(faults)})
    instrument = LoneInstrument(core, role, limits, LoneBench(force_law, wave), plan)
    thread = threading.Thread(target=instrument.loop.run_forever)
    thread.start()

    def run(coroutine: Any) -> None:
        asyncio.run_coroutine_threadsafe(coroutine, instrument.loop).result(LOOP_TIMEOUT_S)

    try:
        run(instrument.server.start())
        yield instrument
    finally:
        run(instrument.server.close())
        instrument.loop.call_soon_threadsafe(instrument.loop.stop)
        thread.join()
        instrument.loop.close()


def clients_of(pty: str) -> int:
    """Return how many descriptors of this process are open on a pseudo-terminal, without the
    server's own."""
    line, found = str(Path(pty).resolve()), 0
    for descriptor in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names only
        with suppress(OSError):
            found += str(Path(f"/proc/self/fd/{descriptor}").readlink()) == line
    return found - 1
