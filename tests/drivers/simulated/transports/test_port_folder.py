"""A simulator that was killed leaves no folder behind for longer than until the next start."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.simulated.transports.port_folder import PREFIX, PortFolder

SIMULATOR = """
import sys
from drivers.simulated.transports.port_folder import PortFolder
print(PortFolder().path, flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A temporary folder of this test's own."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def test_the_next_start_removes_what_a_killed_simulator_left_and_nothing_else(
    temporary: Path,
) -> None:
    killed, alive = (
        subprocess.Popen(
            [sys.executable, "-c", SIMULATOR],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    )
    folders = []
    for process in (killed, alive):
        assert process.stdout is not None
        folders.append(Path(process.stdout.readline().strip()))
    (folders[0] / "serial").symlink_to("/dev/null")
    foreign, link = temporary / "tactile-rig-cache-0", temporary / f"{PREFIX}link"
    foreign.mkdir()
    link.symlink_to(foreign)
    killed.kill()
    killed.wait()

    own = PortFolder()
    assert not folders[0].exists()
    assert own.path.exists()
    assert folders[1].exists()
    assert foreign.exists()
    assert link.is_symlink()
    own.remove()
    assert not own.path.exists()
    alive.communicate("")
    PortFolder().remove()
    assert sorted(path.name for path in temporary.iterdir()) == sorted((foreign.name, link.name))


def test_a_folder_that_another_start_removes_before_it_is_locked_is_made_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = []

    def removed_at_first(prefix: str, make: Callable[..., str] = tempfile.mkdtemp) -> str:
        made.append(make(prefix=prefix))
        if len(made) == 1:
            Path(made[0]).rmdir()
        return made[-1]

    monkeypatch.setattr("tempfile.mkdtemp", removed_at_first)
    folder = PortFolder()
    assert [str(folder.path)] == made[1:]
    assert folder.path.exists()
    folder.remove()
