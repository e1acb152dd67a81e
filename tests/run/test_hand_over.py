"""A run that could not make its bench safe leaves it to the guard: what that is worth."""

from __future__ import annotations

from pathlib import Path

import made_up
import pytest

from rig.core.errors import ExitCode, InstrumentError, RigError, UnsafeError
from rig.core.settings import Settings
from rig.run.context import Run
from rig.run.guard import TakenOver

STILL_OVER = UnsafeError("stage_z: unload: 20 N, over the limit of 15 N", "move it away by hand")
NO_ANSWER = InstrumentError("stage_z", "stop", "no answer within 1 s", "check its cable")


class Pressing(made_up.Example):
    """Presses something that its shutdown action does not release."""

    why: RigError

    def arm(self, run: Run) -> None:
        def off() -> None:
            raise self.why

        run.arm("normal force", off, done="normal force released")


@pytest.mark.parametrize(
    ("why", "released", "safe"),
    [
        (STILL_OVER, False, False),
        (STILL_OVER, True, True),
        (NO_ANSWER, False, True),
    ],
)
def test_a_force_that_remains_over_its_limit_is_safe_only_where_z_was_seen_clear(
    why: RigError, released: bool, safe: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = TakenOver(True, "the guard then made the bench safe", released)
    monkeypatch.setattr(made_up.Guard, "taken_over", taken)
    procedure = Pressing(Settings())
    procedure.why = why
    outcome = made_up.run_of(procedure, tmp_path, monkeypatch)
    assert outcome.code is ExitCode.UNSAFE
    assert outcome.taken_over is not None
    assert outcome.taken_over.safe is safe
    assert safe or "was not released: move it away by hand" in outcome.taken_over.summary
