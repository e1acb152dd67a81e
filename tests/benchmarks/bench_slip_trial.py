"""The slip trial through the whole wire: true to the model, on force, in time, without a loss.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_slip_trial.py``; alone on the machine:
the real-time part means nothing beside other load. `RIG_REPEATS=20` for 20 trials instead of 200 in
the count of samples, and at most as many of the 40 corners.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from multiprocessing import get_context

import numpy as np
import pytest
from measured import heading, repeats, row, target
from slip_model import compare

from procedures.pressed import ticks as pressed_ticks
from procedures.slip_trial import SlipTrial
from rig.bench.plan import read_bench
from rig.control import tick_loop as loop
from rig.core.clock import WallClock
from rig.files.runfile.reader import RunFile
from rig.run.execute import execute
from rig.run.job import RunJob
from rig.run.stopping import StopFlag

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(7200)]

SEEDS = range(1, 6)
TRIALS = repeats(200)
RATE_Hz = 500.0
ERRORS = ("force_error_rms", "force_error_peak", "overshoot")


def take(rig, *given, friction=None):
    """One run of the command; its ending and how long it took."""
    own = ("--world-log", str(rig.world_log), "--json")
    if friction is not None:
        static, kinetic = friction
        coefficients = f"{{ static_coefficient = {static}, kinetic_coefficient = {kinetic} }}"
        own += ("--world", rig.world(f"contact.friction = {coefficients}\n"))
    begin = time.perf_counter()
    ended = rig.run("slip-trial", *own, *given)
    return ended, time.perf_counter() - begin


def file_of(rig, ended):
    """The run file."""
    return rig.folder / ended.object["file"]


def test_five_seeds_show_what_the_model_shows(rig, skin8):
    heading("rig slip-trial --seed S --distance 0.6mm, S = 1..5; measured by modelled")
    kinetics, statics = [], []
    for seed in SEEDS:
        ended, _ = take(rig, "--no-figures", "--seed", str(seed), "--distance", "0.6mm")
        assert ended.code == 0, ended.stderr
        with RunFile.open(file_of(rig, ended)) as run:
            (reading,) = run.readings()
            found = compare(run, "trial-001", reading, skin8)
        ratios = found.ratios()
        print(f"seed {seed}: " + ", ".join(f"{k} {v:.3f}" for k, v in ratios.items()))
        assert ratios == pytest.approx(dict.fromkeys(ratios, 1.0), abs=0.2)
        assert found.slip_order == [1, 9, 2, 3, 8, 4, 7, 5, 6]
        kinetics.append(reading["kinetic_friction"] / 0.65)
        statics.append(reading["static_friction"] / found.static_coefficient)
    row("kinetic friction by the World's", kinetics, "", 4)
    row("static friction by the modelled contact's", statics, "", 4)
    assert kinetics == pytest.approx([1.0] * len(kinetics), abs=0.03)
    assert statics == pytest.approx([1.0] * len(statics), abs=0.03)


CORNERS = [
    (static, ratio, force_N, speed_mm_s, tick_Hz)
    for static, ratio in ((0.3, 0.95), (0.8, 0.85), (1.2, 0.7), (1.2, 0.95))
    for force_N in (2.0, 8.0)
    for speed_mm_s, tick_Hz in ((0.3, 100), (1.3, 100), (6.0, 100), (2.8, 500), (6.0, 500))
]
"""Each tick at its fastest slide without a rehearsal, and at the fastest of all."""
STRIDES = (1, 3, 7, 13)
"""Steps through the corners; none divides their number, so all frictions and speeds are met."""


def test_the_force_is_held_in_the_corners(rig):
    heading("rig slip-trial over friction, force, speed and ticks: errors of F_n in the slide")
    print("mu_s ratio  F_n   mm/s   Hz     rms %  peak %  overshoot %  invalid")
    missed = []
    every = min((k for k in STRIDES if k * TRIALS >= len(CORNERS)), default=STRIDES[-1])
    for static, ratio, force_N, speed_mm_s, tick_Hz in CORNERS[::every]:
        distance_mm = 0.09 * static * force_N + 0.25 + 0.1 * speed_mm_s
        ended, _ = take(
            rig, "--no-figures", "--normal-force", f"{force_N}", "--speed", f"{speed_mm_s}",
            "--tick", f"{tick_Hz}", "--distance", f"{distance_mm:.3f}", "--rest", "0.2",
            friction=(static, static * ratio),
        )  # fmt: skip
        assert ended.code in (0, 5), ended.stderr
        with RunFile.open(file_of(rig, ended)) as run:
            (reading,) = run.readings()
        errors = [reading[f"{name}_percent"] for name in ERRORS]
        condition = f"{static:4g} {ratio:5g} {force_N:4g} {speed_mm_s:6g} {tick_Hz:4g}"
        reported = "   ".join(f"{error:7.2f}" for error in errors)
        print(f"{condition}  {reported}   {reading['invalid']}", flush=True)
        if errors[0] > 2 or errors[1] > 5 or errors[2] > 10:
            missed.append(condition)
    target("corners missed", len(missed), 0, "")
    assert not missed


def test_a_trial_from_command_to_figure(rig):
    heading("rig slip-trial --distance 1mm --speed 0.5mm/s, whole process with its figure")
    walls, benches = [], []
    for _ in range(12):
        ended, wall = take(rig, "--distance", "1mm", "--speed", "0.5mm/s")
        assert ended.code == 0, ended.stderr
        walls.append(wall)
        benches.append(ended.object["duration_s"])
    row("bench time", benches[1:], "s", 2)
    target("command to figure, warm", row("wall, warm", walls[1:], "s", 2), 5.0, "s")


def test_a_series_against_real_time(rig):
    heading("rig slip-trial -n 20 --no-figures")
    ended, wall = take(rig, "-n", "20", "--no-figures")
    assert ended.code == 0, ended.stderr
    bench = ended.object["duration_s"]
    print(f"bench time {bench:.1f} s, wall {wall:.1f} s")
    target("times real time", bench / wall, 3.0, "", at_least=True)


def test_no_sample_is_lost_or_doubled(rig):
    """Counted against the World's own clock, and no block of noise comes twice."""
    heading(f"rig slip-trial -n {TRIALS} --distance 0.3mm --speed 1mm/s --rest 100ms")
    ended, wall = take(
        rig, "-n", f"{TRIALS}", "--no-figures", "--distance", "0.3mm", "--speed", "1mm/s",
        "--rest", "100ms",
    )  # fmt: skip
    assert ended.code == 0, ended.stderr
    reported = [(e["t_us"], e["value"]) for e in rig.log() if e["what"] == "acquisition"]
    assert [what for _, what in reported] == ["run", "stop"] * TRIALS
    samples = frames = 0
    with RunFile.open(file_of(rig, ended)) as run:
        readings = {r["trial"]: r for r in run.readings()}
        for number in range(1, TRIALS + 1):
            series = {w.stream: w for w in run.waveforms(f"trial-{number:03d}")}
            begin_us, end_us = reported[2 * number - 2][0], reported[2 * number - 1][0]
            strip = series["strips"].counts["strip_1"]
            assert len(strip) == readings[number]["samples"]
            left = (end_us - begin_us) // 100 - len(strip)  # 10 kS/s
            assert 0 <= left < 400, f"trial {number}: {left} samples at its end"
            blocks = strip[: len(strip) // 100 * 100].reshape(-1, 100)
            assert len(np.unique(blocks, axis=0)) == len(blocks), f"trial {number}: doubled"
            force = series["force"].counts["F_n"]
            assert abs(1e-4 * len(strip) - 1e-3 * len(force)) < 0.011, f"trial {number}: frames"
            samples, frames = samples + len(strip), frames + len(force)
    bench = ended.object["duration_s"]
    print(f"{samples} samples of each strip and {frames} frames, none lost or doubled")
    print(f"bench time {bench:.0f} s, wall {wall:.0f} s: {bench / wall:.2f} times real time")


BARE_LOOP = """
import signal, sys, time
import numpy as np
rate, path = float(sys.argv[1]), sys.argv[2]
ended = []
signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
start, behind = time.monotonic(), []
while not ended:
    due = start + len(behind) / rate
    rest = due - time.monotonic()
    if rest > 0:
        time.sleep(rest)
    behind.append(time.monotonic() - due)
np.save(path, np.column_stack([start + np.arange(len(behind)) / rate, behind]))
"""


def run_timed(folder, bench_file):
    """Two trials at `RATE_Hz` on a bench file; leaves the work of each tick in ``work.npy``, and
    begin, end, ticks and late ticks of each loop at that rate in ``loops.npy``. In a process of its
    own, which the run's guard may kill."""
    work_s, loops = [], []

    def timed(run, rate_Hz, duration_s, on_tick, *wait):
        def tick(at):
            begin = time.perf_counter()
            going_on = on_tick(at)
            work_s.append(time.perf_counter() - begin)
            return going_on

        begin_s = time.monotonic()
        done = loop.tick_loop(run, rate_Hz, duration_s, tick, *wait)
        if rate_Hz == RATE_Hz:
            loops.append((begin_s, time.monotonic(), done.ticks, done.late))
        return done

    pressed_ticks.tick_loop = timed
    settings = SlipTrial.Settings(tick_Hz=RATE_Hz, distance_mm=2.0, trials=2)
    job = RunJob(procedure=SlipTrial(settings), seed=0, results=folder)
    outcome = execute(job, read_bench(bench_file), WallClock(), StopFlag())
    print(f"outcome: {outcome.status}", *(f.one_line() for f in outcome.failures))
    np.save(folder / "work.npy", work_s)
    np.save(folder / "loops.npy", loops)


def test_ticks_in_real_time(rig):
    """The simulated bench runs by itself, over its sockets and its pty; the bare loop beside it,
    compared while ticks are made."""
    heading(f"slip trial at {RATE_Hz:g} Hz in real time, recording on, beside a bare sleep loop")
    path = rig.folder / "bench.toml"
    serving = rig.start("simulate", "--fixture", "plate", "--write", str(path))
    serving.wait_for("Ctrl-C ends it")
    rig.results.mkdir()
    run = get_context("spawn").Process(target=run_timed, args=(rig.results, path))
    run.start()
    bare_file = rig.results / "bare.npy"
    beside = subprocess.Popen([sys.executable, "-c", BARE_LOOP, str(RATE_Hz), str(bare_file)])
    run.join()
    beside.terminate()
    assert beside.wait() == 0
    serving.send(signal.SIGINT)
    serving.finish()
    assert run.exitcode == 0, "the machine was too slow for the simulated bench in real time"
    work_ms = 1e3 * np.load(rig.results / "work.npy")
    words = "p50 {:.2f}, p99 {:.2f}, p99.9 {:.2f}, most {:.2f}"
    print("work in a tick, ms: " + words.format(*np.quantile(work_ms, [0.5, 0.99, 0.999, 1.0])))
    with RunFile.open(rig.only("*.h5")) as file:
        for reading in file.readings():
            busy, missed = reading["held_back_ticks"], reading["missed_ticks"]
            reported = f"{reading['ticks']} ticks, {missed} left out, z busy in {busy}"
            force = "F_n {:.2f} % rms, {:.2f} % peak, {:.2f} % overshoot".format(
                *(reading[f"{name}_percent"] for name in ERRORS)
            )
            print(f"trial {reading['trial']}: {reported}; {force}; {reading['invalid']}")
    loops, bare = np.load(rig.results / "loops.npy"), np.load(bare_file)
    meanwhile = np.zeros(len(bare), dtype=bool)
    for begin_s, end_s, *_ in loops:
        meanwhile |= (bare[:, 0] >= begin_s) & (bare[:, 0] < end_s)
    late = bare[meanwhile, 1] > loop.LATE / RATE_Hz
    assert bare[0, 0] < loops[0, 0], "the bare loop has begun after the trials"
    print(f"bare loop meanwhile: {len(late)} turns, {100 * late.mean():.2f} % late")
    ticks, late_ticks = loops[:, 2:].sum(axis=0)
    print(f"servo: {ticks:.0f} ticks, {100 * late_ticks / ticks:.2f} % late or left out")
    target("share of late ticks", late_ticks / ticks, late.mean(), "")
