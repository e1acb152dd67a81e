"""The complete sweep against what physics allows: time, load, preload, truth, and the trip's delay.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_levelled_sweep.py``.
"""

from __future__ import annotations

import math
import re
import signal

import numpy as np
import pytest
from measured import heading, row, target

from rig.model.front_end import FrontEndSettings
from rig.model.vibrator import drawn_film, true_response, vibrator_line
from rig.recording.runfile import RunFile

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3000)]

SEEDS = range(20)
TARGET_DB = 0.05
DB = 20 / math.log(10)


def floor_s(run, seed):
    """Least time of each point: ring-down to 1 % of the slowest response, and the larger of a cycle
    and the time in which the World's noise lets the gain be known to the target. (n,) s."""
    mechanics, circuit = drawn_film(seed)
    slowest_s = 1 / np.min(np.abs(vibrator_line(mechanics, circuit).poles.real))
    f, load_N = run.column("frequency"), run.column("load_set")
    density = FrontEndSettings().noise_density_V_sqrtHz
    film_V = np.abs(true_response(f, mechanics, circuit)) * load_N
    cell_V = mechanics.cell_sensitivity_V_N * load_N
    known_s = (DB / TARGET_DB * density) ** 2 * (1 / film_V**2 + 1 / cell_V**2)
    return slowest_s * math.log(100) + np.maximum(1 / f, known_s)


def test_time_load_preload_and_truth(rig):
    heading("rig sweep --seed S, S = 0..19")
    ratios, wholes, deviations, largest, overshoots, settlings, spreads = [], [], [], [], [], [], []
    for seed in SEEDS:
        ended = rig.sweep("--seed", str(seed))
        assert ended.code == 0, ended.stderr
        with RunFile.open(rig.folder / ended.object["file"]) as run:
            floor = floor_s(run, seed).sum()
            ratios.append(run.column("taken").sum() / floor)
            wholes.append(run.outcome.duration)
            load = run.column("load_amplitude") / run.column("load_set")
            deviations.append(100 * np.abs(load - 1).max())
            largest.append(100 * (run.column("largest_load") / run.column("load_set") - 1).max())
            truth = np.abs(true_response(run.column("frequency"), *drawn_film(seed)))
            error = run.column("gain") - 20 * np.log10(truth)
            spreads.append((error / run.column("gain_error")).std())
            told = [m.decode() for m in run.entry["events/message"][()] if b"overshoot" in m]
            overshoots.append(float(re.search(r"overshoot ([\d.]+) %", told[0])[1]))
            settlings.append(float(re.search(r"held ([\d.]+) s", told[0])[1]))
    target("points against their floor, seed 0", ratios[0], 1.25, "")
    row("points against their floor", ratios, "", 2)
    row("whole bench time, preload and parking included", wholes, "s", 1)
    target("load of a kept point off by", row("largest", deviations, "%", 2), 1, "%")
    row("largest overshoot of the load anywhere", largest, "%", 1)
    target("overshoot of the preload", row("overshoot", overshoots, "%", 1), 5, "%")
    row("contact to held preload", settlings, "s", 2)
    row("spread of the normalised residuals of the gain", spreads, "", 2)
    assert max(deviations) <= 1


@pytest.mark.parametrize("blocked", [False, True], ids=["idle", "in a blocking read"])
def test_from_overload_to_the_command_on_the_wire(rig, blocked):
    """In real time; the World's log says when the force rose and when the generator obeyed."""
    heading(f"rig sweep in real time, a push of 30 N, procedure {'blocked' if blocked else 'idle'}")
    pushed = range(3, 400, 4 if not blocked else 400)
    bumps = ", ".join(f"{{ acquisition = {k}, after_s = 0.3, for_s = 0.05 }}" for k in pushed)
    delays = []
    for repeat in range(2 if not blocked else 12):
        path = rig.folder / f"{blocked}{repeat}.toml"
        rig.world_log.unlink(missing_ok=True)
        arguments = ["--world", rig.world(f"bumps = [{bumps}]\n")]
        if blocked:
            arguments += ["--fault", rig.fault(
                '[[fault]]\ndevice = "daq"\nkind = "silence"\nat = 4\ncommand = "WAV:DATA"\n'
            )]  # fmt: skip
        serving = rig.start(
            "simulate", "--write", str(path), "--world-log", str(rig.world_log), *arguments
        )
        serving.wait_for("Ctrl-C ends it")
        path.write_text(path.read_text().replace("timeout_ms = 1000", "timeout_ms = 5000"))
        rig.run("sweep", "--bench", str(path), "--no-figures", "--frequencies", "2,3,300")
        serving.send(signal.SIGINT)
        serving.finish()
        log = rig.log()
        for bump in (line for line in log if line["what"] == "bump"):
            begin_us = bump["t_us"] + 300_000
            off = [
                x["t_us"] for x in log
                if x["what"] == "ch1.on" and not x["value"] and x["t_us"] >= begin_us
            ]  # fmt: skip
            on_before = [x for x in log if x["what"] == "ch1.on" and x["t_us"] < begin_us]
            if off and on_before and on_before[-1]["value"]:
                delays.append((off[0] - begin_us) * 1e-3)
    row("overload to generator off", delays, "ms", 2)
    p50, p99 = np.quantile(delays, [0.5, 0.99])
    print(f"p50 {p50:.2f} ms, p99 {p99:.2f} ms, largest {max(delays):.2f} ms (n = {len(delays)})")
