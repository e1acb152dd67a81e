"""``rig score`` scores detectors on random trials, of the skin model or made on the whole simulated
bench, or on labelled run files.

Modules that are slow to import are imported inside. stdout carries the tables, stderr the progress.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from rig.cli.commands.model_errors import model_errors
from rig.cli.commands.score_report import report, write
from rig.cli.options.numbers import whole_number
from rig.cli.options.shared import Jobs
from rig.cli.outcome import reported, say
from rig.core.errors import ConfigurationError
from rig.core.toml_files import MAX_JSON_BYTES, read_text
from rig.detector import DEFAULT_DETECTOR

if TYPE_CHECKING:
    from rig.core.settings import Settings
    from rig.evaluation.scored_trials import Population
    from rig.evaluation.scoring.baselines import BaselineSettings
    from rig.evaluation.scoring.contenders import Contender
    from rig.evaluation.scoring.seeds import SeedRange
    from rig.evaluation.wire.judging import WireScore
    from rig.evaluation.wire.kinds import WireKind
    from rig.physics.population import PopulationSettings

    Model = TypeVar("Model", bound=Settings)
else:
    Model = TypeVar("Model")
Word = TypeVar("Word", bound=str)

PROGRESS_S = 10.0
"""Time between two reports of progress."""

MODEL_SEEDS, WIRE_SEEDS = "1000000:1001000", "1000000:1000020"
"""Seeds that are scored where none are given."""
Seeds = Annotated[
    str | None,
    typer.Option(
        help=f"Seeds of the random trials, END excluded.  [default: {MODEL_SEEDS}; with "
        f"--wire {WIRE_SEEDS}]",
        metavar="FIRST:END",
    ),
]
Tuning = Annotated[
    bool, typer.Option("--tuning", help="Use seeds reserved for tuning; the tables are marked.")
]
Kinds = Annotated[
    str | None,
    typer.Option(
        help="Kinds of trials, separated by commas: slide, roll, hold, tap (these four by "
        "default), again, reversal, tremor, falling force, re-grip, lift-off; with --wire slide, "
        "ramp, hold, roll a, roll b, reversal, tremor, re-grip, falling force, tap, lift-off, "
        "rest, re-grip in a slide (all by default).",
        metavar="LIST",
    ),
]
Wire = Annotated[
    bool,
    typer.Option(
        "--wire",
        help="Make the trials on the whole simulated bench, each as a separate command (5 s of "
        "processor time or more); trials are stored, so an interrupted score continues.",
    ),
]
Files = Annotated[
    Path | None,
    typer.Option(
        help="CSV list of labelled run files, scored in place of random trials.", metavar="FILE"
    ),
]
Detectors = Annotated[
    list[str] | None,
    typer.Option(
        "--detector",
        help="Detector to score: impulse, rig, paper-literal, paper-hp, or one of another package "
        f"(rig detectors); repeatable.  [default: {DEFAULT_DETECTOR}]",
        metavar="NAME",
    ),
]
DetectorFile = Annotated[
    Path | None,
    typer.Option(help="TOML file overriding parameters of the one --detector.", metavar="FILE"),
]
WithBaselines = Annotated[
    bool,
    typer.Option("--baselines", help="Also score band power, wavelet, CUSUM and a single channel."),
]
BaselineFile = Annotated[
    Path | None, typer.Option(help="JSON file with baselines, as --tune writes it.", metavar="FILE")
]
Tune = Annotated[
    Path | None,
    typer.Option(
        help="With --tuning: choose the thresholds of the baselines and write them to FILE.",
        metavar="FILE",
    ),
]
Sweep = Annotated[
    bool, typer.Option(help="Also score at thresholds from 1/8 to 8 times the detector's own.")
]
PopulationFile = Annotated[
    Path | None, typer.Option(help="JSON file with the ranges of the trials.", metavar="FILE")
]
ShowPopulation = Annotated[
    bool, typer.Option("--show-population", help="Print the ranges of the trials and exit.")
]
FrontEndFile = Annotated[
    Path | None,
    typer.Option(help="JSON file with the ranges of noise, mains and gains.", metavar="FILE"),
]
ShowFrontEnd = Annotated[
    bool,
    typer.Option("--show-front-end", help="Print the ranges of noise, mains and gains and exit."),
]
SkinFile = Annotated[
    Path | None, typer.Option(help="JSON file with the settings of the skin.", metavar="FILE")
]
Elements = Annotated[
    int | None,
    typer.Option(
        help="Finite elements along a ridge, 2 to 40.  [default: 16]",
        parser=whole_number(2, 40),
        metavar="COUNT",
    ),
]
RidgeRead = Annotated[
    int | None,
    typer.Option(
        help="Ridge whose strips are read; 1 is the leftmost.  [default: 3]",
        parser=whole_number(1),
        metavar="NUMBER",
    ),
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
Out = Annotated[
    Path, typer.Option(help="New folder for tables and figures.", file_okay=False, metavar="FOLDER")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")]


def score(
    seeds: Seeds = None,
    wire: Wire = False,
    tuning: Tuning = False,
    kinds: Kinds = None,
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
        from rig.evaluation.scored_trials import judge_trials
        from rig.evaluation.scoring.contenders import BaselineContender
        from rig.evaluation.scoring.seeds import check_unseen, check_use, seed_range
        from rig.physics.population import PopulationSettings, StripFrontEndSettings

        ranges = _with_options(
            read_settings(PopulationSettings(), population),
            skin,
            elements,
            ridge,
            youngs_modulus,
            speed,
        )
        front = read_settings(StripFrontEndSettings(), front_end)
        if show_population or show_front_end:
            typer.echo((ranges if show_population else front).model_dump_json(indent=2))
            return
        _check_new(out)
        of_the_model = {
            "--population": population, "--front-end": front_end, "--skin": skin,
            "--elements": elements, "--ridge": ridge, "--youngs-modulus": youngs_modulus,
            "--speed": speed, "--swapped-gains": swapped_gains or None,
        }  # fmt: skip
        given = [name for name, value in of_the_model.items() if value is not None]
        if wire and given:
            raise ConfigurationError(
                f"--wire cannot be combined with {given[0]}, which is of the skin model's trials",
                "leave it out: --wire draws the bench itself",
            )
        contenders = _detectors(detectors or [DEFAULT_DETECTOR], settings)
        beside = _baselines(baselines or tune is not None, baseline_settings)
        if files is not None:
            if tune is not None or tuning or wire:
                raise ConfigurationError(
                    "--files cannot be combined with --tune, --tuning or --wire", "tune on --seeds"
                )
            given += ["--seeds"] * (seeds is not None) + ["--kinds"] * (kinds is not None)
            if given:
                raise ConfigurationError(
                    f"--files cannot be combined with {given[0]}, which is of random trials",
                    "leave it out: the trials of the list are scored as they are",
                )
            contenders += map(BaselineContender, beside)
            listed = judge_files(files, contenders, sweep=roc, done=_Progress("files"))
            use = f"labelled files of {files}"
            report(contenders, listed.judged, use, listed.simulated, {}, out, as_json)
            return
        drawn = seed_range(seeds or (WIRE_SEEDS if wire else MODEL_SEEDS))
        check_use(drawn, tuning=tuning)
        _check_tuning(tune, tuning, wire)
        if not tuning:
            for one in [*contenders, *map(BaselineContender, beside)]:
                check_unseen(one.name, one.tuned_on, drawn)
        use = f"{'TUNING' if tuning else 'reporting'} seeds {drawn}"
        if wire:
            contenders += map(BaselineContender, beside)
            found = _wire(kinds, drawn, contenders, roc, jobs)
            details = {
                "seeds": str(drawn),
                "kinds": list(_wire_kinds(kinds)),
                "failed": found.failed,
                "code": found.code,
            }
            where = f"on the simulated bench, {use}"
            report(contenders, found.judged, where, True, details, out, as_json)
            return
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
        report(contenders, judged, use, True, said, out, as_json)


def _check_tuning(tune: Path | None, tuning: bool, wire: bool) -> None:
    """Raise ConfigurationError where thresholds would be chosen on other trials than those of the
    skin model at seeds for tuning."""
    from rig.evaluation.scoring.seeds import FIRST_REPORTING_SEED

    if tune is not None and wire:
        raise ConfigurationError(
            "--wire cannot be combined with --tune", "tune on trials of the skin model"
        )
    if tune is not None and not tuning:
        raise ConfigurationError(
            f"--tune {tune}: thresholds are chosen on tuning seeds only",
            f"add --tuning and seeds below {FIRST_REPORTING_SEED}",
        )


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
    ranges: PopulationSettings,
    front: Any,
    swapped_gains: bool,
    kinds: str | None,
    drawn: SeedRange,
) -> Population:
    from rig.core.cache import user_cache
    from rig.evaluation.labelled_trials import KINDS, USUAL_KINDS
    from rig.evaluation.scored_trials import Population
    from rig.physics.skin.condensed import build_skin

    chosen = USUAL_KINDS if kinds is None else _chosen(kinds, KINDS)
    cache = user_cache()
    skin = build_skin(ranges.skin, cache)
    return Population(skin, ranges, front, swapped_gains, chosen, drawn, cache)


def _chosen(kinds: str | None, known: tuple[Word, ...]) -> tuple[Word, ...]:
    """Return the kinds of trials of the option --kinds, in their usual order."""
    if kinds is None:
        return known
    words = [word.strip() for word in kinds.split(",")]
    if unknown := [word for word in words if word not in known]:
        raise ConfigurationError(
            f"--kinds {kinds}: {unknown[0]!r} is not a kind of trial",
            f"choose among {','.join(known)}",
        )
    return tuple(kind for kind in known if kind in words)


def _wire_kinds(kinds: str | None) -> tuple[WireKind, ...]:
    from rig.evaluation.wire.kinds import WIRE_KINDS

    return _chosen(kinds, WIRE_KINDS)


def _wire(
    kinds: str | None, drawn: SeedRange, contenders: Sequence[Contender], roc: bool, jobs: int
) -> WireScore:
    """Make and score the trials on the simulated bench."""
    from rig.core.cache import user_cache
    from rig.evaluation.wire.judging import judge_wire

    chosen = _wire_kinds(kinds)
    progress = WireProgress("score", jobs)
    try:
        found = judge_wire(
            chosen, drawn.seeds(), contenders, user_cache(), sweep=roc, jobs=jobs, done=progress
        )
    except (KeyboardInterrupt, SystemExit):
        say(
            f"score: interrupted after {progress.number} trials; they are stored, and the same "
            "command continues"
        )
        raise
    for name, reason in found.failed.items():
        say(f"score: {name} could not be made: {reason}")
    return found


class WireProgress:
    """Reports progress on stderr every ten seconds, with the time left at the pace so far."""

    def __init__(self, command: str, jobs: int):
        self.number, self._command = 0, command
        self._begun_s = self._said_s = time.monotonic()
        say(f"{command}: making trials on the simulated bench, {jobs} at a time")

    def __call__(self, number: int, total: int, made: int) -> None:
        self.number, now_s = number, time.monotonic()
        if now_s - self._said_s < PROGRESS_S and number < total:
            return
        self._said_s = now_s
        left = ""
        if made and number < total:
            left_s = (now_s - self._begun_s) / made * (total - number)
            left = f", about {math.ceil(left_s / 60)} min left"
        say(f"{self._command}: {number} of {total} trials, {made} of them made now{left}")


def _with_options(
    ranges: PopulationSettings,
    skin_file: Path | None,
    elements: int | None,
    ridge: int | None,
    youngs_modulus: str | None,
    speed: str | None,
) -> PopulationSettings:
    """Return the ranges with skin, ridge and speed of the options."""
    from rig.core.units import quantity
    from rig.physics.population import PopulationSettings, Range
    from rig.physics.skin.settings import SkinSettings

    def number(text: str, unit: str, option: str) -> float:
        try:
            return quantity(text, unit)
        except ValueError as error:
            raise ConfigurationError(f"{option} {text}: {error}", f"write it in {unit}") from error

    changed: dict[str, Any] = {}
    skin = ranges.skin if skin_file is None else read_settings(SkinSettings(), skin_file)
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
    from rig.cli.options.detector import detector_with_settings
    from rig.evaluation.scoring.contenders import DetectorContender

    if overrides is None:
        return [
            DetectorContender(name, detector_with_settings(name, None))
            for name in dict.fromkeys(names)
        ]
    if len(names) != 1:
        raise ConfigurationError(
            f"--settings {overrides}: unclear which of the {len(names)} detectors it changes",
            "give exactly one --detector",
        )
    changed = detector_with_settings(names[0], overrides)
    return [DetectorContender(f"{names[0]} with {overrides.stem}", changed)]


def _baselines(wanted: bool, file: Path | None) -> list[BaselineSettings]:
    from rig.evaluation.scoring.baselines import tuned_baselines

    if file is not None:
        return list(read_settings(tuned_baselines(), file).baselines)
    return list(tuned_baselines().baselines) if wanted else []


def _tuned(
    trials: Population, baselines: Sequence[BaselineSettings], file: Path, jobs: int
) -> list[BaselineSettings]:
    """Choose the thresholds of the baselines on these trials and write them to `file`."""
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
    write(file, chosen.model_dump_json(indent=2) + "\n")
    return list(chosen.baselines)


def _check_new(out: Path) -> None:
    """Raise ConfigurationError for a folder that contains a score, before anything is computed."""
    if (out / "score.json").exists():
        raise ConfigurationError(
            f"--out {out}: contains a score already",
            "choose a new folder; scores are not overwritten",
        )


def read_settings(unless_given: Model, file: Path | None) -> Model:
    """Return the settings of a JSON file, or `unless_given` without one. Raises
    ConfigurationError for a file that does not fit."""
    from pydantic import ValidationError

    if file is None:
        return unless_given
    try:
        return type(unless_given).model_validate_json(
            read_text(file, "file of settings", MAX_JSON_BYTES)
        )
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(file)) from error
