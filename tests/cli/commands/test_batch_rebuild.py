"""A batch whose queue is damaged: one line says so, and the queue is made anew from the runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from nights import QUICK_NIGHT, ask, await_point, folder_of, taken, write_night

pytestmark = pytest.mark.thorough

TWO = (
    QUICK_NIGHT
    + """
[[experiment]]
procedure = "sweep"
matrix = { load_N = [0.5, 1.0] }
settings = { frequencies_Hz = [160, 200, 240], settling_s = 4 }
"""
)
ONE = TWO.replace("[0.5, 1.0]", "[0.5]").replace("[160, 200, 240]", "[200]")


def damage(queue: Path) -> None:
    """Overwrite a part of the file, as a failing disk does."""
    for end in ("-wal", "-shm"):
        queue.with_name(queue.name + end).unlink(missing_ok=True)
    with queue.open("r+b") as file:
        file.seek(3000)
        file.write(b"\xa5" * 20_000)


def test_a_damaged_queue_is_one_line_and_is_made_anew_from_the_runs(rig: Any) -> None:
    write_night(rig, TWO)
    running = rig.start("batch", "run", "night.toml")
    running.wait_for(r"^run 2/")
    batch = folder_of(rig.results)
    await_point(batch, 2)
    running.process.terminate()
    assert running.finish().code == 143
    before = taken(batch)
    damage(batch / "queue.sqlite")

    for command in ("status", "resume"):
        refused = rig.run("batch", command)
        assert refused.code == 2, refused.stderr
        (error,) = refused.errors
        assert "queue.sqlite cannot be read as the queue of a batch" in error
        assert f"rebuild it: rig batch rebuild results/{batch.name}" in error
        assert "Traceback" not in refused.stderr

    made = rig.run("batch", "rebuild", str(batch))
    assert made.code == 0, made.stderr
    assert "was rebuilt: 1 queued, 1 done" in made.stderr
    assert (batch / "queue.damaged-1.sqlite").exists()
    again = rig.run("batch", "resume")
    assert again.code == 0, again.stderr
    after = taken(batch)
    assert [run.state for run in after.values()] == ["done"] * 2
    assert all(len(run.points) == len(set(run.points)) == 3 for run in after.values())
    assert after[1].readings == before[1].readings, "not taken again"
    assert ask(batch, "SELECT run, ending FROM attempt ORDER BY run, attempt") == [
        *[(1, "complete"), (2, "died"), (2, "complete")],
    ]


def test_another_batch_file_than_that_of_the_runs_is_refused(rig: Any) -> None:
    write_night(rig, TWO.replace("[0.5, 1.0]", "[0.5]").replace("[160, 200, 240]", "[200]"))
    ended = rig.run("batch", "run", "night.toml")
    assert ended.code == 0, ended.stderr
    assert "\nrun 1: complete, 1 of 1 point\n" in ended.stderr
    finished, saved, safe = ended.stderr.splitlines()[-3:]
    assert finished.startswith("Finished: 1 of 1 run in ")
    assert finished.endswith(" of bench time (simulated).")
    batch = folder_of(rig.results)
    assert saved == f"Saved: results/{batch.name}"
    assert safe == "Bench is safe."
    sound = (batch / "queue.sqlite").read_bytes()
    refused = rig.run("batch", "rebuild")
    assert refused.code == 2
    assert "is sound; there is nothing to rebuild" in refused.stderr
    assert (batch / "queue.sqlite").read_bytes() == sound
    assert not list(batch.glob("queue.*-1*"))

    write_night(rig, TWO)
    damage(batch / "queue.sqlite")
    refused = rig.run("batch", "rebuild")
    assert refused.code == 2
    assert "night.toml differs from" in refused.stderr
    (rig.folder / "copy.toml").write_text((batch / "batch.toml").read_text())
    assert rig.run("batch", "rebuild", "--file", "copy.toml").code == 0
    shown = rig.run("batch", "status")
    assert "1 of 1 run done" in shown.stdout
    assert "not compiled" not in shown.stdout
    assert "figures and results still to be made: 1 run" in shown.stdout
