"""Zaber's own zaber-motion drives the simulated rotary stage, over TCP and on a pty.

Degrees need the vendor's database of devices, which is on the network: everything is in the stage's
own units here.
"""

from __future__ import annotations

import time
from typing import Any

import pytest
from clients import python_with, seen_by, serving

from drivers.simulated.instruments.zaber_rst import SimulatedRotarySettings, SimulatedRotaryStage
from drivers.simulated.task_log import TaskLog
from drivers.simulated.transports.serial_server import PtyServer
from drivers.simulated.transports.serial_tcp import SerialTcpServer

REQUIREMENTS = ["zaber-motion==10.2.0"]
OPEN = """
import json, sys, time
from zaber_motion import Units
from zaber_motion.ascii import Connection
from zaber_motion.exceptions import (
    BadDataException, DeviceDbFailedException, MovementFailedException,
)

link, where = sys.argv[1:]
if link == "tcp":
    connection = Connection.open_tcp("127.0.0.1", int(where))
else:
    connection = Connection.open_serial_port(where)
(device,) = connection.detect_devices(identify_devices=False)
axis = device.get_axis(1)
seen = {"address": device.device_address}
"""
DRIVE = """
seen["at first"] = sorted(axis.warnings.get_flags())
try:
    axis.move_absolute(22400, Units.NATIVE)
except BadDataException:
    seen["unhomed"] = "BADDATA"
axis.home()
seen["homed"] = [sorted(axis.warnings.get_flags()), axis.get_position(Units.NATIVE)]
axis.move_absolute(22400, Units.NATIVE)
seen["turned"] = axis.get_position(Units.NATIVE)
begun = time.monotonic()
axis.move_relative(-22400, Units.NATIVE, velocity=52429, velocity_unit=Units.NATIVE,
                   acceleration=21, acceleration_unit=Units.NATIVE)
seen["back"] = [axis.get_position(Units.NATIVE), time.monotonic() - begun]
axis.settings.set("limit.max", 64000, Units.NATIVE)
seen["limit"] = axis.settings.get("limit.max", Units.NATIVE)
try:
    axis.move_absolute(64001, Units.NATIVE)
except BadDataException as error:
    seen["beyond"] = str(error)
axis.move_absolute(60000, Units.NATIVE, wait_until_idle=False)
time.sleep(0.1)
seen["busy"] = axis.is_busy()
axis.move_absolute(10000, Units.NATIVE, wait_until_idle=False)
axis.wait_until_idle(throw_error_on_fault=False)
seen["retargeted"] = axis.get_position(Units.NATIVE)
axis.move_absolute(60000, Units.NATIVE, wait_until_idle=False)
time.sleep(0.1)
axis.stop()
seen["stopped"] = [axis.is_busy(), axis.get_position(Units.NATIVE)]
try:
    axis.move_absolute(60000, Units.NATIVE)
except MovementFailedException as error:
    seen["stalled"] = list(error.details.warnings)
seen["cleared"] = sorted(axis.warnings.get_flags())
connection.close()
print(json.dumps(seen))
"""
IDENTIFY = """
try:
    seen["identify"] = str(device.identify().serial_number)
except DeviceDbFailedException as error:
    seen["identify"] = str(error)
connection.close()
print(json.dumps(seen))
"""


class RealTime:
    """The host's time."""

    def __init__(self) -> None:
        self.turned: list[Any] = []
        self.tasks = TaskLog()

    @property
    def now_us(self) -> int:
        return time.monotonic_ns() // 1000

    def log(self, device: str, what: str, value: object, by: str) -> None:
        if what == "turn":
            self.turned.append(value)
            if len(self.turned) == 5:
                self.stage.axis.jammed = True

    stage: SimulatedRotaryStage


def server_of(stage: SimulatedRotaryStage, link: str, world: RealTime) -> tuple[Any, Any]:
    """A server for the link, and where a client finds it once it has started."""
    if link == "tcp":
        tcp = SerialTcpServer(stage.line)
        return tcp, lambda: str(tcp.port)
    pty = PtyServer(stage.line(), world)
    return pty, lambda: pty.path


@pytest.mark.foreign
@pytest.mark.parametrize("link", ["tcp", "serial"])
def test_the_vendors_client_homes_turns_and_is_refused(link: str) -> None:
    python = python_with("zaber-motion", REQUIREMENTS)
    world = RealTime()
    stage = world.stage = SimulatedRotaryStage(SimulatedRotarySettings(start_deg=5.0), world)
    server, where = server_of(stage, link, world)
    with serving(server):
        seen = seen_by(python, OPEN + DRIVE, link, where())

    assert seen["address"] == 1
    assert seen["at first"] == ["WH", "WR"]
    assert seen["unhomed"] == "BADDATA"
    assert seen["homed"] == [[], 0]
    assert seen["turned"] == 22400
    assert seen["back"][0] == 0
    assert seen["back"][1] > 3.5 / 5.0 + 5.0 / 21.0, "the speed that came with the turn"
    assert seen["limit"] == 64000
    assert "BADDATA" in seen["beyond"]
    assert seen["busy"]
    assert seen["retargeted"] == 10000
    assert seen["stopped"][0] is False
    assert 10000 < seen["stopped"][1] < 60000
    assert seen["stalled"] == ["FS"]
    assert seen["cleared"] == [], "by the client itself"
    assert world.turned[0]["target_deg"] == 3.5


@pytest.mark.foreign
@pytest.mark.parametrize("link", ["tcp", "serial"])
def test_the_vendors_client_identifies_it_as_far_as_its_database(link: str) -> None:
    """A serial number of digits is asked for; then all that is missing is the database."""
    python = python_with("zaber-motion", REQUIREMENTS)
    world = RealTime()
    stage = SimulatedRotaryStage(SimulatedRotarySettings(serial="77001"), world)
    server, where = server_of(stage, link, world)
    with serving(server):
        seen = seen_by(python, OPEN + IDENTIFY, link, where())
    assert seen["identify"] == "77001" or "Device Database" in seen["identify"]
