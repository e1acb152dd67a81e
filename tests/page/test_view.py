"""What the page shows of a run, from its journal's records alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import recorded_run as run

from rig.files.journal.follow import JournalTail
from rig.files.journal.format import Block, PointBegin, PointDiscard, PointKeep
from rig.files.journal.layout import Column
from rig.files.journal.values import End, JournalEvent, RunHeader, StreamState
from rig.page.ring import BIN_S, KEPT_S, Ring
from rig.page.stop_course import StopSigns, stop_course
from rig.page.view import MOST_CHANNELS, MOST_EVENTS, RunView
from rig.page.word import Facts, bench_word


@pytest.fixture
def view(tmp_path) -> RunView:
    shown = RunView()
    with JournalTail(run.write_run(tmp_path / "a.rigj")) as tail:
        for record in tail.poll():
            shown.take(record)
    return shown


def test_a_journal_becomes_run_points_curve_events_and_end(view):
    shown = view.summary()
    assert (shown["procedure"], shown["mark"]) == ("sweep", "SIMULATED")
    assert (shown["done"], shown["planned"], shown["n"], shown["point"]) == (5, 5, 5, None)
    assert (shown["end"]["status"], shown["left_s"]) == ("complete", 0.0)
    assert sorted(x for x, _, _ in view.curve) == sorted(run.FREQUENCIES)
    assert [event["text"] for event in view.events][-1] == "complete, exit 0"


def test_a_peak_of_one_sample_stays_visible_and_gaps_and_nan_are_no_values():
    ring = Ring(("v",), "V")
    values = np.zeros((1000, 1))
    values[617] = 3.5
    values[300:320] = math.nan
    ring.add(np.arange(1000) / 1000, values)
    shown = ring.since(0)
    assert max(v for v in shown["high"][0] if v is not None) == 3.5
    assert shown["high"][0][617 // 50] == 3.5
    assert ring.since(ring.last_key)["k"] == [19]
    ring.add(np.array([100.0]), np.array([[1.0]]))
    assert ring.since(0)["k"][-1] == round(100 / BIN_S)


def test_memory_is_bounded_whatever_a_journal_holds():
    streams = [
        {"name": f"s{n}", "device": "", "channels": [f"c{k}" for k in range(64)], "dtype": "<f8",
         "row_shape": [64]}
        for n in range(40)
    ]  # fmt: skip
    view = RunView()
    view.take(RunHeader.model_validate(run.header(streams=streams)))
    assert sum(len(ring.channels) for ring in view.rings.values()) == MOST_CHANNELS
    rows = np.ones((100, 64))
    for n in range(400):
        block = Block(0, 100 * n, 20.0 * n, memoryview(rows.tobytes()).cast("B"))
        view.take(block)
        view.take(JournalEvent(time=20.0 * n, level="x" * 900, code="c" * 900, message="m" * 9000))
    (ring, *_) = view.rings.values()
    assert len(ring.since(-1)["k"]) <= KEPT_S / BIN_S
    assert len(view.events) == MOST_EVENTS
    assert len(str(list(view.events))) < 1000 * MOST_EVENTS


@pytest.mark.parametrize("changing", [{"regrip": True}, {"force_shares": [1.0, 0.5]}])
def test_no_servo_error_is_shown_where_the_set_point_changes(changing):
    streams = [{"name": "force", "device": "", "channels": ["F_n", "F_t"], "dtype": "<f8",
                "row_shape": [2]}]  # fmt: skip
    view = RunView()
    settings = {"normal_force_N": 4.0, **changing}
    header = run.header(streams=streams, settings=settings, setting_units={})
    view.take(RunHeader.model_validate(header))
    assert set(view.rings) == {"force"}
    assert view.summary()["set_point_changes"], "4 N is not what the servo holds"


def test_counts_become_values_at_their_times_and_the_servo_error_is_shown():
    streams = [{"name": "force", "device": "", "channels": ["F_n", "F_t"], "dtype": "<f8",
                "row_shape": [2]}]  # fmt: skip
    view = RunView()
    settings = {"normal_force_N": 4.0}
    header = run.header(streams=streams, settings=settings, setting_units={})
    view.take(RunHeader.model_validate(header))
    view.take(StreamState(stream=0, rate_Hz=10.0, scale=(2.0, 1.0), offset=(0.5, 0.0), units="N"))
    view.take(Block(0, 0, 1.0, memoryview(np.array([[1.0, 0.0], [2.0, 0.0]]).tobytes())))
    assert view.force_N == 4.5
    view.take(JournalEvent(time=4.0, level="info", code="x", message=""))
    assert view.summary()["streams"]["force"]["age_s"] == 3.0
    assert view.rings["servo_error"].latest == (0.5,)
    assert not view.summary()["set_point_changes"]
    assert view.rings["force"].since(0)["k"] == [round(0.9 / BIN_S), round(1.0 / BIN_S)]


def test_recorded_points_that_are_invalid_are_counted_where_a_procedure_judges_them(view):
    assert view.summary()["valid"] is None
    judged = replace(
        run.LAYOUT,
        columns=(*run.LAYOUT.columns, Column("invalid", "", "Why", "text", key="invalid")),
    )
    view = RunView()
    view.take(RunHeader.model_validate(run.header(layout=judged.to_json())))
    x, y = (column.key for column in view.curve_columns() or ())
    for number, why in enumerate(("", "overshoot 11 % is above 10 %", "")):
        view.take(PointKeep(f"p{number}", {"invalid": why, x: number, y: 1.0}, "{}"))
    view.take(PointKeep("p1", {"invalid": "again"}, "{}"))
    assert (view.summary()["done"], view.summary()["valid"]) == (3, 2)
    assert [invalid for _, _, invalid in view.curve] == [False, True, False]


def test_a_retaken_point_counts_once_and_the_time_left_follows_from_those_recorded():
    view = RunView()
    view.take(RunHeader.model_validate(run.header()))
    assert view.left_s() is None
    for n, (point, begun, ended) in enumerate([("a", 0.0, 4.0), ("b", 4.0, 10.0)]):
        view.take(PointBegin(point, {"time": begun}, "{}"))
        assert view.summary()["n"] == n + 1
        view.take(JournalEvent(time=ended, level="info", code="x", message=""))
        view.take(PointKeep(point, {}, "{}"))
    view.take(PointKeep("b", {}, "{}"))
    assert (view.done, view.left_s()) == (2, 3 * 5.0)
    view.take(PointBegin("c", {"time": 10.0}, "{}"))
    view.take(PointDiscard("c", "trip", "{}"))
    assert (view.done, view.discards, view.point) == (2, 1, None)


def test_the_time_left_is_what_is_expected_with_the_excess_of_the_latest_points():
    view = RunView()
    view.take(RunHeader.model_validate(run.header()))
    said = [(1.0, 59.0, 3, 7), (1.0, 58.0, 2, 7)]
    for n, (expected_s, ahead_s, points_ahead, of) in enumerate(said):
        fields = {"time": 2.0 * n, "expected_s": expected_s, "ahead_s": ahead_s,
                  "points_ahead": points_ahead, "of": of}  # fmt: skip
        view.take(PointBegin(f"p{n}", fields, "{}"))
        assert view.left_s() == (60.0 if n == 0 else 59.0 + 3 * 1.0)
        view.take(JournalEvent(time=2.0 * n + 2.0, level="info", code="x", message=""))
        view.take(PointKeep(f"p{n}", {}, "{}"))  # each takes a second more than expected
    assert (view.planned, view.left_s()) == (7, 58.0 + 2 * 1.0)


def test_a_hold_is_shown_from_the_safe_bench_to_its_arming_again(view):
    holding = []
    for code in ("hold", "on-hold", "hold-over"):
        view.take(JournalEvent(time=8.0, level="info", code=code, message="silent sensor"))
        holding.append(view.holding)
    assert holding == ["", "silent sensor", ""]


def test_a_resumed_run_has_not_ended_from_its_first_record_on(view):
    view.take(JournalEvent(time=8.0, level="error", code="off-failed", message="x"))
    view.take(End.model_validate(run.end("stopped", exit=7)))
    assert (view.end.exit, view.off_failed) == (7, True)
    view.take(JournalEvent(time=9.0, level="warning", code="calibration", message="old"))
    assert (view.end, view.off_failed) == (None, False)
    view.take(End.model_validate(run.end("stopped", exit=143)))
    assert view.end.exit == 143


GOOD = Facts(recorded=True, ended=True)


@pytest.mark.parametrize(
    ("facts", "word"),
    [
        (Facts(), "unknown"),
        (Facts(run_lives=True, recorded=True), "running"),
        (
            Facts(run_lives=True, recorded=True, recording=True, guarded=True, silent_s=4.0),
            "unknown",
        ),
        (Facts(run_lives=True, recorded=True, guarded=True, silent_s=4.0), "running"),
        (Facts(run_lives=True, recorded=True, silent_s=4.0), "unknown"),
        (Facts(run_lives=True, recorded=True, recording=True, force_N=1.2), "pressed"),
        (Facts(run_lives=True, recorded=True, holding="silent sensor", silent_s=60.0), "holding"),
        (Facts(run_lives=True, recorded=True, force_N=1.2, off_failed=True), "UNSAFE"),
        (Facts(recorded=True), "UNSAFE"),  # it died, and nobody has said anything yet
        (Facts(recorded=True, guard_reported=True), "safe"),
        (Facts(recorded=True, guard_reported=True, pressed="still pressed at 12 mm"), "pressed"),
        (Facts(recorded=True, ended=True, exit=7), "UNSAFE"),
        (Facts(recorded=True, ended=True, unsafe="a mark"), "UNSAFE"),
        # `rig make-safe` lifts nothing: it ends UNSAFE, and makes no bench green.
        (Facts(recorded=True, ended=True, exit=7, made_safe=True), "unknown"),
        (Facts(recorded=True, made_safe=True), "unknown"),
        (Facts(recorded=True, off_failed=True, guard_reported=True, made_safe=True), "unknown"),
        (Facts(recorded=True, made_safe=True, pressed="still pressed"), "pressed"),
        (Facts(recorded=True, made_safe=True, unsafe="a mark"), "UNSAFE"),
        (Facts(recorded=True, made_safe=True, unfinished=True), "UNSAFE"),
        (Facts(recorded=True, ended=True, made_safe=True), "safe"),
        (Facts(recorded=True, guard_reported=True, made_safe=True), "safe"),
        (Facts(recorded=True, ended=True, held_by_another="process 7"), "unknown"),
        (Facts(recorded=True, ended=True, problem="cannot be followed"), "unknown"),
        (Facts(recorded=True, ended=True, pressed="still pressed"), "pressed"),
        # What the run has reported is green only when nothing can press again by itself.
        (Facts(recorded=True, ended=True, run_lives=True), "holding"),
        (Facts(recorded=True, ended=True, run_lives=True, pressed="still pressed"), "pressed"),
        (Facts(recorded=True, unfinished=True, guard_reported=True), "UNSAFE"),
        (Facts(recorded=True, ended=True, unfinished=True), "UNSAFE"),
        (Facts(recorded=True, ended=True, other_bench=True), "unknown"),
        (Facts(recorded=True, ended=True, bench_problem="no folder"), "unknown"),
        (GOOD, "safe"),
    ],
)
def test_the_word_is_safe_only_where_somebody_has_reported_it(facts, word):
    assert bench_word(facts).word == word


def signs(**changes: object) -> StopSigns:
    given = {"since_s": 0.3, "presses": 1, "pid": 42, "process_lives": True, "reacted": False,
             "ended": False, "guard_pid": 43, "heartbeat_timeout_s": 5.0}  # fmt: skip
    return StopSigns(**(given | changes))


def test_a_stop_is_red_from_the_press_to_the_end_record_or_the_guards_report():
    asked = stop_course(signs())
    assert (asked.phase, asked.safe, asked.over) == ("asked", False, False)
    twice = stop_course(signs(reacted=True, presses=2))
    assert (twice.phase, twice.safe) == ("switching off", False)
    assert "a further press changes nothing" in twice.text
    hanging = stop_course(signs(since_s=3.0))
    assert (hanging.phase, hanging.safe) == ("hanging", False)
    assert "process 43) kills it after 5 s" in hanging.text
    assert "by hand" in stop_course(signs(since_s=3.0, guard_pid=None)).text
    gone = stop_course(signs(process_lives=False))
    assert (gone.phase, gone.over, gone.safe) == ("guard", False, False)
    caught_up = stop_course(signs(process_lives=False, bench_safe=True))  # its END was read late
    assert (caught_up.phase, caught_up.over, caught_up.safe) == ("ended", True, True)
    acted = {"process_lives": False, "guard_report": "it acted", "guard_safe": True}
    stated = stop_course(signs(**acted, guard_done=True))
    assert (stated.phase, stated.over, stated.safe) == ("guard", True, True)
    lifts = stop_course(signs(**acted))  # it has stopped everything, and now z moves
    assert (lifts.phase, lifts.over, lifts.safe) == ("guard", False, False)
    refused = stop_course(signs(**acted, guard_done=True, pressed="still pressed at 12 mm"))
    assert (refused.over, refused.safe, "12 mm" in refused.text) == (True, False, True)
    failed = stop_course(signs(**acted | {"guard_safe": False}, guard_done=True))
    assert (failed.over, failed.safe, "could not make" in failed.text) == (True, False, True)
    assert stop_course(signs(ended=True, exit=143, status="stopped")).safe
    assert not stop_course(signs(ended=True, exit=7)).safe
    rested = signs(process_lives=False, guard_pid=None, recording=False)
    assert (stop_course(rested).over, stop_course(rested).safe) == (True, False)
    assert "process 42 has ended" in stop_course(rested).text.lower()
    made_safe = signs(ended=True, exit=7, process_lives=False, made_safe=True)
    assert (stop_course(made_safe).phase, stop_course(made_safe).safe) == ("ended", False)
    assert "make-safe has succeeded since" in stop_course(made_safe).text
    saves = signs(ended=True, exit=7, made_safe=True)  # its process may still act
    assert "UNSAFE" in stop_course(saves).text
    still = stop_course(signs(ended=True, exit=143, pressed="still pressed at 12 mm"))
    assert (still.over, still.safe, "12 mm" in still.text) == (True, False, True)
