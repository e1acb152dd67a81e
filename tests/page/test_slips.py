"""Slips on the page's time axis are those that `rig detect` finds in the file afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest
import recorded_trials as trials

from rig.detector import DEFAULT_DETECTOR
from rig.detector.registered import chosen_detector
from rig.files.journal.follow import JournalTail
from rig.files.journal.format import JournalRecord, PointBegin
from rig.files.journal.values import JournalEvent
from rig.files.runfile.reader import RunFile
from rig.page.frames import Cursor, next_frame
from rig.page.slips import SHOWN, SlipFollower, SlipSearch
from rig.page.view import MOST_EVENTS, RunView
from rig.page.watch import BenchWatch
from rig.processing.detection import detect_trials


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    """The journal of a slip trial, beside its run file: a slip in the first trial, none in the
    second."""
    path = tmp_path / "results" / "day" / "a_slip-trial_r001.rigj"
    path.parent.mkdir(parents=True)
    return path


def written(journal: Path, **changes: object) -> Path:
    """Write the journal, and its run file; the run file."""
    of_it = {"trial-001": trials.slipping(), "trial-002": trials.quiet(seed=2)}
    return trials.write_trials(journal, of_it, complete=False, **changes)  # type: ignore[arg-type]


def records(journal: Path) -> list[JournalRecord]:
    with JournalTail(journal) as tail:
        return tail.poll()


@pytest.mark.parametrize("missing", [0, 5])
def test_the_slips_of_a_run_under_way_are_those_of_its_file(journal: Path, missing: int) -> None:
    with RunFile.open(written(journal, missing=missing)) as run:
        settings = chosen_detector(DEFAULT_DETECTOR)
        expected = [
            (trial.id, SHOWN[event.kind], event.time_s)
            for trial in detect_trials(run, settings)
            for event in trial.events
            if event.kind in SHOWN
        ]
    search = SlipSearch()
    found = [slip for record in records(journal) for slip in search.take(record)]
    assert [(slip.point, slip.what, slip.in_record_s) for slip in found] == expected
    if not missing:
        assert "incipient slip" in [slip.what for slip in found]
    # The block of the rows behind the 700th was recorded at 0.7 s, with its last row.
    rows = len(trials.slipping())
    assert [slip.time_s for slip in found] == pytest.approx(
        [0.7 - (rows - 1) / trials.RATE_HZ + slip.in_record_s for slip in found]
    )


def test_slips_that_the_run_has_recorded_are_shown_and_not_looked_for_again(journal: Path) -> None:
    written(journal, settings={"detector": "paper-hp"})
    search = SlipSearch()
    assert [slip for record in records(journal) for slip in search.take(record)] == []
    view = RunView()
    for code in ("slip-detected", "early-warning", "slip-rejected", "servo"):
        message = f"trial-001: {code}"
        view.take(JournalEvent(time=2.5, level="info", code=code, message=message))
    shown = [(event["code"], event["t"], event["text"]) for event in view.slips]
    assert shown == [
        ("incipient slip", 2.5, "trial-001: slip-detected"),
        ("motion under load begun", 2.5, "trial-001: early-warning"),
    ]
    assert [event["code"] for event in view.events] == ["servo"]


def test_a_retaken_trial_is_judged_from_its_own_begin(journal: Path) -> None:
    written(journal)
    of_it = records(journal)
    begins = [n for n, record in enumerate(of_it) if isinstance(record, PointBegin)]
    first = of_it[: begins[1] - 1]  # without its end: a resumed run takes it again from its begin
    search = SlipSearch()
    found = [slip.what for record in first for slip in search.take(record)]
    again = [slip.what for record in first[begins[0] :] for slip in search.take(record)]
    assert "incipient slip" in found
    assert again == found


def test_slips_are_events_of_the_page_and_push_no_hold_out(journal: Path) -> None:
    written(journal)
    watch = BenchWatch(journal.parents[1])
    follower = SlipFollower(watch)
    while watch.behind:
        watch.poll()
    watch.view.note("warning", "on-hold", "silent sensor")
    while follower.look():
        pass
    follower.close()
    cursor = Cursor()
    events = next_frame(watch, cursor, may_stop=False, polled_s=0.0)["events"]
    (slip,) = [event for event in events if event["code"] == "incipient slip"]
    assert slip["text"].startswith("trial-001: at 0.90")
    for n in range(2 * MOST_EVENTS):
        watch.view.note_slip(float(n), "incipient slip", "trial-002")
    assert "on-hold" in [event["code"] for event in watch.view.events]
    further = next_frame(watch, cursor, may_stop=False, polled_s=0.0)["events"]
    assert len(further) == MOST_EVENTS
    assert next_frame(watch, cursor, may_stop=False, polled_s=0.0)["events"] == []


def test_strips_that_cannot_be_judged_are_said_and_the_run_is_shown(journal: Path) -> None:
    written(journal, rate_Hz=100.0)
    watch = BenchWatch(journal.parents[1])
    follower = SlipFollower(watch)
    while watch.behind:
        watch.poll()
    for _ in range(3):
        follower.look()
    said = [event["text"] for event in watch.view.events if event["code"] == "page"]
    assert len(said) == 1
    assert "rate 100 Hz must be between 500 and 50000 Hz" in said[0]
    watch.poll()
    assert watch.word.word != "unknown"
