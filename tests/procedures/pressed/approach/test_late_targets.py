"""Whether a z that has not arrived is said to be blocked, or to have waited for its targets."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from procedures.pressed.approach import contact
from procedures.pressed.approach.contact import LateTargetsError, not_there


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(contact, "contact_range_mm", lambda bench: (12.0, 13.0))
    return SimpleNamespace(bench=SimpleNamespace(stage_z=SimpleNamespace(position_mm=lambda: 11.9)))


def test_a_stage_whose_link_is_slow_is_not_said_to_be_blocked(run: Any) -> None:
    late = not_there(run, 3.6, 0.9, 0.1)
    assert isinstance(late, LateTargetsError), "of which no force sensor is suspected"
    assert "had to wait for its targets, which came every 0.9 s and last 0.1 s" in late.message
    assert "blocks" not in (late.hint or "")
    assert "check its connection" in (late.hint or "")


def test_a_stage_that_had_its_targets_in_time_is_blocked(run: Any) -> None:
    for blocked in (not_there(run, 3.6, 0.03, 0.1), not_there(run, 3.6)):
        assert not isinstance(blocked, LateTargetsError)
        assert blocked.hint == "check what blocks the stage; then start again"
