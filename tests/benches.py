"""The combinations of stages and DAQ on which the contract has to hold, and what differs by stage.

A test of the contract speaks of what happens, not of a vendor: where it has to name a number or
words of a drive it asks `Bench` for them. `RIG_BENCH=az-festo/U2542A` chooses one combination for
every test; otherwise each test gets one of all, always the same for its name (decision 0045).
"""

from __future__ import annotations

import itertools
import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.simulated.bench.start import variants
from rig.core.errors import ConfigurationError

DECLARED_CONTACT = "stiffest_contact_N_mm = 150.0\n"
"""World settings whose bench file declares the stiffest contact that there is on a simulated bench,
the skin's (145 N/mm; a film has 88): z goes down six times as fast to a film, half as fast again to
the skin."""


def declare_soft_contact(bench_file: Path) -> None:
    """Let z go quickly where it has not been: the fixture declares a contact so soft that no speed
    is too large. For runs in real time whose way down is not what a test is about; it takes 12 s
    otherwise."""
    before, fixture, after = bench_file.read_text().partition("[fixture]\n")
    assert fixture
    declared = "stiffest_contact_N_mm = 20.0\n"
    bench_file.write_text(before + fixture + declared + after.replace(DECLARED_CONTACT, ""))


@dataclass(frozen=True)
class StageModel:
    """What a model of stage has for what happens to every model."""

    on_tcp: bool
    """Whether a simulated one listens on a TCP port."""
    held_fast: str
    """Words for an axis that something holds."""
    fault: str
    """What it calls a fault of its own."""
    silence_fault: int
    """Number of its communication time-out."""
    asked_every_s: float
    """How often its state is asked for at least, the simulated bench's time-out being 2 s."""
    update_Hz: float
    """How often it can be given a new target."""
    friction: tuple[float, float]
    """Static and kinetic coefficients up to which the force is held within 2 % rms and 5 % peak, at
    6 mm/s and after a rehearsal."""


STAGE_MODELS = {
    "festo": StageModel(
        on_tcp=True,
        held_fast="stopped by its torque limit at 10.",
        fault="drive fault: 126 (",
        silence_fault=391,
        asked_every_s=0.1,
        update_Hz=1000.0,
        friction=(1.2, 0.84),
    ),
    "az": StageModel(
        on_tcp=False,
        held_fast="is held back by 0.",
        fault="drive alarm: 10h (",
        silence_fault=0x85,
        asked_every_s=0.4,
        update_Hz=50.0,
        friction=(0.8, 0.65),
    ),
}
USUAL_Hz = 100.0
"""Ticks of a trial, where its stages allow it."""
PAIRS = variants()
"""Values of `--stages`: both of one model, or z of the first and x of the second."""
DAQ_MODELS = ("U2331A", "U2542A")


@dataclass(frozen=True)
class Bench:
    """One combination, as `RIG_BENCH` names it."""

    stages: str
    daq: str

    def __str__(self) -> str:
        return f"{self.stages}/{self.daq}"

    @property
    def z(self) -> StageModel:
        """The stage that presses."""
        return STAGE_MODELS[self.stages.split("-")[0]]

    @property
    def x(self) -> StageModel:
        """The stage that slides."""
        return STAGE_MODELS[self.stages.split("-")[-1]]

    @property
    def tick_Hz(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Of a trial's servo: as often as z can be given a new target."""
        return min(USUAL_Hz, self.z.update_Hz)

    @property
    def both_Hz(self) -> float:  # noqa: N802
        """How often a trial asks both where they are, or tells both a new target."""
        return min(USUAL_Hz, 1 / (1 / self.z.update_Hz + 1 / self.x.update_Hz))


BENCHES = tuple(Bench(*one) for one in itertools.product(PAIRS, DAQ_MODELS))
CHOSEN = os.environ.get("RIG_BENCH", "")


def bench_for(test: str, able: Sequence[Bench] = BENCHES) -> Bench:
    """The one that was chosen, else the one of those `able` that a test of this name is always
    dealt."""
    if not CHOSEN:
        return able[zlib.crc32(test.encode()) % len(able)]
    named = {str(bench): bench for bench in BENCHES}
    if CHOSEN not in named:
        raise ConfigurationError(
            f"RIG_BENCH {CHOSEN}: no such bench", f"it is one of {', '.join(named)}"
        )
    return named[CHOSEN]
