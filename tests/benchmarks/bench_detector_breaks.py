"""What breaks the detectors, one condition at a time: `rig` as it was at 15205df, `rig` of this
tree and `paper-hp`, on the same trials of the skin model (`rig.evaluation.breaks`).

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_detector_breaks.py``. `RIG_REPEATS` is
the number of seeds of each condition (``-k`` chooses conditions); they are reserved for reporting.
The former network is taken from git. Its kernel is that of this tree, which finds the same slips
with it (decision 0090).
"""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from measured import heading, repeats

from rig.core.cache import user_cache
from rig.detector.network import Network
from rig.detector.registered import chosen_detector
from rig.detector.settings import RigSettings
from rig.evaluation.breaks import BREAKS
from rig.evaluation.scored_trials import Population, judge_trials
from rig.evaluation.scoring.contenders import DetectorContender
from rig.evaluation.scoring.outcomes import SLIPS, TrialOutcome
from rig.evaluation.scoring.results import results
from rig.evaluation.scoring.seeds import FIRST_REPORTING_SEED, SeedRange
from rig.evaluation.scoring.tables import TOUCHING, rate, score
from rig.physics.skin.condensed import build_skin

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(36_000)]

BEFORE = "15205df"
ROOT = Path(__file__).parents[2]


def former() -> DetectorContender:
    """The detector `rig` of commit `BEFORE`."""
    stored = ["git", "show", f"{BEFORE}:rig/detector/rig.json"]
    text = subprocess.run(stored, cwd=ROOT, capture_output=True, check=True).stdout
    network = Network.model_validate_json(text)
    settings = RigSettings(network=network, fire_probability=0.8)
    return DetectorContender(f"rig at {BEFORE}", replace(chosen_detector("rig"), settings=settings))


def contenders() -> list[DetectorContender]:
    """The detectors that are compared."""
    now = [DetectorContender(name, chosen_detector(name)) for name in ("rig", "paper-hp")]
    return [former(), *now]


def share(outcomes: list[TrialOutcome], name: str) -> str:
    """How many outcomes have a property, with Wilson's interval in %."""
    hits = sum(bool(getattr(one, name)) for one in outcomes)
    if not outcomes:
        return "-"
    number = rate(hits, len(outcomes))
    return f"{hits}/{number.of}, {100 * number.low:.0f}–{100 * number.high:.0f} %"


@pytest.mark.parametrize("name", BREAKS)
def test_a_break(name: str) -> None:
    one, count, cache = BREAKS[name], repeats(100), user_cache()
    seeds = SeedRange(first=FIRST_REPORTING_SEED, end=FIRST_REPORTING_SEED + count)
    print()  # after the dot of the condition before
    if name == next(iter(BREAKS)):
        heading(f"each break with seeds {seeds.first}:{seeds.end}")
        columns = ("break", "detector", "slips in time", "early", "no whole slip: false")
        print(f"| {' | '.join(columns)} | before lift-off | unjudged, % |")
        print("|---|---|---|---|---|---|---|")
    skin = build_skin(one.population.skin, cache)
    population = Population(skin, one.population, one.front_end, False, one.kinds, seeds, cache)
    judged = judge_trials(population, contenders(), sweep=False, jobs=1, done=lambda _: None)
    for result in results(contenders(), judged):
        outcomes = list(result.outcomes)
        slips = [each for each in outcomes if each.label in SLIPS]
        still = [each for each in outcomes if each.label in TOUCHING]
        lifted = [each for each in outcomes if each.label == "lift-off"]
        unjudged = score(outcomes)["unjudged_time"].value
        print(
            f"| {name} | {result.contender.name} | {share(slips, 'found')} | "
            f"{share(slips, 'early')} | {share(still, 'alarmed')} | "
            f"{share(lifted, 'alarmed_touching')} | {unjudged:.1f} |",
            flush=True,
        )
