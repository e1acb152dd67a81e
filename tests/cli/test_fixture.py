"""Which fixture the simulated bench has mounted, as the command line chooses it."""

from __future__ import annotations

import signal
import tomllib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from rig.bench.settings import Fixture
from rig.core.cache import DiskCache, user_cache
from rig.physics.skin.condensed import CondensedSkin
from rig.run import bench_selector
from rig.run.bench_selector import BenchRequest, BenchSelector

SMALL = "[skin]\nelements_per_ridge = 6\n"


@pytest.fixture(autouse=True)
def cached(monkeypatch: pytest.MonkeyPatch, skin_cache: DiskCache, skin6: CondensedSkin) -> None:
    """The World finds its skin where these tests keep it."""
    monkeypatch.setenv("RIG_CACHE", str(skin_cache.folder))


@pytest.mark.thorough
def test_the_plates_bench_runs_in_real_time_and_is_made_safe(rig: Any) -> None:
    world = rig.world(SMALL)
    simulator = rig.start("simulate", "--fixture", "plate", "--world", world, "--write", "sim.toml")
    simulator.wait_for("drive it")
    written = tomllib.loads((rig.folder / "sim.toml").read_text())
    assert written["fixture"]["mounted"] == "plate"
    refused = rig.run("sweep", "--bench", "sim.toml")
    assert refused.code == 2, refused.stderr
    assert "has the plate mounted, this procedure needs film-clamp" in refused.errors[0]
    safe = rig.run("make-safe", "--bench", "sim.toml")
    assert safe.code == 0, safe.stderr
    assert "daq, stage_z, stage_x, force_sensor made safe" in safe.stderr
    simulator.send(signal.SIGINT)
    assert simulator.finish().code == 0


def test_only_the_first_start_with_a_skin_says_that_it_takes_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class NotStartedError(Exception):
        """Ends each start before there is a process."""

    def not_started(*_: object) -> None:
        raise NotStartedError

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench_selector, "start_simulated", not_started)
    monkeypatch.setenv("RIG_CACHE", str(tmp_path / "cache"))
    said: list[str] = []

    def start(fixture: Fixture) -> str:
        with ExitStack() as at_the_end, pytest.raises(NotStartedError):
            BenchSelector(said.append).select(BenchRequest(), at_the_end, fixture)
        return said.pop()

    first = "(skin above its plate; the first time on a computer it takes up to two minutes)"
    assert first in start("plate")
    assert "first time" not in start("film-clamp")
    user_cache().put("a skin", b"...")
    assert "(skin above its plate)" in start("plate")
    assert "(skin above a head on the rotary stage)" in start("semi-spherical-object")


@pytest.mark.thorough
def test_a_procedure_gets_the_bench_with_its_fixture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "world.toml").write_text(SMALL)
    with ExitStack() as at_the_end:
        bench = BenchSelector(print).select(
            BenchRequest(world=Path("world.toml")), at_the_end, "plate"
        )
    assert bench.plan.settings.fixture.mounted == "plate"
    assert bench.recorded_toml is not None
    assert 'mounted = "plate"' in bench.recorded_toml
    assert bench.lock is None
    assert bench.started is not None
    bench.clock.close()
    bench.started.wait()


BOTH = """
name = "bench-1"
[fixture]
mounted = "plate"
contact_from_mm = 2.0
contact_to_mm = 3.0
parked_mm = 1.0
[[also_mounted]]
mounted = "film-clamp"
contact_from_mm = 12.0
contact_to_mm = 13.0
[film]
[load_cell]
sensitivity_V_N = 0.1
[generator]
driver = "keysight-33500b"
resource = "TCPIP::192.168.0.12::5025::SOCKET"
max_amplitude_V = 5.0
[daq]
driver = "keysight-u2300a"
resource = "USB0::0x0957::0x1518::TW12345678::INSTR"
channels = { load_cell = 101, film = 102 }
[stage_z]
driver = "festo-cmmt"
axis = "z"
host = "192.168.0.20"
low_limit_mm = 0.0
high_limit_mm = 20.0
max_speed_mm_s = 20.0
torque_limit_percent = 45.0
[force_sensor]
driver = "me-gsv8"
port = "/dev/ttyUSB0"
"""


@pytest.mark.thorough
def test_a_procedure_works_on_a_fixture_that_is_mounted_beside_another(rig: Any) -> None:
    (rig.folder / "both.toml").write_text(BOTH)
    swept = rig.run("sweep", "--frequencies", "200", "--dry-run", "--json", "--bench", "both.toml")
    assert swept.code == 0, swept.stderr
    assert swept.object["points_done"] == 1, "contact is where the film clamp's is"
    refused = rig.run("roll-trial", "--dry-run", "--bench", "both.toml")
    assert refused.code == 2, refused.stderr
    assert "has the plate and the film-clamp mounted" in refused.errors[0]
