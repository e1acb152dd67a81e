"""Drops of weights with and without a grip that answers, in pairs at the same seeds.

A seed draws a bench (friction, rubber, noise), a normal force and a rate of loading. Its holding
force is measured first: a ramp without a grip, up to gross slip. Then weights that are stated as
shares of it are lowered onto the same bench, once for each strategy: `none`, `always` (squeeze when
the motion begins), or the name of a detector whose alarms the grip answers. Shares above 1 are
drops; those below are holds, in which every squeeze is a false one.

All weights of a seed are on one bench, with one friction and one holding force, so that one share
says much of the next: the intervals are those of as many cases as there are benches.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.cache import Cache
from rig.core.json_text import finite
from rig.core.settings import fingerprint
from rig.detector.registered import chosen_detector
from rig.evaluation.scoring.tables import ScoredNumber, rate_of_groups
from rig.evaluation.wire.kinds import (
    LARGEST_FORCE_N,
    ANY_ERROR_percent,
    RAMP_N_s,
    WireTrial,
    drawn,
)
from rig.evaluation.wire.making import TrialCommands, key_of, make_one
from rig.files.runfile.reader import RunFile

NONE, ALWAYS = "none", "always"
"""Strategies that need no detector."""
FORCES_N = (2.0, 6.0)
"""Normal forces are drawn between these, logarithmically: five steps of 20 % double them, which
stays below the force limit."""
STEPS, ALWAYS_STEPS = 5, 2
"""Largest number of squeezes on alarms; and of those that `always` makes at once: the fewest that
hold 1.3 times the holding force."""
SPEED_mm_s = 2.0
"""Speed at which a weight falls that has slipped, unless the study is given a different one."""
WAY_mm, LOST_mm = 3.0, 0.5
HOLD_S = 2.0


@dataclass(frozen=True)
class Weight:
    """The trial of a weight on the contact: what was asked of the grip, and what became of it."""

    seed: int
    share: float
    """Weight over the holding force."""
    strategy: str
    ramp_N_s: float
    least_force_N: float
    """Normal force at which the holding force would equal the weight."""
    outcome: str = ""
    """Result of the trial: held, averted or lost; "" for a trial that could not be made."""
    squeezes: int = 0
    force_used_N: float | None = None
    risen_s: float | None = None
    """Time in s from the first alarm's sample until F_n has risen by 10 % of the step."""
    failed: str = ""
    """Why it could not be made."""


def _bench_of(seed: int, speed_mm_s: float) -> tuple[WireTrial, float, float]:
    """Return a ramp on the bench of a seed, its normal force and its rate of loading."""
    base = drawn("ramp", seed, None)
    own = np.random.default_rng([seed, 200])
    low, high = FORCES_N
    force_N = float(f"{math.exp(own.uniform(math.log(low), math.log(high))):.4g}")
    rate_N_s = float(f"{RAMP_N_s.draw(own):.4g}")
    settings = {
        "normal_force_N": force_N,
        "loading": "ramp",
        "ramp_N_s": rate_N_s,
        "ramp_to_N": LARGEST_FORCE_N - 0.5,
        "speed_mm_s": speed_mm_s,
        "distance_mm": WAY_mm,
        "rest_s": 0.4,
        "rehearsal": "never",
        "largest_force_N": LARGEST_FORCE_N,
        "force_error_rms_percent": ANY_ERROR_percent,
        "force_error_peak_percent": ANY_ERROR_percent,
        "overshoot_percent": ANY_ERROR_percent,
        "detector": "none",
    }
    trial = WireTrial("ramp", seed, "slip-trial", settings, base.world, base.traits)
    return trial, force_N, rate_N_s


def _with_weight(ramp: WireTrial, load_N: float, strategy: str) -> WireTrial:
    """Return the trial of a weight on the same bench."""
    own = {"hold_at_N": float(f"{load_N:.4g}"), "hold_for_s": HOLD_S, "lost_mm": LOST_mm}
    settings = ramp.settings | own
    del settings["ramp_to_N"]
    if strategy == ALWAYS:
        settings |= {"regrip": True, "regrip_on": "motion", "regrip_times": ALWAYS_STEPS}
    elif strategy != NONE:
        settings |= {"regrip": True, "regrip_times": STEPS, "detector": strategy}
    return WireTrial("ramp", ramp.seed, ramp.procedure, settings, ramp.world, ramp.traits)


def read_holding(path: Path) -> float:
    """Return the largest tangential force in the motion of the only trial of a run file, in N."""
    with RunFile.open(path) as run:
        (point,), (reading,) = run.point_ids(), run.readings()
        (force,) = [wave for wave in run.waveforms(point) if wave.stream == "force"]
        assert force.rate_Hz is not None
        first, last = (
            round(float(reading[name]) * force.rate_Hz) for name in ("slide_from_s", "slide_to_s")
        )
        return float(np.abs(force.values("F_t"))[first:last].max())


def read_weight(path: Path) -> dict[str, Any]:
    """Return the values of `Weight` that the reading of the only trial has. Raises ValueError for
    an invalid trial."""
    with RunFile.open(path) as run:
        (reading,) = run.readings()
        return weight_of(reading)


def weight_of(reading: dict[str, Any]) -> dict[str, Any]:
    """Return the values of `Weight` that a reading has. Raises ValueError for an invalid trial: a
    detector that was dropped squeezes no hold, which would be its merit."""
    if reading.get("invalid"):
        raise ValueError(f"the trial is invalid: {reading['invalid']}")
    return {
        "outcome": str(reading["outcome"]),
        "squeezes": int(float(reading["squeezes"] or 0)),
        "force_used_N": _number(reading["force_used_N"]),
        "risen_s": _number(reading["squeeze_risen_s"]),
    }


def _number(value: object) -> float | None:
    """Return a number of a reading; None where it has none."""
    number = math.nan if value is None else float(str(value))
    return number if math.isfinite(number) else None


def _of_detector(trial: WireTrial) -> str:
    """Return what the key of a trial says of the detector that its grip answers: another version or
    other parameters make other squeezes. Nothing for a trial without one."""
    name = trial.settings.get("detector", NONE)
    if name == NONE:
        return ""
    chosen = chosen_detector(name)
    made_by = f"-{fingerprint(chosen.version, chosen.code_digest, chosen.settings)[:24]}"
    # What was stored of another package's may be of a trial in which it was dropped.
    return made_by if chosen.is_own else f"{made_by}-valid"


class RegripStudy:
    """Makes the trials of the study, those that are in the cache at once."""

    def __init__(self, cache: Cache, done: Callable[[int, int, int], None]):
        """`done` is called with the number so far, of all, and of those that had to be made."""
        self._cache, self._done, self._commands = cache, done, TrialCommands()
        self._number = self._made = 0

    def weights(
        self,
        seeds: Sequence[int],
        shares: Sequence[float],
        strategies: Sequence[str],
        speed_mm_s: float = SPEED_mm_s,
    ) -> Iterator[Weight]:
        """Yield the weights of these seeds, which fall at `speed_mm_s` once they slip; a seed
        without a holding force yields failed ones."""
        total = len(seeds) * (1 + len(shares) * len(strategies))
        try:
            for seed in seeds:
                ramp, force_N, rate_N_s = _bench_of(seed, speed_mm_s)
                holding_N, why = self._made_or_stored(ramp, "holding", read_holding, total)
                for share in shares:
                    for strategy in strategies:
                        weight = Weight(seed, share, strategy, rate_N_s, share * force_N)
                        if holding_N is None:
                            self._count(total)
                            yield replace(weight, failed=why)
                            continue
                        trial = _with_weight(ramp, share * holding_N, strategy)
                        found, reason = self._made_or_stored(trial, "weight", read_weight, total)
                        yield (
                            replace(weight, failed=reason)
                            if found is None
                            else replace(weight, **found)
                        )
        finally:
            self._commands.end()

    def _made_or_stored(
        self, trial: WireTrial, what: str, read: Callable[[Path], Any], total: int
    ) -> tuple[Any, str]:
        key = f"regrip-{what}-{key_of(trial)}{_of_detector(trial)}"
        stored = self._cache.get(key)
        if stored is not None:
            self._count(total)
            found, reason = json.loads(stored)
            return found, reason
        found, reason, lasting = make_one(trial, self._commands, read)
        if found is not None or lasting:
            self._cache.put(key, json.dumps([found, reason]).encode())
        self._made += 1
        self._count(total)
        return found, reason

    def _count(self, total: int) -> None:
        self._number += 1
        self._done(self._number, total, self._made)


@dataclass(frozen=True)
class StudyRow:
    """One strategy at one share of the holding force, or over all drops or holds."""

    weights: str
    strategy: str
    n: int
    failed: int
    saved: ScoredNumber
    """Share of weights that were not lost, with Wilson's interval of as many cases as benches."""
    squeezed: ScoredNumber
    """Share of trials with a squeeze, with the same kind of interval."""
    squeezes: int
    force_over_least: float
    """Median of the normal force at the end over the least that would have held, of the weights
    that were not lost; NaN where all were."""
    risen_ms: float
    """Median time from the first alarm's sample to F_n + 10 % of the step."""


def table(weights: Sequence[Weight]) -> list[StudyRow]:
    """Return the table of a study: a row for each share and strategy, then all drops, all holds."""
    strategies = list(dict.fromkeys(one.strategy for one in weights))
    groups = [(f"{share:g}", [share]) for share in sorted({one.share for one in weights})]
    drops = [share for share in {one.share for one in weights} if share > 1]
    holds = [share for share in {one.share for one in weights} if share <= 1]
    groups += [(name, all_) for name, all_ in (("drops", drops), ("holds", holds)) if all_]
    return [
        _row(name, strategy, [w for w in weights if w.share in shares and w.strategy == strategy])
        for name, shares in groups
        for strategy in strategies
    ]


def _row(name: str, strategy: str, weights: list[Weight]) -> StudyRow:
    made = [one for one in weights if one.outcome]
    kept = [one for one in made if one.outcome != "lost"]
    ratios = [one.force_used_N / one.least_force_N for one in kept if one.force_used_N]
    benches = len({one.seed for one in made})
    risen_ms = [1e3 * one.risen_s for one in made if one.risen_s is not None]
    return StudyRow(
        name,
        strategy,
        len(made),
        len(weights) - len(made),
        rate_of_groups(len(kept), len(made), benches),
        rate_of_groups(sum(one.squeezes > 0 for one in made), len(made), benches),
        sum(one.squeezes for one in made),
        statistics.median(ratios) if ratios else math.nan,
        statistics.median(risen_ms) if risen_ms else math.nan,
    )


def as_object(weights: Sequence[Weight]) -> dict[str, object]:
    """Return the study as values for JSON; numbers that there are not are null."""

    return {
        "weights": [finite(asdict(one)) for one in weights],
        "table": [finite(asdict(row)) for row in table(weights)],
    }
