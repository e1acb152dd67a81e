"""``rig score``: how good detectors are, on random trials of the skin model or on labelled files.

Parses, calls, prints. What is expensive to import is imported inside; stdout carries the tables,
stderr progress. Nothing is written before everything is computed.
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
"""Quantities whose tables by trait are printed; the files hold all."""
SHOWN_TRAITS = ("noise_mV", "speed_mm_s", "static_coefficient", "friction_ratio", "pattern")
"""Traits by which they are printed; the files hold more."""
Seeds = Annotated[str, typer.Option(help="Random trials, END excluded.", metavar="FIRST:END")]
Tuning = Annotated[bool, typer.Option("--tuning", help="Score tuning seeds; every table says so.")]
Kinds = Annotated[str, typer.Option(help="Which trials.", metavar="LIST")]
Files = Annotated[
    Path | None,
    typer.Option(
        help="Labelled run files in place of random trials, listed as CSV.", metavar="CSV"
    ),
]
Detectors = Annotated[
    list[str] | None,
    typer.Option(
        "--detector",
        help=f"rig, paper-literal or paper-hp; repeatable [{DEFAULT_DETECTOR}].",
        metavar="NAME",
    ),
]
DetectorFile = Annotated[
    Path | None, typer.Option(help="TOML with parameters that differ from the one --detector's.")
]
WithBaselines = Annotated[
    bool,
    typer.Option("--baselines", help="Band power, wavelet, CUSUM and a single channel beside."),
]
BaselineFile = Annotated[Path | None, typer.Option(help="Theirs as JSON, as --tune writes it.")]
Tune = Annotated[
    Path | None,
    typer.Option(
        help="With --tuning: choose the baselines' thresholds on these trials, write them.",
        metavar="FILE",
    ),
]
Sweep = Annotated[bool, typer.Option(help="Sweep the thresholds.")]
PopulationFile = Annotated[Path | None, typer.Option(help="Ranges of the trials as JSON.")]
ShowPopulation = Annotated[
    bool, typer.Option("--show-population", help="Print them as JSON to edit and stop.")
]
FrontEndFile = Annotated[
    Path | None, typer.Option(help="Ranges of noise, mains and gains as JSON.")
]
ShowFrontEnd = Annotated[
    bool, typer.Option("--show-front-end", help="Print them as JSON to edit and stop.")
]
SkinFile = Annotated[Path | None, typer.Option(help="The skin's settings as JSON.")]
Elements = Annotated[int | None, typer.Option(help="Elements along a ridge [6].", min=2, max=40)]
RidgeRead = Annotated[
    int | None, typer.Option(help="Ridge that is read, 1 is the leftmost [3].", min=1)
]
YoungsModulus = Annotated[str | None, typer.Option(help="Of the skin.", metavar="MPa")]
Speed = Annotated[
    str | None, typer.Option(help="Of slides and holds, one or LOW:HIGH.", metavar="mm/s")
]
SwappedGains = Annotated[
    bool, typer.Option("--swapped-gains", help="The channels' amplifiers change places.")
]
Jobs = Annotated[int, typer.Option(help="Processes.", min=1, max=64)]
Out = Annotated[Path, typer.Option(help="New folder for tables and figures.", file_okay=False)]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


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
    """Score detectors on trials whose truth is known: found, false alarms, delays, prediction."""
    with reported(debug, as_json), model_errors("leave its seed out"):
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
                raise ConfigurationError("--files: files tune nothing", "tune on --seeds")
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
    """How far it is, on stderr: a line every tenth."""

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
            f"--kinds {kinds}: {unknown[0]!r} is no kind of trial",
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
    """The ranges with what options say of skin, ridge and speed."""
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
                f"--speed {speed}: must be one speed above 0 mm/s, or LOW:HIGH with LOW the lesser"
            )
        changed["speed_mm_s"] = Range(low=ends[0], high=ends[-1], logarithmic=True)
    told = PopulationSettings.model_validate({**ranges.model_dump(), **changed})
    if told.ridge > told.skin.ridges:
        raise ConfigurationError(
            f"ridge {told.ridge} of a skin with {told.skin.ridges} ridges: there is none",
            f"choose 1 to {told.skin.ridges}",
        )
    return told


def _detectors(names: Sequence[str], overrides: Path | None) -> list[Contender]:
    from rig.cli.detector_settings import detector_settings
    from rig.evaluation.scoring.contenders import DetectorContender

    if overrides is None:
        return [
            DetectorContender(name, detector_settings(name, None)) for name in dict.fromkeys(names)
        ]
    if len(names) != 1:
        raise ConfigurationError(
            f"--settings {overrides}: says nothing of which of {len(names)} detectors it changes",
            "give one --detector",
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
    """The baselines with thresholds chosen on these trials, written to `file`."""
    from rig.evaluation.scored_trials import tune_baselines
    from rig.evaluation.scoring.baselines import Baselines

    total = len(trials.trials())
    found = tune_baselines(trials, baselines, jobs=jobs, done=_Progress("trials tuned on", total))
    for one, share in found:
        say(
            f"score: {one.statistic}: threshold {one.threshold:.3g} over {one.floor_mV:g} mV "
            f"finds {share:.2f} of the tuning seeds' slips"
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
    """Tables and figures below `out`, the tables on stdout."""
    from rig.core.settings import fingerprint
    from rig.detector.detector import DETECTOR_VERSION
    from rig.evaluation.scoring.results import ROW, results, rows

    told = results(contenders, judged)
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
        "results": [dict(zip(ROW, map(_plain, row), strict=True)) for row in rows(told, use)],
    }
    _make(out)
    drawn = _draw(told, use, simulated, out)
    _write_csv(out / "trials.csv", _TRIAL, _trials(contenders, judged))
    _write_csv(out / "score.csv", ROW, rows(told, use))
    _write(out / "score.json", json.dumps(document, indent=1) + "\n")  # the last: it is complete
    if as_json:
        files = [out / name for name in ("score.json", "score.csv", "trials.csv")]
        typer.echo(json.dumps({**document, "files": [str(file) for file in [*files, *drawn]]}))
        return
    heading = f"{'simulated trials, ' if simulated else ''}{use}, {len(judged)} trials"
    for line in _tables(told, heading):
        typer.echo(line)
    typer.echo(f"in {out}: score.json, score.csv, trials.csv, {len(drawn)} figures")


def _tables(told: Sequence[ContenderResult], heading: str) -> Iterator[str]:
    names = [one.contender.name for one in told]
    known = dict.fromkeys(quantity for one in told for quantity in one.score)
    table = [
        [_named(quantity), *(_shown(one.score.get(quantity)) for one in told)] for quantity in known
    ]
    yield from _aligned(f"All trials: {heading}", ["", *names], table)
    for quantity in BY_TRAIT:
        groups = [
            {(group.trait, group.bin): group.score.get(quantity) for group in one.groups}
            for one in told
        ]
        table = [
            [f"{trait} {name}", *(_shown(each.get((trait, name))) for each in groups)]
            for trait, name in groups[0]
            if trait in SHOWN_TRAITS and any(each.get((trait, name)) for each in groups)
        ]
        if table:
            yield from _aligned(f"{_named(quantity)} by trait: {heading}", ["", *names], table)


def _aligned(title: str, head: list[str], table: list[list[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(head, *table, strict=True)]
    yield title
    for line in (head, *table):
        yield "  ".join(
            cell.ljust(width) for cell, width in zip(line, widths, strict=True)
        ).rstrip()
    yield ""


def _named(quantity: str) -> str:
    """A quantity's name in a printed table: percentiles say that they are."""
    stem, _, percent = quantity.rpartition("_")
    return f"{stem}, {percent} % (ms)" if percent.isdigit() else quantity


def _shown(number: ScoredNumber | None) -> str:
    """A number with its 95 % interval, a rate with the number of its cases."""
    if number is None or not number.of:
        return "-"
    if number.unit == "1":
        return f"{number.value:.3f} ({number.low:.3f}..{number.high:.3f}) {number.of}"
    interval = f" ({number.low:.1f}..{number.high:.1f})" if math.isfinite(number.low) else ""
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


def _draw(told: Sequence[ContenderResult], use: str, simulated: bool, out: Path) -> list[Path]:
    from rig.figures import score as figures
    from rig.figures.style import save

    title = f"{use}{', simulated' if simulated else ''}"
    drawn = {
        "score-found": figures.draw_found(told, title),
        "score-delays": figures.draw_delays(told, title),
    }
    if any(one.rocs for one in told):
        drawn["score-roc"] = figures.draw_roc(told, title)
    return [
        file
        for name, figure in drawn.items()
        for file in save(figure, out / f"{name}.png", simulated)
    ]


def _plain(value: Any) -> Any:
    """A value as JSON can hold it."""
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
    """Missing numbers are empty, flags 0 and 1."""
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
            f"{file} cannot be written: {error.strerror}", "name another place"
        ) from error


def _check_new(out: Path) -> None:
    """Refuses a folder that holds a score before anything is computed."""
    if (out / "score.json").exists():
        raise ConfigurationError(
            f"--out {out}: holds a score already", "name a new folder; scores are not overwritten"
        )


def _read(kind: type[Model], file: Path | None) -> Model:
    from pydantic import ValidationError

    if file is None:
        return kind()
    try:
        return kind.model_validate_json(read_text(file, "file of settings", MAX_JSON_BYTES))
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(file)) from error
