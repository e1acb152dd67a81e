"""docs/add-a-driver.md can be followed literally: its package is built from the page and used."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import packages
import pytest

from rig.files.runfile.reader import RunFile

PAGE = Path(__file__).parents[2] / "docs" / "add-a-driver.md"
SHORT = ("--frequencies", "200,1000", "--no-figures", "--json")
BENCH = packages.film_bench("""driver = "acme-f10"
port = "/dev/ttyUSB0"
max_force_N = 30.0
""")


def files_of_the_page() -> dict[str, str]:
    """The code blocks of the page that begin with a file's name, by that name."""
    blocks = re.findall(r"```\w+\n# (\S+)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return dict(blocks)


def entry_points(pyproject: str) -> str:
    """The text of a package's entry points, as an installation writes it."""
    groups = tomllib.loads(pyproject)["project"]["entry-points"]
    lines = []
    for group, entries in groups.items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    return "\n".join(lines) + "\n"


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder in which the page's package is installed."""
    files = files_of_the_page()
    modules = {name: text for name, text in files.items() if name != "pyproject.toml"}
    modules["acme_f10/__init__.py"] = ""
    return packages.install(
        tmp_path / "site", "acme-f10", entry_points(files["pyproject.toml"]), modules
    )


def test_the_page_has_every_file_that_it_lists() -> None:
    assert set(files_of_the_page()) == {
        "pyproject.toml",
        "acme_f10/driver.py",
        "acme_f10/simulator.py",
        "tests/test_contract.py",
    }


def put_on_tcp(site: Path) -> None:
    """Give the page's simulator a TCP port instead of a serial one."""
    simulator = site / "acme_f10" / "simulator.py"
    text = simulator.read_text()
    assert '"serial"' in text
    simulator.write_text(text.replace('"serial"', '"tcp"'))


def run_contract(site: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the page's contract test as its author would, in a pytest of its own."""
    start = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider"]
    return subprocess.run(
        [*start, *options, str(site / "tests" / "test_contract.py")],
        env={**os.environ, "PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def passed(ended: subprocess.CompletedProcess[str]) -> int:
    """How many checks have passed; an AssertionError shows the output where any has failed."""
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = re.search(r"\b(\d+) passed", ended.stdout)
    assert found is not None, ended.stdout
    return int(found[1])


@pytest.mark.thorough
def test_the_driver_of_the_page_fulfils_the_contract(site: Path) -> None:
    """Without the walk of all faults, which takes as long as everything else together."""
    assert passed(run_contract(site, "-k", "not one_fault_anywhere")) >= 13


@pytest.mark.thorough
def test_it_survives_the_walk_of_all_faults(site: Path) -> None:
    assert passed(run_contract(site, "-k", "one_fault_anywhere")) == 1


@pytest.mark.thorough
def test_it_fulfils_the_contract_on_tcp_as_well(site: Path) -> None:
    put_on_tcp(site)
    assert passed(run_contract(site)) >= 14


@pytest.mark.thorough
def test_a_defect_of_a_driver_is_shown_with_its_values(site: Path) -> None:
    """Without anything that the package would have to set up for it."""
    driver = site / "acme_f10" / "driver.py"
    text = driver.read_text()
    assert "float(FRAME" in text
    driver.write_text(text.replace("float(FRAME", "-float(FRAME"))
    ended = run_contract(site, "-k", "whole_experiment")
    assert ended.returncode == 1
    assert "unit, sign, axis or order is wrong" in ended.stdout


@pytest.mark.thorough
def test_a_dry_run_has_the_simulator_of_the_page_in_its_world(rig: Any, site: Path) -> None:
    packages.on_path(rig, site)
    (rig.folder / "bench.toml").write_text(BENCH)
    done = rig.run("sweep", *SHORT, "--dry-run")
    assert done.code == 0, done.stderr
    assert "in its place" not in done.stderr


@pytest.mark.thorough
def test_a_dry_run_says_which_model_stands_in(rig: Any, site: Path) -> None:
    info = next(site.glob("*.dist-info")) / "entry_points.txt"
    info.write_text(info.read_text().split("[rig.simulators]")[0])
    packages.on_path(rig, site)
    (rig.folder / "bench.toml").write_text(BENCH)
    done = rig.run("sweep", *SHORT, "--dry-run")
    assert done.code == 0, done.stderr
    line = (
        "force_sensor: no simulator for driver 'acme-f10' is installed; the dry run uses the "
        "simulated ME GSV-8 in its place"
    )
    assert done.stderr.index(line) < done.stderr.index("Dry run finished: 2 of 2 points")
    assert line in done.object["warnings"]


@pytest.mark.thorough
def test_a_bench_in_real_time_has_the_simulator_of_the_page_on_tcp(rig: Any, site: Path) -> None:
    put_on_tcp(site)
    packages.on_path(rig, site)
    replaced = ("--replace", "force_sensor=acme-f10")
    simulator = rig.start("simulate", *replaced, "--write", "sim.toml")
    simulator.wait_for(r"drive it with --bench sim\.toml")
    bench = tomllib.loads((rig.folder / "sim.toml").read_text())
    assert bench["force_sensor"]["driver"] == "acme-f10"
    assert bench["force_sensor"]["port"].startswith("socket://127.0.0.1:")
    done = rig.run("sweep", *SHORT, "--bench", "sim.toml")
    assert done.code == 0, done.stderr
    assert done.object["points_done"] > 0
    (file,) = rig.results.rglob("*.h5")
    with RunFile.open(file) as run:
        details = run.entry["instrument/force_sensor/details"]
        assert details["driver_package"].asstr()[()] == "acme-f10"
        assert details["driver_version"].asstr()[()] == "1.0"
        assert "driver_package" not in run.entry["instrument/daq/details"]


@pytest.mark.thorough
def test_what_cannot_be_replaced_is_refused(rig: Any) -> None:
    for given, named in (
        ("laser=me-gsv8", "the simulated bench has no laser"),
        (
            "generator=me-gsv8",
            "is for the role force_sensor, not for generator; use --replace force_sensor=me-gsv8",
        ),
        ("force_sensor", "'force_sensor'"),
        ("force_sensor=acme-f11", "'acme-f11' is unknown"),
        ("stage_x=acme-f11", "the project's other stages are chosen with --stages"),
    ):
        refused = rig.run("simulate", "--replace", given)
        assert refused.code == 2
        assert named in refused.errors[0]
