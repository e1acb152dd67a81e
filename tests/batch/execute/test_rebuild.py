"""A queue that is sound is not rebuilt: its events and presses would be lost for nothing."""

from __future__ import annotations

import contextlib
import sqlite3
from datetime import datetime
from pathlib import Path

import pytest

from rig.batch.execute import rebuild as rebuilding
from rig.batch.execute.rebuild import is_sound, rebuild
from rig.batch.folder import BatchFolder
from rig.batch.plan.read import parse_batch
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.core.errors import ConfigurationError

BATCH = """
[batch]
name = "night"
[[experiment]]
procedure = "slip-trial"
repeat = 2
settings = { trials = 1 }
matrix = { normal_force_N = [2.0, 4.0] }
"""
DONE = AttemptResult("complete", bench_s=5.0)


@pytest.fixture
def complete(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """Numbers of the runs whose own files say that they are complete."""
    numbers = set[int]()

    def outcome(journal: Path) -> AttemptResult:
        return DONE if int(journal.name[1:6]) in numbers else AttemptResult("died", "died")

    monkeypatch.setattr(rebuilding, "outcome_from_journal", outcome)
    return numbers


@pytest.fixture
def batch(tmp_path: Path) -> BatchFolder:
    """A batch of four runs that has not begun."""
    folder = BatchFolder(tmp_path)
    folder.batch_file.write_text(BATCH)
    file, plan, _ = parse_batch(BATCH, "night.toml")
    estimates = dict.fromkeys(plan.conditions, RunEstimate(18.0, 1.0))
    meta = {"name": "night", "file": file.model_dump_json(), "state": "begun"}
    Queue.create(folder.queue, plan, estimates, meta).close()
    return folder


def change(folder: BatchFolder, statement: str) -> None:
    with contextlib.closing(sqlite3.connect(folder.queue)) as sql:
        sql.executescript(statement)


def finish(folder: BatchFolder, *numbers: int) -> None:
    with Queue.open(folder.queue) as queue:
        for number in numbers:
            queue.finish(queue.claim(number), DONE, "done")
        queue.close_log()


def test_a_sound_queue_is_refused_and_nothing_is_touched(
    batch: BatchFolder, complete: set[int]
) -> None:
    finish(batch, 1, 2, 3, 4)
    complete |= {1, 2, 3, 4}
    before = batch.queue.read_bytes()
    files = sorted(path.name for path in batch.path.iterdir())
    with pytest.raises(ConfigurationError, match="is sound; there is nothing to rebuild"):
        rebuild(batch, None, None, datetime.now().astimezone(), print)
    assert batch.queue.read_bytes() == before
    assert sorted(path.name for path in batch.path.iterdir()) == files


def test_a_queue_whose_worker_died_is_sound_and_is_resumed(
    batch: BatchFolder, complete: set[int]
) -> None:
    finish(batch, 1)
    complete.add(1)
    with Queue.open(batch.queue) as queue:
        queue.claim(2)
    assert is_sound(batch)
    complete.add(2)
    assert is_sound(batch), "it died between the end of its run and the queue"


def test_a_queue_that_knows_less_or_more_than_the_files_of_the_runs_is_not_sound(
    batch: BatchFolder, complete: set[int]
) -> None:
    finish(batch, 1)
    assert not is_sound(batch), "the files of run 1 are gone"
    complete |= {1, 2}
    assert not is_sound(batch), "an older copy of the queue, without run 2"


@pytest.mark.parametrize(
    "damage",
    [
        "DROP TABLE event",
        "DROP INDEX run_by_state",
        "DELETE FROM run WHERE number = 3",
        "UPDATE condition SET settings = '{}' WHERE place = 1",
        "UPDATE condition SET settings = '{' WHERE place = 1",
        "DELETE FROM meta WHERE key = 'file'",
        "DELETE FROM condition WHERE place = 1",
    ],
)
def test_a_queue_that_lacks_something_is_not_sound(
    batch: BatchFolder, complete: set[int], damage: str
) -> None:
    assert is_sound(batch)
    change(batch, damage)
    assert not is_sound(batch)


def test_a_batch_whose_stop_by_has_passed_since_is_rebuilt(tmp_path: Path) -> None:
    """Of a batch that an earlier version has begun it is not recorded when that was."""
    folder = BatchFolder(tmp_path)
    folder.batch_file.write_text(
        '[batch]\nname = "night"\nstop_by = 2026-01-14T07:00:00\n'
        '[[experiment]]\nprocedure = "slip-trial"\nsettings = { trials = 1 }\n'
    )
    assert rebuild(folder, None, None, datetime.now().astimezone(), print)["queued"] == 1


def test_a_queue_that_cannot_be_read_or_is_missing_is_not_sound(batch: BatchFolder) -> None:
    content = bytearray(batch.queue.read_bytes())
    content[3000:9000] = b"\xa5" * 6000
    batch.queue.write_bytes(content)
    assert not is_sound(batch)
    batch.queue.unlink()
    assert not is_sound(batch)


def test_a_batch_without_its_queue_is_sent_to_the_rebuild(batch: BatchFolder) -> None:
    batch.queue.unlink()
    with pytest.raises(ConfigurationError, match="holds no batch"):
        Queue.open(batch.queue)
    batch.terms.write_text("{}")
    with pytest.raises(ConfigurationError, match="is the folder of a batch") as refused:
        Queue.open(batch.queue)
    assert f"rig batch rebuild {batch.path}" in (refused.value.hint or "")


def test_a_rebuild_that_is_refused_leaves_the_folder_as_it_was(
    batch: BatchFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise ConfigurationError("run 1: its file has other settings")

    monkeypatch.setattr(rebuilding, "_restore", refuse)
    batch.queue.write_bytes(b"damaged")
    files = sorted(path.name for path in batch.path.iterdir())
    with pytest.raises(ConfigurationError, match="other settings"):
        rebuild(batch, None, None, datetime.now().astimezone(), print)
    assert sorted(path.name for path in batch.path.iterdir()) == files
