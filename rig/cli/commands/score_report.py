"""Tables, files and figures of ``rig score``.

Nothing is written before everything has been computed.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rig.cli.outcome import print_json
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.evaluation.scoring.contenders import Contender, Named
    from rig.evaluation.scoring.results import ContenderResult, ScoredTrial
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
    "held_share": ("held at a share of the way to slip of", ""),
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
    "found_in_a_slide": "slips after which the motion went on, found in time",
    "early_in_a_slide": "slips after which the motion went on, with an early alarm",
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
    "slips_unjudged": "slips that it says it cannot judge (they count as missed)",
    "cannot_judge": "trials of which it says it cannot judge all",
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
    "finds, who knows what the slip does to the signals, in noise and servo steps like those "
    "before it; no detector finds more."
)


def report(
    contenders: Sequence[Contender],
    judged: Sequence[ScoredTrial],
    use: str,
    simulated: bool,
    said: dict[str, Any],
    out: Path,
    as_json: bool,
) -> None:
    """Write tables and figures to `out` and print the tables.

    Trivial answers are scored beside the detectors. `said` goes into the JSON file.
    """
    from rig.core.settings import fingerprint
    from rig.evaluation.scoring.results import ROW, results, rows
    from rig.evaluation.scoring.trivial import with_trivial_answers

    trivial, judged = with_trivial_answers(judged)
    named: list[Named] = [*contenders, *trivial]
    scored = results(named, judged)
    document = {
        "simulated": simulated,
        "use": use,
        "trials": len(judged),
        **said,
        "detectors": [
            {
                "name": one.name,
                **_identity(one),
                "parameters": fingerprint(one.settings),
                "tuned_on": None if one.tuned_on is None else str(one.tuned_on),
            }
            for one in contenders
        ],
        "trivial_answers": [
            {"name": one.name, **one.settings.model_dump(mode="json")} for one in trivial
        ],
        "results": [dict(zip(ROW, map(_plain, row), strict=True)) for row in rows(scored, use)],
    }
    _make(out)
    drawn = _draw(scored, use, simulated, out)
    _write_csv(out / "trials.csv", _TRIAL, _trials(named, judged))
    _write_csv(out / "score.csv", ROW, rows(scored, use))
    # Written last: its presence shows that the folder is complete.
    write(out / "score.json", json.dumps(document, indent=1) + "\n")
    if as_json:
        files = [out / name for name in ("score.json", "score.csv", "trials.csv")]
        print_json({**document, "files": [str(file) for file in [*files, *drawn]]})
        return
    heading = f"{'simulated trials, ' if simulated else ''}{use}, {len(judged)} trials"
    for line in _tables(scored, heading):
        typer.echo(line)
    figures = len({file.stem for file in drawn})
    typer.echo(
        f"saved in {out}: score.json, score.csv, trials.csv, {figures} figures (PNG and SVG)"
    )


def _tables(scored: Sequence[ContenderResult], heading: str) -> Iterator[str]:
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
    return f"{word} {bin_} {unit}".rstrip()


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


_TRIAL = (
    "trial", "detector", "label", "found", "found_first", "early", "late", "alarmed",
    "alarmed_pressing", "alarmed_moving", "cannot_judge", "slip_unjudged", "unjudged_s",
    "early_by_s", "after_node_s", "after_ridge_s", "before_gross_s", "armed",
    "arming_lead_s", "in_vain", "false_alarms",
    "without_slip_s", "quiet_alarms", "quiet_s", "kind", "stop", "pattern", "noise_mV",
    "speed_mm_s", "static_coefficient", "friction_ratio", "normal_force_N", "gain_mismatch",
    "tick_Hz", "held_share",
)  # fmt: skip


def _trials(
    contenders: Sequence[Named], judged: Sequence[ScoredTrial]
) -> Iterator[tuple[Any, ...]]:
    for trial in judged:
        for one, outcome in zip(contenders, trial.outcomes, strict=True):
            values = {"trial": trial.name, "detector": one.name, **outcome.traits, **vars(outcome)}
            yield tuple(values.get(name, "") for name in _TRIAL)


def _draw(scored: Sequence[ContenderResult], use: str, simulated: bool, out: Path) -> list[Path]:
    from rig.figures import score as figures
    from rig.figures.style import save

    title = f"{use}{', simulated' if simulated else ''}"
    drawn = {
        "score-found": figures.draw_found(scored, title),
        "score-delays": figures.draw_delays(scored, title),
    }
    if any(one.rocs for one in scored):
        drawn["score-roc"] = figures.draw_roc(scored, title)
    return [
        file
        for name, figure in drawn.items()
        for file in save(figure, out / f"{name}.png", simulated)
    ]


def _identity(contender: Contender) -> dict[str, Any]:
    """Return version and package of a detector; nothing of a baseline, which has none."""
    from rig.evaluation.scoring.contenders import DetectorContender

    if not isinstance(contender, DetectorContender):
        return {}
    detector = contender.detector
    return {
        "version": detector.version,
        "package": detector.package,
        "package_version": detector.package_version,
        "code": detector.code_digest or None,
    }


def _plain(value: Any) -> Any:
    """Return a value for JSON; numbers that are not finite become None."""
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def _write_csv(file: Path, head: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> None:
    with _writing(file), file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(head)
        for row in rows:
            writer.writerow([_cell(value) for value in row])


def _cell(value: Any) -> Any:
    """Return a value for CSV: missing numbers are empty, flags 0 and 1."""
    if isinstance(value, bool):
        return int(value)
    plain = _plain(value)
    return "" if plain is None else plain


def write(file: Path, text: str) -> None:
    """Write a text file. Raises ConfigurationError if it cannot be written."""
    with _writing(file):
        file.write_text(text, encoding="utf-8")


def _make(folder: Path) -> None:
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


@contextmanager
def _writing(file: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"{file} cannot be written: {error.strerror}", "choose another place"
        ) from error
