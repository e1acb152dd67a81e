"""The beginning of a batch: what was checked is what begins."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from rig.batch.execute import start
from rig.batch.execute.prepare import PreparedBatch, prepare
from rig.batch.execute.start import begin, refuse_changes
from rig.batch.folder import BatchFolder, new_folder
from rig.batch.plan.read import read_batch
from rig.batch.queue import Queue
from rig.batch.queue_records import RunEstimate
from rig.core.errors import ConfigurationError

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
        with pytest.raises(ConfigurationError, match="changed since the batch began: batch file"):
            refuse_changes(queue, batch)
        file.write_bytes(text.encode())
        refuse_changes(queue, batch)
