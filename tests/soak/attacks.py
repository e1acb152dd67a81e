"""Attacks on the wire: one fault of one link at one moment of a trial, drawn from one seed.

A soak draws every kind of fault, several at once, at any time. An attack is on one link, on every
combination of stages, and at a moment in which something is pressed, moves or is recorded.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any, get_args

from drivers.simulated.faults.plan import (
    DAQ,
    FORCE_SENSOR,
    FORCE_STREAM,
    GENERATOR,
    ROTARY,
    STAGE_X,
    STAGE_Z,
    FlippedBit,
    WireFault,
    devices_by_fault,
)

from .invariants import PRESSED_N, Ran
from .trials import ON_A_LINE, STAGES, Trial, world_of

KINDS = tuple(
    kind
    for fault in (WireFault, FlippedBit)
    for kind in get_args(fault.model_fields["kind"].annotation)
)
"""Faults of the wire that need no time to pass: a bench in virtual time stands still meanwhile."""
LINKS = {
    "sweep": (GENERATOR, DAQ, STAGE_Z, FORCE_SENSOR, FORCE_STREAM),
    "slip-trial": (DAQ, STAGE_Z, STAGE_X, FORCE_SENSOR, FORCE_STREAM),
    "roll-trial": (DAQ, STAGE_Z, STAGE_X, ROTARY, FORCE_SENSOR, FORCE_STREAM),
}
OPTIONS = {
    "sweep": (
        "--frequencies", "110,410", "--load", "1N", "--preload", "12N", "--longest-point", "3s",
    ),
    "slip-trial": (
        "--distance", "0.3mm", "--speed", "1mm/s", "--rest", "100ms", "--normal-force", "3N",
    ),
    "roll-trial": (
        "--angle", "2deg", "--start=-3mm", "--rest", "100ms", "--stay", "100ms",
        "--normal-force", "3N",
    ),
}  # fmt: skip
MOST_REQUESTS = 20
"""Within how many requests of a moment an attack begins."""


def attack(seed: int) -> Trial:
    """The attack of a seed: a trial with one fault."""
    chance = random.Random(f"attack {seed}")
    procedure = chance.choice(("slip-trial", "slip-trial", "sweep", "roll-trial"))
    stages = chance.choice(STAGES)
    fault = attack_on(chance, procedure, stages)
    arguments = (procedure, *OPTIONS[procedure], "--stages", stages, "--seed", str(seed % 1000))
    return Trial(seed, arguments, world_of(procedure, [fault]), (fault,))


def attack_on(chance: random.Random, procedure: str, stages: str) -> dict[str, Any]:
    """One fault of one link of a trial on these stages."""
    able = devices_by_fault(ON_A_LINE[stages])
    device = chance.choice(LINKS[procedure])
    kind = chance.choice([kind for kind in KINDS if device in able[kind]])
    fault: dict[str, Any] = {"device": device, "kind": kind, **moment(chance, procedure)}
    fault["at"] = chance.randint(1, MOST_REQUESTS if fault else 1)
    if chance.random() < 0.3:
        fault["for_s"] = round(chance.uniform(0.05, 3), 2)
    else:
        fault["count"] = chance.choice((1, 1, 1, 2, 5, 0))
    if chance.random() < 0.1:
        fault |= {"every": 3, "count": 0}
    if kind == "flip":
        fault |= {"byte": chance.randint(-6, 20), "bit": chance.randint(0, 7)}
    return fault


def moment(chance: random.Random, procedure: str) -> dict[str, Any]:
    """A moment while something goes down, presses, slides, turns, is recorded or is lifted."""
    which = chance.random()
    if procedure == "sweep" and which < 0.4:
        return {"acquisition": chance.randint(1, 6), "after_s": round(chance.uniform(0, 0.3), 3)}
    movers = {"sweep": (STAGE_Z,), "slip-trial": (STAGE_Z, STAGE_X)}.get(
        procedure, (STAGE_Z, ROTARY)
    )
    mover = chance.choice(movers)
    most = {STAGE_Z: 4, STAGE_X: 2, ROTARY: 2}[mover]
    return {
        "move": chance.randint(1, most),
        "of": mover,
        "after_s": round(chance.uniform(0, 1.5), 3),
    }


def left_pressed(ran: Ran) -> Iterator[str]:
    """What is pressed at the end although the fault was over, or a new connection without it: said
    or not, it could have been lifted."""
    (fault,) = ran.trial.faults
    on_a_line = fault["device"] in (*ON_A_LINE[ran.trial.stages], ROTARY, FORCE_SENSOR)
    if fault["kind"] == "half-open":
        lasts = on_a_line  # elsewhere a new connection reaches the instrument
    else:
        lasts = fault.get("count") == 0 and "for_s" not in fault
    for last_N in ran.values("last-force"):
        if last_N > PRESSED_N and not lasts:
            yield f"{last_N:.3g} N are pressed at the end, although z could be reached"
