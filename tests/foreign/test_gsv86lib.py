"""ME-Messsysteme's own gsv86lib, in its own environment, drives the simulator on a pty."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest
from clients import python_with, seen_by, serving

from drivers.simulated.instruments.me_gsv8 import Gsv8, Sensor
from drivers.simulated.transports.serial_server import PtyServer

SCRIPT = """
import json, sys, time
from gsv86lib import gsv86

amplifier = gsv86(sys.argv[1], 230400)
seen = {"stopped": amplifier.transmissionIsRunning is False}
amplifier.writeDataRate(1000.0)
seen["rate"] = amplifier.readDataRate()
value = amplifier.ReadValue()
seen["one"] = [value.getChannel1(), value.getChannel2(), value.getChannel3()]
amplifier.ReadMultiple()
amplifier.StartTransmission()
rows, end = [], time.monotonic() + 3
while time.monotonic() < end:
    time.sleep(0.05)
    rows += amplifier.ReadMultiple()
amplifier.StopTransmission()
time.sleep(0.1)
rows += amplifier.ReadMultiple()
seen["frames"] = len(rows)
seen["ramp"] = [row[1]["channel0"] for row in rows]
seen["overloads"] = sum(row[2] for row in rows)
print(json.dumps(seen))
"""


@dataclass
class RealTimeWorld:
    """A force that rises along x by 3 N/s, so that a lost frame is a step in the ramp."""

    began_ns: int = field(default_factory=time.monotonic_ns)
    noise_key: tuple[int, ...] = (1, 0, 0)
    asked_us: int = 0
    """What the simulator was given when it last asked: its own time for what it does next, however
    late the machine lets it get there."""
    spans_us: list[int] = field(default_factory=list)

    @property
    def now_us(self) -> int:
        self.asked_us = (time.monotonic_ns() - self.began_ns) // 1000
        return self.asked_us

    def force_N(self, times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:  # noqa: N802
        return np.stack([3 * times_s, 0 * times_s - 3.0, 0 * times_s + 25.0], axis=1)

    def log(self, device: str, what: str, value: object, by: str) -> None:
        if what == "streaming":
            self.spans_us.append(self.asked_us)


@pytest.mark.foreign
def test_gsv86lib_stops_sets_reads_one_value_and_streams_without_a_gap() -> None:
    python = python_with("gsv86lib", ["gsv86lib==0.1.1"])
    world = RealTimeWorld()
    sensor = Sensor(matrix=((10, 0, 0), (0, 100, 0), (0, 0, 100)), zero_mV_V=(0, 0, 0))
    server = PtyServer(Gsv8(world, world, sensor=sensor), world)
    with serving(server):
        seen = seen_by(python, SCRIPT, server.path)

    assert seen["stopped"]
    assert seen["rate"] == 1000.0
    assert seen["one"][1:] == pytest.approx([-0.03, 0.25], abs=2e-4)
    started, stopped = world.spans_us[1:3]
    assert seen["frames"] == (stopped - started) // 1000
    assert seen["frames"] >= 3000
    steps = np.diff(seen["ramp"]) * 10
    assert steps == pytest.approx(np.full(len(steps), 0.003), abs=1.5e-3), "1 ms after 1 ms"
    assert seen["overloads"] == 0
    assert server.bytes_lost == 0
