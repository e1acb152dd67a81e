"""The running bench in a terminal, by its journal."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO

import numpy as np
import recorded_run as run
from rich.console import Console

from rig.bench.plan import BenchPlan
from rig.bench.settings import BenchSettings, FixtureSettings
from rig.files.journal.format import PointKeep
from rig.files.journal.layout import Column
from rig.files.journal.values import End, JournalEvent, RunHeader
from rig.files.runfile.compile import compile_run
from rig.page import live_bench
from rig.page.ring import Ring
from rig.page.terminal import add_value, bars, run_panel, show_run, value_table
from rig.page.watch import BenchWatch
from rig.page.word import BenchWord


def test_values_become_bars_between_their_smallest_and_largest():
    assert bars([0.0, None, 1.0, 0.5]) == "  █▄"
    assert bars([]) == ""


def test_on_80_columns_names_and_values_are_whole_and_the_latest_bars_are_shown():
    table = value_table()
    add_value(table, "force_sensor x", -1.7722e-06, "mV/V (old)", [0.0] * 59 + [1.0])
    shown = StringIO()
    Console(file=shown, width=80).print(table)
    head, row = shown.getvalue().splitlines()
    assert head.split() == ["channel", "latest", "unit", "last", "seconds"]
    assert row.split()[:5] == ["force_sensor", "x", "-1.7722e-06", "mV/V", "(old)"]
    assert row.rstrip().endswith("█")


def test_on_40_columns_no_value_and_no_unit_is_cut():
    table = value_table()
    add_value(table, "position z_commanded", -0.00095731, "mm (old)", [0.0] * 59 + [1.0])
    shown = StringIO()
    Console(file=shown, width=40).print(table)
    assert "-0.00095731  mm (old)" in shown.getvalue()
    assert "…" not in shown.getvalue()


def test_the_latest_run_is_named_where_only_its_file_is_left(rig):
    day = rig.results / "2026-11-21"
    day.mkdir(parents=True)
    path = day / "2026-11-21T22-00-00_sweep_r001.rigj"
    run.write_run(path)
    compile_run(path, retire=True)
    ended = rig.run("monitor", "--seconds", "0.5")
    assert ended.code == 0, ended.stderr
    assert "SIMULATED: these are not measurements" in ended.stdout
    assert f"latest run: {path.stem}.h5, complete, exit 0" in ended.stdout
    assert "last seconds" not in ended.stdout


def test_a_file_cannot_control_the_terminal(tmp_path):
    watch = BenchWatch(tmp_path)
    escape = "\x1b]0;taken over\x07"
    watch.view.take(RunHeader.model_validate(run.header(sample={"name": escape})))
    watch.view.note("info", escape, escape)
    watch.word = BenchWord("unknown", escape)
    shown = StringIO()
    Console(file=shown, force_terminal=True, width=200).print(run_panel(watch))
    assert "taken over" in shown.getvalue()
    assert "\x1b]" not in shown.getvalue()
    assert "\x07" not in shown.getvalue()


def panel_of(watch: BenchWatch) -> str:
    shown = StringIO()
    Console(file=shown, width=200).print(run_panel(watch))
    return shown.getvalue()


def test_a_run_that_was_stopped_or_has_died_is_not_at_a_point(tmp_path):
    watch = BenchWatch(tmp_path)
    watch.view.take(RunHeader.model_validate(run.header()))
    assert "sweep: interrupted, 0 of 5 points; sample" in panel_of(watch)
    watch.view.take(End.model_validate(run.end("stopped", 0)))
    assert "sweep: stopped, 0 of 5 points; sample" in panel_of(watch)


def test_a_person_at_the_terminal_sees_how_many_trials_are_valid(tmp_path):
    judged = replace(
        run.LAYOUT,
        columns=(*run.LAYOUT.columns, Column("invalid", "", "Why", "text", key="invalid")),
    )
    watch = BenchWatch(tmp_path)
    watch.view.take(RunHeader.model_validate(run.header(layout=judged.to_json())))
    for number, why in enumerate(("", "overshoot 11 % is above 10 %")):
        watch.view.take(PointKeep(f"p{number}", {"invalid": why}, "{}"))
    watch.view.take(End.model_validate(run.end("complete", 2)))
    assert "sweep: complete, 2 of 5 points, 1 of them valid; sample" in panel_of(watch)


def test_the_failure_that_ended_a_run_is_not_called_by_the_name_of_its_class(tmp_path):
    watch = BenchWatch(tmp_path)
    watch.view.take(RunHeader.model_validate(run.header()))
    for code, message in (
        ("StopRequestedError", "stopped by Ctrl-C"),
        ("RecordError", "daq: it sends nothing"),
        ("hold", "the door is open"),
    ):
        event = {"time": 1.0, "level": "error", "code": code, "message": message}
        watch.view.take(JournalEvent.model_validate(event))
    shown = panel_of(watch)
    assert "1.00 s stop: stopped by Ctrl-C" in shown
    assert "1.00 s failure: daq: it sends nothing" in shown
    assert "1.00 s hold: the door is open" in shown


def test_a_channel_with_the_name_of_its_stream_is_named_once_and_no_empty_table_is_shown(tmp_path):
    watch = BenchWatch(tmp_path)
    watch.view.rings["servo_error"] = Ring(("servo_error",), "N")
    assert "last seconds" not in panel_of(watch)
    watch.view.rings["servo_error"].add(np.array([0.1]), np.array([[-0.2]]))
    shown = panel_of(watch)
    assert "servo_error -0.2" in " ".join(shown.split())
    assert shown.count("servo_error") == 1


def test_what_is_shown_in_a_file_ends_with_a_whole_line(tmp_path):
    shown = StringIO()
    show_run(BenchWatch(tmp_path), Console(file=shown, width=200), lambda: False)
    assert shown.getvalue().endswith("nothing was read yet\n")


def test_a_bench_is_shown_at_least_once_however_short_the_time(monkeypatch):
    monkeypatch.setattr(live_bench, "links_of", lambda _: ([], ["stage_z"]))
    fixture = FixtureSettings(mounted="film-clamp")
    plan = BenchPlan(BenchSettings(name="b", fixture=fixture), (), "", "b.toml")
    shown = StringIO()
    live_bench.show_bench(plan, Console(file=shown, width=200), lambda: False)
    assert "bench b: no run; nothing is moved or set" in shown.getvalue()


def test_a_run_is_shown_by_its_journal(rig):
    day = rig.results / "2026-11-21"
    day.mkdir(parents=True)
    run.write_run(day / "2026-11-21T22-00-00_sweep_r001.rigj")
    ended = rig.run("monitor", "--seconds", "0.5")
    assert ended.code == 0, ended.stderr
    assert "SIMULATED" in ended.stdout
    assert "sweep: complete, 5 of 5 points; sample " in ended.stdout
    assert " left" not in ended.stdout
    assert "complete, exit 0" in ended.stdout
