"""The AZ driver over the simulated pair, through pyserial and a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from patience import TIMEOUT_S, UNDISTURBED_S
from simulated.axis_bench import AxisBench
from simulated.ideal import serving

from drivers.oriental_az import driver as oriental_az
from drivers.oriental_az.driver import AzAxis
from drivers.oriental_az.settings import OrientalAzSettings
from drivers.simulated.faults.plan import FaultPlan, MoveFault
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.oriental_az import AzDrive, SimulatedAzSettings
from drivers.simulated.ports import Exchange
from drivers.simulated.transports.modbus_rtu import RTU_DIALECT, RtuLine
from drivers.simulated.transports.serial_server import PtyServer

from .clock import BenchClock

STEPS = 1000
OWN: dict[str, Any] = {
    "parity": "N",
    "timeout_s": TIMEOUT_S,
    "communication_timeout_ms": 500,
    "steps_per_mm": STEPS,
    "low_limit_mm": 0.0,
    "high_limit_mm": 80.0,
    "max_speed_mm_s": 50.0,
    "torque_limit_percent": 30.0,
}


class Wire(RtuLine):
    """The line with a memory: every frame in hexadecimal, and how much bench time it had."""

    said: list[str]
    at_us: list[int]

    def exchanges(self, data: bytes, by: str) -> Iterator[Exchange]:
        self.said.append(data[:-2].hex(" "))
        self.at_us.append(self._timeline.now_us)
        yield from super().exchanges(data, by)


class Service:
    """Two simulated drives on their line, and clients as they are asked for."""

    def __init__(self, faults: Iterable[dict[str, Any]], own: dict[str, Any]):
        self.bench = AxisBench()
        self.clock = BenchClock(self.bench)
        plan = FaultPlan.model_validate({"fault": list(faults)})
        self.z, self.x = (
            AzDrive(
                SimulatedAzSettings(name, number, STEPS, faults=plan.of(MoveFault, name)),
                self.bench,
            )
            for number, name in enumerate(("stage_z", "stage_x"), 1)
        )
        self.line = Wire([self.z, self.x], self.bench)
        self.line.said, self.line.at_us = [], []
        wire = {name: WireFaults(plan, name, RTU_DIALECT) for name in ("stage_z", "stage_x")}
        self.server = PtyServer(self.line, self.bench, slaved=True, faults=wire)
        patience = {} if plan.fault else {"timeout_s": UNDISTURBED_S}
        self._own = {**OWN, **patience, **own}
        self.axes: list[AzAxis] = []

    def settings(self, axis: str = "z") -> OrientalAzSettings:
        unit = {"axis": axis, "unit_id": "zx".index(axis) + 1, "port": self.server.path}
        return OrientalAzSettings(**{**self._own, **unit})

    def connect(self, axis: str = "z") -> AzAxis:
        connected = oriental_az.connect(self.settings(axis), self.clock)
        self.axes.append(connected)
        return connected

    def homed(self, axis: str = "z") -> AzAxis:
        connected = self.connect(axis)
        self.clock.each_slice(connected.keep_alive)
        connected.home()
        self.line.said.clear()
        return connected

    def speed(self, drive: AzDrive) -> float:
        return drive.velocity_mm_s(self.bench.now_us)

    def run_dry(self, seconds: float) -> None:
        """Time passes and nobody says anything."""
        self.bench.now_us += round(seconds * 1e6)


@contextmanager
def service(*faults: dict[str, Any], **own: Any) -> Iterator[Service]:
    running = Service(faults, own)
    with serving(running.server):
        try:
            yield running
        finally:
            for axis in running.axes:
                axis.close()
