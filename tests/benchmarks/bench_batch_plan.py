"""What a batch is planned to take and what it takes.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_batch_plan.py``; alone on the machine:
the real-time part means nothing beside other load. `RIG_REPEATS=5` for five short runs in real time
instead of twenty.
"""

from __future__ import annotations

import signal
import time

import pytest
from measured import heading, repeats, row, target

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]

RUNS = repeats(20)
KINDS = (
    ("slip-trial", "", ()),
    ("slip-trial", "trials = 4", ("-n", "4")),
    ("slip-trial", "speed_mm_s = 5\ndistance_mm = 5", ("--speed", "5", "--distance", "5")),
    ("slip-trial", 'loading = "ramp"', ("--loading", "ramp")),
    ("roll-trial", "", ()),
    ("roll-trial", "trials = 3", ("-n", "3")),
    ("sweep", 'frequencies_Hz = "200,300,500,1000"', ("--frequencies", "200,300,500,1000")),
    ("sweep", 'frequencies_Hz = "2,5,20,2000"', ("--frequencies", "2,5,20,2000")),
    ("sweep", "", ()),
)
"""Procedure, settings in a batch file, the same as options."""
SHORT = {
    "film-clamp": 'procedure = "sweep"\nsettings = { frequencies_Hz = "200,300,500,1000" }\n',
    "plate": 'procedure = "slip-trial"\nsettings = { distance_mm = 0.5 }\n',
}


def batch_of(experiments: str) -> str:
    return f'[batch]\nname = "planned"\nfigures = false\ndetect = false\n{experiments}'


def plan_of(rig, text, *options):
    (rig.folder / "batch.toml").write_text(text)
    planned = rig.run("batch", "plan", "batch.toml", "--json", *options)
    assert planned.code == 0, planned.stderr
    return planned.object


def test_bench_time_of_every_kind_of_run(rig):
    heading("rig batch plan, then rig PROCEDURE on the simulated bench: bench time")
    errors = []
    for procedure, settings, options in KINDS:
        text = f'[[experiment]]\nprocedure = "{procedure}"\n[experiment.settings]\n{settings}\n'
        plan = plan_of(rig, batch_of(text))
        (condition,) = plan["conditions"].values()
        ended = rig.run(procedure, "--no-figures", "--json", *options).object
        taken_s, planned_s = ended["duration_s"], plan["duration_s"]
        errors.append(100 * (planned_s / taken_s - 1))
        size_B = (rig.folder / ended["file"]).stat().st_size
        print(
            f"{procedure:11s}{' '.join(options):35s} planned {planned_s:6.2f} ± "
            f"{condition['spread_s']:.2f} s, taken {taken_s:6.2f} s ({errors[-1]:+.1f} %); file "
            f"planned {condition['disk_B'] / 1e3:6.0f} kB, is {size_B / 1e3:6.0f} kB"
        )
    row("planned beyond taken", errors, "%", 1)


@pytest.mark.parametrize("fixture", SHORT)
def test_short_runs_in_real_time(rig, fixture):
    heading(f"rig simulate --fixture {fixture}; rig batch run of {RUNS} short runs on it")
    simulator = rig.start("simulate", "--fixture", fixture, "--write", "sim.toml")
    simulator.wait_for("drive it")
    text = batch_of(f"[[experiment]]\nrepeat = {RUNS}\n{SHORT[fixture]}")
    plan = plan_of(rig, text, "--bench", "sim.toml")
    batch = rig.start("batch", "run", "batch.toml", "--bench", "sim.toml")
    batch.wait_for(r"^run 1/")
    begun_s = time.monotonic()
    last_s, single_s = begun_s, []
    for number in range(1, RUNS + 1):
        line = batch.wait_for(rf"^run {number}: ")
        assert "complete" in line, line
        now_s = time.monotonic()
        single_s.append(now_s - last_s)
        last_s = now_s
    ended = batch.finish()
    simulator.send(signal.SIGINT)
    simulator.finish()
    assert ended.code in (0, 5), ended.stderr
    taken_s = last_s - begun_s
    row("single runs", single_s, "s", 2)
    print(f"planned {plan['duration_s']:.1f} ± {plan['spread_s']:.1f} s, taken {taken_s:.1f} s")
    target("difference", 100 * abs(plan["duration_s"] / taken_s - 1), 5, "%")
