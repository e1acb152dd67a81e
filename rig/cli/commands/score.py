"""``rig score`` scores detectors on random trials, of the skin model or made on the whole simulated
bench, or on labelled run files.

Modules that are slow to import are imported inside. stdout carries the tables, stderr the progress.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rig.cli.commands.model_errors import model_errors
from rig.cli.commands.score_report import check_no_score, report, reserved, write
from rig.cli.options import scoring
from rig.cli.options.new_file import check_new_file
from rig.cli.options.settings_file import read_settings
from rig.cli.options.shared import AsJson, Debug, Jobs
from rig.cli.outcome import reported, say
from rig.cli.progress import TenthsProgress, WireProgress
from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.units import counted
from rig.detector import DEFAULT_DETECTOR

if TYPE_CHECKING:
    from rig.evaluation.scored_trials import Population
    from rig.evaluation.scoring.baselines import BaselineSettings
    from rig.evaluation.scoring.contenders import Contender
    from rig.evaluation.scoring.seeds import SeedRange
    from rig.evaluation.wire.judging import WireScore
    from rig.physics.population import PopulationSettings


def score(
    seeds: scoring.Seeds = None,
    wire: scoring.Wire = False,
    tuning: scoring.Tuning = False,
    kinds: scoring.Kinds = None,
    files: scoring.Files = None,
    detectors: scoring.Detectors = None,
    settings: scoring.DetectorFile = None,
    baselines: scoring.WithBaselines = False,
    baseline_settings: scoring.BaselineFile = None,
    tune: scoring.Tune = None,
    roc: scoring.Sweep = True,
    population: scoring.PopulationFile = None,
    show_population: scoring.ShowPopulation = False,
    front_end: scoring.FrontEndFile = None,
    show_front_end: scoring.ShowFrontEnd = False,
    skin: scoring.SkinFile = None,
    elements: scoring.Elements = None,
    ridge: scoring.RidgeRead = None,
    youngs_modulus: scoring.YoungsModulus = None,
    speed: scoring.Speed = None,
    swapped_gains: scoring.SwappedGains = False,
    jobs: Jobs = 1,
    out: scoring.Out = Path("results/score"),
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score detectors on trials whose truth is known: slips found, false alarms, delays."""
    with reported(debug, as_json), model_errors("omit its seed"), ExitStack() as stack:
        from rig.evaluation.labelled_files import judge_files
        from rig.evaluation.scored_trials import judge_trials
        from rig.evaluation.scoring.contenders import BaselineContender
        from rig.evaluation.scoring.seeds import check_unseen, check_use, seed_range
        from rig.physics.population import PopulationSettings, StripFrontEndSettings

        ranges = scoring.ranges_with_options(
            read_settings(PopulationSettings(), population),
            skin,
            elements,
            ridge,
            youngs_modulus,
            speed,
        )
        front = read_settings(StripFrontEndSettings(), front_end)
        if show_population and show_front_end:
            raise ConfigurationError(
                "--show-population and --show-front-end print one object each", "give one of them"
            )
        if show_population or show_front_end:
            typer.echo((ranges if show_population else front).model_dump_json(indent=2))
            return
        check_no_score(out)
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
        contenders = scoring.detectors_named(detectors or [DEFAULT_DETECTOR], settings)
        beside = scoring.baselines_named(baselines or tune is not None, baseline_settings)
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
            if jobs > 1:
                raise ConfigurationError(
                    f"--files cannot be combined with --jobs {jobs}: files are scored one after "
                    "the other",
                    "leave it out",
                )
            contenders += map(BaselineContender, beside)
            stack.enter_context(reserved(out))
            listed = judge_files(
                files, contenders, sweep=roc, done=TenthsProgress("score", "files")
            )
            use = f"labelled files of {files}"
            report(contenders, listed.judged, use, listed.simulated, {}, out, as_json)
            return
        drawn = seed_range(seeds or (scoring.WIRE_SEEDS if wire else scoring.MODEL_SEEDS))
        check_use(drawn, tuning=tuning)
        _check_tuning(tune, tuning, wire)
        if not tuning:
            for one in [*contenders, *map(BaselineContender, beside)]:
                check_unseen(one.name, one.tuned_on, drawn)
        stack.enter_context(reserved(out))
        use = f"{'TUNING' if tuning else 'reporting'} seeds {drawn}"
        if wire:
            contenders += map(BaselineContender, beside)
            found = _wire(kinds, drawn, contenders, roc, jobs)
            details = {
                "seeds": str(drawn),
                "kinds": list(scoring.wire_kinds_named(kinds)),
                "failed": found.failed,
                "code": found.code,
            }
            where = f"on the simulated bench, {use}"
            missing = len(found.failed)
            left_out = f"{counted(missing, 'trial')} could not be made" if missing else ""
            report(contenders, found.judged, where, True, details, out, as_json, left_out)
            return
        trials = _population(ranges, front, swapped_gains, kinds, drawn)
        if tune is not None:
            beside = _tuned(trials, beside, tune, jobs)
        contenders += map(BaselineContender, beside)
        try:
            judged = judge_trials(
                trials, contenders, sweep=roc, jobs=jobs,
                done=TenthsProgress("score", "trials", len(trials.trials())),
            )  # fmt: skip
        except (KeyboardInterrupt, SystemExit):
            say("score: interrupted; what was simulated is stored, and the same command continues")
            raise
        said = {
            "seeds": str(drawn), "kinds": list(trials.kinds), "swapped_gains": swapped_gains,
            "population": ranges.model_dump(mode="json"),
            "front_end": front.model_dump(mode="json"),
        }  # fmt: skip
        report(contenders, judged, use, True, said, out, as_json)


def _check_tuning(tune: Path | None, tuning: bool, wire: bool) -> None:
    """Raise ConfigurationError where thresholds would be chosen on other trials than those of the
    skin model at seeds for tuning, or could not be written."""
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
    if tune is not None:
        check_new_file("--tune", tune)


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

    chosen = USUAL_KINDS if kinds is None else scoring.kinds_named(kinds, KINDS)
    cache = user_cache()
    skin = build_skin(ranges.skin, cache)
    return Population(skin, ranges, front, swapped_gains, chosen, drawn, cache)


def _wire(
    kinds: str | None, drawn: SeedRange, contenders: Sequence[Contender], roc: bool, jobs: int
) -> WireScore:
    """Make and score the trials on the simulated bench."""
    from rig.core.cache import user_cache
    from rig.evaluation.wire.judging import judge_wire

    chosen = scoring.wire_kinds_named(kinds)
    progress = WireProgress("score", jobs)
    try:
        found = judge_wire(
            chosen, drawn.seeds(), contenders, user_cache(), sweep=roc, jobs=jobs, done=progress,
            scored=TenthsProgress("score", "trials scored"),
        )  # fmt: skip
    except (KeyboardInterrupt, SystemExit):
        say(
            f"score: interrupted after {counted(progress.number, 'trial')}; what was made is "
            "stored, and the same command continues"
        )
        raise
    for name, reason in found.failed.items():
        say(f"score: {name} could not be made: {reason}")
    if not found.judged:
        missing = counted(len(found.failed), "trial")
        raise RigError(
            f"none of the {missing} could be made, so nothing is scored",
            "choose other seeds or kinds, or repeat the command if the reasons are the computer's",
            ExitCode.FINISHED_WITH_FAILURES,
        )
    return found


def _tuned(
    trials: Population, baselines: Sequence[BaselineSettings], file: Path, jobs: int
) -> list[BaselineSettings]:
    """Choose the thresholds of the baselines on these trials and write them to `file`."""
    from rig.evaluation.scored_trials import tune_baselines
    from rig.evaluation.scoring.baselines import Baselines

    total = len(trials.trials())
    found = tune_baselines(
        trials, baselines, jobs=jobs, done=TenthsProgress("score", "tuning trials", total)
    )
    for one, share in found:
        say(
            f"score: {one.statistic}: threshold {one.threshold:.3g}, noise floor "
            f"{one.floor_mV:g} mV, finds {share:.0%} of the slips of the tuning seeds"
        )
    chosen = Baselines(baselines=tuple(one for one, _ in found))
    write(file, chosen.model_dump_json(indent=2) + "\n")
    return list(chosen.baselines)
