"""The CMMT driver over the simulated drive, through pymodbus and a real socket."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from patience import TIMEOUT_S, UNDISTURBED_S
from simulated.axis_bench import AxisBench
from simulated.ideal import serving

from drivers.festo_cmmt import driver as festo_cmmt
from drivers.festo_cmmt.driver import FestoAxis, FestoCmmtSettings
from drivers.simulated.faults.plan import FaultPlan, MoveFault
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.festo_cmmt import CmmtDrive
from drivers.simulated.transports.modbus_tcp import ModbusTcpServer

from .clock import BenchClock

OWN: dict[str, Any] = {
    "axis": "z",
    "host": "127.0.0.1",
    "timeout_s": TIMEOUT_S,
    "communication_timeout_ms": 500,
    "low_limit_mm": 0.0,
    "high_limit_mm": 80.0,
    "max_speed_mm_s": 50.0,
    "torque_limit_percent": 30.0,
}


class Wire:
    """The drive's registers with a memory: every request in words, in order."""

    def __init__(self, drive: CmmtDrive):
        self.drive = drive
        self.said: list[str] = []
        self.refused: set[int] = set()
        self.forged: dict[int, list[int]] = {}

    def identification(self) -> Mapping[int, str]:
        self.said.append("identify")
        return self.drive.identification()

    def read(self, address: int, count: int, by: str) -> Sequence[int]:
        self.said.append(f"read {address} x{count}")
        return self.forged.get(address) or self.drive.read(address, count, by)

    def write(self, address: int, values: Sequence[int], by: str) -> None:
        self.said.append(f"write {address}: {_shown(address, values)}")
        if address == 500 and values[0] in self.refused:
            self.drive.write(500, [1], by)  # a parameter that this firmware does not know
            return
        self.drive.write(address, values, by)

    def heard(self) -> list[str]:
        """What was said since last asked; polls of the input image only once in a row."""
        said, self.said = self.said, []
        return [line for line, _ in itertools.groupby(said)]


def _shown(address: int, values: Sequence[int]) -> str:
    if address != 0:
        return " ".join(str(value) for value in values)
    target = values[5] | values[6] << 16
    speed = values[7] | values[8] << 16
    return f"{values[0]:04x} {values[1]:04x} {values[2]:04x} {values[3]:04x} {target} at {speed}"


class Service:
    """A simulated drive on its wire, and clients as they are asked for."""

    def __init__(self, fault: dict[str, Any] | None, drive: dict[str, Any], own: dict[str, Any]):
        self.bench = AxisBench()
        self.clock = BenchClock(self.bench)
        self.drive = CmmtDrive(SimulatedCmmtSettings(**drive), self.bench)
        self.wire = Wire(self.drive)
        faults = [{"device": "it", **fault}] if fault else []
        plan = FaultPlan.model_validate({"fault": faults})
        self.server = ModbusTcpServer(self.wire, faults=WireFaults(plan, "it"))
        patience = {} if fault or drive.get("faults") else {"timeout_s": UNDISTURBED_S}
        self._own = {**OWN, **patience, **own}
        self.axes: list[FestoAxis] = []

    @property
    def settings(self) -> FestoCmmtSettings:
        return FestoCmmtSettings(**{**self._own, "port": self.server.port})

    def connect(self) -> FestoAxis:
        axis = festo_cmmt.connect(self.settings, self.clock)
        self.axes.append(axis)
        return axis

    def homed(self) -> FestoAxis:
        axis = self.connect()
        self.clock.each_slice(axis.keep_alive)
        axis.home()
        self.wire.heard()
        return axis

    @property
    def truth_mm(self) -> float:
        return self.drive.position_mm(self.bench.now_us)

    @property
    def speed(self) -> float:
        return self.drive.velocity_mm_s(self.bench.now_us)


@contextmanager
def service(
    fault: dict[str, Any] | None = None, drive: dict[str, Any] | None = None, **own: Any
) -> Iterator[Service]:
    running = Service(fault, drive or {}, own)
    with serving(running.server):
        try:
            yield running
        finally:
            for axis in running.axes:
                axis.close()


def move_faults(fault: dict[str, Any]) -> tuple[MoveFault, ...]:
    """One fault of the simulated drive's mechanics."""
    plan = FaultPlan.model_validate({"fault": [{"device": "stage_z", **fault}]})
    return plan.of(MoveFault)


def break_wire(it: Service, **fault: Any) -> None:
    """A fault on the wire from now on."""
    plan = FaultPlan.model_validate({"fault": [{"device": "it", **fault}]})
    it.server.faults._faults = list(plan.fault)
    it.server.faults._matched = [0]
