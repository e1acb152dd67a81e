"""A grip that answers: latency in real time against the bench's own floor; live events against the
file's.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_grip.py``. `RIG_REPEATS=8` for eight
weights in real time instead of 30, or for eight trials whose events are compared instead of 500;
``-k latency`` or ``-k file`` chooses. The trials of ``-k file`` are the same in every run: with
`RIG_FIRST=250` those before are left out, so that several processes can share them.

The floor is the same weight in virtual time, where exchanges and threads take none: what remains is
the age of the sample in its block, the drive's acceleration and the force sensor. From the alarm,
that is from the decision, it is the drive's acceleration and the force sensor alone.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import time

import numpy as np
import pytest
from measured import heading, repeats

from procedures.pressed.record.detection import LiveDetection
from rig.core.clock import WallClock
from rig.detector.registered import chosen_detector
from rig.files.journal.detections import from_text
from rig.files.runfile.reader import RunFile
from rig.processing.detection import detect_trials

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(6 * 3600)]

WEIGHT = (
    "slip-trial", "--json", "--no-figures", "--regrip", "--loading", "ramp", "--hold-at", "3N",
    "--speed", "2mm/s", "--distance", "2mm", "--hold-for", "0.3s",
    "--force-error-peak", "1000", "--force-error-rms", "1000", "--late-ticks", "100",
)  # fmt: skip
STAGES = ("decided", "sent", "acknowledged", "risen")


def stages_ms(rig, *given):
    """Stages of every first squeeze of a run in ms since its alarm's sample, by stage."""
    ended = rig.run(*WEIGHT, *given)
    assert ended.code in (0, 5), ended.stderr
    with RunFile.open(rig.folder / json.loads(ended.stdout)["file"]) as run:
        found = {name: 1e3 * run.column(f"squeeze_{name}") for name in STAGES}
        said = [one for one in run.outcome.warnings if "blocks of" in one]
        late = 100 * run.column("late_ticks").sum() / run.column("ticks").sum()
    return found, late, said


def test_latency_in_real_time_against_the_floor(rig):
    trials = repeats(30)
    floor, _, _ = stages_ms(rig, "-n", "16")  # where a slip falls in its block decides: 3 to 5 ms
    path = rig.folder / "bench.toml"
    serving = rig.start("simulate", "--fixture", "plate", "--write", str(path))
    serving.wait_for(path.name)
    real, late, said = stages_ms(rig, "--bench", str(path), "-n", str(trials))
    heading(f"rig simulate; rig {' '.join(WEIGHT)} -n {trials}: ms since the alarm's sample")
    print(f"late ticks {late:.1f} %", *said, sep="\n")
    for name in STAGES:
        values = real[name][np.isfinite(real[name])]
        if not values.size:
            continue
        print(
            f"{name:>13}: floor {np.nanmedian(floor[name]):.1f}, median "
            f"{np.median(values):.1f}, p99 {np.percentile(values, 99):.1f}, n {values.size}"
        )
    serving.send(signal.SIGTERM)
    if not np.isfinite(real["risen"]).any():
        print("no trial squeezed")
        return
    for since, took, at_least in (
        ("sample", real["risen"], floor["risen"]),
        ("decision", real["risen"] - real["decided"], floor["risen"] - floor["decided"]),
    ):
        least = np.nanmedian(at_least)
        over = took[np.isfinite(took)] - least
        print(
            f"since the alarm's {since}: floor {least:.1f} ms, median {np.median(over):.1f} ms "
            f"over it, p99 {np.percentile(over, 99):.1f} ms"
        )


def test_the_detectors_share_of_a_tick():
    heading("LiveDetection.judge, blocks of 2 rows (2 ms), paper-hp and rig")
    rows = 1e-4 * np.random.default_rng(1).standard_normal((20_000, 2))
    for name in ("paper-hp", "rig"):
        live = LiveDetection(name, WallClock())
        live.judge(rows[:2])
        took_us = []
        for first in range(2, len(rows), 2):
            begun_s = time.perf_counter()
            live.judge(rows[first : first + 2])
            took_us.append(1e6 * (time.perf_counter() - begun_s))
        share = 5 * statistics.median(took_us) / 10_000
        print(
            f"{name}: median {statistics.median(took_us):.1f} us a block, p99 "
            f"{np.percentile(took_us, 99):.1f} us; five are {100 * share:.2f} % of a tick of "
            "10 ms, on the DAQ's link and not in the tick"
        )


def test_live_events_are_those_of_the_file(rig):
    """Slides with blocks of any length, ticks of any rate, each detector, and late ticks."""
    trials, chance = repeats(500), np.random.default_rng(2025)
    first = int(os.environ.get("RIG_FIRST", "0"))
    equal = events = slips = late = 0
    for seed in range(trials):
        tick_Hz, block_ms = int(chance.integers(50, 400)), float(chance.choice([1, 2, 5, 20, 50]))
        at_s, by_s = float(chance.uniform(0.2, 2.5)), float(chance.uniform(0.005, 0.05))
        plan = rig.fault(
            f'[[fault]]\ndevice = "clock"\nkind = "clock-jump"\nby_s = {by_s}\n'
            f"acquisition = 1\nafter_s = {at_s}\n"
        )
        detector = str(chance.choice(["paper-hp", "rig", "paper-literal"]))
        if seed < first:
            continue
        given = ("--seed", str(seed), "--tick", str(tick_Hz), "--block", f"{block_ms}ms")
        ended = rig.run(
            "slip-trial", "--json", "--no-figures", "--detector", detector, "--distance", "0.6mm",
            "--fault", plan, "--late-ticks", "100", "--force-error-rms", "1000",
            "--force-error-peak", "1000", "--overshoot", "1000", *given,
        )  # fmt: skip
        assert ended.code in (0, 5), ended.stderr
        with RunFile.open(rig.folder / json.loads(ended.stdout)["file"]) as run:
            (reading,) = run.readings()
            (found,) = detect_trials(run, chosen_detector(detector))
        live = [
            (e.kind, e.sample, e.confidence, e.reason) for e in from_text(reading["detections"])
        ]
        filed = [(e.kind, e.sample, e.confidence, e.reason) for e in found.events]
        assert live == filed, f"seed {seed} {given}"
        equal += 1
        events += len(live)
        slips += sum(kind == "incipient slip" for kind, *_ in live)
        late += int(reading["late_ticks"] > 0)
    drawn = "drawn ticks, blocks, detectors and jumps of the clock"
    heading(f"{trials - first} slip trials with {drawn}")
    print(f"{equal} equal to the file, {events} events, {slips} slips; {late} had late ticks")
