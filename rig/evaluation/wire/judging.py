"""Scores detectors on trials that were made on the simulated bench."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from rig.core.cache import Cache
from rig.evaluation.scored_trials import judge_one
from rig.evaluation.scoring.contenders import Contender
from rig.evaluation.scoring.results import ScoredTrial
from rig.evaluation.wire.kinds import WIRE_KINDS, WireKind
from rig.evaluation.wire.making import MadeTrial, code_digest, make_trials


@dataclass(frozen=True)
class WireScore:
    """The scored trials, and those that could not be made."""

    judged: list[ScoredTrial]
    """Scored trials, by seed and kind."""
    failed: dict[str, str]
    """Reason for each trial that could not be made, by its name."""
    code: str
    """Digest of the code that determines what a trial records."""


def judge_wire(
    kinds: Sequence[WireKind],
    seeds: Sequence[int],
    contenders: Sequence[Contender],
    cache: Cache,
    *,
    sweep: bool,
    jobs: int,
    done: Callable[[int, int, int], None],
    scored: Callable[[int, int], None],
) -> WireScore:
    """Make the trials that are not in the cache, `jobs` at a time, and score all of them.

    `done` is called with the number so far, that of all, and that of those that had to be made;
    `scored`, after that, with the number of scored trials and of all that were made. The result
    does not depend on what was in the cache.
    """
    made = sorted(make_trials(kinds, seeds, cache, jobs, done), key=_place)
    recorded = [one for one in made if one.record is not None]
    judged = []
    for number, one in enumerate(recorded, 1):
        judged.append(_judged(one, contenders, sweep))
        scored(number, len(recorded))
    failed = {one.trial.name: one.failed for one in made if one.record is None}
    return WireScore(judged, failed, code_digest())


def _place(one: MadeTrial) -> tuple[int, int]:
    return one.trial.seed, WIRE_KINDS.index(one.trial.kind)


def _judged(one: MadeTrial, contenders: Sequence[Contender], sweep: bool) -> ScoredTrial:
    record, drawn = one.record, one.trial.traits
    assert record is not None
    tick_s = 1 / float(drawn["tick_Hz"])
    truth = replace(record.truth, tick_s=tick_s, tick_from_s=record.tick_from_s)
    if one.trial.kind == "tap" and not truth.slipped:
        truth = replace(truth, label="tap")
    traits = {**drawn, **record.traits}
    return judge_one(
        one.trial.name, truth, record.volts, record.rate_Hz, traits, contenders, sweep=sweep,
        notices=record.notices,
    )  # fmt: skip
