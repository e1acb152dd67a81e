"""Ideal physics and a log in a list: what a simulated instrument needs to stand on in a test."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.simulated.ports import Excitation
from drivers.simulated.task_log import TaskLog
from drivers.simulated.transports.scpi import ScpiInstrument


@dataclass
class IdealBench:
    """A clock set by hand, terminals that carry a formula, and everything that was reported."""

    now_us: int = 0
    wave: Callable[[int, npt.NDArray[np.float64]], npt.NDArray[np.float64]] = (
        lambda terminal, time_s: np.zeros_like(time_s)
    )
    excitations: list[tuple[int, Excitation, str]] = field(default_factory=list)
    entries: list[tuple[str, str, object, str]] = field(default_factory=list)
    acquisitions: int = 0
    tasks: TaskLog = field(default_factory=TaskLog)

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        self.excitations.append((channel, excitation, by))

    def log(self, device: str, what: str, value: object, by: str) -> None:
        self.entries.append((device, what, value, by))

    def begin_acquisition(self) -> int:
        self.acquisitions += 1
        return self.acquisitions

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
        time_s = start_us * 1e-6 + (first + np.arange(count)) / rate_S_s
        columns = [
            self.wave(terminal, time_s + skew)
            for terminal, skew in zip(terminals, skew_s, strict=True)
        ]
        return np.stack(columns, axis=1)


class Talk:
    """A person at a terminal: says a message, gets the reply as text."""

    def __init__(self, instrument: ScpiInstrument, by: str = "test"):
        self.instrument = instrument
        self.by = by

    def __call__(self, message: str) -> str | None:
        reply = self.instrument.process(message.encode(), self.by)
        return None if reply is None else reply.decode().removesuffix("\n")

    def errors(self) -> list[int]:
        """Codes of the error queue, emptied."""
        codes = []
        while code := int((self("SYST:ERR?") or "0").split(",")[0]):
            codes.append(code)
        return codes


@contextmanager
def serving(*servers: Any) -> Iterator[None]:
    """The servers' event loop in a thread, started and closed."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    def run(coroutine: Any) -> None:
        asyncio.run_coroutine_threadsafe(coroutine, loop).result(10)

    try:
        for server in servers:
            run(server.start())
        yield
    finally:
        for server in servers:
            run(server.close())
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
