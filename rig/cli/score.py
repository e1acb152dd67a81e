"""``rig score`` scores detectors on random trials of the skin model or on labelled run files.

Modules that are slow to import are imported inside. stdout carries the tables, stderr the progress.
Nothing is written before everything has been computed.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from rig.cli.model_errors import model_errors
from rig.cli.outcome import reported, say
from rig.core.errors import ConfigurationError
from rig.core.toml_files import MAX_JSON_BYTES, read_text
from rig.detector import DEFAULT_DETECTOR

if TYPE_CHECKING:
    from rig.core.settings import Settings
    from rig.evaluation.labelled_trials import PopulationSettings
    from rig.evaluation.scored_trials import Population
    from rig.evaluation.scoring.baselines import BaselineSettings
    from rig.evaluation.scoring.contenders import Contender
    from rig.evaluation.scoring.results import ContenderResult, ScoredTrial
    from rig.evaluation.scoring.seeds import SeedRange
    from rig.evaluation.scoring.tables import ScoredNumber

    Model = TypeVar("Model", bound=Settings)
else:
    Model = TypeVar("Model")

BY_TRAIT = ("found", "roll_alarms", "after_ridge_50", "armed")
"""Quantities that are also printed by trait; the files contain all of them."""
SHOWN_TRAITS = ("noise_mV", "speed_mm_s", "static_coefficient", "friction_ratio", "pattern")
"""Traits by which they are printed; the files contain more."""
TRAIT_WORDS = {
    "noise_mV": ("noise", "mV"),
    "speed_mm_s": ("speed", "mm/s"),
    "static_coefficient": ("static friction", ""),
    "friction_ratio": ("friction ratio μ_k/μ_s", ""),
    "pattern": ("roll pattern", ""),
}
"""Words and unit of the traits in printed tables."""
LABELS = {
    "found": "slips found",
    "early": "slips with an alarm before the first node slipped",
    "late": "slips with an alarm too late",
    "found_in_roll": "slips within rolls found",
    "early_in_roll": "slips within rolls with an alarm before the first node slipped",
    "roll_alarms": "rolls with a false alarm",
    "hold_alarms": "holds with a false alarm",
    "tap_alarms": "taps with a false alarm",
    "lift_off_alarms_before": "lift-offs with an alarm before the lift-off",
    "lift_off_alarms": "lift-offs with any alarm",
    "rolls_recognised": "rolls recognised",
    "taken_for_rolls": "slips, holds and taps classified as roll",
    "pressing_alarms": "trials with an alarm while pressing on",
    "armed": "slips with an early warning",
    "armings_in_vain": "early warnings without slip",
    "roll_armed": "rolls with an early warning",
    "lift_off_armed": "lift-offs with an early warning",
    "hold_armed": "holds with an early warning",
    "tap_armed": "taps with an early warning",
    "after_node": "delay after first node slip",
    "after_ridge": "delay after slip of the whole ridge",
    "before_gross": "time from the alarm to gross slip",
    "arming_lead": "time from early warning to slip of the whole ridge",
}
"""Labels of the quantities in printed tables; JSON and CSV contain the keys."""
ORDINALS = {"5": "5th percentile", "50": "median", "95": "95th percentile"}
LEGEND = "Rates: share (95 % interval) of the number of cases. Times: value (95 % interval) in ms."
Seeds = Annotated[
    str, typer.Option(help="Seeds of the random trials, END excluded.", metavar="FIRST:END")
]
Tuning = Annotated[
    bool, typer.Option("--tuning", help="Use seeds reserved for tuning; the tables are marked.")
]
Kinds = Annotated[
    str,
    typer.Option(
        help="Kinds of trials, separated by commas: slide, roll, hold, tap.", metavar="LIST"
    ),
]
Files = Annotated[
    Path | None,
    typer.Option(
        help="CSV list of labelled run files, scored in place of random trials.", metavar="CSV"
    ),
]
Detectors = Annotated[
    list[str] | None,
    typer.Option(
        "--detector",
        help=f"Detector to score; repeatable. Default: {DEFAULT_DETECTOR}.",
        metavar="[rig|paper-literal|paper-hp]",
    ),
]
DetectorFile = Annotated[
    Path | None, typer.Option(help="TOML file overriding parameters of the one --detector.")
]
WithBaselines = Annotated[
    bool,
    typer.Option("--baselines", help="Also score band power, wavelet, CUSUM and a single channel."),
]
BaselineFile = Annotated[
    Path | None, typer.Option(help="JSON file with baselines, as --tune writes it.")
]
Tune = Annotated[
    Path | None,
    typer.Option(
        help="With --tuning: choose the thresholds of the baselines and write them to FILE.",
        metavar="FILE",
    ),
]
Sweep = Annotated[
    bool, typer.Option(help="Also score at thresholds from 1/8 to 8 times the own one.")
]
PopulationFile = Annotated[
    Path | None, typer.Option(help="JSON file with the ranges of the trials.")
]
ShowPopulation = Annotated[
    bool, typer.Option("--show-population", help="Print the ranges of the trials and exit.")
]
FrontEndFile = Annotated[
    Path | None, typer.Option(help="JSON file with the ranges of noise, mains and gains.")
]
ShowFrontEnd = Annotated[
    bool,
    typer.Option("--show-front-end", help="Print the ranges of noise, mains and gains and exit."),
]
SkinFile = Annotated[Path | None, typer.Option(help="JSON file with the settings of the skin.")]
Elements = Annotated[
    int | None, typer.Option(help="Finite elements along a ridge. Default: 6.", min=2, max=40)
]
RidgeRead = Annotated[
    int | None,
    typer.Option(help="Ridge whose strips are read; 1 is the leftmost. Default: 3.", min=1),
]
YoungsModulus = Annotated[
    str | None, typer.Option(help="Young's modulus of the skin.", metavar="MPa")
]
Speed = Annotated[
    str | None,
    typer.Option(help="Speed of slides and holds: one value or LOW:HIGH.", metavar="mm/s"),
]
SwappedGains = Annotated[
    bool, typer.Option("--swapped-gains", help="Exchange the amplifiers of the two channels.")
]
Jobs = Annotated[int, typer.Option(help="Number of parallel processes.", min=1, max=64)]
Out = Annotated[Path, typer.Option(help="New folder for tables and figures.", file_okay=False)]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")]


def score(
    seeds: Seeds = "1000000:1001000",
    tuning: Tuning = False,
    kinds: Kinds = "slide,roll,hold,tap",
    files: Files = None,
    detectors: Detectors = None,
    settings: DetectorFile = None,
    baselines: WithBaselines = False,
    baseline_settings: BaselineFile = None,
    tune: Tune = None,
    roc: Sweep = True,
    population: PopulationFile = None,
    show_population: ShowPopulation = False,
    front_end: FrontEndFile = None,
    show_front_end: ShowFrontEnd = False,
    skin: SkinFile = None,
    elements: Elements = None,
    ridge: RidgeRead = None,
    youngs_modulus: YoungsModulus = None,
    speed: Speed = None,
    swapped_gains: SwappedGains = False,
    jobs: Jobs = 1,
    out: Out = Path("results/score"),
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score detectors on trials whose truth is known: slips found, false alarms, delays."""
    with reported(debug, as_json), model_errors("omit its seed"):
        from rig.evaluation.labelled_files import judge_files
        from rig.evaluation.labelled_trials import PopulationSettings, StripFrontEndSettings
        from rig.evaluation.scored_trials import judge_trials
        from rig.evaluation.scoring.contenders import BaselineContender
        from rig.evaluation.scoring.seeds import (
            FIRST_REPORTING_SEED,
            check_unseen,
            check_use,
            seed_range,
        )

        ranges = _with_options(
            _read(PopulationSettings, population), skin, elements, ridge, youngs_modulus, speed
        )
        front = _read(StripFrontEndSettings, front_end)
        if show_population or show_front_end:
            typer.echo((ranges if show_population else front).model_dump_json(indent=2))
            return
        _check_new(out)
        contenders = _detectors(detectors or [DEFAULT_DETECTOR], settings)
        beside = _baselines(baselines or tune is not None, baseline_settings)
        if files is not None:
            if tune is not None or tuning:
                raise ConfigurationError(
                    "--files cannot be combined with --tune or --tuning", "tune on --seeds"
                )
            contenders += map(BaselineContender, beside)
            listed = judge_files(files, contenders, sweep=roc, done=_Progress("files"))
            use = f"labelled files of {files}"
            _report(contenders, listed.judged, use, listed.simulated, {}, out, as_json)
            return
        drawn = seed_range(seeds)
        check_use(drawn, tuning=tuning)
        if tune is not None and not tuning:
            raise ConfigurationError(
                f"--tune {tune}: thresholds are chosen on tuning seeds only",
                f"add --tuning and seeds below {FIRST_REPORTING_SEED}",
            )
        if not tuning:
            for one in [*contenders, *map(BaselineContender, beside)]:
                check_unseen(one.name, one.tuned_on, drawn)
        trials = _population(ranges, front, swapped_gains, kinds, drawn)
        if tune is not None:
            beside = _tuned(trials, beside, tune, jobs)
        contenders += map(BaselineContender, beside)
        judged = judge_trials(
            trials, contenders, sweep=roc, jobs=jobs,
            done=_Progress("trials", len(trials.trials())),
        )  # fmt: skip
        said = {
            "seeds": str(drawn), "kinds": list(trials.kinds), "swapped_gains": swapped_gains,
            "population": ranges.model_dump(mode="json"),
            "front_end": front.model_dump(mode="json"),
        }  # fmt: skip
        use = f"{'TUNING' if tuning else 'reporting'} seeds {drawn}"
        _report(contenders, judged, use, True, said, out, as_json)


class _Progress:
    """Reports progress on stderr, one line per tenth."""

    def __init__(self, what: str, total: int | None = None):
        self._what, self._total = what, total

    def __call__(self, number: int, total: int | None = None) -> None:
        total = self._total if total is None else total
        assert total is not None
        if number * 10 // total != (number - 1) * 10 // total:
            say(f"score: {number} of {total} {self._what}")


def _population(
    ranges: PopulationSettings, front: Any, swapped_gains: bool, kinds: str, drawn: SeedRange
) -> Population:
    from typing import get_args

    from rig.core.cache import user_cache
    from rig.evaluation.labelled_trials import Kind
    from rig.evaluation.scored_trials import Population
    from rig.physics.skin.condensed import build_skin

    known: tuple[Kind, ...] = get_args(Kind)
    words = [word.strip() for word in kinds.split(",")]
    if unknown := [word for word in words if word not in known]:
        raise ConfigurationError(
            f"--kinds {kinds}: {unknown[0]!r} is not a kind of trial",
            f"choose among {','.join(known)}",
        )
    chosen = tuple(kind for kind in known if kind in words)
    cache = user_cache()
    skin = build_skin(ranges.skin, cache)
    return Population(skin, ranges, front, swapped_gains, chosen, drawn, cache)


def _with_options(
    ranges: PopulationSettings,
    skin_file: Path | None,
    elements: int | None,
    ridge: int | None,
    youngs_modulus: str | None,
    speed: str | None,
) -> PopulationSettings:
    """Returns the ranges with skin, ridge and speed of the options."""
    from rig.core.units import quantity
    from rig.evaluation.labelled_trials import PopulationSettings, Range
    from rig.physics.skin.settings import SkinSettings

    def number(text: str, unit: str, option: str) -> float:
        try:
            return quantity(text, unit)
        except ValueError as error:
            raise ConfigurationError(f"{option} {text}: {error}", f"write it in {unit}") from error

    changed: dict[str, Any] = {}
    skin = ranges.skin if skin_file is None else _read(SkinSettings, skin_file)
    body = skin.model_dump()
    if elements is not None:
        body["elements_per_ridge"] = elements
    if youngs_modulus is not None:
        body["youngs_modulus_MPa"] = number(youngs_modulus, "MPa", "--youngs-modulus")
    changed["skin"] = SkinSettings.model_validate(body)
    if ridge is not None:
        changed["ridge"] = ridge
    if speed is not None:
        ends = [number(part, "mm/s", "--speed") for part in speed.split(":")]
        if len(ends) > 2 or not 0 < ends[0] <= ends[-1]:
            raise ConfigurationError(
                f"--speed {speed}: must be a speed above 0 mm/s, or LOW:HIGH with LOW below HIGH"
            )
        changed["speed_mm_s"] = Range(low=ends[0], high=ends[-1], logarithmic=True)
    changed_ranges = PopulationSettings.model_validate({**ranges.model_dump(), **changed})
    if changed_ranges.ridge > changed_ranges.skin.ridges:
        raise ConfigurationError(
            f"ridge {changed_ranges.ridge}: the skin has only {changed_ranges.skin.ridges} ridges",
            f"choose 1 to {changed_ranges.skin.ridges}",
        )
    return changed_ranges


def _detectors(names: Sequence[str], overrides: Path | None) -> list[Contender]:
    from rig.cli.detector_settings import detector_settings
    from rig.evaluation.scoring.contenders import DetectorContender

    if overrides is None:
        return [
            DetectorContender(name, detector_settings(name, None)) for name in dict.fromkeys(names)
        ]
    if len(names) != 1:
        raise ConfigurationError(
            f"--settings {overrides}: unclear which of the {len(names)} detectors it changes",
            "give exactly one --detector",
        )
    changed = detector_settings(names[0], overrides)
    return [DetectorContender(f"{names[0]} with {overrides.stem}", changed)]


def _baselines(wanted: bool, file: Path | None) -> list[BaselineSettings]:
    from rig.evaluation.scoring.baselines import Baselines, tuned_baselines

    if file is not None:
        return list(_read(Baselines, file).baselines)
    return list(tuned_baselines().baselines) if wanted else []


def _tuned(
    trials: Population, baselines: Sequence[BaselineSettings], file: Path, jobs: int
) -> list[BaselineSettings]:
    """Chooses the thresholds of the baselines on these trials and writes them to `file`."""
    from rig.evaluation.scored_trials import tune_baselines
    from rig.evaluation.scoring.baselines import Baselines

    total = len(trials.trials())
    found = tune_baselines(trials, baselines, jobs=jobs, done=_Progress("tuning trials", total))
    for one, share in found:
        say(
            f"score: {one.statistic}: threshold {one.threshold:.3g}, noise floor "
            f"{one.floor_mV:g} mV, finds {share:.0%} of the slips of the tuning seeds"
        )
    chosen = Baselines(baselines=tuple(one for one, _ in found))
    _write(file, chosen.model_dump_json(indent=2) + "\n")
    return list(chosen.baselines)


def _report(
    contenders: Sequence[Contender],
    judged: Sequence[ScoredTrial],
    use: str,
    simulated: bool,
    said: dict[str, Any],
    out: Path,
    as_json: bool,
) -> None:
    """Writes tables and figures to `out` and prints the tables."""
    from rig.core.settings import fingerprint
    from rig.detector.detector import DETECTOR_VERSION
    from rig.evaluation.scoring.results import ROW, results, rows

    scored = results(contenders, judged)
    document = {
        "simulated": simulated,
        "use": use,
        "trials": len(judged),
        **said,
        "detector_version": DETECTOR_VERSION,
        "detectors": [
            {
                "name": one.name,
                "parameters": fingerprint(one.settings),
                "tuned_on": None if one.tuned_on is None else str(one.tuned_on),
            }
            for one in contenders
        ],
        "results": [dict(zip(ROW, map(_plain, row), strict=True)) for row in rows(scored, use)],
    }
    _make(out)
    drawn = _draw(scored, use, simulated, out)
    _write_csv(out / "trials.csv", _TRIAL, _trials(contenders, judged))
    _write_csv(out / "score.csv", ROW, rows(scored, use))
    # Written last: its presence shows that the folder is complete.
    _write(out / "score.json", json.dumps(document, indent=1) + "\n")
    if as_json:
        files = [out / name for name in ("score.json", "score.csv", "trials.csv")]
        typer.echo(json.dumps({**document, "files": [str(file) for file in [*files, *drawn]]}))
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
    """Returns the label of a quantity in a printed table.

    >>> _label("after_node_5")
    'delay after first node slip, 5th percentile (ms)'
    """
    stem, _, percent = quantity.rpartition("_")
    if percent in ORDINALS:
        return f"{LABELS[stem]}, {ORDINALS[percent]} (ms)"
    return LABELS[quantity]


def _condition(trait: str, bin_: str) -> str:
    """Returns a bin of a trait as text.

    >>> _condition("noise_mV", "0.2 to 0.5")
    'noise 0.2 to 0.5 mV'
    """
    word, unit = TRAIT_WORDS[trait]
    return f"{word} {bin_} {unit}".rstrip()


def _shown(number: ScoredNumber | None) -> str:
    """Returns a number with its 95 % interval; a rate also with the number of its cases."""
    if number is None or not number.of:
        return "-"
    if number.unit == "1":
        return f"{number.value:.3f} ({number.low:.3f} to {number.high:.3f}) of {number.of}"
    interval = f" ({number.low:.1f} to {number.high:.1f})" if math.isfinite(number.low) else ""
    return f"{number.value:.1f}{interval}"


_TRIAL = (
    "trial", "detector", "label", "found", "early", "late", "alarmed", "after_node_s",
    "after_ridge_s", "before_gross_s", "armed", "arming_lead_s", "in_vain", "pattern", "noise_mV",
    "speed_mm_s", "static_coefficient", "friction_ratio", "normal_force_N", "gain_mismatch",
)  # fmt: skip


def _trials(
    contenders: Sequence[Contender], judged: Sequence[ScoredTrial]
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


def _plain(value: Any) -> Any:
    """Returns a value for JSON; numbers that are not finite become None."""
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
    """Returns a value for CSV: missing numbers are empty, flags 0 and 1."""
    if isinstance(value, bool):
        return int(value)
    plain = _plain(value)
    return "" if plain is None else plain


def _write(file: Path, text: str) -> None:
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


def _check_new(out: Path) -> None:
    """Raises ConfigurationError for a folder that contains a score, before anything is computed."""
    if (out / "score.json").exists():
        raise ConfigurationError(
            f"--out {out}: contains a score already",
            "choose a new folder; scores are not overwritten",
        )


def _read(kind: type[Model], file: Path | None) -> Model:
    from pydantic import ValidationError

    if file is None:
        return kind()
    try:
        return kind.model_validate_json(read_text(file, "file of settings", MAX_JSON_BYTES))
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(file)) from error
