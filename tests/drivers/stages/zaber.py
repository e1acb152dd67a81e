"""The X-RST driver over the simulated stage, through pyserial and a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from patience import TIMEOUT_S, UNDISTURBED_S
from simulated.ideal import IdealBench, serving

from drivers.simulated.faults.plan import FaultPlan, RotaryFault
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.zaber_rst import (
    ZABER_DIALECT,
    ChainLine,
    SimulatedRotarySettings,
    SimulatedRotaryStage,
)
from drivers.simulated.ports import Exchange
from drivers.simulated.transports.serial_server import PtyServer
from drivers.zaber_rst import driver as zaber_rst
from drivers.zaber_rst.driver import ZaberAxis
from drivers.zaber_rst.settings import ZaberRstSettings

from .clock import BenchClock

OWN: dict[str, Any] = {
    "timeout_s": TIMEOUT_S,
    "microstep_deg": 0.00015625,
    "low_limit_deg": -5.0,
    "high_limit_deg": 90.0,
    "max_speed_deg_s": 50.0,
    "max_acceleration_deg_s2": 1000.0,
}


class Wire(ChainLine):
    """The stage's line with a memory, whose replies a test may forge by what was said."""

    def __init__(self, stage: SimulatedRotaryStage):
        super().__init__(stage)
        self.said: list[str] = []
        self.forged: dict[str, Callable[[bytes], bytes]] = {}

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        for exchange in super().exchanges(data, by):
            words = exchange.request.decode()
            self.said.append(words)
            forge = self.forged.get(words, lambda reported: reported)
            yield Exchange(exchange.request, forge(exchange.reply or b""))

    def heard(self) -> list[str]:
        """What was said since last asked."""
        said, self.said = self.said, []
        return said


def saying(data: str) -> Callable[[bytes], bytes]:
    """Another datum in an otherwise sound reply."""

    def forge(reported: bytes) -> bytes:
        head = reported.split(b":")[0].rpartition(b" ")[0]
        return signed(head + b" " + data.encode())

    return forge


def signed(text: bytes) -> bytes:
    return text + b":%02X\r\n" % (-sum(text[1:]) & 0xFF)


class Service:
    """A simulated stage on a pseudo-terminal, and drivers as they are asked for."""

    def __init__(self, fault: dict[str, Any] | None, stage: dict[str, Any], own: dict[str, Any]):
        self.bench = IdealBench()
        self.clock = BenchClock(self.bench)
        self.stage = SimulatedRotaryStage(SimulatedRotarySettings(**stage), self.bench)
        self.wire = Wire(self.stage)
        plan = FaultPlan.model_validate({"fault": [{"device": "it", **fault}] if fault else []})
        faults = WireFaults(plan, "it", ZABER_DIALECT)
        self.server = PtyServer(self.wire, self.bench, slaved=True, faults=faults)
        patience = {} if fault or stage.get("faults") else {"timeout_s": UNDISTURBED_S}
        self._own = {**OWN, **patience, **own}
        self.axes: list[ZaberAxis] = []

    @property
    def settings(self) -> ZaberRstSettings:
        return ZaberRstSettings(**{**self._own, "port": self.server.path})

    def connect(self) -> ZaberAxis:
        axis = zaber_rst.connect(self.settings, self.clock)
        self.axes.append(axis)
        return axis

    def homed(self) -> ZaberAxis:
        axis = self.connect()
        self.clock.each_slice(axis.keep_alive)
        axis.home()
        self.wire.heard()
        return axis

    @property
    def angle(self) -> float:
        return self.stage.angle_deg(self.bench.now_us)

    @property
    def speed(self) -> float:
        return self.stage.speed_deg_s(self.bench.now_us)


@contextmanager
def service(
    fault: dict[str, Any] | None = None, stage: dict[str, Any] | None = None, **own: Any
) -> Iterator[Service]:
    running = Service(fault, stage or {}, own)
    with serving(running.server):
        try:
            yield running
        finally:
            for axis in running.axes:
                axis.close()


def suffering(**fault: Any) -> dict[str, tuple[RotaryFault, ...]]:
    """Settings of a simulated stage with one fault."""
    plan = FaultPlan.model_validate({"fault": [{"device": "rotary", **fault}]})
    return {"faults": plan.of(RotaryFault)}
