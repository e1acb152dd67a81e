"""A force sensor of another package that is derived from `LineForceSensor`, with three axes, a unit
of its own, a choice of rates and commands that are acknowledged: its contract on both links, and a
run with a serial format that only the real sensor needs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import packages
import pytest
from tiers import mostly_nightly

REGISTERED = """[rig.drivers]
tf-3 = triple_force.driver
[rig.simulators]
tf-3 = triple_force.simulator:TripleForceCore
"""
CONTRACT = """from triple_force.simulator import TripleForceCore
from rig.testing import driver_contract
test_tf_3 = driver_contract("tf-3", core=TripleForceCore)
"""
SENSOR = """driver = "tf-3"
port = "/dev/ttyUSB0"
baudrate = 19200
serial_format = "7E1"
max_force_N = 30.0
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the package."""
    folder = Path(__file__).parent / "triple_force"
    modules = {f"triple_force/{path.name}": path.read_text() for path in folder.glob("*.py")}
    modules["test_tf_3.py"] = CONTRACT
    return packages.install(tmp_path / "site", "triple-force", REGISTERED, modules)


WRONG_SCALES = {
    "a unit of the driver": ("driver.py", '"xyz", "mN"', '"xyz", "N"'),
    "a core without a matrix": ("simulator.py", "    matrix = ", "    other = "),
}


@pytest.mark.parametrize("mistake", WRONG_SCALES)
def test_forces_that_are_not_in_newtons_before_a_calibration_are_found(
    site: Path, mistake: str
) -> None:
    """A bench file without a calibration record uses the scale that the driver begins with."""
    name, right, wrong = WRONG_SCALES[mistake]
    module = site / "triple_force" / name
    text = module.read_text()
    assert right in text
    module.write_text(text.replace(right, wrong))
    start = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider"]
    ended = subprocess.run(
        [*start, "-k", "without_faults", str(site / "test_tf_3.py")],
        env={**os.environ, "PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1, ended.stdout + ended.stderr
    assert "before calibrate(), raw [" in ended.stdout
    assert "the driver's unit and that matrix must agree" in ended.stdout


@pytest.mark.parametrize("link", mostly_nightly(["serial", "tcp"], ["tcp"]))
def test_three_axes_and_acknowledged_commands_fulfil_the_contract(site: Path, link: str) -> None:
    simulator = site / "triple_force" / "simulator.py"
    text = simulator.read_text()
    assert '"serial"' in text
    simulator.write_text(text.replace('"serial"', f'"{link}"'))
    start = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider"]
    ended = subprocess.run(
        [*start, str(site / "test_tf_3.py")],
        env={**os.environ, "PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.thorough
def test_a_dry_run_has_it_in_virtual_time_whatever_the_serial_format(rig: Any, site: Path) -> None:
    packages.on_path(rig, site)
    (rig.folder / "bench.toml").write_text(packages.film_bench(SENSOR))
    done = rig.run("sweep", "--frequencies", "200", "--no-figures", "--json", "--dry-run")
    assert done.code == 0, done.stderr
    assert done.object["points_done"] == 1


def test_a_force_beyond_the_sensor_is_refused_with_its_setting(rig: Any, site: Path) -> None:
    packages.on_path(rig, site)
    too_much = SENSOR.replace("max_force_N = 30.0", "max_force_N = 70.0")
    (rig.folder / "bench.toml").write_text(packages.film_bench(too_much))
    refused = rig.run("sweep", "--frequencies", "200", "--no-figures", "--dry-run")
    assert refused.code == 2, refused.stderr
    assert "max_force_N = 70 is beyond the 60 N that the TF 3 measures" in refused.stderr
    assert "lower max_force_N of [force_sensor] in the bench file" in refused.stderr
