"""QCoDeS's own driver for the 33500 series, in its own environment, drives the simulator."""

from __future__ import annotations

import pytest
from clients import Terminals, python_with, seen_by, serving

from drivers.simulated.instruments.keysight_33500b import Keysight33500B
from drivers.simulated.transports.scpi_servers import ScpiSocketServer

SCRIPT = """
import json, sys
from qcodes.instrument_drivers.Keysight import Keysight33512B

address = f"TCPIP::127.0.0.1::{sys.argv[1]}::SOCKET"
generator = Keysight33512B("generator", address, visalib="@py", silent=True)
seen = {"identity": generator.get_idn(), "channels": generator.num_channels}
seen["readable"] = {
    f"{module} {name}": parameter.get()
    for module, part in generator.submodules.items()
    for name, parameter in part.parameters.items()
    if parameter.gettable
}
channel = generator.ch2
channel.function_type("TRI")
channel.frequency(2.5)
channel.amplitude(1.5)
channel.offset(0.25)
channel.burst_mode("N Cycle")
channel.burst_ncycles(5)
channel.burst_state("ON")
channel.trigger_source("BUS")
channel.output("ON")
generator.force_trigger()
generator.sync_channel_phases()
seen["set"] = [
    channel.function_type(), channel.frequency(), channel.amplitude(), channel.offset(),
    channel.burst_mode(), channel.burst_ncycles(), channel.burst_state(), channel.output(),
]
seen["errors"] = [generator.error()]
generator.write("SOURce1:FREQuency 1e9")
generator.write("FREQUENZ 5")
seen["errors"] += [generator.error(), generator.error(), generator.error()]
print(json.dumps(seen))
"""


@pytest.mark.foreign
def test_qcodes_drives_the_generator() -> None:
    python = python_with("qcodes", ["qcodes==0.58.0", "pyvisa-py==0.8.1"])
    terminals = Terminals()
    server = ScpiSocketServer(Keysight33500B(terminals, terminals))
    with serving(server):
        seen = seen_by(python, SCRIPT, str(server.port))

    assert (seen["identity"]["model"], seen["channels"]) == ("33512B", 2)
    assert len(seen["readable"]) >= 40
    assert None not in seen["readable"].values()
    assert seen["set"] == ["TRI", 2.5, 1.5, 0.25, "N Cycle", 5, "ON", "ON"]
    assert [code for code, _ in seen["errors"]] == [0, -222, -113, 0]
    assert (2, True) in [(channel, wave.on) for channel, wave in terminals.excitations]
