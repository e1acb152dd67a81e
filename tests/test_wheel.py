"""A wheel, built by a build front end and installed outside the repository."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import h5py
import pytest

import rig
from rig.run.source_state import commit_of, source_state

REPOSITORY = Path(__file__).parents[1]


def run(*command: str | Path, cwd: Path) -> str:
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True, check=False, env=clean
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.thorough
def test_a_wheels_files_state_version_and_commit(tmp_path: Path) -> None:
    """Built as `uv build` does it: a source archive, and the wheel from that."""
    own = REPOSITORY / ".uv" / "bin" / "uv"
    uv = str(own) if own.exists() else shutil.which("uv")
    if uv is None:
        pytest.skip("uv is needed to build")
    built, bench = tmp_path / "built", tmp_path / "bench"
    bench.mkdir()
    build = [uv, "build", "--quiet", "--no-build-isolation", "--python", sys.executable]
    run(*build, "--out-dir", built, REPOSITORY, cwd=tmp_path)
    (wheel,) = built.glob("*.whl")
    assert len(list(built.glob("*.tar.gz"))) == 1

    venv = tmp_path / "venv"
    python = venv / "bin" / "python"
    run(uv, "venv", "--quiet", "--python", sys.executable, venv, cwd=tmp_path)
    run(uv, "pip", "install", "--quiet", "--no-deps", "--python", python, wheel, cwd=tmp_path)
    # Its dependencies are those of this environment, whose editable tactile-rig stays out: the
    # .pth files of a folder that a .pth names are not read.
    (site,) = venv.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    where = run(python, "-c", "import rig; print(rig.__file__)", cwd=bench)
    assert where.startswith(str(venv))

    ended = run(
        *(venv / "bin" / "rig", "sweep", "--frequencies", "200,300", "--no-figures", "--json"),
        cwd=bench,
    )
    with h5py.File(bench / json.loads(ended)["file"]) as file:
        for program in (file["entry/program_name"], file["entry/results/program"]):
            assert program.attrs["configuration"] == commit_of(REPOSITORY)
        assert file["entry/program_name"].attrs["version"] == rig.__version__
        assert file.attrs["creator_version"] == rig.__version__
    assert list(REPOSITORY.glob("rig/commit.txt")) == []


def test_a_checkout_asks_git_and_an_installation_reads_what_the_build_wrote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert source_state() == commit_of(REPOSITORY)
    assert len(source_state().removesuffix("+dirty")) == 40
    assert commit_of(tmp_path) == ""
    module = sys.modules["rig.run.source_state"]
    monkeypatch.setattr(module, "commit_of", lambda folder: "")
    monkeypatch.setattr(module, "BUILT_FROM", tmp_path / "commit.txt")
    assert source_state.__wrapped__() == ""
    (tmp_path / "commit.txt").write_text("abc+dirty\n")
    assert source_state.__wrapped__() == "abc+dirty"
