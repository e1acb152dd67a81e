"""How often a point with an invalid reading is retaken."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.run.context import Run
from rig.run.points import Point, Reading


class Doubtful(Example):
    """The first three readings are invalid."""

    retries = 0

    def retries_of_invalid(self) -> int:
        return self.retries

    def take(self, run: Run, point: Point) -> Reading:
        reading = super().take(run, point)
        return {**reading, "note": "too noisy" if len(self.log) <= 4 else ""}  # beside "on"

    def why_invalid(self, reading: Reading) -> str:
        return str(reading["note"])


@pytest.mark.parametrize(
    ("retries", "taken", "code"),
    [
        (0, ["first", "second"], ExitCode.FINISHED_WITH_FAILURES),
        (1, ["first", "first", "second", "second"], ExitCode.FINISHED_WITH_FAILURES),
        (3, ["first", "first", "first", "first", "second"], ExitCode.DONE),
    ],
)
def test_a_procedure_says_how_often_an_invalid_point_is_retaken(
    retries: int, taken: list[str], code: ExitCode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = Doubtful(Settings())
    procedure.retries = retries
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert [entry for entry in procedure.log if entry in ("first", "second")] == taken
    assert outcome.code == code
