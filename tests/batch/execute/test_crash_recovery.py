"""What is known of a run whose worker died, from its files alone."""

from __future__ import annotations

from pathlib import Path

import pytest
import recorded_run

from rig.batch.execute import crash_recovery
from rig.batch.execute.crash_recovery import outcome_from_journal
from rig.core.settings import Settings


class Defective:
    """A procedure of another package whose results have a bug."""

    name, Settings = "sweep", Settings

    def __init__(self, settings: Settings):
        self.settings = settings

    def summarise(self, readings: object) -> None:
        """Fail."""
        raise ZeroDivisionError


def test_a_bug_in_the_results_does_not_end_the_worker_that_settles_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each further worker would die of it, and with the third one the batch."""
    journal = recorded_run.write_run(tmp_path / "a.rigj", settings={}, setting_units={})
    monkeypatch.setattr(crash_recovery, "installed", lambda name: Defective)
    ended = outcome_from_journal(journal)
    assert (ended.ending, ended.points_done, ended.summary) == ("complete", 5, {})
