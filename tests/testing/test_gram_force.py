"""A force sensor of another package that streams over TCP, numbers its frames and has another unit:
its contract, a sweep in virtual time, and a fault of its simulator."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import packages
import pytest

REGISTERED = """[rig.drivers]
gf-one = gram_force.driver
[rig.simulators]
gf-one = gram_force.simulator:GfOneCore
"""
CONTRACT = """from gram_force.simulator import GfOneCore
from rig.testing import driver_contract
test_gf_one = driver_contract("gf-one", core=GfOneCore, settings={"max_force_N": 40.0})
"""
BENCH = """
name = "real"
[fixture]
mounted = "film-clamp"
contact_from_mm = 12.0
contact_to_mm = 13.0
[film]
[load_cell]
sensitivity_V_N = 0.1
[generator]
driver = "keysight-33500b"
resource = "TCPIP::10.0.0.2::5025::SOCKET"
max_amplitude_V = 5.0
[daq]
driver = "keysight-u2300a"
resource = "USB0::0x0957::0x1518::TW12345678::INSTR"
channels = { load_cell = 101, film = 102 }
[stage_z]
driver = "festo-cmmt"
axis = "z"
host = "10.0.0.4"
low_limit_mm = 0.0
high_limit_mm = 20.0
max_speed_mm_s = 20.0
torque_limit_percent = 45.0
[force_sensor]
driver = "gf-one"
host = "10.0.0.5"
max_force_N = 30.0
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the package."""
    folder = Path(__file__).parent / "gram_force"
    modules = {f"gram_force/{path.name}": path.read_text() for path in folder.glob("*.py")}
    modules["test_gf_one.py"] = CONTRACT
    return packages.install(tmp_path / "site", "gram-force", REGISTERED, modules)


@pytest.mark.thorough
def test_numbered_frames_over_tcp_fulfil_the_contract(site: Path) -> None:
    """A lost batch of frames is found by the number of the next one, not by a time-out."""
    start = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider"]
    ended = subprocess.run(
        [*start, str(site / "test_gf_one.py")],
        env={**os.environ, "PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.thorough
def test_a_dry_run_has_it_in_virtual_time(rig: Any, site: Path) -> None:
    packages.on_path(rig, site)
    (rig.folder / "bench.toml").write_text(BENCH)
    done = rig.run("sweep", "--frequencies", "200", "--no-figures", "--json", "--dry-run")
    assert done.code == 0, done.stderr
    assert done.object["points_done"] == 1


def test_a_fault_of_its_simulator_names_the_package_and_the_line(rig: Any, site: Path) -> None:
    packages.on_path(rig, site)
    simulator = site / "gram_force" / "simulator.py"
    right = "host, port = host_and_port(where)"
    text = simulator.read_text()
    assert right in text
    simulator.write_text(text.replace(right, 'host, port = where, int("x")'))
    (rig.folder / "bench.toml").write_text(BENCH)
    failed = rig.run("sweep", "--frequencies", "200", "--no-figures", "--dry-run")
    assert failed.code == 2, failed.stderr
    assert "the package gram-force" in failed.stderr
    assert "simulator.py line" in failed.stderr
    assert "ValueError: invalid literal for int()" in failed.stderr
