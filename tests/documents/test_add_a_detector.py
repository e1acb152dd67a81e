"""docs/add-a-detector.md, followed literally."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from typing import Any

import pytest
from page import Page

from rig.detector.contract import Detector
from rig.detector.events import EVENT_KINDS
from rig.files.processed.reader import ProcessedFile
from rig.files.runfile.reader import RunFile
from rig.testing.detectors import checks_of

PAGE = "add-a-detector.md"


@pytest.mark.thorough
def test_the_detector_runs_as_the_page_says(rig: Any) -> None:
    page = Page(PAGE, rig)
    assert page.strange_commands() == []
    page.make()
    ended = page.run_rig()
    assert len(ended) == 4
    for command, done in ended.items():
        assert done.code == 0, (command, done.stderr)
    listed, _, _, scored = ended.values()
    assert re.search(r"lab-jump +1 +lab-jump 1\.0 +Reports a slip where v_d jumps", listed.stdout)
    (made,) = rig.results.rglob("*.lab-jump-1-*.h5")
    with ProcessedFile.open(made) as processed:
        events = [event for _, event in processed.events()]
        assert processed.detector.settings.model_dump()["sigmas"] == 12.0
    (run_file,) = rig.results.glob("*/*_slip-trial_*.h5")
    with RunFile.open(run_file) as run:
        (reading,) = run.readings()
    live = [(one["kind"], one["time_s"]) for one in json.loads(reading["detections"])]
    assert live == [(event.kind, event.time_s) for event in events]
    assert "incipient slip" in [kind for kind, _ in live]
    with (rig.results / "score/trials.csv").open() as table:
        named = {row["detector"] for row in csv.DictReader(table)}
    assert {"lab-jump", "paper-hp"} <= named
    assert "lab-jump" in scored.stdout


@pytest.mark.thorough
def test_the_page_s_own_test_and_its_live_example_pass(rig: Any) -> None:
    page = Page(PAGE, rig)
    page.make()
    tested = page.run_test()
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert f"{len(checks_of('paper-hp')) + 1} passed" in tested.stdout
    shown = subprocess.run(
        [sys.executable, str(page.package / "live.py")],
        env=rig.env,
        capture_output=True,
        text=True,
        check=True,
    )
    assert shown.stdout.split() == ["incipient", "slip", "400", "kept", "up"]


def test_the_page_s_tables_name_what_there_is(rig: Any) -> None:
    text = Page(PAGE, rig).text
    table = text[text.index("| member |") : text.index("In `judge`")]
    named = set(re.findall(r"^\| (`[^|]*`) \|", table, re.MULTILINE))
    for cell in named:
        for member in re.findall(r"`(\w+)", cell):
            assert hasattr(Detector, member), member
    assert len(named) >= 9
    for kind in EVENT_KINDS:
        assert f"`{kind}`" in text


def test_a_detector_that_fails_at_once_and_one_with_a_misspelt_hook_are_refused(rig: Any) -> None:
    page = Page(PAGE, rig)
    assert "a detector that fails at those is refused" in page.text
    assert "such as `cutoff`, is refused" in page.text
    judge = "    def judge(self, volts):\n"
    page.make((judge, f"{judge}        1 / 0\n"))
    trial = ("slip-trial", "--detector", "lab-jump", "--no-figures")
    failed = rig.run(*trial)
    assert failed.code == 1
    assert "of the package lab-jump failed at judging: lab_jump/detector.py line" in failed.stderr
    assert not list(rig.folder.rglob("*.rigj")), "nothing was connected"
    page.make((judge, f"    def cutoff(self, now):\n        pass\n\n{judge}"))
    refused = rig.run(*trial)
    assert refused.code == 2
    assert "did you mean 'cut_off'?" in refused.stderr
