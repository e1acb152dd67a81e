"""PyMeasure's own driver for the 33500 series, in its own environment, drives the simulator.

It is the independent check of the simulator: nobody here wrote that driver.
"""

from __future__ import annotations

import pytest
from clients import Terminals, python_with, seen_by, serving

from drivers.simulated.instruments.keysight_33500b import Keysight33500B
from drivers.simulated.transports.scpi_servers import ScpiSocketServer

SCRIPT = """
import json, sys
from pymeasure.instruments.agilent import Agilent33500

generator = Agilent33500(
    f"TCPIP::127.0.0.1::{sys.argv[1]}::SOCKET",
    visa_library="@py", read_termination="\\n", write_termination="\\n", timeout=5000,
)
seen = {"identity": generator.id, "errors at first": generator.check_errors()}

first, second = generator.ch_1, generator.ch_2
first.output_load = "INF"
seen["load"] = first.output_load
first.frequency = 2.5
first.amplitude = 3.0
first.offset = -0.25
first.phase = 90
first.shape = "SIN"
seen["channel 1"] = [
    first.frequency, first.amplitude, first.offset, first.phase, first.shape, first.amplitude_unit,
    first.voltage_high, first.voltage_low,
]
first.output_load = 50
seen["amplitude into 50 ohm"] = first.amplitude
first.output = True
seen["output"] = [first.output, second.output]

first.burst_ncycles = 5
first.burst_mode = "TRIGGERED"
first.burst_period = 0.5
first.burst_state = True
seen["burst"] = [first.burst_ncycles, first.burst_mode, first.burst_period, first.burst_state]
first.burst_state = False

second.amplitude_unit = "VRMS"
second.shape = "SQU"
second.square_dutycycle = 25
second.data_volatile_clear()
second.data_arb("wave", range(-10000, 10000, 20), data_format="DAC")
second.arb_file = "wave"
second.arb_srate = 1e6
second.arb_filter = "STEP"
seen["channel 2"] = [
    second.amplitude_unit, second.shape, second.square_dutycycle, second.arb_file,
    second.arb_srate, second.arb_filter,
]
generator.frequency = 10.0
seen["default channel"] = [generator.frequency, first.frequency]
generator.phase_sync()
seen["errors so far"] = generator.check_errors()

generator.frequency = 50e6
seen["too fast"] = [generator.check_errors(), generator.frequency]
generator.write("FREQUENZ 5")
seen["unknown"] = generator.check_errors()
generator.reset()
seen["after reset"] = [generator.output, generator.frequency, generator.check_errors()]
print(json.dumps(seen))
"""


@pytest.mark.foreign
def test_pymeasure_drives_the_generator() -> None:
    python = python_with("pymeasure", ["pymeasure==0.16.0", "pyvisa-py==0.8.1"])
    terminals = Terminals()
    server = ScpiSocketServer(Keysight33500B(terminals, terminals))
    with serving(server):
        seen = seen_by(python, SCRIPT, str(server.port))

    assert seen["identity"].split(",")[:2] == ["Agilent Technologies", "33512B"]
    assert seen["errors at first"] == seen["errors so far"] == []
    assert seen["load"] == 9.9e37
    assert seen["channel 1"] == [2.5, 3.0, -0.25, 90.0, "SIN", "VPP", 1.25, -1.75]
    assert seen["amplitude into 50 ohm"] == 1.5
    assert seen["output"] == [True, False]
    assert seen["burst"] == [5.0, "TRIG", 0.5, True]
    assert seen["channel 2"] == ["VRMS", "SQU", 25.0, '"wave"', 1e6, "STEP"]
    assert seen["default channel"] == [10.0, 10.0]
    assert [int(error[0]) for error in seen["too fast"][0]] == [-222]
    assert seen["too fast"][1] == 20e6
    assert [int(error[0]) for error in seen["unknown"]] == [-113]
    assert seen["after reset"] == [False, 1000.0, []]

    channel, wave = next(e for e in terminals.excitations if e[1].on)
    assert (channel, wave.amplitude_V, wave.offset_V, wave.frequency_Hz) == (1, 1.5, -0.25, 2.5)
    assert not terminals.excitations[-1][1].on
