"""A run records that it makes the bench safe; no failure of that record keeps it from doing so."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core.errors import RigError
from rig.core.settings import Settings
from rig.files.errors import JournalMovedError
from rig.files.journal.reader import read_journal
from rig.run.context import Run
from rig.run.points import Point, Reading


class Disturbed(Example):
    """The first point ends the run, with a recorder that then takes no event."""

    def __init__(self, refusal: Exception | None):
        super().__init__(Settings())
        self._refusal = refusal

    def take(self, run: Run, point: Point) -> Reading:
        put = run._recorder.put_event

        def refuse_once(fields: object) -> None:
            run._recorder.put_event = put  # type: ignore[method-assign]
            assert self._refusal is not None
            raise self._refusal

        if self._refusal is not None:
            run._recorder.put_event = refuse_once  # type: ignore[method-assign]
        raise RigError("it ends here")


def test_the_journal_says_that_the_run_makes_the_bench_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Disturbed(None), tmp_path, monkeypatch)
    assert outcome.journal is not None
    codes = [event.code for event in read_journal(outcome.journal).events]
    assert codes[0] == "making-safe"


@pytest.mark.parametrize(
    "refusal",
    [ValueError("a bug"), JournalMovedError("a.rigj", "it was deleted", Path("b.rigj"))],
    ids=["a bug", "a journal that was moved"],
)
def test_a_recorder_that_takes_no_event_does_not_keep_the_bench_from_being_made_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: Exception
) -> None:
    procedure = Disturbed(refusal)
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert procedure.log[-3:] == ["off", "guard: safe", "guard: done"]
    assert outcome.safe
    reported = any("everything recorded is in b.rigj" in text for text in outcome.warnings)
    assert reported is isinstance(refusal, JournalMovedError)
