"""`rig jog` at a real terminal, on a simulated bench in real time and on the command's own."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import termios
import time

import pytest
from typist import Typist

from rig.bench.plan import read_bench
from rig.core.clock import WallClock
from rig.jog.keys import SILENCE_S

LESS, MORE = b"\x1b[A", b"\x1b[B"
REPEAT_S = 0.033
PATIENCE_S = 30.0
STEP_mm, SPEED_mm_s = 0.1, 1.0
SLOW_mm_s = 0.3
"""Speed at which a late line of the terminal is still seen below the largest force."""
LATE_S = 1.5
"""What a loaded machine may add to a stop; the figure itself is a benchmark's business."""
START_mm, CONTACT_mm = 10.0, 10.5


@pytest.fixture
def jogs(rig):
    """Start `rig jog` at a terminal."""
    started = []

    def start(*arguments):
        started.append(Typist(rig, "jog", *arguments))
        return started[-1]

    yield start
    for typist in started:
        typist.close()


@pytest.fixture
def bench_file(rig):
    """A bench in real time, its z stage homed and half a millimetre above the film."""
    world = rig.world(f"[clamp]\ncontact_mm = {CONTACT_mm}\n")
    log = ("--world-log", str(rig.world_log))
    serving = rig.start("simulate", "--write", "sim.toml", "--world", world, *log)
    serving.wait_for("Ctrl-C ends it")
    plan = read_bench(rig.folder / "sim.toml")
    (z,) = (part for part in plan.instruments if part.role == "stage_z")
    with contextlib.closing(z.driver.connect(z.settings, WallClock())) as stage:
        stage.home()
        stage.move_to(START_mm, 20.0)
    yield "sim.toml"
    serving.send(signal.SIGINT)
    assert serving.finish().code == 0


def stage_log(rig, *whats):
    return [e for e in rig.log() if e["device"] == "stage_z" and e["what"] in whats]


@pytest.mark.thorough
def test_a_held_key_moves_an_axis_up_to_a_limit_and_letting_go_stops_it(rig, jogs):
    """On the command's own bench, where the World keeps the time."""
    typist = jogs("--world-log", str(rig.world_log), "--step", "5mm", "--speed", "3mm/s")
    typist.sees(r"SIMULATED bench")
    typist.sees(r"--speed 3 mm/s reduced to 1 mm/s")
    typist.sees(r"--step 5 mm reduced to 0.15 mm")
    typist.types_after(r"not homed\)", MORE)
    typist.sees(r"stage_z is not homed and does not move")
    typist.types(b"h")
    typist.types_after(r"Press y within", b"y")
    typist.sees(r"stage_z is homed")
    time.sleep(2 * SILENCE_S)
    typist.types(LESS)
    typist.sees(r"limit 0 mm of stage_z reached")
    assert stage_log(rig, "move") == []
    held_s = typist.holds(MORE, r"stage_z 0\.[6-9]\d\d mm moving")
    typist.sees(r"stage_z \d\.\d+ mm \|", since=typist.sees(r"moving"))
    typist.types(b"q")
    code, shown = typist.ends()

    assert code == 0, shown
    (move, *_), rest = stage_log(rig, "move"), stage_log(rig, "at-rest")[-1]
    assert 0.6 <= rest["value"] <= held_s * SPEED_mm_s + 0.15
    assert (rest["t_us"] - move["t_us"]) * 1e-6 <= held_s + SILENCE_S + LATE_S
    log = (rig.results / "rig.log").read_text()
    assert re.search(r"stage_z from 0\.0000 mm towards more.*force x [-+]\d", log)
    assert re.search(rf"came from 0\.0000 to {rest['value']:.3f}\d mm \(released\)", log)
    assert termios.tcgetattr(typist.slave) == typist.before


@pytest.mark.thorough
def test_force_over_the_limit_stops_everything_and_leaves_only_the_way_off(rig, jogs, bench_file):
    typist = jogs("--bench", bench_file, "--largest-force", "4N")
    typist.sees(r"stage_z 10\.000 mm \|")
    typist.holds(MORE, r"stopped: force along z of .* N is over the limit of 4 N")
    typist.sees(r"only stage_z - moves until the force is below 3.2 N")
    typist.sees(r"OVER THE LIMIT")
    pressed_mm = stage_log(rig, "at-rest")[-1]["value"]
    moves = len(stage_log(rig, "move"))
    time.sleep(2 * SILENCE_S)
    typist.types(MORE)
    typist.sees(r"this way stays closed")
    assert len(stage_log(rig, "move")) == moves
    typist.holds(LESS, r"the force has fallen to")
    typist.types(b" ")
    typist.types(b"q")
    code, shown = typist.ends()
    assert code == 0, shown
    assert stage_log(rig, "at-rest")[-1]["value"] < pressed_mm
    assert "came from" in (log := (rig.results / "rig.log").read_text())
    assert "(tripped)" in log


@pytest.mark.thorough
def test_a_session_that_is_left_pressed_is_said_by_the_next_command(rig, jogs, bench_file):
    typist = jogs("--bench", bench_file, "--largest-force", "4N")
    typist.sees(r"stage_z 10\.000 mm \|")
    typist.holds(MORE, r"stopped: force along z of .* N is over the limit of 4 N")
    typist.types(b"q")
    code, shown = typist.ends()
    assert code == 0, shown
    again = jogs("--bench", bench_file, "--largest-force", "30N")
    again.sees(r"`rig jog` ended with a force that was over 4 N and had not fallen")
    again.sees(r"stage_z 1\d\.\d+ mm \|")
    again.types(b"q")
    assert again.ends()[0] == 0


@pytest.mark.thorough
def test_a_second_trip_on_the_way_off_ends_it(rig, jogs):
    """The sensor's zero is over this limit from the beginning; then something pushes."""
    fault = rig.fault(
        '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nafter_s = 2.0\nforce_N = 10.0\n'
    )
    code, shown = jogs("--largest-force", "1.5N", "--fault", fault).ends()
    assert code == 4, shown
    assert "only stage_z - moves until the force is below 1.2 N" in shown
    assert re.search(r"error: force along . of .* N .* during the retreat: the force", shown)
    assert "every axis is at rest" in shown


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("given", "code", "said"),
    [
        (("--largest-force", "1e9N"), 4, "error: --largest-force 1e+09 N is outside"),
        (("--axis", "rotary"), 2, "error: --axis rotary: the simulated bench does not have"),
    ],
)
def test_what_the_bench_cannot_do_is_refused_by_its_option(jogs, given, code, said):
    ended, shown = jogs(*given).ends()
    assert ended == code, shown
    assert said in shown
    assert "bench file" not in shown.partition("error:")[2]


def test_an_axis_that_no_bench_has_is_refused_before_anything_is_started(rig):
    ended = rig.run("jog", "--axis", "foo")
    assert ended.code == 2
    assert ended.errors == [
        "error: --axis foo: not an axis; choose one of stage_z, stage_x, rotary"
    ]


@pytest.mark.thorough
def test_a_key_stops_homing(rig, jogs):
    fault = rig.fault('[[fault]]\ndevice = "stage_z"\nkind = "slow"\nafter_s = 0.1\nshare = 0.02\n')
    typist = jogs("--fault", fault)
    typist.types_after(r"not homed\)", b"h")
    typist.types_after(r"Press y within", b"y")
    typist.types_after(r"homing stage_z", b" ")
    stopped = typist.sees(r"homing was stopped by a key")
    typist.sees(r"not homed\)", since=stopped)
    typist.types(b"q")
    code, shown = typist.ends()
    assert code == 0, shown
    assert "stage_z is homed" not in shown[stopped:]


def test_ctrl_c_at_a_held_key_ends_in_order_and_a_second_owner_is_refused(rig, jogs, bench_file):
    typist = jogs("--bench", bench_file, "--largest-force", "30N")
    typist.sees(r"stage_z 10\.000 mm \|")
    second = rig.run("sweep", "--bench", bench_file)
    assert second.code == 2
    assert f"in use by pid {typist.process.pid}" in second.stderr
    typist.holds(MORE, r"stage_z 10\.\d+ mm moving")
    typist.types(b"\x1a")
    paused = typist.sees(r"stopped: paused by the operator \(Ctrl-Z continues\); nothing moves")
    typist.types(b"\x1a")
    typist.sees(r"Resumed", since=paused)
    typist.types(b"\x03")
    code, shown = typist.ends()
    assert code == 130, shown
    assert "stopped by Ctrl-C" in shown
    assert "every axis is at rest" in shown
    assert termios.tcgetattr(typist.slave) == typist.before
    rig.await_world("streaming", False, count=2)
    assert stage_log(rig, "move", "at-rest")[-1]["what"] == "at-rest"


@pytest.mark.thorough
def test_ctrl_backslash_at_a_held_key_ends_in_order(rig, jogs, bench_file):
    """The terminal turns it into SIGQUIT for every process of its foreground group."""
    typist = jogs("--bench", bench_file, "--largest-force", "30N")
    typist.sees(r"stage_z 10\.000 mm \|")
    typist.holds(MORE, r"stage_z 10\.\d+ mm moving")
    typist.types(b"\x1c")
    code, shown = typist.ends()
    assert code == 131, shown
    assert "stopped by Ctrl-\\" in shown
    assert "every axis is at rest" in shown
    assert termios.tcgetattr(typist.slave) == typist.before
    rig.await_world("streaming", False, count=2)
    assert stage_log(rig, "move", "at-rest")[-1]["what"] == "at-rest"


@pytest.mark.thorough
def test_a_killed_program_leaves_at_most_a_step_and_the_guard_tells(rig, jogs, bench_file):
    """It presses: a guard that lifts would lift z here."""
    path = rig.folder / bench_file
    text = path.read_text()
    assert "contact_from_mm = 12.0" in text
    path.write_text(text.replace("contact_from_mm = 12.0", f"contact_from_mm = {CONTACT_mm}"))
    typist = jogs("--bench", bench_file, "--largest-force", "30N", "--speed", f"{SLOW_mm_s}mm/s")
    typist.sees(r"stage_z 10\.000 mm \|")
    typist.holds(MORE, r"stage_z 10\.[6-9]\d+ mm")
    typist.process.send_signal(signal.SIGKILL)
    typist.process.wait()
    rig.await_world("at-rest", count=3)
    last_seen_mm = float(re.findall(r"stage_z (\d+\.\d+) mm", typist.ends()[1])[-1])
    rest_mm = stage_log(rig, "at-rest")[-1]["value"]
    shown_late_mm = LATE_S * SLOW_mm_s  # the line is shown now and then
    assert rest_mm <= last_seen_mm + shown_late_mm + STEP_mm

    report = rig.results / "guard-simulated.json"
    deadline = time.monotonic() + PATIENCE_S
    while not (report.exists() and "file" in report.read_text()):
        assert time.monotonic() < deadline, "the guard never reported"
        time.sleep(0.05)
    written = json.loads(report.read_text())
    assert written["safe"] is True
    assert "was lifted" not in written["pressed"]
    assert re.match(r"stage_z is at 10\.\d+ mm, the force sensor reads \d", written["pressed"])
    assert written["released"] is False
    downwards = [START_mm, *(e["value"]["target_mm"] for e in stage_log(rig, "move")[1:])]
    assert downwards == sorted(downwards), "nothing has moved z up beside a person"
    assert stage_log(rig, "at-rest")[-1]["value"] == rest_mm > CONTACT_mm + 0.1
    again = jogs("--bench", bench_file, "--largest-force", "30N")
    again.sees(
        r"the guard of an earlier run had to act at .*; everything was stopped and switched off, "
    )
    again.sees(r"stage_z 10\.\d+ mm \|")
    again.process.send_signal(signal.SIGTERM)
    code, shown = again.ends()
    assert code == 143, shown
    assert "rig resume" not in shown


@pytest.mark.thorough
def test_an_axis_that_could_not_be_stopped_is_reached_by_the_guard(rig, jogs):
    """Its serial port serves one program at a time: the session closes it first."""
    unheard = 'device = "rotary"\nkind = "silence"\ncommand = "stop"\nmove = 1\ncount = 3\n'
    fault = rig.fault(f"[[fault]]\n{unheard}")
    fixture = ("--fixture", "semi-spherical-object", "--write", "sim.toml", "--fault", fault)
    serving = rig.start("simulate", *fixture, "--world-log", str(rig.world_log))
    serving.wait_for("Ctrl-C ends it")
    typist = jogs("--bench", "sim.toml", "--axis", "rotary")
    typist.types_after(r"rotary .*not homed\)", b"h")
    typist.types_after(r"Press y within", b"y")
    typist.sees(r"rotary is homed")
    time.sleep(2 * SILENCE_S)
    typist.holds(MORE, r"rotary [\d.]+ deg moving")
    typist.types(b"q")
    code, shown = typist.ends()
    assert code == 7, shown
    assert "NOT SAFE: rotary could not be stopped" in shown
    assert "the guard then made the bench safe" in shown, shown
    report = json.loads((rig.results / "guard-simulated.json").read_text())
    assert "could not stop every axis: rotary: " in report["cause"]
    serving.send(signal.SIGINT)
    assert serving.finish().code == 0


@pytest.mark.thorough
def test_a_terminal_that_goes_away_ends_it(rig, jogs, bench_file):
    typist = jogs("--bench", bench_file)
    typist.sees(r"stage_z 10\.000 mm \|")
    os.close(typist._master)
    assert typist.process.wait(PATIENCE_S) == 129


def test_without_a_terminal_it_refuses_before_anything_is_connected(rig, bench_file):
    refused = rig.run("jog", "--bench", bench_file)
    assert refused.code == 2
    assert "stdin is not a terminal" in refused.errors[0]
    assert "run it in a terminal" in refused.errors[0]
    assert rig.run("jog", "--speed", "-1mm/s").code == 2
    assert len(stage_log(rig, "move")) == 1, "the preparation's own"
