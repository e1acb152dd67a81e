"""Simulators of another package take their places in the World, in every role."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import packages
import pytest
from test_driver_contract import installed

CLAMP = packages.clamp_bench("""[generator]
driver = "acme-generator"
resource = "TCPIP::10.0.0.2::1::SOCKET"
max_amplitude_V = 5.0
[daq]
driver = "acme-daq"
port = "socket://10.0.0.3:4001"
channels = { load_cell = "AI0", film = "AI1" }
[stage_z]
driver = "acme-stage"
port = "socket://10.0.0.4:4001"
high_limit_mm = 20.0
max_speed_mm_s = 20.0
torque_limit_percent = 25.0
""")


@pytest.fixture
def site(rig: Any, tmp_path: Path) -> Path:
    """A folder with the package, on the command line's path."""
    folder = installed(tmp_path / "site")
    packages.on_path(rig, folder)
    return folder


@pytest.mark.thorough
@pytest.mark.usefixtures("site")
def test_a_dry_run_has_all_of_them_in_its_world_and_in_virtual_time(rig: Any) -> None:
    (rig.folder / "bench.toml").write_text(CLAMP + packages.FORCE_SENSOR)
    done = rig.run("sweep", "--frequencies", "200,1000", "--no-figures", "--json", "--dry-run")
    assert done.code == 0, done.stderr
    assert "in its place" not in done.stderr
    assert done.object["points_done"] == 2


@pytest.mark.thorough
def test_a_dry_run_names_each_model_that_stands_in(rig: Any, site: Path) -> None:
    info = next(site.glob("*.dist-info")) / "entry_points.txt"
    info.write_text(info.read_text().split("[rig.simulators]")[0])
    (rig.folder / "bench.toml").write_text(CLAMP + packages.FORCE_SENSOR)
    done = rig.run("sweep", "--frequencies", "200", "--no-figures", "--dry-run")
    assert done.code == 0, done.stderr
    for role, driver, model in (
        ("generator", "acme-generator", "Keysight 33500B"),
        ("daq", "acme-daq", "Keysight U2331A"),
        ("stage_z", "acme-stage", "Festo CMMT"),
    ):
        assert (
            f"{role}: no simulator for driver '{driver}' is installed; the dry run uses the "
            f"simulated {model} in its place"
        ) in done.stderr


@pytest.mark.thorough
@pytest.mark.usefixtures("site")
def test_a_bench_in_real_time_has_them_where_its_command_says(rig: Any) -> None:
    replaced = [
        word
        for role, kind in (("daq", "daq"), ("stage_z", "stage"), ("rotary", "rotary"))
        for word in ("--replace", f"{role}=acme-{kind}")
    ]
    fixture = ("--fixture", "semi-spherical-object")
    simulator = rig.start("simulate", *fixture, *replaced, "--write", "sim.toml")
    simulator.wait_for(r"drive it with --bench sim\.toml")
    bench = tomllib.loads((rig.folder / "sim.toml").read_text())
    assert bench["daq"]["channels"] == {"strip_1": "AI0", "strip_2": "AI1"}
    assert bench["stage_z"]["driver"] == "acme-stage"
    assert bench["stage_x"]["driver"] == "festo-cmmt"
    assert bench["rotary"]["high_limit_deg"] == 30.0
    safe = rig.run("make-safe", "--bench", "sim.toml")
    assert safe.code == 0, safe.stderr


def test_what_a_simulator_raises_while_it_serves_is_named_with_its_file_and_line(
    rig: Any, site: Path
) -> None:
    (module,) = site.rglob("daq_simulator.py")
    source = module.read_text()
    broken = source.replace(
        '            case ["ID?"]:\n', '            case ["ID?"]:\n' + " " * 16 + "1 / 0\n"
    )
    assert broken != source
    module.write_text(broken)
    line = broken.splitlines().index(" " * 16 + "1 / 0") + 1
    (rig.folder / "bench.toml").write_text(CLAMP + packages.FORCE_SENSOR)
    failed = rig.run("sweep", "--frequencies", "200", "--no-figures", "--dry-run")
    assert failed.code == 3, failed.stderr
    (warning,) = (one for one in failed.stderr.splitlines() if one.startswith("warning: simulator"))
    assert "warning: simulator 'acme-daq' of the package acme" in warning
    assert f"daq_simulator.py line {line}: ZeroDivisionError: division by zero" in warning


def test_a_simulator_that_answers_nothing_is_refused_when_it_is_loaded(
    rig: Any, site: Path
) -> None:
    (module,) = site.rglob("daq_simulator.py")
    module.write_text(module.read_text().replace("def answer(", "def answers("))
    refused = rig.run("simulate", "--replace", "daq=acme-daq")
    assert refused.code == 2
    assert "simulator 'acme-daq' of the package acme" in refused.stderr
    assert "lacks answer or exchanges" in refused.stderr
