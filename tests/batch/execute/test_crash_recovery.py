"""What is known of a run whose worker died, from its files alone."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest
import recorded_run

from rig.batch.execute import crash_recovery
from rig.batch.execute.crash_recovery import outcome_from_journal
from rig.core.settings import Settings
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run


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


@pytest.mark.parametrize("compiled", [False, True])
def test_the_time_on_hold_is_not_what_a_run_takes(tmp_path: Path, compiled: bool) -> None:
    """Later runs of its condition would be expected to take as long."""
    journal = tmp_path / "a.rigj"
    with JournalWriter.create(journal, recorded_run.header()) as writer:  # begins at 22:00
        for time_s, code in [
            (2.0, "on-hold"),
            (7202.0, "hold-over"),
            (7203.0, "on-hold"),  # its process dies
            (7230.0, "on-hold"),
            (7240.0, "hold-over"),
            (7250.0, "state"),
        ]:
            writer.event(recorded_run.event(time_s) | {"code": code})
        writer.sync()
    if compiled:
        compile_run(journal)
        journal.unlink()
    whole = outcome_from_journal(journal)
    assert (whole.bench_s, whole.on_hold_s) == (40.0, 7210.0)
    assert whole.elapsed_s == 7250.0
    later = outcome_from_journal(journal, datetime.fromisoformat("2026-11-22T00:00:35+01:00"))
    assert (later.bench_s, later.on_hold_s) == (10.0, 5.0)
