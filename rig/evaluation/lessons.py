"""Lessons from which the detector's network learns: recordings with their truth, of the skin model,
of the whole simulated bench, or of run files.

A lesson of the model is heard through several front ends, of which each has at most one fault, so
that nothing that belongs to one simulated noise is learnt. Some lessons are held out: they say how
the network does on what it has not seen. All lessons of a seed, or of a sample and a day, are on
the same side.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.core.errors import ConfigurationError
from rig.detector.built_in import Rig
from rig.detector.detector import IncipientSlipDetector, NETWORK_RATE_Hz
from rig.detector.kernel import INPUTS
from rig.detector.network import OUTPUTS, Network
from rig.detector.notices import Notice
from rig.detector.registered import ChosenDetector
from rig.detector.resampling import Ratio, StreamingResampler, check_rate
from rig.detector.settings import named_detectors
from rig.evaluation.breaks import between
from rig.evaluation.front_ends import recorded
from rig.evaluation.labelled_files import ListedTrial
from rig.evaluation.labelled_trials import KINDS, LabelledTrial
from rig.evaluation.scored_trials import truth_of
from rig.evaluation.scoring.contenders import DetectorContender
from rig.evaluation.scoring.outcomes import Truth, judge
from rig.evaluation.scoring.tables import rate
from rig.evaluation.training import TrainingRows, TrainingTrial, rows_of
from rig.evaluation.wire.kinds import WIRE_KINDS, WireKind
from rig.evaluation.wire.making import MadeTrial
from rig.physics.population import PopulationSettings, Range, StripFrontEndSettings
from rig.physics.skin.settings import SkinSettings

Floats = NDArray[np.float64]

LESSON_KINDS = KINDS
"""Kinds of the model's trials in lessons: all."""
LESSON_WIRE_KINDS: tuple[WireKind, ...] = tuple(kind for kind in WIRE_KINDS if kind != "rest")
"""Kinds of the bench's trials in lessons. A rest takes longest and teaches least."""
LESSON_POPULATION = PopulationSettings(
    # Half the processor time of 16 elements; the shape of v_d is off by 12 % in the median instead
    # of 6 % (decision 0083).
    skin=SkinSettings(elements_per_ridge=10),
    drawn_skin=True,
    friction_ratio=Range(low=0.65, high=1.0),
    normal_force_N=between(0.7, 12.0),
    speed_mm_s=between(0.1, 10.0),
    ramp_s=between(0.002, 0.1),
    jitter_um=Range(low=0.0, high=1.0),
    tick_share=between(0.0003, 0.02),
    held_share=Range(low=0.15, high=0.98),
)
"""Ranges of the model's trials in lessons: wider than those of the scored ones."""
LESSON_FRONT_END = StripFrontEndSettings(noise_mV=between(0.05, 2.0), gain=between(0.25, 4.0))
"""Ranges of a front end without a fault."""
FAULTS: tuple[dict[str, Range], ...] = (
    {},
    {},
    {"coupling_Hz": between(0.1, 1.0)},
    {"flicker_mV": between(0.3, 3.0)},
    {"noise_mV": between(1.0, 4.0)},
    {"step_mV": between(0.2, 2.0)},
    {"bursts_Hz": between(0.5, 5.0)},
    {"drift_mV": between(3.0, 40.0)},
)
"""What is different in front ends with a fault; a quarter has none."""
AS_IT_IS = {"noise_mV": Range(low=0.0, high=0.0), "mains_mV": Range(low=0.0, high=0.0)}
"""What a recording that has been through a front end already is not given again."""
BENCH_WEIGHT = 2.0
"""Weight of a trial of the bench, which is what the detector will meet; one of the model has 1."""
HELD_OUT_EVERY = 5
"""One seed out of this many is held out."""


@dataclass(frozen=True)
class Lesson:
    """A recording and its truth. Times are in s from its first sample."""

    name: str
    """Its name, for messages."""
    held_out: bool
    """True if the network does not learn from it but is judged on it."""
    volts: Floats
    """Signals v_1 and v_2 in V, (n, 2)."""
    rate_Hz: float
    """Sampling rate of the rows, in samples/s."""
    truth: Truth
    """What happened."""
    slips_s: Floats
    """Begin and end of every slip of the whole ridge, (k, 2)."""
    rolls: bool
    """True if the motion is a roll."""
    motion_end_s: float = math.nan
    """End of a roll, NaN if it lasts to the end of the record."""
    notices: tuple[Notice, ...] = ()
    """What was commanded, where that is known."""
    ends_known: bool = True
    """False where no one has stated when the ridge stuck again: `slips_s` end with the record."""
    first: bool = True
    """False for a trial that is heard through a further front end."""
    weight: float = 1.0
    """Weight of its rows."""


def held_out(seed: int) -> bool:
    """Return whether the lessons of a seed are held out.

    >>> [seed for seed in range(10) if held_out(seed)]
    [4, 9]
    """
    return seed % HELD_OUT_EVERY == HELD_OUT_EVERY - 1


def front_end_of(number: int, base: StripFrontEndSettings) -> StripFrontEndSettings:
    """Return the front end with the fault of this number, counted round and round."""
    return base.model_copy(update=FAULTS[number % len(FAULTS)])


def model_lessons(
    trial: LabelledTrial, base: StripFrontEndSettings, hearings: int
) -> Iterator[Lesson]:
    """Yield a trial of the skin model through several front ends."""
    for hearing in range(hearings):
        key = [KINDS.index(trial.kind), trial.seed, 3, hearing]
        chance = np.random.default_rng(key)
        front_end = front_end_of(int(chance.integers(len(FAULTS))), base)
        volts, _ = recorded(trial.volts, trial.rate_Hz, front_end, chance)
        rolls = trial.kind == "roll"
        yield Lesson(
            name=f"{trial.kind} {trial.seed}",
            held_out=held_out(trial.seed),
            volts=volts,
            rate_Hz=trial.rate_Hz,
            truth=truth_of(trial),
            slips_s=trial.slips_s,
            rolls=rolls,
            motion_end_s=trial.motion_s + trial.traits["roll_s"] if rolls else math.nan,
            first=hearing == 0,
        )


def bench_lessons(made: MadeTrial, hearings: int) -> Iterator[Lesson]:
    """Yield a trial of the simulated bench as it was recorded, with its commands and without, and
    then with the gains and the fault of further front ends; nothing for one that could not be made.

    Every second hearing is without commands, as recordings of other programs are.
    """
    trial, record = made.trial, made.record
    if record is None:
        return
    rolls = trial.procedure == "roll-trial"
    motion_end_s = math.nan
    if rolls:
        turning_s = abs(trial.settings["angle_deg"]) / trial.settings["turn_speed_deg_s"]
        motion_end_s = record.truth.motion_s + turning_s
    first = Lesson(
        name=trial.name,
        held_out=held_out(trial.seed),
        volts=record.volts,
        rate_Hz=record.rate_Hz,
        truth=record.truth,
        slips_s=np.array(record.slips_s, dtype=np.float64).reshape(-1, 2),
        rolls=rolls,
        motion_end_s=motion_end_s,
        notices=record.notices,
        weight=BENCH_WEIGHT,
    )
    yield first
    base = LESSON_FRONT_END.model_copy(update=AS_IT_IS)
    for hearing in range(1, hearings):
        volts, notices = record.volts, () if hearing % 2 else record.notices
        if hearing > 1:
            chance = np.random.default_rng([WIRE_KINDS.index(trial.kind), trial.seed, 4, hearing])
            front_end = front_end_of(int(chance.integers(len(FAULTS))), base)
            volts, _ = recorded(record.volts, record.rate_Hz, front_end, chance)
        yield replace(first, volts=volts, notices=notices, first=False)


def file_lesson(listed: ListedTrial, held_out: bool) -> Lesson:
    """Return a trial of a run file as a lesson."""
    return Lesson(
        name=listed.name,
        held_out=held_out,
        volts=listed.volts,
        rate_Hz=listed.rate_Hz,
        truth=listed.truth,
        slips_s=np.array(listed.slips_s, dtype=np.float64).reshape(-1, 2),
        rolls=listed.rolls,
        notices=listed.notices,
        ends_known=listed.ends_known,
    )


class Teacher:
    """Turns lessons into rows of the network's inputs with what is right in them."""

    def __init__(self) -> None:
        silent = Network(
            name="silent", inputs=INPUTS, hidden=((0.0,) * (len(INPUTS) + 1),),
            output=((0.0, -50.0),) * len(OUTPUTS), first_seed=0, last_seed=0, trained_by="nothing",
        )  # fmt: skip
        self._settings = named_detectors()["rig"].model_copy(update={"network": silent})

    def rows_of(self, lesson: Lesson) -> TrainingRows:
        """Return the rows of a lesson. Raises ValueError for a recording that the detector
        refuses."""
        volts, ratio, notices = lesson.volts, Ratio(1, 1), lesson.notices
        if not Rig.accepts(lesson.rate_Hz):
            check_rate(lesson.rate_Hz)
            resampler = StreamingResampler(lesson.rate_Hz, NETWORK_RATE_Hz, 2)
            volts, ratio = resampler.add(volts), resampler.ratio
            notices = tuple(one.at_rows(ratio.outputs_before) for one in notices)
        shown = IncipientSlipDetector(self._settings, NETWORK_RATE_Hz).network_inputs(
            volts, notices
        )
        moves = shown.inputs[:, INPUTS.index("speed of x")] > 0
        rows = rows_of(
            TrainingTrial(
                inputs=shown.inputs,
                # Rows at which the answer could be given, as in a score.
                time_s=shown.rows * ratio.down // ratio.up / lesson.rate_Hz,
                slips_s=lesson.slips_s,
                rolls=lesson.rolls,
                motion_s=lesson.truth.motion_s,
                motion_end_s=lesson.motion_end_s,
                lift_off_s=lesson.truth.lift_off_s,
                moves=moves if notices and lesson.ends_known else None,
            )
        )
        return replace(rows, weight=lesson.weight * rows.weight)


def judged(
    network: Network, lessons: Sequence[Lesson]
) -> Iterator[tuple[str, int, int, float, float]]:
    """Yield what a network finds in lessons: name of the share, hits, cases, and Wilson's 95 %
    interval."""
    settings = named_detectors()["rig"].model_copy(update={"network": network})
    contender = DetectorContender(network.name, ChosenDetector("rig", settings))
    hits: dict[str, list[bool]] = {}
    for one in lessons:
        if not one.first:
            continue  # the same contact: not another case
        (report,) = contender.reports(one.volts, one.rate_Hz, (1.0,), one.notices)
        outcome = judge(one.truth, report, {})
        label = one.truth.label
        if one.truth.slipped:
            hits.setdefault(f"{label}, in time", []).append(outcome.found)
            hits.setdefault(f"{label}, early alarm", []).append(outcome.early)
        else:
            hits.setdefault(f"{label}, false alarm", []).append(outcome.alarmed_touching)
        if not one.rolls:
            hits.setdefault("no roll, taken for one", []).append(outcome.classified_as_roll)
    for name in sorted(hits):
        share = rate(sum(hits[name]), len(hits[name]))
        yield name, sum(hits[name]), len(hits[name]), share.low, share.high


def sides_of(groups: Sequence[tuple[str, str]]) -> list[bool]:
    """Return which trials of these samples and days are held out: about a fifth of them, such that
    no sample and no day is on both sides. Raises ConfigurationError where that cannot be.

    >>> sides_of([("a", "monday"), ("a", "tuesday"), ("b", "friday")])
    [False, False, True]
    """
    part = _connected(groups)
    sizes = Counter(part)
    if len(sizes) < 2:
        named = ", ".join(sorted({sample or "without a name" for sample, _ in groups})[:4])
        what = f"all {len(groups)} trials share samples or days ({named})"
        if len(groups) == 1:
            what = "it lists one trial"
        raise ConfigurationError(
            f"--files: {what}, so that none can be held out",
            "add trials of another sample on another day (rig import --sample, --start-time), or "
            "hold none out with --all",
        )
    kept, chosen = 0, set[int]()
    for one in sorted(sizes, key=lambda one: sizes[one]):
        if not chosen or (kept + sizes[one]) * HELD_OUT_EVERY <= len(groups):
            chosen.add(one)
            kept += sizes[one]
    return [one in chosen for one in part]


def _connected(groups: Sequence[tuple[str, str]]) -> list[int]:
    """Return for each trial the number of its part: trials that share a sample or a day, also by
    way of others, are in the same one."""
    above: dict[tuple[str, str], tuple[str, str]] = {}

    def top(name: tuple[str, str]) -> tuple[str, str]:
        while (next_above := above.setdefault(name, name)) != name:
            above[name] = above.setdefault(next_above, next_above)
            name = next_above
        return name

    for sample, day in groups:
        above[top(("sample", sample))] = top(("day", day))
    tops = [top(("sample", sample)) for sample, _ in groups]
    numbers = {one: number for number, one in enumerate(dict.fromkeys(tops))}
    return [numbers[one] for one in tops]
