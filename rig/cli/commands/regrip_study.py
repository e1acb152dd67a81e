"""``rig regrip-study``: parses the command, calls `rig.evaluation.wire.regrip_study`, prints."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options.shared import AsJson, Debug
from rig.cli.outcome import print_json, reported, say
from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.units import counted
from rig.detector import DEFAULT_DETECTOR

if TYPE_CHECKING:
    from rig.evaluation.scoring.seeds import SeedRange
    from rig.evaluation.scoring.tables import ScoredNumber
    from rig.evaluation.wire.regrip_study import StudyRow

SEEDS = "1000000:1000010"


def regrip_study(
    seeds: Annotated[
        str, typer.Option(help="Seeds of the benches, END excluded.", metavar="FIRST:END")
    ] = SEEDS,
    shares: Annotated[
        str,
        typer.Option(
            help="Weights as shares of the holding force: a weight above 1 drops, one below 1 "
            "holds.",
            metavar="LIST",
        ),
    ] = "0.8,1.05,1.1,1.3",
    strategies: Annotated[
        str,
        typer.Option(
            help="none, always (squeeze when the motion begins), and names of detectors.",
            metavar="LIST",
        ),
    ] = f"none,always,{DEFAULT_DETECTOR}",
    speed: Annotated[
        str,
        typer.Option(help="Largest speed of a weight that slips, 0.1 to 20 mm/s.", metavar="mm/s"),
    ] = "2mm/s",
    tuning: Annotated[
        bool, typer.Option("--tuning", help="Use seeds reserved for tuning; the table is marked.")
    ] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Drop weights with and without a grip that answers alarms, in pairs at the same seeds.

    Every trial is a separate command on its own simulated bench. Trials are stored: an
    interrupted study continues where it stopped.
    """
    with reported(debug, as_json):
        from rig.cli.progress import WireProgress
        from rig.core.cache import user_cache
        from rig.evaluation.scoring.seeds import check_use, seed_range
        from rig.evaluation.wire.regrip_study import RegripStudy, as_object, table

        drawn, wanted = seed_range(seeds), _shares(shares)
        chosen, speed_mm_s = _strategies(strategies), _speed(speed)
        check_use(drawn, tuning=tuning)
        if not tuning:
            _check_unseen(chosen, drawn)
        progress = WireProgress("regrip-study", 1)
        weights = []
        try:
            study = RegripStudy(user_cache(), progress)
            for weight in study.weights(drawn.seeds(), wanted, chosen, speed_mm_s):
                weights.append(weight)
                if weight.failed:
                    say(f"seed {weight.seed}, {weight.share:g}, {weight.strategy}: {weight.failed}")
        except (KeyboardInterrupt, SystemExit):
            say(
                f"interrupted after {counted(progress.number, 'trial')}; the same command continues"
            )
            raise
        if not any(weight.outcome for weight in weights):
            missing = counted(len(weights), "weight")
            raise RigError(
                f"none of the {missing} could be tried, so the table would be empty",
                "choose other seeds, or repeat the command if the reasons are the computer's",
                ExitCode.FINISHED_WITH_FAILURES,
            )
        if as_json:
            drawn_as = {"seeds": str(drawn), "tuning": tuning, "speed_mm_s": speed_mm_s}
            said = drawn_as | as_object(weights)
            print_json(said)
        else:
            for line in lines_of(table(weights), "TUNING seeds. " if tuning else ""):
                print(line)  # noqa: T201 - data


def lines_of(rows: list[StudyRow], mark: str = "") -> list[str]:
    """Return a table as aligned lines, the first of which bears the mark."""
    lines = [
        f"SIMULATED. {mark}Weights are shares of the holding force of the same bench; saved: not "
        "lost; force: over the least that holds, median of those saved; 95 % by Wilson, of as many "
        "cases as benches: the weights of a bench are alike. Left out: trials that could not be "
        "made or were invalid.",
        f"{'weight':>7} {'strategy':<16}{'n':>4} {'left out':>8}  {'saved':<18}"
        f"{'squeezed':<18}{'squeezes':>8} {'force':>6} {'risen (ms)':>10}",
    ]
    for row in rows:
        force, risen = (
            "-" if math.isnan(value) else f"{value:.{digits}f}"
            for value, digits in ((row.force_over_least, 2), (row.risen_ms, 1))
        )
        lines.append(
            f"{row.weights:>7} {row.strategy:<16}{row.n:>4} {row.failed:>8}  "
            f"{_share(row.saved):<18}{_share(row.squeezed):<18}{row.squeezes:>8} "
            f"{force:>6} {risen:>10}"
        )
    return lines


def _share(found: ScoredNumber) -> str:
    if math.isnan(found.value):
        return "-"
    return f"{found.value:.2f} ({found.low:.2f}-{found.high:.2f})"


def _check_unseen(strategies: list[str], drawn: SeedRange) -> None:
    """Raise ConfigurationError if the detector of a strategy was tuned on some of the seeds."""
    from rig.detector.registered import chosen_detector
    from rig.evaluation.scoring.contenders import DetectorContender
    from rig.evaluation.scoring.seeds import check_unseen
    from rig.evaluation.wire.regrip_study import ALWAYS, NONE

    for name in strategies:
        if name not in (NONE, ALWAYS):
            check_unseen(name, DetectorContender(name, chosen_detector(name)).tuned_on, drawn)


def _shares(text: str) -> list[float]:
    try:
        shares = [float(part) for part in text.split(",")]
    except ValueError:
        shares = []
    if not shares or not all(0.1 <= share <= 2 for share in shares):
        raise ConfigurationError(
            f"--shares {text}: not a list of shares from 0.1 to 2", "for example 0.8,1.05,1.1,1.3"
        )
    _refuse_twice("--shares", [f"{share:g}" for share in shares])
    return shares


def _speed(text: str) -> float:
    from rig.core.units import quantity

    try:
        speed_mm_s = quantity(text, "mm/s")
    except ValueError as error:
        raise ConfigurationError(f"--speed {text}: {error}", "for example 0.5mm/s") from error
    if not 0.1 <= speed_mm_s <= 20:
        raise ConfigurationError(f"--speed {text} is outside 0.1 to 20 mm/s")
    return speed_mm_s


def _strategies(text: str) -> list[str]:
    from rig.detector.registered import detector_names
    from rig.evaluation.wire.regrip_study import ALWAYS, NONE

    known = (NONE, ALWAYS, *detector_names())
    chosen = [part.strip() for part in text.split(",")]
    if unknown := [name for name in chosen if name not in known]:
        raise ConfigurationError(
            f"--strategies: {unknown[0]!r} is unknown", f"choose from {', '.join(known)}"
        )
    _refuse_twice("--strategies", chosen)
    return chosen


def _refuse_twice(option: str, chosen: list[str]) -> None:
    """Raise ConfigurationError for a value that is given twice: its weights would be counted
    twice."""
    if repeated := [one for one in chosen if chosen.count(one) > 1]:
        raise ConfigurationError(f"{option}: {repeated[0]} is given twice", "give each value once")
