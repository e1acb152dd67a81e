"""Which fixture the simulated bench has mounted, as the command line chooses it."""

from __future__ import annotations

import signal
import tomllib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from rig.cache import DiskCache
from rig.model.skin.condensed import CondensedSkin
from rig.runner.bench_choice import BenchRequest, Choosing

SMALL = "[skin]\nelements_per_ridge = 6\n"


@pytest.fixture(autouse=True)
def cached(monkeypatch: pytest.MonkeyPatch, skin_cache: DiskCache, skin6: CondensedSkin) -> None:
    """The World finds its skin where these tests keep it."""
    monkeypatch.setenv("RIG_CACHE", str(skin_cache.folder))


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


def test_a_procedure_gets_the_bench_with_its_fixture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "world.toml").write_text(SMALL)
    with ExitStack() as at_the_end:
        bench = Choosing(print).bench_for(
            BenchRequest(world=Path("world.toml")), at_the_end, "plate"
        )
    assert bench.plan.settings.fixture.mounted == "plate"
    assert bench.recorded_toml is not None
    assert 'mounted = "plate"' in bench.recorded_toml
    assert bench.lock is None
    assert bench.started is not None
    bench.clock.close()
    bench.started.wait()
