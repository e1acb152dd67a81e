"""What goes wrong in the slide or ramp of a trial in real time at 500 Hz, its links served in
background threads: x at rest, the skin off the plate or said to be on it, what went wrong
reported, a file that can be read.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_real_time_faults.py``. CI has the same
faults in slaved time, where each happens at the same instant every time; here it does not.
``-k ramp`` for five of the 23 cases; ``-k late`` for the late ticks of a loop of 500 Hz beside a
DAQ whose every answer takes 30 ms longer, and beside one that is not disturbed, `RIG_REPEATS` (3)
slides of each in turn, which needs an idle computer.
"""

from __future__ import annotations

import signal
import time

import pytest
from benches import declare_soft_contact
from measured import heading, repeats

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(600)]

SLIDES = 2
"""Which move of x is the one under the force: the first goes to where it begins."""
SLIDING = f'move = {SLIDES}\nof = "stage_x"\nafter_s = 0.5\n'
FAULTS = {
    "nothing": ("", {0, 5}),
    "z silent": (f'device = "stage_z"\nkind = "silence"\ncount = 0\n{SLIDING}', {3}),
    "z silent for 1.5 s": (f'device = "stage_z"\nkind = "silence"\nfor_s = 1.5\n{SLIDING}', {3}),
    "z closes": (f'device = "stage_z"\nkind = "close"\n{SLIDING}', {3}),
    "z reset": (f'device = "stage_z"\nkind = "reset"\n{SLIDING}', {3}),
    "z garbage": (f'device = "stage_z"\nkind = "garbage"\n{SLIDING}', {3}),
    "z stale": (f'device = "stage_z"\nkind = "stale"\n{SLIDING}', {0, 3, 5}),
    "z fault": (f'device = "stage_z"\nkind = "drive-fault"\n{SLIDING}', {3}),
    "z runs away": (f'device = "stage_z"\nkind = "runaway"\n{SLIDING}', {0, 3, 4, 5}),
    "x silent": (f'device = "stage_x"\nkind = "silence"\ncount = 0\n{SLIDING}', {3}),
    "x half open": (f'device = "stage_x"\nkind = "half-open"\n{SLIDING}', {3}),
    "x stuck": (f'device = "stage_x"\nkind = "stuck"\n{SLIDING}', {3}),
    "DAQ silent": ('device = "daq"\nkind = "silence"\ncommand = "WAV:DATA"\nat = 150\n', {3}),
    "DAQ closes": ('device = "daq"\nkind = "close"\ncommand = "WAV:DATA"\nat = 150\n', {3}),
    "DAQ overruns": ('device = "daq"\nkind = "overrun"\nacquisition = 1\nafter_s = 2.5\n', {3}),
    "force, retaken": (f'device = "force_sensor"\nkind = "spike"\nforce_N = 30\n{SLIDING}', {0, 5}),
    "SIGINT": ("", {130}),
    "SIGTERM": ("", {143}),
}
FAILED = {3, 4, 7}
TOO_SLOW = {"the computer or a link to an instrument cannot keep": 3, "on hold": 5}
"""What a run says on a computer that is too busy for real time, and the exit code that may then
follow: of a loop that gave up, of an invalid trial. The bench has to be safe all the same."""

LOADINGS = {"slide": ("--speed", "0.5mm/s"), "ramp": ("--loading", "ramp", "--ramp", "1N/s")}
CASES = [(name, "slide") for name in FAULTS] + [
    (name, "ramp") for name in ("nothing", "z silent", "x silent", "x stuck", "SIGINT")
]


@pytest.mark.parametrize(("name", "loading"), CASES)
def test_a_motion_that_goes_wrong_in_real_time_ends_in_order(rig, name, loading):
    fault, codes = FAULTS[name]
    bench = rig.folder / "bench.toml"
    disturbed = ("--fault", rig.fault("[[fault]]\n" + fault)) if fault else ()
    serving = rig.start(
        "simulate", "--fixture", "plate", "--write", str(bench), "--world-log",
        str(rig.world_log), *disturbed,
    )  # fmt: skip
    serving.wait_for("Ctrl-C ends it")
    try:
        running = rig.start(
            "slip-trial", "--bench", str(bench), "--tick", "500", "--distance", "1mm",
            *LOADINGS[loading], "--json", "--no-figures",
        )  # fmt: skip
        if name.startswith("SIG"):
            while sum((e["device"], e["what"]) == ("stage_x", "move") for e in rig.log()) < SLIDES:
                time.sleep(0.05)
            time.sleep(0.5)
            running.send(getattr(signal, name))
        ended = running.finish()
        time.sleep(1.5)  # a drive that was left to itself stops by its own time-out
    finally:
        serving.send(signal.SIGINT)
        serving.finish()
    heading(f"{loading}, {name}: exit code {ended.code}; {'; '.join(ended.errors)}")
    disturbances = {code for words, code in TOO_SLOW.items() if words in ended.stderr}
    injected = [e["value"] for e in rig.log() if e["what"] == "injected"]
    print(f"injected: {injected or 'nothing'}; the computer was too slow: {bool(disturbances)}")
    assert ended.code in codes | {7} | disturbances, ended.stderr
    assert bool(ended.errors) == (ended.code in FAILED), ended.stderr
    rest = {}
    for stage in ("stage_z", "stage_x"):
        seen = [e for e in rig.log() if e["device"] == stage and e["what"] in ("move", "at-rest")]
        assert seen[-1]["what"] == "at-rest", f"{stage} still moves"
        rest[stage] = seen[-1]["value"]
    reported = "NOT SAFE" in ended.stderr or "may still be pressed" in ended.stderr
    print(
        f"z at {rest['stage_z']:.3f} mm, x at {rest['stage_x']:.3f} mm, "
        f"reported as not safe: {reported}"
    )
    assert (reported and name.startswith("z ")) or rest["stage_z"] == pytest.approx(5.0, abs=0.01)
    assert verify(rig.only("*.h5")) == []


SLOW_DAQ = '[[fault]]\ndevice = "daq"\nkind = "late"\nby_s = 0.03\ncount = 0\n'


def test_late_ticks_beside_a_slow_daq(rig):
    heading("slides of 1 s at 500 Hz in real time, DAQ 30 ms slow and none slow in turn")
    for turn in range(2 * repeats(3)):
        slow = turn % 2 == 0
        folder = rig.folder / str(turn)
        folder.mkdir()
        one = type(rig)(folder)
        disturbed = ("--fault", one.fault(SLOW_DAQ)) if slow else ()
        bench = one.folder / "bench.toml"
        serving = one.start("simulate", "--fixture", "plate", "--write", str(bench), *disturbed)
        serving.wait_for("Ctrl-C ends it")
        declare_soft_contact(bench)
        ended = one.run(
            "slip-trial", "--bench", str(bench), "--tick", "500", "--distance", "1mm",
            "--speed", "1mm/s", "--block", "100ms", "--json", "--no-figures",
            "--accept", "each slide has a bench of its own",  # whose way to the force is short
        )  # fmt: skip
        serving.send(signal.SIGINT)
        serving.finish()
        with RunFile.open(one.only("*.h5")) as run:
            readings = list(run.readings())
        reading = readings[0] if readings else {"late ticks unknown": ended.errors}
        shown = {key: reading[key] for key in reading if "late" in key or "tick" in key}
        print(f"DAQ {'30 ms slow' if slow else 'as it is'}: exit {ended.code} {shown}", flush=True)
