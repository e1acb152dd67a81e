"""Starting a simulated bench as a process of its own: what happens where there is nothing to be."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from drivers.simulated.bench import start as simulated
from rig.core.errors import ConfigurationError

PATIENCE_S = 30.0


def test_a_bench_whose_owner_dies_before_it_gives_options_ends() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "drivers.simulated.bench.process"],
        input=b"",
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"", b"")


def test_no_process_is_started_for_a_fault_plan_that_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[object] = []
    monkeypatch.setattr(simulated.subprocess, "Popen", lambda *a, **k: started.append(a))
    plan = tmp_path / "fault.toml"
    plan.write_text('[[fault]]\ndevice = "kettle"\nkind = "stuck"\n')
    with pytest.raises(ConfigurationError, match="kettle"):
        simulated.start({"fault": str(plan), "results": str(tmp_path)})
    assert started == []
