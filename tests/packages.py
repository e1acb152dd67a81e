"""Packages as `pip install` would leave them, in a folder that goes on PYTHONPATH."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from rig.core import entry_points

FORCE_SENSOR = """
[force_sensor]
driver = "me-gsv8"
port = "/dev/ttyUSB0"
nominal_force_N = 50.0
max_force_N = 40.0
matrix_N_mV_V = [[83.2, 0.4, -0.6], [0.4, 79.9, 0.8], [1.5, 0.5, 83.7]]
"""
"""The project's own force sensor, as a table of a bench file."""


def install(
    site: Path, package: str, entry_points: str, modules: Mapping[str, str] | None = None
) -> Path:
    """Put a package with the text of its entry points and its `modules`, source by file name, into
    the folder `site`; the folder."""
    info = site / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    for name, source in (modules or {}).items():
        path = site / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    return site


def drivers_installed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, sources: Mapping[str, str]
) -> Iterator[None]:
    """Install a package with a driver in each of these modules, for as long as a fixture yields."""
    registered = "[rig.drivers]\n" + "".join(f"{module} = {module}\n" for module in sources)
    files = {f"{module}.py": source for module, source in sources.items()}
    monkeypatch.syspath_prepend(install(folder / "site", name, registered, files))
    entry_points._registered.cache_clear()
    yield
    entry_points._registered.cache_clear()
    for module in sources:
        sys.modules.pop(module, None)


def on_path(rig: Any, site: Path) -> None:
    """Let a command line find what is installed in a folder."""
    already = rig.env.get("PYTHONPATH")
    rig.env["PYTHONPATH"] = os.pathsep.join([str(site), *([already] if already else [])])


def film_bench(force_sensor: str) -> str:
    """A bench file with a film in its clamp, instruments that nobody connects to, and a force
    sensor with these settings."""
    generator = """[generator]
driver = "keysight-33500b"
resource = "TCPIP::127.0.0.1::1::SOCKET"
max_amplitude_V = 5.0
"""
    daq = _daq("load_cell = 101, film = 102")
    return clamp_bench(f"{generator}{daq}{_stage('z', 20.0)}[force_sensor]\n{force_sensor}")


def clamp_bench(instruments: str) -> str:
    """A bench file with a film in its clamp and these instruments."""
    return f"{_mounted('film-clamp')}[film]\n[load_cell]\nsensitivity_V_N = 0.1\n{instruments}"


def plate_bench(force_sensor: str) -> str:
    """A bench file with the skin above a plate, instruments that nobody connects to, and a force
    sensor with these settings."""
    instruments = _daq("strip_1 = 101, strip_2 = 102") + _stage("z", 20.0) + _stage("x", 40.0)
    return f"{_mounted('plate')}[skin]\n{instruments}[force_sensor]\n{force_sensor}"


def _mounted(fixture: str) -> str:
    return f"""
name = "real"
[fixture]
mounted = "{fixture}"
contact_from_mm = 12.0
contact_to_mm = 13.0
"""


def _daq(channels: str) -> str:
    return f"""[daq]
driver = "keysight-u2300a"
resource = "TCPIP::127.0.0.1::hislip0,1::INSTR"
channels = {{ {channels} }}
"""


def _stage(axis: str, high_mm: float) -> str:
    return f"""[stage_{axis}]
driver = "festo-cmmt"
axis = "{axis}"
host = "127.0.0.{1 if axis == "z" else 2}"
low_limit_mm = 0.0
high_limit_mm = {high_mm}
max_speed_mm_s = 20.0
torque_limit_percent = 45.0
"""
