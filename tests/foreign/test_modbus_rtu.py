"""Foreign Modbus RTU clients drive the simulated AZ pair: mbpoll, libmodbus, minimalmodbus.

Each reads positions, homes and moves an axis, and meets the drives' exceptions.
"""

from __future__ import annotations

import ctypes.util
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from clients import python_with, seen_by, serving

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.oriental_az import AzDrive, SimulatedAzSettings
from drivers.simulated.task_log import TaskLog
from drivers.simulated.transports.modbus_rtu import RtuLine
from drivers.simulated.transports.serial_server import PtyServer

pytestmark = pytest.mark.foreign

DATA = [0, 0, 0, 1, 0, 15_000, 0, 60_000, 1, 0xD4C0, 1, 0xD4C0, 0, 1000, 0, 1]
"""Direct data: absolute, 15000 steps, 60000 steps/s, 120000 steps/s2, 100 %, start."""

MINIMALMODBUS = """
import json, sys, time
import minimalmodbus

z, x = (minimalmodbus.Instrument(sys.argv[1], unit) for unit in (1, 2))
for drive in (z, x):
    drive.serial.baudrate, drive.serial.parity, drive.serial.timeout = 230400, "N", 1.0

def position(drive):
    return drive.read_long(0xCC, signed=True)

def until(bit, drive):
    while not drive.read_register(0x178) & bit or drive.read_register(0x7F) & 0x2000:
        time.sleep(0.02)

seen = {"before": [position(z), position(x)]}
x.write_registers(0x7C, [0, 0x10])
until(3, x)
x.write_registers(0x7C, [0, 0])
seen["homed"] = position(x)
x.write_registers(0x58, json.loads(sys.argv[2]))
seen["moving"] = bool(x.read_register(0x7F) & 0x2000)
until(3, x)
seen["moved"] = [position(z), position(x)]
x.write_register(0x138B, 750, functioncode=6)
seen["timeout"] = x.read_long(0x138A)

def refusal(ask):
    try:
        ask()
    except Exception as error:
        return f"{type(error).__name__}: {error}"

seen["refused"] = [
    refusal(lambda: z.read_register(0x4000)),
    refusal(lambda: z.write_registers(0x64, [0, 2000])),
    refusal(lambda: z.read_register(0xCC, functioncode=4)),
]
print(json.dumps(seen))
"""

LIBMODBUS = """
import ctypes, json, sys, time

lib = ctypes.CDLL(sys.argv[3], use_errno=True)
lib.modbus_new_rtu.restype = ctypes.c_void_p
lib.modbus_strerror.restype = ctypes.c_char_p
line = lib.modbus_new_rtu(sys.argv[1].encode(), 230400, ctypes.c_char(b"N"), 8, 1)
line = ctypes.c_void_p(line)
assert lib.modbus_connect(line) == 0
lib.modbus_set_response_timeout(line, 1, 0)

def unit(number):
    assert lib.modbus_set_slave(line, number) == 0

def read(address, count):
    words = (ctypes.c_uint16 * count)()
    got = lib.modbus_read_registers(line, address, count, words)
    return list(words) if got == count else error()

def write(address, values):
    words = (ctypes.c_uint16 * len(values))(*values)
    done = lib.modbus_write_registers(line, address, len(values), words)
    return done == len(values) or error()

def error():
    return lib.modbus_strerror(ctypes.get_errno()).decode()

def position():
    upper, lower = read(0xCC, 2)
    return ctypes.c_int32(upper << 16 | lower).value

def until_done():
    while not read(0x178, 1)[0] & 2 or read(0x7F, 1)[0] & 0x2000:
        time.sleep(0.02)

unit(1)
seen = {"before": position()}
assert write(0x7C, [0, 0x10]) is True
until_done()
write(0x7C, [0, 0])
assert write(0x58, json.loads(sys.argv[2])) is True
until_done()
seen["moved"] = position()
got = (ctypes.c_uint16 * 2)()
values = (ctypes.c_uint16 * 2)(0, 500)
asked = (line, 0x64, 2, values, 0x64, 2, got)
seen["written and read"] = [lib.modbus_write_and_read_registers(*asked), list(got)]
seen["refused"] = [read(0x4000, 1), write(0x64, [0, 2000])]
unit(2)
seen["other"] = position()
unit(3)
lib.modbus_set_response_timeout(line, 0, 200000)
seen["nobody"] = read(0xCC, 2)
print(json.dumps(seen))
"""


class RealWorld:
    """The host's time and no resistance."""

    def __init__(self) -> None:
        self.tasks = TaskLog()

    @property
    def now_us(self) -> int:
        return time.monotonic_ns() // 1000

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        return 0.0

    def log(self, device: str, what: str, value: object, by: str) -> None:
        pass


@contextmanager
def pair() -> Iterator[PtyServer]:
    """Two drives on one line, not yet homed."""
    world = RealWorld()
    names = ("stage_z", "stage_x")
    drives = [AzDrive(SimulatedAzSettings(name, unit), world) for unit, name in enumerate(names, 1)]
    faults = {name: WireFaults(FaultPlan(), name) for name in names}
    server = PtyServer(RtuLine(drives, world), world, faults=faults)
    with serving(server):
        yield server


UNHOMED = round(47.5 * 3000)
"""Steps at 10 mm, wrong by 37.5 mm."""


def test_minimalmodbus_moves_one_of_two_drives_and_meets_exceptions() -> None:
    python = python_with("minimalmodbus", ["minimalmodbus==2.1.1"])
    with pair() as server:
        seen = seen_by(python, MINIMALMODBUS, server.path, str(DATA))
    assert seen["before"] == [UNHOMED, UNHOMED]
    assert seen["homed"] == 0
    assert seen["moving"]
    assert seen["moved"] == [UNHOMED, 15_000]
    assert seen["timeout"] == 750
    address, value, function = seen["refused"]
    assert address.startswith("IllegalRequestError")
    assert value.startswith("SlaveReportedException")
    assert function.startswith("IllegalRequestError")


def test_libmodbus_moves_a_drive_and_meets_exceptions() -> None:
    library = ctypes.util.find_library("modbus")
    if library is None:
        pytest.skip("libmodbus is not installed (Debian: apt install libmodbus5)")
    with pair() as server:
        seen = seen_by(sys.executable, LIBMODBUS, server.path, str(DATA), library)
    assert (seen["before"], seen["moved"], seen["other"]) == (UNHOMED, 15_000, UNHOMED)
    assert seen["written and read"] == [2, [0, 500]]
    assert seen["refused"] == ["Illegal data address", "Slave device or server failure"]
    assert "timed out" in seen["nobody"]


def test_mbpoll_reads_writes_and_is_refused() -> None:
    mbpoll = shutil.which("mbpoll")
    if mbpoll is None:
        pytest.skip("mbpoll is not installed (Debian: apt install mbpoll)")
    with pair() as server:

        def poll(*arguments: str) -> subprocess.CompletedProcess[Any]:
            line = ["-m", "rtu", "-b", "230400", "-P", "none", "-0", "-1", "-o", "1"]
            command = [mbpoll, *line, *arguments]
            return subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)

        def position(unit: str) -> str:
            where = ("-a", unit, "-r", "204", "-c", "1", "-t", "4:int", "-B", server.path)
            return poll(*where).stdout.split("[204]:")[1].split()[0]

        registers = ("-t", "4")
        assert position("1") == str(UNHOMED)
        homing = poll("-a", "1", *registers, "-r", "124", server.path, "0", "16")
        assert homing.returncode == 0, homing.stdout + homing.stderr
        deadline = time.monotonic() + 20
        while position("1") != "0" and time.monotonic() < deadline:
            time.sleep(0.1)
        poll("-a", "1", *registers, "-r", "124", server.path, "0", "0")
        moving = poll("-a", "1", *registers, "-r", "88", server.path, *map(str, DATA))
        assert moving.returncode == 0, moving.stdout + moving.stderr
        while position("1") != "15000" and time.monotonic() < deadline:
            time.sleep(0.1)
        assert (position("1"), position("2")) == ("15000", str(UNHOMED))
        refused = poll("-a", "1", *registers, "-r", "16384", server.path)
        assert "Illegal data address" in refused.stdout + refused.stderr
        nobody = poll("-a", "9", *registers, "-r", "204", server.path)
        assert "timed out" in nobody.stdout + nobody.stderr
