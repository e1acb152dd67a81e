"""The simulated bench that a command line begins before it has been understood."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from drivers.simulated.bench import start as simulated
from rig.cli import beginning
from rig.core.errors import ConfigurationError

PATIENCE_S = 30.0


@pytest.fixture
def benches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Those that were begun, in a folder without a bench file."""
    monkeypatch.chdir(tmp_path)
    begun: list[str] = []
    monkeypatch.setattr(simulated, "begin", lambda: begun.append("begun"))
    return begun


@pytest.mark.parametrize(
    "words", [("sweep",), ("--json", "slip-trial", "-n", "2"), ("roll-trial",)]
)
def test_a_procedure_without_a_bench_begins_one(benches: list[str], words: tuple[str, ...]) -> None:
    beginning.begin_bench(words)
    assert benches == ["begun"]


@pytest.mark.parametrize(
    "words",
    [
        (), ("--help",), ("show", "a.h5"), ("batch", "run"), ("resume", "sweep"), ("nonsense",),
        ("sweep", "--help"), ("sweep", "--bench", "b.toml"), ("sweep", "--bench=b.toml"),
    ],
)  # fmt: skip
def test_what_needs_none_begins_none(benches: list[str], words: tuple[str, ...]) -> None:
    assert beginning.begin_bench(words) is None
    assert benches == []


def test_a_bench_file_here_begins_none(benches: list[str]) -> None:
    Path("bench.toml").touch()
    assert beginning.begin_bench(("sweep",)) is None
    assert benches == []


def test_one_that_is_never_told_how_to_be_ends_with_its_owner() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "drivers.simulated.bench.process"],
        input=b"",
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"", b"")


def test_one_whose_options_are_refused_is_ended(tmp_path: Path) -> None:
    begun = simulated.begin()
    plan = tmp_path / "fault.toml"
    plan.write_text('[[fault]]\ndevice = "kettle"\nkind = "stuck"\n')
    options = {"fault": str(plan), "results": str(tmp_path)}
    with pytest.raises(ConfigurationError, match="kettle"):
        simulated.start(options, begun)
    assert begun._process.poll() is not None
