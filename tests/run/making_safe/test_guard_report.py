"""What the report of a guard has a person do."""

from __future__ import annotations

from pathlib import Path

from rig.files.file_kind import BATCH_QUEUE
from rig.run.making_safe.guard_report import in_words


def words_for(journal: Path) -> str:
    report = {"time": "22:10", "cause": "the run ended without saying so", "safe": True}
    files = {"journal": str(journal), "file": str(journal.with_suffix(".h5"))}
    return in_words(report | {"failures": {}} | files)


def test_a_run_of_a_batch_is_continued_by_its_batch_and_any_other_by_itself(tmp_path: Path) -> None:
    """The batch continues its own run: a person who resumed it alone would do so beside the
    queue."""
    journal = tmp_path / "runs" / "r00001_sweep.rigj"
    assert words_for(journal).endswith(f"; continue with: rig resume {journal}")
    (tmp_path / BATCH_QUEUE).touch()
    assert words_for(journal).endswith(f"; continue with: rig batch resume {tmp_path}")
