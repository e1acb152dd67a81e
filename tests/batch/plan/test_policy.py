"""What the end of a run means for the night."""

from __future__ import annotations

import errno
from typing import Any

import pytest

from rig.batch.plan.policy import (
    FailureDecision,
    FailureKind,
    after_failure,
    kind_of,
    reason_to_end,
    remedy_at_the_end,
)
from rig.batch.plan.settings import BatchSettings
from rig.core.errors import (
    ConfigurationError,
    ExitCode,
    InstrumentError,
    InstrumentTimeoutError,
    LimitError,
    RigError,
)
from rig.files.errors import RecordingError
from rig.run.interlocks.watch import InterlockError
from rig.run.locks.lock import BenchInUseError


def batch(**given: Any) -> BatchSettings:
    return BatchSettings.model_validate({"name": "night", **given})


@pytest.mark.parametrize(
    ("code", "failure", "kind"),
    [
        (3, InstrumentTimeoutError("daq", "read", "silent"), "timeout"),
        (3, InstrumentError("daq", "read", "garbage"), "instrument"),
        (4, LimitError("too much"), "limit"),
        (4, InterlockError("interlock door (person) opened"), "interlock"),
        (2, ConfigurationError("unknown"), "usage"),
        (2, BenchInUseError("the bench b is in use by pid 12"), "in-use"),
        (1, RigError("a defect"), "internal"),
        (1, RecordingError("run.rigj", "disk full"), "storage"),
        (7, InstrumentTimeoutError("stage_z", "stop", "silent"), "unsafe"),
    ],
)
def test_the_first_cause_says_the_kind_but_an_unsafe_bench_comes_before(
    code: int, failure: RigError, kind: FailureKind
) -> None:
    assert kind_of(code, [failure, LimitError("what came of it")]) == kind


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENOSPC, "storage"),
        (errno.EMFILE, "recording"),
        (errno.ENFILE, "recording"),
        (errno.ENOLCK, "recording"),
    ],
)
def test_data_that_no_room_on_the_disk_would_save_are_another_kind(
    number: int, kind: FailureKind
) -> None:
    failure = RecordingError("run.rigj", "it cannot be locked")
    failure.__cause__ = RecordingError("run.rigj", "the same")
    failure.__cause__.__cause__ = OSError(number, "refused")
    assert kind_of(ExitCode.INTERNAL, [failure]) == kind


def test_a_bench_that_the_guard_made_safe_is_one_that_can_be_continued_with() -> None:
    failure = InstrumentTimeoutError("stage_x", "stop", "silent")
    assert kind_of(ExitCode.UNSAFE, [failure], made_safe=True) == "instrument"


@pytest.mark.parametrize(("kind", "tries"), [("timeout", 3), ("instrument", 2), ("died", 3)])
def test_what_may_pass_is_tried_again_so_often(kind: FailureKind, tries: int) -> None:
    for attempt in range(1, tries):
        assert after_failure(batch(), kind, {kind: attempt}, 0, 0, "x") == FailureDecision("again")
    assert after_failure(batch(), kind, {kind: tries}, 0, 0, "x").run == "failed"


@pytest.mark.parametrize("kind", ["limit", "usage", "internal"])
def test_what_would_happen_again_is_never_tried_again(kind: FailureKind) -> None:
    assert after_failure(batch(), kind, {kind: 1}, 0, 0, "x").run == "failed"


def test_a_persons_interlock_ends_the_night_and_the_run_is_taken_again_after_a_new_start() -> None:
    forgiving = batch(on_failure="continue", retries={"instrument": 3})
    decision = after_failure(forgiving, "interlock", {"interlock": 1}, 0, 0, "door; reset it")
    assert decision == FailureDecision("again", "end", "door; reset it")


def test_tries_of_one_kind_are_not_those_of_another() -> None:
    assert after_failure(batch(), "timeout", {"timeout": 1, "died": 9}, 0, 0, "x").run == "again"


def test_a_condition_is_set_aside_with_its_last_allowed_failure() -> None:
    assert not after_failure(batch(), "limit", {"limit": 1}, 0, 0, "x").set_aside
    assert after_failure(batch(), "limit", {"limit": 1}, 1, 0, "x").set_aside


@pytest.mark.parametrize(
    ("given", "in_a_row", "becomes"),
    [
        ({}, 1, "go-on"),
        ({}, 2, "hold"),
        ({"on_failure": "hold"}, 0, "hold"),
        ({"on_failure": "stop"}, 0, "end"),
        ({"hold_when": {"consecutive_failures": 1}}, 0, "hold"),
    ],
)
def test_what_a_failure_means_for_the_batch(
    given: dict[str, Any], in_a_row: int, becomes: str
) -> None:
    assert after_failure(batch(**given), "limit", {"limit": 1}, 0, in_a_row, "x").batch == becomes


def test_a_full_disk_holds_and_an_unsafe_bench_ends_the_batch_and_neither_costs_the_run() -> None:
    for kind, becomes in (("storage", "hold"), ("recording", "hold"), ("unsafe", "end")):
        verdict = after_failure(batch(), kind, {kind: 1}, 5, 5, "x")  # type: ignore[arg-type]
        assert (verdict.run, verdict.batch) == ("again", becomes)


@pytest.mark.parametrize(
    ("kind", "given"), [("unsafe", {}), ("limit", {"on_failure": "stop"}), ("limit", {})]
)
def test_a_long_reason_of_a_run_is_cut_in_the_headline_of_its_batch(
    kind: FailureKind, given: dict[str, Any]
) -> None:
    reason = "stage_z: no answer; check its cable; " + "generator: the connection failed; " * 50
    why = after_failure(batch(**given), kind, {kind: 1}, 0, 2, reason).why
    assert "stage_z: no answer; check its cable" in why
    assert len(why) < 300


def test_a_bench_that_another_program_has_costs_no_run_and_the_batch_waits_for_a_person() -> None:
    why = "the bench b is in use by pid 12 (ann)"
    assert after_failure(batch(), "in-use", {"in-use": 9}, 5, 5, why) == FailureDecision(
        "again", "hold", why
    )


@pytest.mark.parametrize(
    ("when", "reported"),
    [
        ({"finished_runs": 3}, "3 runs are finished"),
        ({"failed_runs": 2}, "2 runs have failed"),
        ({"bench_hours": 2.0}, "in use for 2.00 h"),
        ({"finished_runs": 4, "failed_runs": 3, "bench_hours": 2.1}, ""),
    ],
)
def test_stop_conditions_tell_what_was_met(when: dict[str, Any], reported: str) -> None:
    why = reason_to_end(batch(stop_when=when), done=3, failed=2, bench_s=7200.0)
    assert reported in why
    assert bool(why) == bool(reported)
    if why:
        remedy = remedy_at_the_end(batch(stop_when=when), done=3, bench_s=7200.0)
        assert "begin a new batch with the runs that are left" in remedy
        assert ("--retry-failed" in remedy) == ("failed_runs" in when), "they count no more"
