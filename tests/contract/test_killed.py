"""A run that is killed or hangs: the guard makes the bench safe and compiles what there is."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import asdict

from drivers.simulated.bench import Options
from rig.recording.contents import read_journal
from rig.recording.runfile import RunFile
from rig.recording.verify import verify

PATIENCE_S = 30.0
SIXTY_POINTS = ("--frequencies", ",".join(str(f) for f in range(300, 6300, 100)))


def test_a_killed_run_is_made_safe_compiled_and_can_be_resumed(rig):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^20/60 ")
    running.send(signal.SIGKILL)
    running.process.wait()
    report = rig.guard_report()
    assert report is not None, "the guard never reported"

    assert report["safe"] is True
    rig.await_world("ch1.on", False)
    off = next(e for e in rig.log() if e["what"] == "ch1.on" and e["value"] is False)
    on = next(e for e in rig.log() if e["what"] == "ch1.on" and e["value"] is True)
    assert off["by"] != on["by"], "the guard came in on a connection of its own"
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.outcome.status == "failed"
        assert 10 <= len(run.point_ids()) < 60

    resumed = rig.run("resume", str(file), "--no-figures", "--json")
    assert resumed.code == 0, resumed.stderr
    assert resumed.object["points_done"] == 60
    assert verify(file) == []


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


def test_the_bench_ends_by_itself_after_its_run_was_killed(rig):
    running = rig.start_sweep(*SIXTY_POINTS)
    running.wait_for(r"^10/60 ")
    running.send(signal.SIGKILL)
    running.process.wait()

    rig.await_world("owner-gone")
    rig.await_world("end")
    assert rig.outputs()[-1] is False


def test_a_run_killed_while_it_starts_leaves_no_bench_behind(rig):
    running = rig.start_sweep()
    while not rig.world_log.exists():
        time.sleep(0.005)
    running.send(signal.SIGKILL)
    running.process.wait()

    rig.await_world("owner-gone")
    rig.await_world("end")
    assert rig.outputs()[-1:] in ([], [False])


def test_a_bench_whose_owner_died_before_it_listened_ends_by_itself(rig):
    options = Options(slaved=True, world_log=str(rig.world_log), linger_s=0.1)
    bench = subprocess.Popen(
        [sys.executable, "-m", "drivers.simulated.bench", json.dumps(asdict(options))],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    assert bench.stdin is not None
    bench.stdin.close()

    assert bench.wait(PATIENCE_S) == 0
    assert [entry["what"] for entry in rig.log()][-2:] == ["owner-gone", "end"]
