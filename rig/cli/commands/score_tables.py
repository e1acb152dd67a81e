"""The tables that ``rig score`` prints, with the words of their quantities and conditions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.evaluation.scoring.results import ContenderResult
    from rig.evaluation.scoring.tables import ScoredNumber

BY_KIND = ("found", "found_first", "early", "no_slip_alarms", "lift_off_alarms_before")
"""Quantities that are also printed for each kind of trial."""
BY_TRAIT = ("found", "early", "no_slip_alarms", "after_ridge_50")
"""Quantities that are also printed by trait; the files contain all of them."""
SHOWN_TRAITS = (
    "noise_mV", "speed_mm_s", "static_coefficient", "friction_ratio", "normal_force_N", "tick_Hz",
    "held_share", "stop", "pattern",
)  # fmt: skip
"""Traits by which they are printed; the files contain more."""
TRAIT_WORDS = {
    "stop": ("stop:", ""),
    "held_share": ("held at", "of the way to slip"),
    "tick_Hz": ("servo tick", "Hz"),
    "normal_force_N": ("normal force", "N"),
    "noise_mV": ("noise", "mV"),
    "speed_mm_s": ("speed", "mm/s"),
    "static_coefficient": ("static friction", ""),
    "friction_ratio": ("friction ratio μ_k/μ_s", ""),
    "pattern": ("roll pattern", ""),
}
"""Words and unit of the traits in printed tables."""
LABELS = {
    "found": "slips found in time",
    "found_first": "slips found in time by the first alarm of the motion",
    "early": "slips with an early alarm",
    "late": "slips with an alarm too late",
    "alarms_after": "slips with an alarm after the time to find them",
    "found_at_a_stop": "slips with which the motion ended, found in time",
    "early_at_a_stop": "slips with which the motion ended, with an early alarm",
    "found_in_a_slide": "slips after which the motion continued, found in time",
    "early_in_a_slide": "slips after which the motion continued, with an early alarm",
    "found_in_roll": "slips within rolls found in time",
    "early_in_roll": "slips within rolls with an early alarm",
    "no_slip_alarms": "trials without a whole slip, with a false alarm",
    "no_slip_alarms_moving": "trials without a whole slip, with a false alarm in the motion",
    "roll_alarms": "rolls with a false alarm",
    "roll_alarms_moving": "rolls with a false alarm in the motion",
    "hold_alarms": "holds without any slip, with a false alarm",
    "hold_alarms_moving": "holds without any slip, with a false alarm in the motion",
    "partial_slip_alarms": "partial slips without a whole one, with a false alarm",
    "partial_slip_alarms_moving": "partial slips, with a false alarm in the motion",
    "tap_alarms": "taps with a false alarm",
    "tap_alarms_moving": "taps with a false alarm in the motion",
    "lift_off_alarms_before": "lift-offs with an alarm before the lift-off",
    "lift_off_alarms": "lift-offs with any alarm",
    "rolls_recognised": "rolls recognised",
    "taken_for_rolls": "slips, holds and taps classified as roll",
    "pressing_alarms": "trials with a false alarm before the motion",
    "found_of_judged": "of the slips that it says it can judge, found in time",
    "slips_unjudged": "slips that it says it cannot judge (counted as missed)",
    "cannot_judge": "trials that it says it cannot judge completely",
    "says_inverted": "trials in which it says that v_1 or v_2 may be inverted",
    "unjudged_time": "time that it says it cannot judge, % of all",
    "false_per_hour": "early and false alarms per hour without slip",
    "false_per_hour_of": "hours without slip",
    "quiet_per_hour": "alarms per hour of quiet, pressed and at rest",
    "quiet_per_hour_of": "hours of quiet",
    "tick_phase_p": "p that early and false alarms are uniform in the servo's tick",
    "armed": "slips armed before: motion under load begun",
    "armings_in_vain": "armed without a slip: motions under load that no slip followed",
    "roll_armed": "rolls that arm",
    "lift_off_armed": "lift-offs that arm",
    "hold_armed": "holds without any slip that arm",
    "partial_slip_armed": "partial slips that arm",
    "tap_armed": "taps that arm",
    "early_by": "how early the first early alarm is",
    "after_node": "delay after first node slip",
    "after_ridge": "delay after slip of the whole ridge",
    "before_gross": "time from the alarm to gross slip",
    "arming_lead": "time from arming to slip of the whole ridge",
}
"""Labels of the quantities in printed tables; JSON and CSV contain the keys."""
ORDINALS = {"5": "5th percentile", "50": "median", "95": "95th percentile"}
LEGEND = (
    "In time: 10 ms before to 30 ms after the whole ridge slips. Rates: share (95 % interval) of "
    "the number of cases. Times: value (95 % interval) in ms. Possible: what an ideal observer "
    "finds, who knows when the slip comes: a change of the signals that Gaussian noise like that "
    "before it shows once an hour."
)


def score_tables(scored: Sequence[ContenderResult], heading: str) -> Iterator[str]:
    """Yield the lines of the tables: all trials, by kind of trial, by condition. `heading` stands
    in the title of each."""
    names = [one.contender.name for one in scored]
    known = dict.fromkeys(quantity for one in scored for quantity in one.score)
    table = [
        [_label(quantity), *(_shown(one.score.get(quantity)) for one in scored)]
        for quantity in known
    ]
    yield from _aligned(f"All trials: {heading}", ["", *names], table)
    yield LEGEND
    yield ""
    kinds = [
        {(group.bin, name): group.score[name] for group in one.groups if group.trait == "kind"
         for name in BY_KIND if name in group.score}
        for one in scored
    ]  # fmt: skip
    if kinds and kinds[0]:
        table = [
            [f"{kind}: {_label(quantity)}", *(_shown(each.get((kind, quantity))) for each in kinds)]
            for kind, quantity in kinds[0]
        ]
        yield from _aligned(f"By kind of trial: {heading}", ["", *names], table)
    for quantity in BY_TRAIT:
        groups = [
            {(group.trait, group.bin): group.score.get(quantity) for group in one.groups}
            for one in scored
        ]
        table = [
            [_condition(trait, name), *(_shown(each.get((trait, name))) for each in groups)]
            for trait, name in groups[0]
            if trait in SHOWN_TRAITS and any(each.get((trait, name)) for each in groups)
        ]
        if table:
            yield from _aligned(f"{_label(quantity)}, by condition: {heading}", ["", *names], table)


def _aligned(title: str, head: list[str], table: list[list[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(head, *table, strict=True)]
    yield title
    for line in (head, *table):
        yield "  ".join(
            cell.ljust(width) for cell, width in zip(line, widths, strict=True)
        ).rstrip()
    yield ""


def _label(quantity: str) -> str:
    """Return the label of a quantity in a printed table.

    >>> _label("after_node_5")
    'delay after first node slip, 5th percentile (ms)'
    """
    stem, _, percent = quantity.rpartition("_")
    if percent in ORDINALS:
        return f"{LABELS[stem]}, {ORDINALS[percent]} (ms)"
    return LABELS[quantity]


def _condition(trait: str, bin_: str) -> str:
    """Return a bin of a trait as text.

    >>> _condition("noise_mV", "0.2 to 0.5")
    'noise 0.2 to 0.5 mV'
    """
    word, unit = TRAIT_WORDS[trait]
    numbers, _, above = bin_.partition(" and ")
    return " ".join(part for part in (word, numbers, unit, above and f"and {above}") if part)


def _shown(number: ScoredNumber | None) -> str:
    """Return a number with its 95 % interval; a rate also with the number of its cases."""
    if number is None or not number.of:
        return "-"
    if number.unit == "p":
        return f"{number.value:.2g} ({number.of} alarms)"
    if number.unit == "h":
        return f"{number.value:.3g}"
    if number.unit == "1":
        return f"{number.value:.3f} ({number.low:.3f} to {number.high:.3f}) of {number.of}"
    interval = f" ({number.low:.1f} to {number.high:.1f})" if math.isfinite(number.low) else ""
    return f"{number.value:.1f}{interval}"
