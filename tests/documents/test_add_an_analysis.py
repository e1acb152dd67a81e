"""docs/add-an-analysis.md, followed literally."""

from __future__ import annotations

import json
from typing import Any

import pytest
from page import Page

PAGE = "add-an-analysis.md"


@pytest.mark.thorough
def test_the_analysis_is_shown_and_kept_as_the_page_says(rig: Any) -> None:
    page = Page(PAGE, rig)
    assert page.strange_commands() == []
    page.make()
    ended = page.run_rig()
    assert len(ended) == 3
    for command, done in ended.items():
        assert done.code == 0, (command, done.stderr)
    _, shown, _ = ended.values()
    assert "slip-trial.friction (lab-friction 1.0):" in shown.stdout
    kept = json.loads(rig.only("*.analyses.json").read_text())
    found = kept["analyses"]["slip-trial.friction"]
    assert 0.5 < found["values"]["largest_ratio"] < 0.9
    assert found["units"] == {"speed_mm_s": "mm/s"}


@pytest.mark.thorough
def test_the_page_s_own_test_passes(rig: Any) -> None:
    page = Page(PAGE, rig)
    page.make()
    tested = page.run_test()
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert "1 passed" in tested.stdout
