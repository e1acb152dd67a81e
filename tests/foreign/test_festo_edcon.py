"""Foreign Modbus clients drive the simulated CMMT: the vendor's festo-edcon, and mbpoll."""

from __future__ import annotations

import shutil
import subprocess
import time

import pytest
from clients import python_with, seen_by, serving

from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.festo_cmmt import CmmtDrive
from drivers.simulated.task_log import TaskLog
from drivers.simulated.transports.modbus_tcp import ModbusTcpServer

SCRIPT = """
import functools, json, sys, time
import edcon.edrive.com_modbus as com_modbus

com_modbus.ModbusClient = functools.partial(com_modbus.ModbusClient, port=int(sys.argv[1]))
from edcon.edrive.diagnosis import diagnosis_name
from edcon.edrive.motion_handler import MotionHandler

com = com_modbus.ComModbus("127.0.0.1", timeout_ms=600)
seen = {"who": com.device_info, "unit": com.read_pnu(12698), "serial": com.read_pnu_raw(2021, 0, 5)}
seen["serial"] = seen["serial"].decode().rstrip("\\0")
seen["timeout"] = [com.set_timeout(600), com.read_pnu(4854)]
motion = MotionHandler(com, config_mode="validate")
seen["acknowledged"] = motion.acknowledge_faults()
seen["enabled"] = motion.enable_powerstage()
seen["homed"] = motion.referencing_task()
seen["moved"] = motion.position_task(15000, 60000, absolute=True)
seen["position"] = motion.current_position()
seen["relative"] = motion.position_task(-2500, 60000)
seen["then"] = motion.current_position()
motion.position_task(40000, 50000, absolute=True, nonblocking=True)
time.sleep(0.2)
motion.pause_motion_task()
paused = motion.current_position()
time.sleep(0.2)
seen["paused"] = [paused, motion.current_position()]
motion.resume_motion_task()
seen["resumed"] = motion.wait_for_target_position()
seen["on"] = motion.current_position()
seen["jogged"] = motion.jog_task(True, False, duration=0.3)
up = motion.current_position()
motion.jog_task(False, True, duration=0.3)
seen["jog"] = [up - seen["on"], motion.current_position() - up]
motion.configure_traversing_to_fixed_stop(True)
seen["pressed"] = motion.position_task(70000, 20000, absolute=True)
seen["held"] = [motion.fix_stop_reached(), motion.clamping_torque_reached()]
seen["at"] = motion.current_position()
motion.configure_traversing_to_fixed_stop(False)
motion.stop_motion_task()
seen["back"] = motion.position_task(12500, 60000, absolute=True)
motion.configure_continuous_update(True)
motion.position_task(90000, 20000, absolute=True, nonblocking=True)
motion.position_task(30000, 20000, absolute=True, nonblocking=True)
time.sleep(0.3)
seen["retargeted"] = motion.current_position()
motion.stop_motion_task()
motion.configure_continuous_update(False)
motion.configure_software_limit_switch(True)
seen["too far"] = motion.position_task(200000, 20000, absolute=True)
seen["beyond"] = [motion.fault_present(), motion.current_fault_code()]
seen["mended"] = [motion.acknowledge_faults(), motion.enable_powerstage()]
motion.position_task(49000, 20000, absolute=True, nonblocking=True)
time.sleep(0.2)
com.io_thread.stop()
com.io_thread.join()
time.sleep(1.0)  # longer than the communication time-out
com.start_io()
time.sleep(0.2)
motion.update_inputs()
seen["fault"] = motion.fault_present()
seen["code"] = motion.current_fault_code()
seen["name"] = diagnosis_name(seen["code"])
seen["powered"] = bool(motion.telegram.zsw1.operation_enabled)
seen["stopped"] = motion.stopped()
seen["cleared"] = motion.acknowledge_faults()
seen["again"] = motion.enable_powerstage()
seen["onwards"] = motion.position_task(5000, 60000, absolute=True)
seen["end"] = motion.current_position()
print(json.dumps(seen))
motion.shutdown()
"""


WALL_mm = 50.0


class RealWorld:
    """The host's time, and a stiff wall."""

    def __init__(self) -> None:
        self.moves: list[object] = []
        self.tasks = TaskLog()

    @property
    def now_us(self) -> int:
        return time.monotonic_ns() // 1000

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        return -1000.0 * max(0.0, position_mm - WALL_mm)

    def log(self, device: str, what: str, value: object, by: str) -> None:
        if what == "move":
            self.moves.append(value)


@pytest.mark.foreign
def test_the_vendors_client_drives_the_axis() -> None:
    python = python_with("festo-edcon", ["festo-edcon==0.14.12"])
    world = RealWorld()
    drive = CmmtDrive(SimulatedCmmtSettings(), world)
    server = ModbusTcpServer(drive)
    with serving(server):
        seen = seen_by(python, SCRIPT, str(server.port))

    assert seen["who"]["vendor_name"].startswith("Festo")
    assert "CMMT" in seen["who"]["model_name"]
    assert (seen["serial"], seen["unit"]) == ("SIMZ1", 0xFA010000)
    assert seen["timeout"] == [True, 600.0]
    done = (
        "acknowledged", "enabled", "homed", "moved", "relative", "resumed", "jogged", "pressed",
        "back", "cleared", "again", "onwards",
    )  # fmt: skip
    assert {name: seen[name] for name in done} == dict.fromkeys(done, True)
    assert (seen["position"], seen["then"]) == (15_000, 12_500)
    assert 12_500 < seen["paused"][0] == seen["paused"][1] < 40_000
    assert seen["on"] == 40_000
    assert 2_000 < seen["jog"][0] < 10_000
    assert -10_000 < seen["jog"][1] < -2_000
    assert seen["held"] == [True, True]
    assert seen["at"] == pytest.approx(50_100, abs=40), "100 N against 1000 N/mm"
    assert 12_500 < seen["retargeted"] < 30_000
    assert (seen["too far"], seen["beyond"]) == (False, [True, 110])
    assert seen["mended"] == [True, True]
    assert (seen["fault"], seen["code"], seen["powered"]) == (True, 391, False)
    assert seen["name"] == "Process data communication failed"
    assert seen["stopped"]
    assert seen["end"] == 5_000
    assert world.moves[0] == {"target_mm": 15.0, "speed_mm_s": 60.0}


@pytest.mark.foreign
def test_mbpoll_reads_and_writes_registers() -> None:
    mbpoll = shutil.which("mbpoll")
    if mbpoll is None:
        pytest.skip("mbpoll is not installed (Debian: apt install mbpoll)")
    server = ModbusTcpServer(CmmtDrive(SimulatedCmmtSettings(), RealWorld()))
    with serving(server):

        def poll(*arguments: str) -> str:
            where = ["-m", "tcp", "-p", str(server.port), "-a", "1", "-0", "-1", "-t", "4"]
            command = [mbpoll, *where, *arguments]
            done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
            assert done.returncode == 0, done.stdout + done.stderr
            return done.stdout

        poll("-r", "400", "127.0.0.1", "750", "0")
        assert "750" in poll("-r", "400", "-c", "2", "127.0.0.1")
        image = poll("-r", "100", "-c", "28", "127.0.0.1")
    assert "[105]:" in image
    assert "47500" in image.replace("(-18036)", ""), "XIST_A before homing, in micrometres"
