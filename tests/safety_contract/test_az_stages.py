"""Stages on one RS-485 line under the real commands: the AZ pair in place of the Festo pair.

What holds on every model of stage stands in the other files of this folder.
"""

from __future__ import annotations

import re
import signal

import pytest

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

SHORT = ("--distance", "0.5mm", "--speed", "0.5mm/s", "--rest", "100ms")
WORLD = "skin_mount.contact_mm = 12.05\n"
"""Contact soon after the search begins."""
LONG = ("--distance", "2mm")
"""Still sliding when a time-out of 1.5 s is over."""
SLIDING = "count = 0\nmove = 2\nafter_s = 0.4\n"
"""From then on, x being on its way through a slide."""


def take(rig, fault="", *given):
    """A short trial on the AZ pair, under such a fault plan."""
    disturbed = ("--fault", rig.fault(fault)) if fault else ()
    return rig.run(
        "slip-trial", "--stages", "az", "--json", "--no-figures", "--world",
        rig.world(WORLD), "--world-log", str(rig.world_log), *SHORT, *disturbed, *given,
    )  # fmt: skip


def assert_lifted(rig):
    """z is parked, the skin has left the plate that it had touched."""
    at_rest = [e for e in rig.log() if (e["device"], e["what"]) == ("stage_z", "at-rest")]
    assert at_rest[-1]["value"] == pytest.approx(5.0, abs=0.01)
    touches = [e["what"] for e in rig.log() if e["what"] in ("touch-down", "lift-off")]
    assert touches == ["touch-down", "lift-off"]


def assert_ordered_to_stop(rig):
    """x has stopped on its way, because it was made to: its time-out was fed by frames to z."""
    happened = [e["what"] for e in rig.log() if e["device"] == "stage_x"]
    said = [what for what in happened if what != "injected"]
    assert "fault" not in said
    assert said[-2:] == ["stop", "at-rest"]


@pytest.mark.thorough
def test_a_trial_holds_the_force_at_fifty_ticks_a_second_and_says_so(rig):
    ended = take(rig)
    assert ended.code == 0, ended.stderr
    assert "the servo holds the force at 50 Hz, as often as the stages' links" in ended.stderr
    assert ended.object["summary"]["tick_Hz"] == 50.0
    assert_lifted(rig)
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        (reading,) = run.readings()
    assert reading["force_error_rms_percent"] < 2
    assert reading["force_error_peak_percent"] < 5
    assert reading["late_ticks"] == 0
    assert reading["kinetic_friction"] == pytest.approx(0.65, rel=0.03)


@pytest.mark.thorough
def test_more_ticks_than_the_line_has_time_for_are_refused_before_anything_moves(rig):
    ended = take(rig, "", "--tick", "100")
    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert "stage_z update_rate 100 Hz is outside 0 to 50 Hz" in error
    assert "its line carries a poll and a new target in 0.02 s" in error
    assert not [e for e in rig.log() if e["what"] == "move"]


@pytest.mark.thorough
def test_an_alarm_in_the_slide_is_reported_with_its_remedy_and_the_skin_lifted(rig):
    plan = '[[fault]]\ndevice = "stage_x"\nkind = "drive-fault"\ncode = 48\nmove = 2\nafter_s = 0.3'
    ended = take(rig, plan)
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: stage_x: drive alarm: 30h (overload); check what blocks")
    assert "NOT SAFE" not in ended.stderr
    assert_lifted(rig)


@pytest.mark.thorough
def test_a_drive_that_falls_silent_beside_the_other_is_reported_and_the_skin_lifted(rig):
    """x hears, and its time-out is fed by z's frames: it is ordered to stop, and obeys unheard."""
    plan = '[[fault]]\ndevice = "stage_x"\nkind = "silence"\ncommand = "FC3 198"\n'
    ended = take(rig, plan + SLIDING, *LONG)
    assert ended.code == 3, ended.stderr
    assert ended.errors[0].startswith("error: stage_x: read register 00C6h: no answer within")
    assert_lifted(rig)
    assert_ordered_to_stop(rig)


@pytest.mark.thorough
def test_a_drive_that_answers_nothing_any_more_is_not_safe_and_the_skin_is_lifted(rig):
    plan = '[[fault]]\ndevice = "stage_x"\nkind = "silence"\n'
    ended = take(rig, plan + SLIDING, *LONG)
    assert ended.code == 7, ended.stderr
    cause, unsafe = ended.errors
    assert cause.startswith("error: stage_x: ")
    assert unsafe.startswith("error: NOT SAFE: slide could not be switched off: stage_x: ")
    assert_lifted(rig)
    assert_ordered_to_stop(rig)


@pytest.mark.thorough
def test_a_killed_run_is_stopped_by_the_drives_own_time_out_and_the_guard(rig):
    running = rig.start(
        "slip-trial", "--stages", "az", "--no-figures", "--distance", "5mm", "--speed", "0.3mm/s",
        "--world", rig.world(WORLD), "--world-log", str(rig.world_log),
    )  # fmt: skip
    rig.await_world("slip")
    running.send(signal.SIGKILL)
    running.process.wait()
    report = rig.guard_report()
    assert report is not None
    assert report["safe"], report
    rig.await_world("end")
    for stage in ("stage_z", "stage_x"):
        last = [e for e in rig.log() if e["device"] == stage and e["what"] in ("move", "at-rest")]
        assert last[-1]["what"] == "at-rest", stage


@pytest.mark.thorough
def test_a_sweep_runs_on_a_bench_file_with_an_az_stage_in_real_time(rig):
    simulator = rig.start(
        "simulate", "--stages", "az", "--write", "az.toml", "--world-log", str(rig.world_log)
    )
    simulator.wait_for("Ctrl-C ends it")
    text = (rig.folder / "az.toml").read_text()
    assert 'driver = "oriental-az"' in text
    hidden = re.sub(r"\[simulation\]\n(?:.+\n)*", "", text)
    (rig.folder / "hidden.toml").write_text(hidden)
    for bench in ("az.toml", "hidden.toml"):
        ended = rig.run("sweep", "--bench", bench, "--json", "--no-figures", "--frequencies", "210")
        assert ended.code == 0, ended.stderr
        assert ended.object["simulated"] is True, "other instruments admit it, an AZ cannot"
    simulator.send(signal.SIGINT)
    assert simulator.finish().code == 0
