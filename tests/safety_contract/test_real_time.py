"""The same sweep on a bench file in real time; a bench that somebody else changes meanwhile."""

from __future__ import annotations

import re
import signal
import time
import tomllib

import pytest

from drivers.simulated.bench.process import Lateness
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify


@pytest.fixture
def bench_file(rig):
    """A simulated bench that runs by itself, and the file that drives it."""
    with rig.served() as path:
        yield path


@pytest.mark.thorough
def test_the_same_sweep_runs_on_a_bench_file_in_real_time(rig, bench_file):
    ended = rig.run(
        "sweep", "--bench", str(bench_file), "--json", "--no-figures", "--frequencies", "210,2100"
    )

    assert ended.code == 0, ended.stderr
    assert ended.object["simulated"] is True
    assert "SIMULATED" in ended.stderr
    assert rig.outputs() == [True, False]
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.header.title.startswith("SIMULATED")
        assert run.header.bench_toml == bench_file.read_text()


def test_a_simulated_bench_that_falls_behind_real_time_says_so(rig):
    """The computer does something else for a while: no instrument is to blame for that."""
    serving = rig.start("simulate", "--write", "b.toml", "--world-log", str(rig.world_log))
    serving.wait_for("Ctrl-C ends it")
    serving.send(signal.SIGSTOP)
    time.sleep(0.5)
    serving.send(signal.SIGCONT)
    serving.wait_for("the computer is too busy for it in real time")
    serving.send(signal.SIGINT)
    ended = serving.finish()
    reported = re.search(r"the simulated bench was late by ([0-9.]+) s", ended.stderr)
    assert float(reported[1]) > 0.4, ended.stderr
    assert [e["value"] for e in rig.log() if e["what"] == "late"]


def test_a_bench_that_is_late_again_says_so_when_it_is_twice_as_late():
    lateness = Lateness()
    late_s = [lateness.note(at_s) for at_s in (0.0, 0.02, 0.16, 0.46, 0.86, 1.66, 1.68)]
    assert [round(one, 2) for one in late_s if one] == [0.28, 0.78]


@pytest.mark.thorough
def test_a_simulated_bench_whose_file_hides_it_is_still_marked(rig, bench_file):
    """The instruments admit it themselves: their serial numbers begin with SIM."""
    text = bench_file.read_text()
    hidden = re.sub(r"\[+simulation(?:\.[\w.]+)?\]+\n(?:.+\n)*", "", text)
    assert "simulation" not in tomllib.loads(hidden)
    bench_file.with_name("b.toml").write_text(hidden)
    ended = rig.run("sweep", "--bench", "b.toml", "--json", "--no-figures", "--frequencies", "2100")

    assert ended.code == 0, ended.stderr
    assert ended.object["simulated"] is True
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.outcome.simulated


@pytest.mark.thorough
def test_an_amplitude_that_the_generator_clips_is_a_failure(rig, bench_file):
    """-222 means that the instrument applied another value than it was asked for."""
    import pyvisa

    resource = tomllib.loads(bench_file.read_text())["generator"]["resource"]
    running = rig.start(
        "sweep", "--bench", str(bench_file), "--json", "--no-figures",
        "--frequencies", "210,310,410,510,610,710,810,910,1010", "--settling", "0.3s",
    )  # fmt: skip
    running.wait_for("^2/9 ")
    somebody = pyvisa.ResourceManager("@py").open_resource(resource)
    somebody.write_termination = somebody.read_termination = "\n"
    somebody.query("SOUR1:VOLT 0.2;:SOUR1:VOLT:LIM:HIGH 0.3;:SOUR1:VOLT:LIM:LOW -0.3;:SYST:ERR?")
    somebody.close()
    ended = running.finish()

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: generator: SOUR1:FREQ")
    assert "error -222" in error
    assert "clipped" in error
    assert rig.outputs() == [True, False]
    assert ended.object["points_done"] >= 2
    assert verify(rig.only("*.h5")) == []


@pytest.mark.thorough
def test_a_bench_that_disappears_is_reported_and_the_next_start_is_refused(rig, bench_file):
    """The output could not be switched off: exit 7, and nobody starts before somebody looked."""
    text = bench_file.read_text()
    generator = tomllib.loads(text)["generator"]["resource"]
    nowhere = text.replace(generator, "TCPIP::127.0.0.1::9::SOCKET")
    bench_file.with_name("gone.toml").write_text(nowhere)
    unreachable = rig.run("sweep", "--bench", "gone.toml", "--frequencies", "210")
    assert unreachable.code == 3
    assert "generator" in unreachable.errors[0]

    cannot = rig.run("make-safe", "--bench", "gone.toml")
    assert cannot.code == 7
    assert "by hand" in cannot.errors[-1]
    can = rig.run("make-safe", "--bench", str(bench_file))
    assert can.code == 0


@pytest.mark.thorough
def test_a_killed_run_leaves_a_bench_that_the_guard_made_safe(rig, bench_file):
    running = rig.start(
        "sweep", "--bench", str(bench_file), "--no-figures",
        "--frequencies", "210,310,410,510,610", "--settling", "0.3s",
    )  # fmt: skip
    running.wait_for("^1/5 ")
    running.send(signal.SIGKILL)
    running.process.wait()
    rig.await_world("ch1.on", False)

    assert rig.outputs() == [True, False]
    again = rig.run("sweep", "--bench", str(bench_file), "--no-figures", "--frequencies", "210")
    assert again.code == 0, again.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("moment", ["homing", "pressed", "paused"])
def test_make_safe_on_a_run_ends_it_lifted_and_nothing_moves_afterwards(rig, bench_file, moment):
    """Instruments that were only stopped behind its back would be moved by its next command."""
    many = ",".join(str(f) for f in range(300, 12300, 100))
    running = rig.start(
        "sweep", "--bench", str(bench_file), "--json", "--no-figures", "--frequencies", many
    )
    if moment == "homing":
        rig.await_world("homing")
    else:
        running.wait_for("^1/120 ")
    if moment == "paused":
        running.send(signal.SIGTSTP)
        running.wait_for("^PAUSED")
    safe = rig.run("make-safe", "--bench", str(bench_file))
    then = len(rig.log())
    ended = running.finish()

    assert safe.code == 0, safe.stderr
    assert f"in use by pid {running.process.pid} (" in safe.stderr
    assert "waiting for it to stop and to make the bench safe" in safe.stderr
    assert ended.code == 143, ended.stderr
    assert "preload released" in ended.stderr or moment != "pressed"
    assert not any(e["what"] in ("move", "homing", "ch1.on") for e in rig.log()[then:])
    assert rig.outputs()[-1:] != [True]
    assert rig.marks() == []


@pytest.mark.thorough
def test_an_unsafe_mark_keeps_the_next_run_from_starting_wherever_its_results_go(rig, bench_file):
    rig.mark_unsafe(bench_file, {"generator": "no answer"})
    refused = rig.run(
        "sweep", "--bench", str(bench_file), "--frequencies", "210", "--results", "elsewhere"
    )
    assert refused.code == 7
    assert "no answer" in refused.errors[0]
    assert "rig make-safe" in refused.errors[0]
    assert True not in rig.outputs()

    assert rig.run("make-safe", "--bench", str(bench_file)).code == 0
    assert rig.run("sweep", "--bench", str(bench_file), "--frequencies", "210").code == 0


@pytest.mark.thorough
def test_a_second_run_on_the_bench_is_refused_and_disturbs_nothing(rig, bench_file):
    many = ",".join(str(f) for f in range(300, 6300, 100))
    running = rig.start(
        "sweep", "--bench", str(bench_file), "--json", "--no-figures", "--frequencies", many
    )
    running.wait_for("^2/60 ")
    second = rig.run("sweep", "--bench", str(bench_file), "--json", "--results", "elsewhere")
    assert second.code == 2, second.stderr
    (error,) = second.object["errors"]
    assert f"the bench simulated is in use by pid {running.process.pid} (" in error
    assert ".rigj" in error
    running.wait_for("^10/60 ")

    running.send(signal.SIGKILL)
    running.finish()
    ended = rig.run(*two_points(bench_file))  # it waits until the guard is done
    assert ended.code == 0, ended.stderr
    (reported,) = [line for line in ended.stderr.splitlines() if "guard of an earlier run" in line]
    assert "the run ended without saying so; everything was stopped and switched off, " in reported
    lifted = r"stage_z was lifted: nothing is pressed at \d+\.\d\d mm, 0\.\d N; data: "
    assert re.search(r"was pressed at \d+\.\d\d mm, 2\d\.\d N; " + lifted, reported), reported
    assert f"rig resume {rig.only('*_r001.rigj')}" in reported
    again = rig.run(*two_points(bench_file))
    assert "guard of an earlier run" not in again.stderr


def two_points(bench_file):
    return (
        "sweep", "--bench", str(bench_file), "--json", "--no-figures", "--frequencies", "210,2100"
    )  # fmt: skip
