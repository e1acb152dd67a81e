"""The bench in a terminal: a run by its journal; without one its sensors, and nothing moves."""

from __future__ import annotations

from io import StringIO

import pytest
import recorded_run as run
from rich.console import Console

from rig.files.journal.values import RunHeader
from rig.files.runfile.compile import compile_run
from rig.page.sensors import come
from rig.page.terminal import bars, run_panel
from rig.page.watch import BenchWatch
from rig.page.word import BenchWord


def test_values_become_bars_between_their_smallest_and_largest():
    assert bars([0.0, None, 1.0, 0.5]) == "  █▄"
    assert bars([]) == ""


def test_a_sensor_that_always_has_something_new_is_left_for_the_next_drawing():
    assert set(come(lambda: 1)) == {1}
    left = [2, 1]
    assert list(come(lambda: left.pop() if left else None)) == [1, 2]


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


@pytest.mark.thorough
def test_without_a_run_the_sensors_are_read_and_nothing_moves_or_is_switched(rig):
    with rig.served("--fixture", "plate") as path:
        watched = rig.start("monitor", "--bench", str(path), "--seconds", "6")
        rig.await_world("streaming", True)
        refused = rig.run("slip-trial", "--bench", str(path))
        assert (refused.code, "is in use by" in refused.stderr) == (2, True)
        ended = watched.finish()
    assert ended.code == 0, ended.stderr
    for shown in ("SIMULATED", "force z", "strip_1"):
        assert shown in ended.stdout
    by_the_monitor = []
    for entry in rig.log():
        if entry["what"] == "streaming" and entry["value"] is False:
            break
        by_the_monitor.append(entry)
    devices = {entry["device"] for entry in by_the_monitor if entry["what"] != "ready"}
    assert devices <= {"force_sensor", "daq"}, by_the_monitor
