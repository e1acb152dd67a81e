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
SENSOR = """driver = "gf-one"
host = "10.0.0.5"
max_force_N = 30.0
"""
BENCH = packages.film_bench(SENSOR)


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


@pytest.mark.thorough
def test_a_trial_that_needs_the_tangential_force_is_refused_before_anything_moves(
    rig: Any, site: Path
) -> None:
    packages.on_path(rig, site)
    (rig.folder / "bench.toml").write_text(packages.plate_bench(SENSOR))
    refused = rig.run("slip-trial", "--no-figures", "--dry-run", "--world-log", "world.jsonl")
    assert refused.code == 2, refused.stderr
    (line,) = refused.errors
    assert "slip-trial needs the force along x" in line
    assert "the force sensor ONE measures z only" in line
    assert not [event for event in rig.log() if event["what"] in ("move", "home")]


@pytest.mark.thorough
def test_a_trial_that_can_do_without_it_says_what_is_not_measured(rig: Any, site: Path) -> None:
    packages.install(site, "lab-creep", "[rig.procedures]\ncreep = procedures.example:Creep\n")
    packages.on_path(rig, site)
    (rig.folder / "bench.toml").write_text(packages.plate_bench(SENSOR))
    done = rig.run("creep", "--hold", "1s", "--no-figures", "--dry-run")
    assert done.code == 0, done.stderr
    assert "the force sensor ONE measures z only: F_t and F_y are not measured" in done.stderr


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
