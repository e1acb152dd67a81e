"""The beginning of a batch: what was checked is what begins."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from rig.batch.execute import start
from rig.batch.execute.prepare import PreparedBatch, prepare
from rig.batch.execute.run_benches import RunBenches
from rig.batch.execute.start import begin, refuse_changes, refuse_missing
from rig.batch.execute.worker import Worker
from rig.batch.folder import BatchFolder, new_folder
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.plan.read import read_batch
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, Claim, RunEstimate
from rig.core.errors import ConfigurationError
from rig.run.bench_selector import BenchRequest

NOW = datetime(2026, 11, 21, 22, 0, tzinfo=UTC)


def test_a_folder_whose_name_cannot_be_recorded_is_refused_before_anything_is_made(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "n\udcfc"  # as on an old disk: a letter in Latin-1
    folder.mkdir()
    file = folder / "night.toml"
    file.write_text('[batch]\nname = "night"\n[[experiment]]\nprocedure = "sweep"\n')
    with pytest.raises(ConfigurationError, match="is not UTF-8 text"):
        prepare(file, None, NOW, lambda _: None)


def test_a_batch_file_that_is_edited_while_it_is_checked_begins_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its copy and its fingerprint would be those of other runs than the queue's."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "night.toml"
    file.write_text('[batch]\nname = "night"\n[[experiment]]\nprocedure = "sweep"\nrepeat = 6\n')
    batch, plan, source = read_batch(file)
    forecast: Any = None
    prepared = PreparedBatch(batch, plan, None, {}, forecast, source.text)

    file.write_text(source.text.replace("repeat = 6", "repeat = 2"))
    with pytest.raises(ConfigurationError, match=r"night\.toml was changed while the batch was"):
        begin(file, prepared, NOW)
    file.unlink()
    with pytest.raises(ConfigurationError, match="cannot read the batch file"):
        begin(file, prepared, NOW)
    assert not list(tmp_path.iterdir()), "no folder of a batch that has not begun"


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_the_copy_of_a_batch_file_is_of_the_text_that_was_compared(
    mark: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that is edited while the batch's folder is made has changed since the batch began."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "night.toml"
    text = mark + '[batch]\r\nname = "night"\r\n[[experiment]]\r\nprocedure = "sweep"\r\n'
    file.write_bytes(text.encode())
    batch, plan, source = read_batch(file)
    estimates = dict.fromkeys(plan.conditions, RunEstimate(18.0, 1.0))
    forecast: Any = None
    prepared = PreparedBatch(batch, plan, None, estimates, forecast, source.text)

    def edit_meanwhile(*given: Any) -> BatchFolder:
        file.write_bytes(text.encode() + b"repeat = 6\r\n")
        return new_folder(*given)

    monkeypatch.setattr(start, "new_folder", edit_meanwhile)
    folder = begin(file, prepared, NOW)
    assert folder.batch_file.read_bytes() == text.encode()
    with Queue.open(folder.queue) as queue:
        with pytest.raises(ConfigurationError, match="changed since the batch began") as changed:
            refuse_changes(queue, batch)
        assert f"batch file ({folder.batch_file} then, {file} now)" in changed.value.message
        file.write_bytes(text.encode())
        refuse_changes(queue, batch)


@pytest.mark.parametrize(
    ("procedure", "settings", "named"),
    [
        ("lab-sweep", {}, "procedure = 'lab-sweep' is unknown"),
        ("sweep", {"extra_s": 2.0}, "sweep, condition two: extra_s"),
        ("slip-trial", {"detector": "lab-jump"}, "lab-jump"),
    ],
)
def test_a_batch_whose_package_was_uninstalled_is_not_resumed_and_loses_no_run(
    tmp_path: Path, procedure: str, settings: dict[str, Any], named: str
) -> None:
    conditions = {
        "one": BatchCondition("one", 0, "sweep", {}, {}),
        "two": BatchCondition("two", 1, procedure, settings, {}),
    }
    runs = (PlannedRun(1, "one", 1), PlannedRun(2, "two", 1))
    estimates = dict.fromkeys(conditions, RunEstimate(10.0, 2.0))
    path = tmp_path / "queue.sqlite"
    with Queue.create(path, BatchPlan(conditions, runs), estimates, {}) as queue:
        with pytest.raises(ConfigurationError, match="the runs that are left cannot be") as refused:
            refuse_missing(queue, ("queued", "running"))
        assert named in refused.value.message
        assert queue.counts()["queued"] == 2
        queue.finish(queue.claim(2), AttemptResult("failed"), "failed")
        refuse_missing(queue, ("queued", "running"))
        with pytest.raises(ConfigurationError):
            refuse_missing(queue, ("queued", "failed"))


def test_a_run_whose_package_is_gone_fails_alone(tmp_path: Path) -> None:
    """Neither the run before it, during which its bench is started, nor the batch."""
    lost = Claim(2, 1, 1, BatchCondition("two", 1, "lab-sweep", {}, {}), 10.0, 2.0)
    benches = RunBenches.__new__(RunBenches)
    benches._ahead = None
    benches._simulated = lambda _: BenchRequest()  # type: ignore[method-assign]
    benches.boot(lost)
    assert benches._ahead is None

    sent: list[str] = []
    worker = Worker.__new__(Worker)
    worker._folder = BatchFolder(tmp_path)
    worker._send = lambda _, **fields: sent.append(fields["points"])
    worker._finished(lost, AttemptResult("failed", "usage", 2, "'lab-sweep' is unknown"), "failed")
    assert sent == ["0 of 0 points"]


def test_a_program_whose_files_were_edited_since_is_seen_to_be_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = '[batch]\nname = "night"\n[[experiment]]\nprocedure = "sweep"\n'
    (tmp_path / "night.toml").write_text(text)
    batch, plan, source = read_batch(tmp_path / "night.toml")
    monkeypatch.chdir(tmp_path)
    commit = "9c142c0df5a1b2c3d4e5f60718293a4b5c6d7e8f"
    monkeypatch.setattr(start, "source_state", lambda: commit)
    estimates = dict.fromkeys(plan.conditions, RunEstimate(18.0, 1.0))
    forecast: Any = None
    prepared = PreparedBatch(batch, plan, None, estimates, forecast, source.text)
    folder = begin(tmp_path / "night.toml", prepared, NOW)
    monkeypatch.setattr(start, "source_state", lambda: f"{commit}+dirty")
    with Queue.open(folder.queue) as queue, pytest.raises(ConfigurationError) as refused:
        refuse_changes(queue, batch)
    assert f"{commit} then, " in refused.value.message
    assert f"{commit}+dirty now" in refused.value.message
