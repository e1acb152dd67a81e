"""Stops of a run in each of its states, for each cause, judged by the World's own log.

Every cause is marked in the World's log at the instant at which it happens: an opened door and a
push on the probe are entries of a fault plan; for a signal a spare contact is disturbed, and the
run's own process sends itself the signal as soon as the log has that entry. All is in virtual time,
so the times are those of the program, of braking and of the way up, not those of the computer.

What a batch does needs signals between processes: `stopped_in_real_time` measures that on a served
bench, the computer's own delays included.
"""

from __future__ import annotations

import itertools
import signal
import time
from dataclasses import dataclass
from typing import Any

SWEEP = ("sweep", "--frequencies", "2,300", "--settling", "0.5s")
SLIP = ("slip-trial", "--distance", "2mm", "--speed", "1mm/s", "--rest", "300ms")
ROLL = ("roll-trial", "--rest", "100ms", "--stay", "100ms")
WORLD = (
    'daq_model = "U2331A"\n'
    '[[interlock]]\nname = "door"\ninput = "daq.501.0"\n'
    '[[interlock]]\nname = "spare"\ninput = "daq.501.1"\nclass = "process"\n'
)


@dataclass(frozen=True)
class State:
    """A state of a run: the command, and the moment of a fault plan at which the run is in it."""

    command: tuple[str, ...]
    moment: str
    after_s: float
    paused_s: float | None = None
    """Time in s before the cause at which the run is paused, by Ctrl-Z; None: it is not."""


STATES = {
    "homing": State(SWEEP, "", 0.3),
    "travel": State(SWEEP, 'move = 1\nof = "stage_z"\n', 0.3),
    "approach": State(SWEEP, 'move = 3\nof = "stage_z"\n', 1.5),
    "held": State(SLIP, 'move = 4\nof = "stage_z"\n', 1.75),
    "slide": State(SLIP, 'move = 2\nof = "stage_x"\n', 1.0),
    "roll": State(ROLL, 'move = 3\nof = "stage_x"\n', 0.2),
    "sweep, settling": State(SWEEP, "acquisition = 2\n", 0.8),
    "sweep, recording": State(SWEEP, "acquisition = 6\n", 0.5),
    "paused": State(SWEEP, "acquisition = 6\n", 2.5, paused_s=2.0),
}
NIGHT = """
[batch]
name = "night"
figures = false
detect = false

[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [300, 600] }

[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [300, 600] }
rest_s = 100
"""
BATCH = ("batch", "run", "night.toml")
REAL_STATES = {
    "in a batch, sweep recording": State(BATCH, "acquisition = 5\n", 0.02),
    # The first run ends some 10 s after z has begun to press, on a loaded computer up to 40 s.
    "between two runs of a batch": State(BATCH, 'move = 4\nof = "stage_z"\n', 60.0),
}
SIGNALS = {"SIGTERM": 15, "Ctrl-C": 2}
CAUSES = (*SIGNALS, "interlock", "force limit")
NOTHING_FOLLOWS = ("paused", "force limit")
"""A push while nothing is armed: the run stays paused."""
SIGNAL_AT_MARK = """
import os, rig.core.clock as clock
plain, seen, numbers = clock.SlavedClock._advance, [0], {numbers}
def advance(self, step_us):
    plain(self, step_us)
    if not numbers:
        return
    with open({log!r}) as log:
        log.seek(seen[0])
        new = log.read()
        seen[0] = log.tell()
    if '"injected"' in new:
        os.kill(os.getpid(), numbers.pop(0))
clock.SlavedClock._advance = advance
"""


@dataclass(frozen=True)
class Stop:
    """What the World's log says of one stop. Times in s from the cause; None for what was not on or
    not in motion."""

    moving: tuple[str, ...]
    """Axes in motion at the cause."""
    generator_off_s: float | None
    still_s: float | None
    """Until every axis in motion has come to rest."""
    clear_s: float | None
    """Until z has come to rest for the last time, clear of contact."""
    deepest_mm: float
    """By how much z stands deeper, at any rest after the first, than at the rest before."""


def plan(state: State, cause: str, later_s: float = 0.0) -> str:
    """Return the fault plan that marks or makes the cause."""
    at = f"{state.moment}after_s = {state.after_s + later_s:.4f}\n"
    mark = '[[fault]]\ndevice = "interlock"\nname = "spare"\nkind = "closed"\n'
    before = ""
    if state.paused_s is not None:
        before = f"{mark}{state.moment}after_s = {state.after_s - state.paused_s:.4f}\n"
    if cause == "interlock":
        return f'{before}[[fault]]\ndevice = "interlock"\nname = "door"\nkind = "opened"\n{at}'
    if cause == "force limit":
        push = "force_N = 60.0\nfor_s = 0.05\n"
        return f'{before}[[fault]]\ndevice = "force_sensor"\nkind = "spike"\n{push}{at}'
    return f"{before}{mark}{at}"


def stopped(rig: Any, state: State, cause: str, later_s: float = 0.0) -> tuple[Any, Stop]:
    """Run to the cause and to the end; return how the command ended, and its stop."""
    rig.world_log.unlink(missing_ok=True)
    before = ""
    numbers = [] if state.paused_s is None else [int(signal.SIGTSTP)]
    numbers += [SIGNALS[cause]] if cause in SIGNALS else []
    if numbers:
        before = SIGNAL_AT_MARK.format(log=str(rig.world_log), numbers=numbers)
    running = rig.start(
        *state.command, "--json", "--no-figures", "--stages", "festo",
        "--world", rig.world(WORLD), "--world-log", str(rig.world_log),
        "--fault", rig.fault(plan(state, cause, later_s)), before=before,
    )  # fmt: skip
    ended = running.finish()
    return ended, read_stop(rig.log())


@dataclass(frozen=True)
class RealStop:
    """A stop on a bench in real time."""

    stop: Stop
    driven: int
    """Number of motions that were begun, and outputs that were switched on, after the cause."""
    ended_s: float
    """From the cause to the end of the command, whose file is compiled by then."""
    code: int


def stopped_in_real_time(rig: Any, state: State, cause: str, later_s: float) -> RealStop:
    """Run a command against a served bench to the cause and to the end."""
    (rig.folder / "night.toml").write_text(NIGHT)
    serving = rig.start(
        "simulate", "--write", str(rig.folder / "bench.toml"), "--stages", "festo",
        "--world", rig.world(WORLD), "--world-log", str(rig.world_log),
        "--fault", rig.fault(plan(state, cause, later_s)),
    )  # fmt: skip
    serving.wait_for("Ctrl-C ends it")
    running = rig.start(*state.command, "--bench", "bench.toml")
    while not marked(rig):
        if running.process.poll() is not None:
            raise AssertionError(f"{running.reported('ended before the cause')}\n{rig.log()[-5:]}")
        time.sleep(0.005)
    marked_s = time.monotonic()
    if cause in SIGNALS:
        running.send(signal.Signals(SIGNALS[cause]))
    ended = running.finish()
    ended_s = time.monotonic() - marked_s
    serving.send(signal.SIGINT)
    serving.finish()
    log = rig.log()
    after = log[next(k for k, x in enumerate(log) if x["what"] == "injected") :]
    driven = sum(x["what"] in ("move", "homing") or x["value"] is True for x in after)
    return RealStop(read_stop(log), driven, ended_s, ended.code)


def marked(rig: Any) -> bool:
    """Return whether the World's log has the cause."""
    return '"injected"' in rig.world_log.read_text()


def read_stop(log: list[dict[str, Any]]) -> Stop:
    """Read a stop from the World's log."""
    cause = max(k for k, x in enumerate(log) if x["what"] == "injected")
    before, after, cause_us = log[:cause], log[cause:], log[cause]["t_us"]

    def since(entry: dict[str, Any]) -> float:
        return (entry["t_us"] - cause_us) * 1e-6

    def last(device: str, *whats: str) -> dict[str, Any] | None:
        found = [x for x in before if x["device"] == device and x["what"] in whats]
        return found[-1] if found else None

    motions = ("move", "turn", "homing", "at-rest")
    axes = ("stage_z", "stage_x", "rotary")
    moving = [a for a in axes if (entry := last(a, *motions)) and entry["what"] != "at-rest"]
    rests = {a: [x for x in after if x["device"] == a and x["what"] == "at-rest"] for a in axes}
    generator = last("generator", "ch1.on")
    off = [since(x) for x in after if x["what"] == "ch1.on" and not x["value"]]
    still = [since(rests[a][0]) for a in moving if rests[a]]
    stands = [x["value"] for x in rests["stage_z"]]
    deeper = [b - a for a, b in itertools.pairwise(stands)]
    return Stop(
        tuple(moving),
        off[0] if generator and generator["value"] and off else None,
        max(still) if moving and len(still) == len(moving) else None,
        since(rests["stage_z"][-1]) if rests["stage_z"] else None,
        max(deeper, default=0.0),
    )
