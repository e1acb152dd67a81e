"""Options of ``rig score``, and what their texts mean."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from rig.cli.options.numbers import number_in, whole_number
from rig.cli.options.settings_file import read_settings
from rig.core.errors import ConfigurationError
from rig.detector import DEFAULT_DETECTOR

if TYPE_CHECKING:
    from rig.evaluation.scoring.baselines import BaselineSettings
    from rig.evaluation.scoring.contenders import Contender
    from rig.evaluation.wire.kinds import WireKind
    from rig.physics.population import PopulationSettings

Word = TypeVar("Word", bound=str)

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
        help="Detector to score: impulse, rig, rig-grip, paper-literal, paper-hp, or one of "
        f"another package (rig detectors); repeatable.  [default: {DEFAULT_DETECTOR}]",
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
    str | None,
    typer.Option(help="Young's modulus of the skin.  [default: that of the skin]", metavar="MPa"),
]
Speed = Annotated[
    str | None,
    typer.Option(
        help="Speed of slides and holds: one value or LOW:HIGH.  [default: that of the population]",
        metavar="mm/s",
    ),
]
SwappedGains = Annotated[
    bool, typer.Option("--swapped-gains", help="Exchange the amplifiers of the two channels.")
]
Out = Annotated[
    Path, typer.Option(help="New folder for tables and figures.", file_okay=False, metavar="FOLDER")
]


def kinds_named(kinds: str | None, known: tuple[Word, ...]) -> tuple[Word, ...]:
    """Return the kinds of trials of the option --kinds, in their usual order; all without it.

    Raises ConfigurationError for a word that names none of the known kinds.
    """
    if kinds is None:
        return known
    words = [word.strip() for word in kinds.split(",")]
    if unknown := [word for word in words if word not in known]:
        raise ConfigurationError(
            f"--kinds {kinds}: {unknown[0]!r} is not a kind of trial",
            f"choose among {','.join(known)}",
        )
    return tuple(kind for kind in known if kind in words)


def wire_kinds_named(kinds: str | None) -> tuple[WireKind, ...]:
    """Return the kinds of trials on the simulated bench of the option --kinds; all without it."""
    from rig.evaluation.wire.kinds import WIRE_KINDS

    return kinds_named(kinds, WIRE_KINDS)


def ranges_with_options(
    ranges: PopulationSettings,
    skin_file: Path | None,
    elements: int | None,
    ridge: int | None,
    youngs_modulus: str | None,
    speed: str | None,
) -> PopulationSettings:
    """Return the ranges of the trials with the skin, ridge and speed that the options name.

    Raises ConfigurationError for a file, a text or a ridge that does not fit.
    """
    from rig.physics.population import PopulationSettings, Range
    from rig.physics.skin.settings import SkinSettings

    changed: dict[str, Any] = {}
    skin = ranges.skin if skin_file is None else read_settings(SkinSettings(), skin_file)
    body = skin.model_dump()
    if elements is not None:
        body["elements_per_ridge"] = elements
    if youngs_modulus is not None:
        body["youngs_modulus_MPa"] = number_in(youngs_modulus, "MPa", "--youngs-modulus", above=0.0)
    changed["skin"] = SkinSettings.model_validate(body)
    if ridge is not None:
        changed["ridge"] = ridge
    if speed is not None:
        ends = [number_in(part, "mm/s", "--speed") for part in speed.split(":")]
        if len(ends) > 2 or not 0 < ends[0] <= ends[-1]:
            raise ConfigurationError(
                f"--speed {speed}: must be a speed above 0 mm/s, or LOW:HIGH with LOW below HIGH"
            )
        changed["speed_mm_s"] = Range(low=ends[0], high=ends[-1], logarithmic=True)
    changed_ranges = PopulationSettings.model_validate({**ranges.model_dump(), **changed})
    if changed_ranges.ridge > changed_ranges.skin.ridges:
        raise ConfigurationError(
            f"{'ridge' if ridge is None else '--ridge'} {changed_ranges.ridge}: the skin has only "
            f"{changed_ranges.skin.ridges} ridges",
            f"choose 1 to {changed_ranges.skin.ridges}",
        )
    return changed_ranges


def detectors_named(names: Sequence[str], overrides: Path | None) -> list[Contender]:
    """Return the detectors of these names, each once. A TOML file may override parameters of the
    only one. Raises ConfigurationError for an unknown name, and for overrides of several."""
    from rig.cli.options.detector import detector_with_settings
    from rig.detector.registered import ChosenDetector
    from rig.evaluation.scoring.contenders import DetectorContender
    from rig.evaluation.scoring.outside_contender import OutsideContender

    def contender(name: str, chosen: ChosenDetector) -> Contender:
        return (DetectorContender if chosen.is_own else OutsideContender)(name, chosen)

    if overrides is None:
        return [
            contender(name, detector_with_settings(name, None)) for name in dict.fromkeys(names)
        ]
    if len(names) != 1:
        raise ConfigurationError(
            f"--settings {overrides}: unclear which of the {len(names)} detectors it changes",
            "give exactly one --detector",
        )
    changed = detector_with_settings(names[0], overrides)
    return [contender(f"{names[0]} with {overrides.stem}", changed)]


def baselines_named(wanted: bool, file: Path | None) -> list[BaselineSettings]:
    """Return the baselines of a JSON file; without one the tuned ones where they are wanted.
    Raises ConfigurationError for a file that does not fit."""
    from rig.evaluation.scoring.baselines import tuned_baselines

    if file is not None:
        return list(read_settings(tuned_baselines(), file).baselines)
    return list(tuned_baselines().baselines) if wanted else []
