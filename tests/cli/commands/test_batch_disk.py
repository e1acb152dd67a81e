"""A batch whose disk fills up holds, says why, and continues when there is room again."""

from __future__ import annotations

import contextlib
import json
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from nights import NIGHT, PATIENCE_S, ask, await_point, folder_of, object_of, taken, write_night

pytestmark = pytest.mark.thorough

NOTIFY = """#!{python}
import json, sys
open({path!r}, "a").write(json.dumps(json.load(sys.stdin)) + "\\n")
"""


SLOW_SWEEP = (
    NIGHT
    + """
hold_when = { free_disk_GB = 0 }
[simulation]
world = "world.toml"
[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [160, 180, 200], settling_s = 4 }
"""
)
"""A batch whose run takes long enough to be disturbed."""


@pytest.fixture
def small_disk(rig: Any) -> Iterator[Path]:
    """The folder of results is a file system of its own, of 24 MB."""
    rig.results.mkdir()
    command = ("mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(rig.results))
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("a small file system cannot be mounted here")
    yield rig.results
    subprocess.run(("umount", "-l", str(rig.results)), check=False)


@pytest.fixture
def stalling_disk(rig: Any) -> Iterator[Path]:
    """The folder of results is a file system of its own, which `fsfreeze` can stall."""
    rig.results.mkdir()
    image = rig.folder / "disk.img"
    with image.open("wb") as file:
        file.truncate(64 << 20)
    for command in (
        ("mkfs.ext4", "-q", str(image)),
        ("mount", "-o", "loop", str(image), str(rig.results)),
    ):
        if not shutil.which(command[0]) or subprocess.run(command, check=False).returncode:
            pytest.skip("a disk that can be stalled cannot be made here")
    try:
        if not shutil.which("fsfreeze"):
            pytest.skip("fsfreeze is not installed")
        for what in ("-f", "-u"):
            if subprocess.run(("fsfreeze", what, str(rig.results)), check=False).returncode:
                pytest.skip("a disk cannot be stalled here")
        try:
            yield rig.results
        finally:
            subprocess.run(("fsfreeze", "-u", str(rig.results)), capture_output=True, check=False)
    finally:
        subprocess.run(("umount", "-l", str(rig.results)), check=False)


def fill(folder: Path) -> Path:
    """A file that takes all room that is left."""
    path = folder / "filler"
    with path.open("ab", buffering=0) as file, contextlib.suppress(OSError):
        for size in (1 << 20, 1 << 12, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))
    return path


def test_a_full_disk_holds_the_batch_until_there_is_room(rig: Any, small_disk: Path) -> None:
    reported = rig.folder / "reported.jsonl"
    command = rig.folder / "notify"
    command.write_text(NOTIFY.format(python=sys.executable, path=str(reported)))
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    write_night(
        rig,
        NIGHT
        + f"""
hold_when = {{ free_disk_GB = 0 }}
notify = {{ command = [{str(command)!r}], on = ["hold", "end"] }}
[simulation]
world = "world.toml"
[[experiment]]
procedure = "sweep"
settings = {{ frequencies_Hz = [160, 180, 200, 220], settling_s = 4 }}
""",
    )
    running = rig.start("batch", "run", "night.toml", "--json")
    running.wait_for(r"^run 1/")
    batch = folder_of(rig.results)
    await_point(batch, 1)
    filler = fill(small_disk)
    running.wait_for("the bench is safe and the batch waits; it continues when there is room")
    status = rig.run("batch", "status")
    assert "SIMULATED batch night: held: " in status.stdout, status.stdout
    assert "supervisor has died" not in status.stdout
    beat = json.loads((batch / "heartbeat.json").read_text())
    assert beat["state"] == "holding"
    assert "full" in beat["message"] or "No space left" in beat["message"]
    deadline = time.monotonic() + PATIENCE_S
    while not reported.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    filler.unlink()
    ended = running.finish()
    assert ended.code == 0, ended.stderr
    assert object_of(ended.stdout)["runs"]["done"] == 1
    assert all(len(run.points) == 4 for run in taken(batch).values())
    assert ask(batch, "SELECT number FROM run WHERE processed IS NULL") == []
    first, *_, last = (json.loads(line) for line in reported.read_text().splitlines())
    assert (first["occasion"], last["occasion"]) == ("hold", "end")
    assert "full" in first["text"] or "No space left" in first["text"]
    assert "complete" in last["text"]


def test_a_batch_that_is_held_by_a_full_disk_stops_when_it_is_asked_to(
    rig: Any, small_disk: Path
) -> None:
    write_night(rig, SLOW_SWEEP)
    running = rig.start("batch", "run", "night.toml", "--json")
    running.wait_for(r"^run 1/")
    await_point(folder_of(rig.results), 1)
    filler = fill(small_disk)
    running.wait_for("the bench is safe and the batch waits")
    running.process.terminate()
    ended = running.finish()
    assert ended.code == 143, ended.stderr
    filler.unlink()
    again = rig.run("batch", "resume", "--json")
    assert again.code == 0, again.stderr
    assert object_of(again.stdout)["runs"]["done"] == 1


def test_a_batch_whose_disk_stalls_is_stopped_at_once_without_it(
    rig: Any, stalling_disk: Path
) -> None:
    write_night(rig, SLOW_SWEEP)
    running = rig.start("batch", "run", "night.toml", "--json")
    running.wait_for(r"^run 1/")
    subprocess.run(("fsfreeze", "-f", str(stalling_disk)), check=True)
    status = rig.run("batch", "status")
    assert (status.code, len(status.errors)) == (1, 1)
    assert "results did not answer for 10 s: its disk has stalled" in status.errors[0]
    stopped = rig.run("batch", "stop", "--now")
    assert stopped.code == 0, stopped.stderr
    assert "the process that runs the batch was asked directly" in stopped.stderr
    running.wait_for("stopping: making the bench safe")
    subprocess.run(("fsfreeze", "-u", str(stalling_disk)), check=True)
    ended = running.finish()
    assert ended.code == 143, ended.stderr
    again = rig.run("batch", "resume", "--json")
    assert again.code == 0, again.stderr
    assert object_of(again.stdout)["runs"]["done"] == 1
