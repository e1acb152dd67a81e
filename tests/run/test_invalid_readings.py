"""How often a point with an invalid reading is retaken, and where the reason is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from made_up import LAYOUT, Example, run_of

from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.settings import Settings
from rig.files.journal.layout import Column
from rig.files.runfile.reader import RunFile
from rig.run.checked_procedure import CheckedProcedure
from rig.run.context import Run
from rig.run.observers import RunObserver
from rig.run.points import Point, Reading, RetakeError
from rig.run.procedure import Procedure


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
    repeated = {one for one in taken if taken.count(one) > 1}
    words = "an attempt was invalid: too noisy"
    assert {one for one in taken if f"{one}: {words}" in outcome.warnings} == repeated


class Ends(Doubtful):
    """A procedure whose second point cannot be measured."""

    def take(self, run: Run, point: Point) -> Reading:
        if point.id == "second":
            raise ConfigurationError("not today")
        return super().take(run, point)


class Watched(RunObserver):
    """What a person sees during the run."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def event(self, level: str, message: str) -> None:
        self.said.append(f"{level}: {message}")

    def point_recorded(self, number: int, total: int, point: Point, reading: Reading) -> None:
        self.said.append(f"{number}/{total} {point.id}")


def test_why_a_recorded_reading_is_invalid_is_said_at_once_and_however_the_run_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Watched()
    outcome = run_of(Ends(Settings()), tmp_path, monkeypatch, watched)
    assert outcome.status == "failed"
    why = "first is invalid: too noisy"
    assert watched.said[:2] == ["1/2 first", f"warning: {why}"]
    assert outcome.warnings == [why]
    assert outcome.file is not None
    with RunFile.open(outcome.file) as run:
        assert run.outcome.warnings == (why,)


class GivesUp(Example):
    """A procedure that gives up the first attempts at each point, as long as it has reason to."""

    attempts = 2

    def take(self, run: Run, point: Point) -> Reading:
        reading = super().take(run, point)
        if self.log.count(point.id) <= self.attempts:
            raise RetakeError("the samples came too late")
        return reading


def test_an_attempt_that_the_procedure_gives_up_is_retaken_without_arming(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = GivesUp(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert outcome.code == ExitCode.DONE
    assert procedure.log[:8] == ["on", *["first"] * 3, *["second"] * 3, "off"]
    assert outcome.warnings == [
        f"{name}: an attempt was given up: the samples came too late"
        for name in ("first", "second")
    ]
    with RunFile.open(tmp_path / str(outcome.file)) as run:
        assert len(run.readings()) == 2


def test_a_procedure_that_gives_up_every_attempt_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = GivesUp(Settings())
    procedure.attempts = 1000
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert outcome.code != ExitCode.DONE
    (failure,) = outcome.failures
    words = "first: given up 11 times, the last time because the samples came too late"
    assert failure.message == words
    assert procedure.log.count("first") == 11


class Lamp(Doubtful):
    """The lamp may still be hot when everything is switched off."""

    def arm(self, run: Run) -> None:
        super().arm(run)
        hot = RigError("the lamp may still be hot", None, ExitCode.INSTRUMENT)
        run.arm("fan", lambda: run.ending.fail(hot))


def test_what_follows_an_invalid_reading_determines_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Code 5 alone would say that the run is complete and nothing else is wrong."""
    outcome = run_of(Lamp(Settings()), tmp_path, monkeypatch)
    assert "first is invalid: too noisy" in outcome.warnings
    assert [failure.message for failure in outcome.failures] == ["the lamp may still be hot"]
    assert (outcome.status, outcome.code) == ("failed", ExitCode.INSTRUMENT)


class Judged(Doubtful):
    """A procedure with a column for the reason, which `take` fills otherwise than its hook says."""

    layout = replace(LAYOUT, columns=(*LAYOUT.columns, Column("invalid", "", "Why", "text")))

    def take(self, run: Run, point: Point) -> Reading:
        return {**super().take(run, point), "invalid": "" if point.id == "first" else "a doubt"}

    def why_invalid(self, reading: Reading) -> str:
        assert reading["invalid"] in ("", "a doubt")  # the hook is asked once, before it is filled
        return "too noisy" if reading["x_V"] == 1 else ""

    def summarise(self, readings: Any) -> Mapping[str, Any]:
        return {"invalid": [reading["invalid"] for reading in readings]}


def test_the_file_the_summary_and_the_exit_code_have_the_reason_of_the_procedure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Judged(Settings()), tmp_path, monkeypatch)
    assert outcome.code == ExitCode.FINISHED_WITH_FAILURES
    assert outcome.warnings == ["first is invalid: too noisy"]
    assert outcome.summary == {"invalid": ["too noisy", ""]}
    assert outcome.file is not None
    with RunFile.open(outcome.file) as run:
        assert list(run.column("invalid")) == ["too noisy", ""]


class Unjudged(Judged):
    """The same without a judgement of its own."""

    why_invalid = Procedure.why_invalid


def test_a_column_that_take_has_filled_stays_where_nothing_else_is_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Unjudged(Settings()), tmp_path, monkeypatch)
    assert outcome.summary == {"invalid": ["", "a doubt"]}


class Failing(Judged):
    """A procedure whose judgement of the first reading fails."""

    def why_invalid(self, reading: Reading) -> str:
        return "" if reading["x_V"] != 1 else str(1 / 0)


def test_a_reading_that_cannot_be_judged_is_kept_and_is_invalid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Failing(Settings()), tmp_path, monkeypatch)
    assert outcome.code == ExitCode.FINISHED_WITH_FAILURES
    (first, second) = outcome.summary["invalid"]
    assert first.startswith("it could not be judged: ")
    assert "ZeroDivisionError" in first
    assert second == ""


def test_a_reading_of_an_earlier_version_whose_column_is_empty_is_judged_again() -> None:
    checked = CheckedProcedure(Judged(Settings()))
    assert checked.why_invalid({"x_V": 1, "invalid": ""}) == "too noisy"
    assert checked.why_invalid({"x_V": 2, "invalid": "a doubt"}) == "a doubt"


@pytest.mark.parametrize(
    ("returned", "reason"),
    [
        (True, "why_invalid() returned True (a bool), not the reason as text"),
        (["noise"], "why_invalid() returned ['noise'] (a list), not the reason as text"),
        (False, ""),
        (None, ""),
    ],
)
def test_a_judgement_that_is_not_a_text_is_named(
    monkeypatch: pytest.MonkeyPatch, returned: Any, reason: str
) -> None:
    monkeypatch.setattr(Judged, "why_invalid", lambda self, reading: returned)
    assert CheckedProcedure(Judged(Settings())).why_invalid({"x_V": 1}) == reason


class Broken(Example):
    """A procedure whose first point cannot be measured, and whose summary needs a reading."""

    def take(self, run: Run, point: Point) -> Reading:
        raise ConfigurationError("not today")

    def summarise(self, readings: Any) -> Mapping[str, Any]:
        return {"largest": max(reading["x_V"] for reading in readings)}


def test_a_run_without_a_reading_is_not_summarised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Broken(Settings()), tmp_path, monkeypatch)
    assert [failure.message for failure in outcome.failures] == ["not today"]
    assert outcome.warnings == []
    assert outcome.summary == {}
