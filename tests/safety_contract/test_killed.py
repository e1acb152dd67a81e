"""A run that is killed or hangs: the guard makes the bench safe and compiles what there is."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import asdict
from pathlib import Path

import pytest
from processes import children_named

from drivers.simulated.bench.options import Options
from rig.files.journal.reader import read_journal
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

PATIENCE_S = 30.0
SIXTY_POINTS = (
    "--frequencies", ",".join(str(f) for f in range(300, 6300, 100)), "--settling", "0.3s"
)  # fmt: skip
"""They take seconds: what is done to a run in the middle finds it there on a busy machine too."""
FORTY_POINTS = (
    "--frequencies", ",".join(str(f) for f in range(300, 4300, 100)), "--settling", "0.3s"
)  # fmt: skip
"""The same, for a run that all of them are taken of."""


def test_a_killed_run_is_made_safe_compiled_and_can_be_resumed(rig):
    running = rig.start_sweep(*FORTY_POINTS)
    running.wait_for(r"^10/40 ")
    running.send(signal.SIGKILL)
    running.process.wait()
    report = rig.guard_report()
    assert report is not None, "the guard never reported"

    assert report["safe"] is True
    assert report["stopped"] is True
    rig.await_world("ch1.on", False)
    off = next(e for e in rig.log() if e["what"] == "ch1.on" and e["value"] is False)
    on = next(e for e in rig.log() if e["what"] == "ch1.on" and e["value"] is True)
    assert off["by"] != on["by"], "the guard came in on a connection of its own"
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.outcome.status == "failed"
        assert 2 <= len(run.point_ids()) < 40  # what was put last may not have been written

    resumed = rig.run("resume", str(file), "--no-figures", "--json")
    assert resumed.code == 0, resumed.stderr
    assert resumed.object["points_done"] == 40
    assert verify(file) == []


LIFTED = (
    r"was pressed at (\d+\.\d\d) mm, (\d+\.\d) N; stage_z was lifted: "
    r"nothing is pressed at (\d+\.\d\d) mm, 0\.\d N"
)


@pytest.mark.thorough
def test_what_a_killed_run_leaves_pressed_is_lifted_and_said_first_by_the_next_command(rig):
    """The film is under a preload of 25 N; the guard stops everything, measures, and lifts."""
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^5/60 ")
    running.send(signal.SIGKILL)
    running.process.wait()
    report = rig.guard_report()
    assert report is not None, "the guard never reported"
    pressed = re.fullmatch(LIFTED, report["pressed"])
    assert pressed, report
    assert report["safe"] is True
    stage = [e for e in rig.log() if e["device"] == "stage_z"]
    *_, lifted_mm = (e["value"] for e in stage if e["what"] == "at-rest")
    assert float(pressed[2]) == pytest.approx(25.0, abs=1.0)
    assert float(pressed[3]) == pytest.approx(lifted_mm, abs=0.02)
    assert lifted_mm < float(pressed[1]) - 0.3, "away from contact"
    lift = [e["value"] for e in stage if e["what"] == "move"][-1]
    assert lift == {"target_mm": pytest.approx(11.7), "speed_mm_s": pytest.approx(1.0)}

    again = rig.run("sweep", "--json", "--no-figures", "--frequencies", "210")
    first = again.stderr.splitlines()[:3]
    assert any(report["pressed"] in line for line in first), first


@pytest.mark.thorough
def test_what_a_killed_run_leaves_pressed_is_lifted_although_its_force_sensor_is_unplugged(rig):
    """The port of the sensor is gone when the guard comes; z is lifted by where it stands."""
    with rig.served() as path:
        port = Path(tomllib.loads(path.read_text())["force_sensor"]["port"])
        running = rig.start(
            "sweep",
            "--bench",
            str(path),
            "--no-figures",
            "--frequencies",
            "210,310,410,510,610,710",
        )
        running.wait_for(r"^2/6 ")
        port.unlink()
        running.send(signal.SIGKILL)
        running.process.wait()
        report = rig.guard_report()
    assert report is not None, "the guard never reported"
    assert (report["safe"], report["released"]) == (True, True), report
    assert re.search(
        r"stage_z was at 12\.\d\d mm; what is pressed is not known since .*; "
        r"stage_z was lifted: stage_z is at 11\.70 mm",
        report["pressed"],
    ), report
    assert str(port) in report["pressed"]
    stage = [e for e in rig.log() if e["device"] == "stage_z"]
    *_, lifted_mm = (e["value"] for e in stage if e["what"] == "at-rest")
    assert lifted_mm == pytest.approx(11.7, abs=0.02)


@pytest.mark.thorough
def test_a_run_that_hangs_is_ended_and_made_safe_by_the_guard(rig):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^20/60 ")
    running.send(signal.SIGSTOP)
    report = rig.guard_report()
    assert report is not None, "the guard never reported"

    assert running.process.wait(PATIENCE_S) == -signal.SIGKILL
    assert report["safe"] is True
    assert "no sign of life" in report["cause"]
    rig.await_world("ch1.on", False)
    journal = read_journal(rig.only("*.rigj"))
    assert 10 <= len(journal.kept_ids()) < 60  # what was put last may not have been written


@pytest.mark.thorough
def test_the_drive_of_a_run_that_hangs_stops_by_itself_before_the_guard_comes(rig):
    """In real time, on the longest way there is in free air: nobody talks to the drive any more."""
    with rig.served(ways="as usual") as path:
        text = path.read_text()
        for said, instead in (
            ("communication_timeout_ms = 2000", "communication_timeout_ms = 600"),
            ("timeout_s = 0.9", "timeout_s = 0.4"),
            ("[fixture]", "[fixture]\nparked_mm = 1.0"),
        ):
            assert said in text
            text = text.replace(said, instead)
        path.write_text(text)
        running = rig.start("sweep", "--bench", str(path), "--no-figures", "--frequencies", "300")
        target_mm = await_way_down(rig)
        running.send(signal.SIGSTOP)
        rig.await_world("fault", rig.bench.z.silence_fault)
        assert not (rig.results / "guard-simulated.json").exists()
        assert running.process.wait(PATIENCE_S) == -signal.SIGKILL
        report = await_report(rig.results / "guard-simulated.json")

    assert report["safe"] is True
    assert report["cause"] == "no sign of life for 5 s; the run was killed"
    stage = [(e["what"], e["t_us"], e["value"]) for e in rig.log() if e["device"] == "stage_z"]
    names = [what for what, _, _ in stage]
    fault = names.index("fault")
    assert names[-1] == "at-rest"
    assert "stop" not in names[fault:], "and the guard had nothing to stop"
    stopped_s = (stage[-1][1] - stage[fault][1]) * 1e-6
    assert stopped_s < 0.1, "its own ramp"
    assert stage[-1][2] < target_mm - 0.5, "it was on its way"


def await_way_down(rig):
    """Until the stage is on its quick way to the film; where to."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        log = rig.log() if rig.world_log.exists() else []
        targets = [entry["value"]["target_mm"] for entry in log if entry["what"] == "move"]
        if targets and targets[-1] > 10:
            return targets[-1]
        time.sleep(0.02)
    raise AssertionError("the stage never went to the film")


def await_report(path):
    """A guard's report, once it is final."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if path.exists() and "file" in (report := json.loads(path.read_text())):
            return report
        time.sleep(0.05)
    raise AssertionError("the guard never reported")


@pytest.mark.thorough
def test_a_run_whose_guard_was_killed_says_so_and_continues(rig):
    running = rig.start_sweep(*FORTY_POINTS)
    running.wait_for(r"^5/40 ")
    (guard,) = children_named("rig.run.making_safe.guard", running.process.pid)
    os.kill(guard, signal.SIGKILL)
    ended = running.finish()
    assert ended.code == 0, ended.stderr
    words = "the guard has died: if this run dies as well, nothing makes the bench safe"
    assert f"warning: {words}" in ended.stderr
    assert ended.object["warnings"] == [words]
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
def test_a_run_whose_guard_is_stopped_says_so_once_and_continues(rig):
    running = rig.start(
        *rig.sweep_arguments(*FORTY_POINTS),
        before="import rig.run.making_safe.guard_link as g; g.SILENT_S = g.ENDING_S = 0.5",
    )
    running.wait_for(r"^5/40 ")
    (guard,) = children_named("rig.run.making_safe.guard", running.process.pid)
    os.kill(guard, signal.SIGSTOP)
    ended = running.finish()
    assert ended.code == 0, ended.stderr
    (warning,) = ended.object["warnings"]
    assert warning.startswith(f"the guard (process {guard}) has not read a heartbeat for ")
    assert f"kill -CONT {guard}" in warning
    assert rig.outputs() == [True, False]
    assert not Path(f"/proc/{guard}").exists()


@pytest.mark.thorough
def test_the_bench_ends_by_itself_after_its_run_was_killed(rig):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^10/60 ")
    running.send(signal.SIGKILL)
    running.process.wait()

    rig.await_world("owner-gone")
    rig.await_world("end")
    assert rig.outputs()[-1] is False


@pytest.mark.thorough
def test_a_run_killed_while_it_starts_leaves_no_bench_behind(rig):
    running = rig.start(*rig.sweep_arguments(), fresh=True)
    while not rig.world_log.exists():
        time.sleep(0.005)
    running.send(signal.SIGKILL)
    running.process.wait()

    rig.await_world("owner-gone")
    rig.await_world("end")
    assert rig.outputs()[-1:] in ([], [False])


@pytest.mark.thorough
def test_a_bench_whose_owner_died_before_it_listened_ends_by_itself(rig):
    options = Options(slaved=True, world_log=str(rig.world_log), linger_s=0.1)
    bench = subprocess.Popen(
        [sys.executable, "-m", "drivers.simulated.bench.process"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    bench.communicate(json.dumps(asdict(options)).encode() + b"\n", PATIENCE_S)

    assert bench.returncode == 0
    assert [entry["what"] for entry in rig.log()][-2:] == ["owner-gone", "end"]
