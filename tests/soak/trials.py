"""Random trials: a procedure, its settings and a fault plan, all drawn from one seed."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from drivers.simulated.faults.plan import (
    DEVICES,
    DEVICES_BY_FAULT,
    FORCE_STREAM,
    ON_TCP,
    ROTARY,
    STAGE_X,
    STAGE_Z,
    devices_by_fault,
)

Fault = dict[str, Any]

DOOR = '[[interlock]]\nname = "door"\n'
SKIN_CONTACT = "skin_mount.contact_mm = 12.05\n"
"""Contact soon after the search begins."""
SWEEP_LIMIT_N, SKIN_LIMIT_N = 40.0, 15.0
TORQUE_LIMIT_N = {SWEEP_LIMIT_N: 45.0, SKIN_LIMIT_N: 25.0}
"""What the torque limit of z allows on the simulated benches with these force limits."""
RUNAWAY_S = 0.06
"""What runs into the film at travel speed, 10 mm/s, takes 50 ms to brake at 200 mm/s^2."""
DEAD_S = 1.0
"""A dead sensor is named when the torque limit has held the stage for 0.3 s; then z goes up."""
UNNOTICED = ("wrong-scale", "drift")
"""Kinds for which docs/safety.md declares the torque limit alone, in a first run on a bench."""
TALLER = "taller-object"
"""A kind of its own: nothing fails, but the object reaches higher than the bench file states."""
TALLER_SHARE = 0.05
TALLER_mm = (10.2, 11.9)
"""Between the place where z of a simulated bench begins and the earliest contact stated."""

STAGES = ("festo", "az", "festo-az", "az-festo")
ON_A_LINE = {
    "festo": (),
    "az": (STAGE_Z, STAGE_X),
    "festo-az": (STAGE_X,),
    "az-festo": (STAGE_Z,),
}
"""Stages on the serial line, by combination."""
WIDE_SLIP_SHARE, WIDE_ROLL_SHARE = 0.3, 0.2

REQUESTS = {
    "generator": 60,
    "daq": 80,
    "stage_z": 700,
    "stage_x": 300,
    "force_sensor": 40,
    FORCE_STREAM: 900,
    ROTARY: 80,
}
"""About as many as a trial has."""
COMMANDS = {
    "generator": ("SOUR1:FREQ", "SOUR1:VOLT", "OUTP1", "SOUR1"),
    "daq": ("WAV:DATA", "DIG", "WAV", "STOP"),
    "stage_z": ("FC3 100", "FC16 0"),
    "stage_x": ("FC3 100", "FC16 0"),
    "force_sensor": ("23", "24", "8B"),
    ROTARY: ("move abs", "get pos", "stop"),
}


@dataclass(frozen=True)
class Trial:
    """One command on a simulated bench that goes wrong as planned."""

    seed: int
    arguments: tuple[str, ...]
    world: str
    faults: tuple[Fault, ...]
    contact_mm: float | None = None
    """Position of z at which a taller object is met; None: where the bench file states it."""

    @property
    def procedure(self) -> str:
        """The command."""
        return self.arguments[0]

    @property
    def stages(self) -> str:
        """Kinds of the drives of z and x."""
        where = self.arguments.index("--stages") if "--stages" in self.arguments else None
        return STAGES[0] if where is None else self.arguments[where + 1]

    @property
    def in_words(self) -> str:
        """The trial in words."""
        words = [
            " ".join(str(v) if k in ("device", "kind") else f"{k}={v}" for k, v in fault.items())
            for fault in self.faults
        ]
        if self.contact_mm is not None:
            words.append(f"{TALLER} at {self.contact_mm} mm")
        return f"{self.procedure} {self.stages}: {'; '.join(words)}"

    @property
    def limit_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """The force limit of the program."""
        return SWEEP_LIMIT_N if self.procedure == "sweep" else SKIN_LIMIT_N

    @property
    def plan(self) -> str:
        """The fault plan as TOML."""
        return as_toml(self.faults)


LATER_KINDS = ("late", "flip", "before-last", "wrong-torque")
KINDS = tuple(kind for kind in DEVICES_BY_FAULT if kind not in LATER_KINDS)
"""All but those that were added after the first seeds were recorded: a seed means what it meant.
A late answer is no fault in virtual time, which stops meanwhile; `tests/drivers` and
`tests/safety_contract` flip bits."""
EARLIER_DEVICES: dict[str, tuple[str, ...]] = {
    **DEVICES_BY_FAULT,
    **dict.fromkeys(("reset", "half-open"), ON_TCP),
}
"""The devices of each kind when the first seeds were recorded."""
WIDE_KINDS = tuple(kind for kind in DEVICES_BY_FAULT if kind != "late")
"""Of `draw_wide`."""
ROTARY_KINDS = tuple(kind for kind, able in DEVICES_BY_FAULT.items() if set(able) == {ROTARY})
"""Those of roll trials alone."""


def draw(seed: int, slip_share: float = 0.15, roll_share: float = 0.05) -> Trial:
    """The trial of a seed; shares of them are slip and roll trials, which take longer. Of what goes
    wrong in a roll trial half happens to the stage that only it has."""
    chance = random.Random(seed)
    which = chance.random()
    rotary_share = 0.0
    if which < slip_share:
        arguments, absent = _slip(chance), {"generator", ROTARY}
    elif which < slip_share + roll_share:
        arguments, absent = _roll(chance), {"generator"}
        rotary_share = 0.5
    else:
        arguments, absent = _sweep(chance), {STAGE_X, ROTARY}
    faults = []
    for _ in range(chance.choice((1, 1, 2, 3))):
        only_rotary = rotary_share and chance.random() < rotary_share
        faults.append(fault(chance, {*DEVICES} - {ROTARY} if only_rotary else absent))
    contact_mm = round(chance.uniform(*TALLER_mm), 2) if chance.random() < TALLER_SHARE else None
    world = world_of(arguments[0], faults, contact_mm)
    return Trial(seed, (*arguments, "--seed", str(seed % 1000)), world, tuple(faults), contact_mm)


def draw_wide(seed: int) -> Trial:
    """The trial of a seed in the series that has every combination of stages, every kind of fault
    but late answers, and slips and rolls as often as sweeps."""
    chance = random.Random(f"wide {seed}")
    stages = chance.choice(STAGES)
    which = chance.random()
    rotary_share = 0.0
    if which < WIDE_SLIP_SHARE:
        arguments, absent = _slip(chance), {"generator", ROTARY}
    elif which < WIDE_SLIP_SHARE + WIDE_ROLL_SHARE:
        arguments, absent = _roll(chance), {"generator"}
        rotary_share = 0.3
    else:
        arguments, absent = _sweep(chance), {STAGE_X, ROTARY}
    able = devices_by_fault(ON_A_LINE[stages])
    faults = []
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        only_rotary = chance.random() < rotary_share
        away = {*DEVICES} - {ROTARY} if only_rotary else absent
        faults.append(fault(chance, away, able, WIDE_KINDS))
    contact_mm = round(chance.uniform(*TALLER_mm), 2) if chance.random() < TALLER_SHARE else None
    world = world_of(arguments[0], faults, contact_mm)
    arguments = (*arguments, "--stages", stages, "--seed", str(seed % 1000))
    return Trial(seed, arguments, world, tuple(faults), contact_mm)


def world_of(procedure: str, faults: Sequence[Fault], contact_mm: float | None = None) -> str:
    """The World's settings for a plan: where the object is, a door, and the force that the World's
    monitor allows, with the times that docs/safety.md declares for these kinds."""
    on_film = procedure == "sweep"
    mount = "" if on_film else SKIN_CONTACT
    if contact_mm is not None:
        mount = f"{'clamp' if on_film else 'skin_mount'}.contact_mm = {contact_mm}\n"
    limit_N = SWEEP_LIMIT_N if on_film else SKIN_LIMIT_N
    kinds = {fault["kind"] for fault in faults}
    watch: dict[str, float] = {"force_limit_N": limit_N}
    if kinds & {*UNNOTICED} or kinds >= {"dead-noisy", "wrong-torque"}:
        watch["force_limit_N"] = TORQUE_LIMIT_N[limit_N] + 0.5
    if "dead-noisy" in kinds:
        watch |= {"reaction_s": DEAD_S, "longest_over_s": DEAD_S}
    if "runaway" in kinds:
        # Nothing stops what runs away while the computer is suspended: docs/safety.md.
        suspended_s = sum(fault["by_s"] for fault in faults if fault["kind"] == "clock-jump")
        watch["reaction_s"] = max(watch.get("reaction_s", 0.0), RUNAWAY_S + suspended_s)
        if suspended_s:
            watch["longest_over_s"] = 1.0 + suspended_s
    lines = "".join(f"{key} = {_toml(value)}\n" for key, value in watch.items())
    return f"{mount}{DOOR}[watch]\n{lines}"


def as_toml(faults: Iterable[Fault]) -> str:
    """A fault plan."""
    return "".join(
        "[[fault]]\n" + "".join(f"{key} = {_toml(value)}\n" for key, value in fault.items())
        for fault in faults
    )


def shrunk(trial: Trial, fails: Callable[[Trial], bool]) -> Trial:
    """The smallest plan of the trial that still fails: faults are left out one by one."""
    for index in range(len(trial.faults) - 1, -1, -1):
        smaller = replace(trial, faults=trial.faults[:index] + trial.faults[index + 1 :])
        if fails(smaller):
            trial = smaller
    return trial


def _sweep(chance: random.Random) -> tuple[str, ...]:
    choice = sorted(chance.sample((20, 110, 210, 300, 410, 600, 1000, 3000), chance.choice((2, 3))))
    return (
        "sweep", "--frequencies", ",".join(map(str, choice)),
        "--order", chance.choice(("ascending", "descending", "random")),
        "--load", f"{chance.uniform(0.5, 2):.2f}N",
        "--preload", f"{chance.uniform(8, 25):.1f}N",
        "--longest-point", "5s",
    )  # fmt: skip


def _slip(chance: random.Random) -> tuple[str, ...]:
    return (
        "slip-trial",
        "--distance", f"{chance.uniform(0.2, 0.5):.2f}mm",
        "--speed", f"{chance.uniform(0.5, 1):.2f}mm/s",
        "--rest", "100ms",
        "--normal-force", f"{chance.uniform(2, 5):.1f}N",
        "--direction", chance.choice(("+x", "-x")),
    )  # fmt: skip


def _roll(chance: random.Random) -> tuple[str, ...]:
    return (
        "roll-trial",
        "--angle", f"{chance.uniform(1.5, 3.5):.2f}deg",
        "--start", f"{chance.uniform(-6, 0):.2f}mm",
        "--rest", "100ms",
        "--stay", "100ms",
        "--normal-force", f"{chance.uniform(2, 5):.1f}N",
        "--alignment", chance.choice(("compensate", "measure", "none")),
    )  # fmt: skip


def fault(
    chance: random.Random,
    absent: set[str],
    able: Mapping[str, Sequence[str]] = EARLIER_DEVICES,
    kinds: Sequence[str] = KINDS,
) -> Fault:
    """A fault of one of the kinds that happen to a device which is not `absent`; `able` are the
    devices that each can happen to."""
    kind = chance.choice([kind for kind in kinds if set(able[kind]) - absent])
    device = chance.choice([name for name in able[kind] if name not in absent])
    return {"device": device, "kind": kind, **_KEYS.get(kind, _reply)(chance, device)}


def _reply(chance: random.Random, device: str) -> Fault:
    count = chance.choice((1, 1, 1, 1, 2, 5, 20))
    keys = {"at": round(math.exp(chance.uniform(0, math.log(REQUESTS[device])))), "count": count}
    if device in COMMANDS and chance.random() < 0.3:
        keys |= {"command": chance.choice(COMMANDS[device]), "at": max(1, keys["at"] // 5)}
    return keys


def _error(chance: random.Random, device: str) -> Fault:
    scpi = device in ("generator", "daq")
    return {**_reply(chance, device), "code": chance.choice((-310, -350) if scpi else (1, 4, 0x71))}


def _move(chance: random.Random, device: str) -> Fault:
    return {"move": chance.randint(1, 4), "after_s": round(chance.uniform(0, 1.5), 3)}


def _timed(chance: random.Random, device: str) -> Fault:
    """A moment: in an acquisition, while z goes down, presses or parks, or any."""
    which = chance.random()
    if which < 0.3:
        return {"acquisition": chance.randint(1, 12), "after_s": round(chance.uniform(0, 0.1), 4)}
    if which < 0.7:
        after_s = round(chance.uniform(0, 3), 3)
        return {"move": chance.randint(1, 8), "of": STAGE_Z, "after_s": after_s}
    return {"after_s": round(chance.uniform(0.2, 25), 3)}


_KEYS: dict[str, Callable[[random.Random, str], Fault]] = {
    "error": _error,
    "refused": lambda chance, device: {"at": chance.randint(1, 4)},
    "flip": lambda chance, device: {
        **_reply(chance, device), "byte": chance.randint(-6, 20), "bit": chance.randint(0, 7),
    },
    **dict.fromkeys(
        (
            *("stuck", "runaway", "limit-switch", "reference-lost"),
            *("idle", "stale-status", "wrong-position"),
        ),
        _move,
    ),
    "wrong-torque": lambda chance, device: {
        **_move(chance, device), "shows": chance.choice(("zero", "frozen", "scaled")),
        "factor": round(math.exp(chance.uniform(-2.5, 2.5)), 3),
    },
    "drive-fault": lambda chance, device: {
        **_move(chance, device), "code": chance.choice((58, 126, 391)),
    },
    **dict.fromkeys(
        ("opened", "closed", "stuck-closed", "stuck-open", "bouncing"),
        lambda chance, device: {"name": "door", **_timed(chance, device)},
    ),
    "slow": lambda chance, device: {
        **_move(chance, device), "share": round(chance.uniform(0.02, 0.9), 3),
    },
    "spike": lambda chance, device: {
        **_timed(chance, device),
        "force_N": round(chance.choice((-1, 1)) * math.exp(chance.uniform(0, 5)), 1),
        "for_s": round(chance.uniform(0.002, 0.2), 3),
    },
    "saturated": lambda chance, device: {
        **_timed(chance, device), "for_s": round(chance.uniform(0.002, 1), 3),
    },
    "frozen": lambda chance, device: {
        **_timed(chance, device), "for_s": round(chance.uniform(0.002, 2), 3),
    },
    "dead-noisy": lambda chance, device: {
        **_timed(chance, device), "noise_N": round(chance.choice((0.0, chance.uniform(0, 1))), 3),
    },
    "one-axis-stuck": lambda chance, device: {
        **_timed(chance, device), "axis": chance.choice("xyz"),
    },
    "drift": lambda chance, device: {
        **_timed(chance, device),
        "axis": chance.choice("xyz"), "rate_N_s": round(chance.uniform(-4, 4), 2),
    },
    "wrong-scale": lambda chance, device: {
        **_timed(chance, device), "factor": round(math.exp(chance.uniform(-2.5, 2.5)), 3),
    },
    "wrong-value": lambda chance, device: {
        **_timed(chance, device),
        "axis": chance.choice("xyz"), "force_N": round(chance.uniform(-60, 60), 1),
    },
    "previous": lambda chance, device: {
        **_timed(chance, device), "for_s": round(chance.uniform(0.002, 2), 3),
    },
    "clipped": lambda chance, device: {
        **_timed(chance, device), "amplitude_V": round(math.exp(chance.uniform(-4, 1)), 4),
    },
    "overrun": _timed,
    "warning-flag": lambda chance, device: {
        "after_s": round(chance.uniform(0.2, 9), 3), "flag": chance.choice(("WH", "FS", "FZ")),
    },
    "knob": lambda chance, device: {
        "after_s": round(chance.uniform(0.2, 9), 3), "by_deg": round(chance.uniform(-3, 3), 2),
    },
    "clock-jump": lambda chance, device: {
        **_timed(chance, device), "by_s": round(chance.uniform(0.05, 10), 2),
    },
    "disk-full": lambda chance, device: {"after_bytes": chance.randint(0, 150_000)},
    "read-only": lambda chance, device: {
        "after_bytes": chance.choice((0, 1)) * chance.randint(1, 60_000),
    },
    "slow-sync": lambda chance, device: {"delay_s": round(chance.uniform(0.01, 0.3), 3)},
}  # fmt: skip
"""Keys of each kind of fault; a disturbance of replies where nothing stands here."""


def _toml(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)
