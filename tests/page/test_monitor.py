"""The running bench in a terminal, by its journal."""

from __future__ import annotations

from io import StringIO

import recorded_run as run
from rich.console import Console

from rig.files.journal.values import RunHeader
from rig.files.runfile.compile import compile_run
from rig.page.terminal import add_value, bars, run_panel, value_table
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


def test_a_run_is_shown_by_its_journal(rig):
    day = rig.results / "2026-11-21"
    day.mkdir(parents=True)
    run.write_run(day / "2026-11-21T22-00-00_sweep_r001.rigj")
    ended = rig.run("monitor", "--seconds", "0.5")
    assert ended.code == 0, ended.stderr
    assert "SIMULATED" in ended.stdout
    assert "sweep: point 5 of 5" in ended.stdout
    assert "complete, exit 0" in ended.stdout
