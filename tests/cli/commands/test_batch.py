"""A batch through the real command line: every run once, whoever dies, and people at other
terminals."""

from __future__ import annotations

import json
import math
import re
import signal
import sqlite3
from contextlib import closing

import h5py
import pytest
from nights import (
    QUICK_NIGHT,
    Taken,
    ask,
    await_answer,
    await_point,
    folder_of,
    kill,
    object_of,
    taken,
    worker_of,
    write_night,
)

ONE_RUN = (
    QUICK_NIGHT
    + """
[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [160, 180, 200, 220], load_N = 0.5, settling_s = 4 }
"""
)
"""A point takes most of a second: what happens after the first one finds the run under way, on a
busy machine too."""
TWO_RUNS = (
    ONE_RUN
    + """
[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [200], load_N = 1.0 }
"""
)
ONE_FREQUENCY = (
    QUICK_NIGHT
    + """
[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [200] }
matrix = { load_N = [0.5, 1.0] }
"""
)


def begin(rig, text: str):
    """Start a batch; it has its folder, and its first run is under way."""
    write_night(rig, text)
    running = rig.start("batch", "run", "night.toml", "--json")
    running.wait_for(r"^run 1/")
    return running


@pytest.fixture(scope="module")
def uninterrupted(rig_of_the_module) -> dict[int, Taken]:
    """The same runs, each to its end."""
    rig = rig_of_the_module
    write_night(rig, TWO_RUNS)
    ended = rig.run("batch", "run", "night.toml", "--json")
    assert ended.code == 0, ended.stderr
    assert object_of(ended.stdout)["runs"]["done"] == 2
    return taken(folder_of(rig.results))


def same(interrupted: dict[int, Taken], uninterrupted: dict[int, Taken]) -> None:
    """Every point of the first run once, and what it gave within the stated errors: the film
    remembers its preload."""
    assert interrupted.keys() == {1}
    run, expected = interrupted[1], uninterrupted[1]
    assert run.state == "done"
    assert sorted(run.points) == sorted(set(run.points)), "each point once"
    assert set(run.points) == set(expected.points)
    gains = {r["frequency_Hz"]: r for r in expected.readings}
    for reading in run.readings:
        other = gains[reading["frequency_Hz"]]
        error = math.hypot(reading["gain_standard_error_dB"], other["gain_standard_error_dB"])
        assert abs(reading["gain_dB"] - other["gain_dB"]) < 5 * error


@pytest.mark.thorough
def test_every_run_is_taken_once_and_its_file_says_of_which_batch(
    uninterrupted: dict[int, Taken], rig_of_the_module
) -> None:
    folder = folder_of(rig_of_the_module.results)
    assert [run.state for run in uninterrupted.values()] == ["done", "done"]
    assert [len(run.points) for run in uninterrupted.values()] == [4, 1]
    assert ask(folder, "SELECT run, attempt, ending FROM attempt") == [
        (1, 1, "complete"),
        (2, 1, "complete"),
    ]
    shown = rig_of_the_module.run("batch", "status", str(folder))
    assert "SIMULATED batch night: complete" in shown.stdout
    assert "2 of 2 runs done" in shown.stdout
    with h5py.File(rig_of_the_module.only("r00001*.h5")) as file:
        assert "identifier_collection" in file["entry"]
        assert "simulated_world/mounted_film" in file["entry"]


INVALID = f"""{QUICK_NIGHT}
[[experiment]]
procedure = "slip-trial"
settings = {{ speed_mm_s = 2, overshoot_percent = 1e-6 }}
"""


@pytest.mark.thorough
def test_a_run_of_invalid_trials_says_so_as_it_ends_and_in_the_morning(rig) -> None:
    write_night(rig, INVALID)
    ended = rig.run("batch", "run", "night.toml")
    assert ended.code == 5, ended.stderr
    assert "run 1: complete, 1 of 1 trial, 0 of 1 trial valid" in ended.stderr.splitlines()
    assert re.search(r"^invalid: run 1 \S+: 0 of 1 trial valid; why: ", ended.stderr, re.M)
    events = ask(folder_of(rig.results), "SELECT level, text FROM event")
    assert ("info", "complete") in events


@pytest.mark.thorough
def test_a_worker_that_is_killed_is_followed_by_another(
    rig, uninterrupted: dict[int, Taken]
) -> None:
    running = begin(rig, ONE_RUN)
    folder = folder_of(rig.results)
    await_point(folder, 1)
    kill(worker_of(folder))
    ended = running.finish()
    assert ended.code == 0, ended.stderr
    assert "warning: the worker died (signal 9)" in ended.stderr
    assert ask(folder, "SELECT ending FROM attempt WHERE run = 1") == [("died",), ("complete",)]
    same(taken(folder), uninterrupted)


@pytest.mark.thorough
def test_with_its_supervisor_killed_the_worker_stops_in_order_and_resume_continues(
    rig, uninterrupted: dict[int, Taken]
) -> None:
    running = begin(rig, ONE_RUN)
    folder = folder_of(rig.results)
    await_point(folder, 1)
    running.send(signal.SIGKILL)
    await_answer(folder, "SELECT ending FROM attempt WHERE run = 1", "stopped")
    shown = rig.run("batch", "status")
    assert f"continue with: rig batch resume results/{folder.name}" in shown.stdout
    ended = rig.run("batch", "resume", "--json")
    assert ended.code == 0, ended.stderr
    same(taken(folder), uninterrupted)


@pytest.mark.thorough
def test_ctrl_c_stops_a_batch_safely_and_resume_continues_at_the_point(
    rig, uninterrupted: dict[int, Taken]
) -> None:
    running = begin(rig, ONE_RUN)
    folder = folder_of(rig.results)
    await_point(folder, 1)
    running.send(signal.SIGINT)
    ended = running.finish()
    assert ended.code == 130, ended.stderr
    assert "Continue with: rig batch resume" in ended.stderr
    journal = folder / "runs" / "r00001_sweep.rigj"
    assert rig.run("resume", str(journal), "--no-figures").code == 0, "a run alone, by hand"
    assert rig.run("batch", "resume").code == 0
    same(taken(folder), uninterrupted)
    assert ask(folder, "SELECT number FROM run WHERE processed IS NULL") == [], "files made, too"


@pytest.mark.thorough
def test_files_that_are_missing_are_shown_and_made_by_resume(
    uninterrupted: dict[int, Taken], rig_of_the_module
) -> None:
    """As where a batch was stopped before it came to them."""
    rig = rig_of_the_module
    folder = folder_of(rig.results)
    with closing(sqlite3.connect(folder / "queue.sqlite")) as queue, queue:
        queue.execute("UPDATE run SET processed = NULL WHERE number = 2")
    shown = rig.run("batch", "status", str(folder))
    assert "figures and results still to be made: 1 run" in shown.stdout
    assert f"continue with: rig batch resume {folder}" in shown.stdout
    ended = rig.run("batch", "resume", str(folder))
    assert ended.code == 0, ended.stderr
    ((made,),) = ask(folder, "SELECT processed FROM run WHERE number = 2")
    assert json.loads(made)["file"] == "r00002_sweep.h5"


@pytest.mark.thorough
def test_ctrl_backslash_stops_a_batch_as_ctrl_c_does(rig) -> None:
    running = begin(rig, ONE_RUN)
    folder = folder_of(rig.results)
    await_point(folder, 1)
    running.send_as_the_terminal_does(signal.SIGQUIT)
    ended = running.finish()
    assert ended.code == 131, ended.stderr
    assert "Continue with: rig batch resume" in ended.stderr
    assert ask(folder, "SELECT ending, code FROM attempt WHERE run = 1") == [("stopped", 131)]


@pytest.mark.thorough
def test_this_run_only_ends_safely_is_not_taken_again_and_the_batch_continues(rig) -> None:
    # The request has to come while the first run is under way, also beside other tests.
    running = begin(rig, TWO_RUNS.replace("settling_s = 4", "settling_s = 12"))
    folder = folder_of(rig.results)
    await_point(folder, 1)
    assert rig.run("batch", "stop", "--this-run").code == 0
    ended = running.finish()
    assert ended.code == 5, ended.stderr
    counts = object_of(ended.stdout)["runs"]
    assert (counts["done"], counts["failed"]) == (1, 1)
    states = ask(folder, "SELECT number, state, reason FROM run ORDER BY number")
    assert states[0][:2] == (1, "failed")
    assert "by a person" in states[0][2]
    assert states[1][:2] == (2, "done")
    assert ask(folder, "SELECT ending FROM attempt WHERE run = 1") == [("stopped",)]


@pytest.mark.thorough
def test_other_terminals_pause_it_let_it_go_on_and_stop_it_after_a_point(rig) -> None:
    running = begin(rig, ONE_RUN + "repeat = 50\n")
    folder = folder_of(rig.results)
    await_point(folder, 1)
    assert rig.run("batch", "pause").code == 0
    running.wait_for("^paused")
    status = object_of(rig.run("batch", "status", "--json").stdout)
    assert status["running"]
    assert status["state"].startswith("paused")
    resumed = rig.run("batch", "resume", "--json")
    assert (resumed.code, "resumed" in resumed.stderr) == (0, True), "no second supervisor"
    assert object_of(resumed.stdout)["running"]
    running.wait_for("^running")
    assert rig.run("batch", "stop").code == 0
    ended = running.finish()
    assert ended.code == 143, ended.stderr
    assert object_of(ended.stdout)["state"].startswith("stopped")
    refused = rig.run("batch", "stop")
    assert refused.code == 2
    assert "is not running" in refused.stderr


def test_a_batch_that_is_paused_within_a_run_is_stopped_without_being_resumed(rig) -> None:
    """A stop after the point under way: none is."""
    # 40 points, so that the run is still under way when the other command has started.
    frequencies = ", ".join(map(str, range(160, 200)))
    running = begin(rig, ONE_RUN.replace("160, 180, 200, 220", frequencies))
    await_point(folder_of(rig.results), 1)
    assert rig.run("batch", "pause").code == 0
    running.wait_for("^paused")
    assert rig.run("batch", "stop").code == 0
    ended = running.finish()
    assert ended.code == 143, ended.stderr
    assert object_of(ended.stdout)["state"].startswith("stopped")
    assert ask(folder_of(rig.results), "SELECT state FROM run") == [("queued",)]


@pytest.mark.thorough
def test_a_time_out_is_tried_again_and_a_limit_never(rig) -> None:
    (rig.folder / "silence.toml").write_text(
        '[[fault]]\ndevice = "daq"\nkind = "silence"\nat = 20\n'
    )
    (rig.folder / "spikes.toml").write_text(
        '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nforce_N = 60\n'
        'move = 3\nof = "stage_z"\n'
    )
    text = ONE_FREQUENCY + (
        "repeat = 2\n"
        '[[simulation.fault]]\nruns = [1]\nplan = "silence.toml"\n'
        '[[simulation.fault]]\nruns = [2]\nplan = "spikes.toml"\nattempts = 9\n'
        '[batch.notify]\ncommand = ["sh", "-c", "echo $1 >> told.txt", "tell"]\n'
    )
    text = text.replace("figures = false", "figures = false\nset_aside_after = 1")
    write_night(rig, text)
    ended = rig.run("batch", "run", "night.toml", "--json")
    folder = folder_of(rig.results)
    assert ended.code == 5, ended.stderr
    attempts = ask(folder, "SELECT run, ending, kind FROM attempt ORDER BY run, attempt")
    assert attempts == [
        (1, "failed", "timeout"),
        (1, "complete", ""),
        (2, "failed", "limit"),
        (3, "complete", ""),
    ]
    states = dict(ask(folder, "SELECT number, state FROM run"))
    assert states == {1: "done", 2: "failed", 3: "done", 4: "set-aside"}
    assert "condition sweep-002: 1 run failed; 1 queued run left out" in ended.stderr
    assert (rig.folder / "told.txt").read_text().splitlines() == [
        "SIMULATED batch night: start",
        "SIMULATED batch night: failure",
        "SIMULATED batch night: end",
    ]
    beat = json.loads((folder / "heartbeat.json").read_text())
    assert (beat["state"], beat["of"], beat["simulated"]) == ("ended", 4, True)
    again = rig.run("batch", "resume", "--retry-failed")
    assert "2 runs queued again" in again.stderr


@pytest.mark.thorough
def test_what_changed_since_the_beginning_is_reported_and_refused(rig) -> None:
    running = begin(rig, ONE_RUN)
    running.send(signal.SIGTERM)
    assert running.finish().code == 143
    (rig.folder / "night.toml").write_text(ONE_RUN + "repeat = 3\n")
    refused = rig.run("batch", "resume")
    assert refused.code == 2
    assert "changed since the batch began: batch file" in refused.stderr
    assert rig.run("batch", "resume", "--despite-changes").code == 0


def test_where_no_batch_is_says_so(rig) -> None:
    ended = rig.run("batch", "status")
    assert ended.code == 2
    assert "results contains no batch; name its folder" in ended.stderr
    refused = rig.run("batch", "status", "--json")
    assert refused.code == 2
    assert "results contains no batch" in object_of(refused.stdout)["errors"][0]


@pytest.mark.thorough
def test_a_run_whose_worker_died_before_it_could_say_so_is_done_and_not_taken_again(
    uninterrupted: dict[int, Taken], rig_of_the_module
) -> None:
    """Its files are whole, the queue says that it is running."""
    folder = folder_of(rig_of_the_module.results)
    with closing(sqlite3.connect(folder / "queue.sqlite")) as queue, queue:
        queue.execute("UPDATE run SET state = 'running', summary = NULL WHERE number = 2")
        queue.execute("UPDATE attempt SET ended = NULL, ending = NULL WHERE run = 2")
    before = (folder / "runs" / "r00002_sweep.h5").stat().st_ino
    ended = rig_of_the_module.run("batch", "resume", "--json")
    assert ended.code == 0, ended.stderr
    assert ask(folder, "SELECT run, attempt, ending FROM attempt WHERE run = 2") == [
        (2, 1, "complete")
    ]
    ((summary,),) = ask(folder, "SELECT summary FROM run WHERE number = 2")
    assert json.loads(summary)["points"] == 1
    assert (folder / "runs" / "r00002_sweep.h5").stat().st_ino == before
