"""The work behind ``rig score``: simulates trials or reads them from the cache, and scores them in
parallel.

Worker processes are forks that inherit skin, settings and detectors; only small results come back.
The result does not depend on their number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.core.cache import Cache
from rig.core.pool_workers import begin_worker, kill_workers
from rig.detector.checking import DetectorError
from rig.detector.notices import Notice
from rig.evaluation.front_ends import through_front_end
from rig.evaluation.labelled_trials import Kind, LabelledTrial, labelled_trial
from rig.evaluation.scoring.baselines import BaselineSettings, baseline_score
from rig.evaluation.scoring.contenders import FACTORS, Contender
from rig.evaluation.scoring.ideal import ideal_report
from rig.evaluation.scoring.outcomes import FOUND_WITHIN_S, DetectorReport, Truth, judge
from rig.evaluation.scoring.patterns import roll_pattern
from rig.evaluation.scoring.results import ScoredTrial
from rig.evaluation.scoring.roc import tune
from rig.evaluation.scoring.seeds import SeedRange
from rig.physics.population import PopulationSettings, StripFrontEndSettings
from rig.physics.skin.condensed import CondensedSkin

Floats = NDArray[np.float64]
Traits = dict[str, float | str]
Result = TypeVar("Result")
Each = Callable[[LabelledTrial, Floats, Traits], Result]
"""Function of a trial, its recorded volts and its traits."""

FLOORS_mV = (0.1, 0.2, 0.4, 0.8, 1.5, 3.0)
"""Floors of the noise from which that of a baseline is chosen."""
RESTS_AFTER_S = 0.02
"""Time after pressing on from which the rubber rests."""
_CHUNK = 4


@dataclass(frozen=True)
class Population:
    """The trials to be scored, and the front end through which they are recorded."""

    skin: CondensedSkin
    """The skin on which they are simulated."""
    settings: PopulationSettings
    """Ranges from which the trials are drawn."""
    front_end: StripFrontEndSettings
    """Ranges from which noise, mains and gain mismatch are drawn."""
    swapped_gains: bool
    """True if the amplifiers of the two channels, with noise and mains, are exchanged."""
    kinds: tuple[Kind, ...]
    """Kinds of trials."""
    seeds: SeedRange
    """Seeds of the trials; each seed gives one trial of every kind."""
    cache: Cache
    """Cache of simulated trials."""

    def trials(self) -> list[tuple[Kind, int]]:
        """Return kind and seed of every trial; the kinds alternate."""
        return [(kind, seed) for seed in self.seeds.seeds() for kind in self.kinds]


def judge_trials(
    population: Population,
    contenders: Sequence[Contender],
    *,
    sweep: bool,
    jobs: int,
    done: Callable[[int], None],
) -> list[ScoredTrial]:
    """Score every trial of the population. `done` is called with the number of trials so far."""

    def work(trial: LabelledTrial, volts: Floats, traits: Traits) -> ScoredTrial:
        return judge_one(
            f"{trial.kind} {trial.seed}", truth_of(trial), volts, trial.rate_Hz, traits,
            contenders, sweep=sweep,
        )  # fmt: skip

    for one in contenders:
        # Compiles the detector here, so that the forked workers do not each do it. One that fails
        # already is named with the first trial.
        with suppress(DetectorError):
            one.reports(np.zeros((1000, 2)), 1000.0, (1.0,))
    return list(each_trial(population, work, jobs, done))


def judge_one(
    name: str,
    truth: Truth,
    volts: Floats,
    rate_Hz: float,
    traits: Traits,
    contenders: Sequence[Contender],
    *,
    sweep: bool,
    notices: tuple[Notice, ...] = (),
) -> ScoredTrial:
    """Score one recording with these commands. Raises ValueError if a detector cannot process
    it; one of another package that fails is named in the result, with an outcome of no alarms."""
    factors = (1.0, *FACTORS) if sweep else (1.0,)
    judged, failed = [], {}
    for one in contenders:
        try:
            reports = one.reports(volts, rate_Hz, factors, notices)
        except DetectorError as error:
            failed[one.name] = error
            reports = [DetectorReport()] * len(factors)
        judged.append([judge(truth, report, traits) for report in reports])
    swept = [outcomes[1:] for outcomes in judged]
    return ScoredTrial(
        name=name,
        truth=truth,
        outcomes=tuple(outcomes[0] for outcomes in judged),
        found=np.array([[one.found for one in each] for each in swept], bool),
        alarmed=np.array([[one.alarmed for one in each] for each in swept], bool),
        possible=ideal_report(volts, rate_Hz, truth),
        failed=failed,
    )


def tune_baselines(
    population: Population,
    baselines: Sequence[BaselineSettings],
    *,
    jobs: int,
    done: Callable[[int], None],
) -> list[tuple[BaselineSettings, float]]:
    """Return the baselines with floor and threshold chosen on these trials, and the share of slips
    found."""
    variants = [
        one.model_copy(update={"floor_mV": floor}) for one in baselines for floor in FLOORS_mV
    ]

    def work(trial: LabelledTrial, volts: Floats, traits: Traits) -> tuple[str, list[float]]:
        if trial.label not in ("roll", "slip"):
            return trial.label, []
        truth = truth_of(trial)
        counted = slice(0, len(volts))
        if truth.slipped:
            first, last = truth.window_s()
            counted = slice(int(np.ceil(first * trial.rate_Hz)), int(last * trial.rate_Hz) + 1)
        scores = (baseline_score(volts, trial.rate_Hz, one)[counted] for one in variants)
        return trial.label, [float(score.max(initial=0.0)) for score in scores]

    peaks = list(each_trial(population, work, jobs, done))
    shape = (-1, len(baselines), len(FLOORS_mV))
    rolls, slips = (
        np.array([each for label, each in peaks if label == wanted]).reshape(shape)
        for wanted in ("roll", "slip")
    )
    tuned = []
    for at, one in enumerate(baselines):
        floor, threshold, found = tune(FLOORS_mV, rolls[:, at], slips[:, at])
        chosen = {"floor_mV": floor, "threshold": threshold, "tuned_on": population.seeds}
        tuned.append((one.model_copy(update=chosen), found))
    return tuned


def recorded_volts(population: Population, trial: LabelledTrial) -> tuple[Floats, Traits]:
    """Return the volts (n, 2) that the population's front end records, and the traits of the
    trial."""
    if population.swapped_gains:
        turned = replace(trial, volts=trial.volts[:, ::-1])
        volts, added = through_front_end(turned, population.front_end)
        volts, added["gain_mismatch"] = volts[:, ::-1], -added["gain_mismatch"]
    else:
        volts, added = through_front_end(trial, population.front_end)
    traits: Traits = {**trial.traits, **added, "kind": trial.kind}
    if trial.kind == "roll":
        way_mm = trial.traits["radius_mm"] * np.radians(abs(trial.traits["angle_deg"]))
        traits["speed_mm_s"] = float(way_mm / trial.traits["roll_s"])
        traits["pattern"] = roll_pattern(trial.volts, trial.rate_Hz, trial.motion_s)
    return volts, traits


def truth_of(trial: LabelledTrial) -> Truth:
    """Return the truth of a trial. Its record ends at its last sample; the motion of a slide
    continues until then."""
    record_s = len(trial.volts) / trial.rate_Hz
    label: str = trial.label
    if trial.kind == "slide" and trial.ridge_slip_s + FOUND_WITHIN_S < record_s:
        label = "slip in a slide"
    elif label == "hold" and math.isfinite(trial.node_slip_s):
        label = "partial slip"
    rests_from_s = trial.motion_s - trial.traits["rest_s"] + RESTS_AFTER_S
    return Truth(
        record_s=record_s,
        quiet_s=((rests_from_s, trial.motion_s),) if rests_from_s < trial.motion_s else (),
        label=label,
        motion_s=trial.motion_s,
        node_slip_s=trial.node_slip_s,
        ridge_slip_s=trial.ridge_slip_s,
        gross_slip_s=trial.gross_slip_s,
        lift_off_s=trial.lift_off_s,
    )


class _Work(Generic[Result]):
    """Work of a process on one kind and seed. Forks inherit it."""

    def __init__(self, population: Population, each: Each[Result]):
        self.population, self.each = population, each

    def __call__(self, drawn: tuple[Kind, int]) -> Result:
        population = self.population
        trial = labelled_trial(
            population.skin, *drawn, population=population.settings, cache=population.cache
        )
        return self.each(trial, *recorded_volts(population, trial))


_inherited: _Work[Any] | None = None


def _work_inherited(drawn: tuple[Kind, int]) -> Any:
    assert _inherited is not None
    return _inherited(drawn)


def each_trial(
    population: Population, each: Each[Result], jobs: int, done: Callable[[int], None]
) -> Iterator[Result]:
    """Yield the result of `each` for every trial, in order. `done` is called with the number so
    far."""
    for number, result in enumerate(_over(population, each, jobs), 1):
        done(number)
        yield result


def _over(population: Population, each: Each[Result], jobs: int) -> Iterator[Result]:
    """Yield the result of `each` for every trial, in the order of the trials."""
    global _inherited
    work, trials = _Work(population, each), population.trials()
    if jobs == 1:
        yield from map(work, trials)
        return
    _inherited = work
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("fork"), initializer=begin_worker)
    try:
        yield from pool.map(_work_inherited, trials, chunksize=_CHUNK)
    except BaseException:
        kill_workers(pool)  # the results of the trials under way are not wanted any more
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        _inherited = None
