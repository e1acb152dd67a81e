"""Options of the calibrations, and what their texts mean."""

from __future__ import annotations

import contextlib
import getpass
import math
import re
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options.groups import option_group
from rig.cli.options.numbers import real_number
from rig.cli.options.shared import RESULTS, AsJson, BenchFile, Debug, Notes, Seed, World, WorldLog
from rig.cli.options.utf8 import as_utf8
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.instruments.calibration import Kind
    from rig.run.streams.scales import Timing

    Vector = tuple[float, float, float]

LARGEST_TOLERANCE_PERCENT = 5.0
"""Largest tolerance of weights that are good enough for a calibration."""
SHORTEST_READING_S, LONGEST_WAIT_S = 0.1, 60.0
TEMPERATURES_degC = (-40.0, 85.0)
"""Range of temperature in which sensors and film work."""
DIRECTIONS: dict[str, Vector] = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}


@option_group
class RecordOptions:
    """Options that all records have in common."""

    to: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the record.  [default: calibrations/ next to the bench file, or here "
            "without one]",
            metavar="FOLDER",
        ),
    ] = None
    operator: Annotated[
        str,
        typer.Option(
            help="Name of the person who calibrates.  [default: the login name]", metavar="NAME"
        ),
    ] = ""
    valid: Annotated[
        str | None,
        typer.Option(
            help="Period of validity of the record.  [default: 90d for a film, 365d for a sensor]",
            metavar="DAYS",
        ),
    ] = None
    temperature: Annotated[
        float | None,
        typer.Option(
            help="Ambient temperature in degrees Celsius, -40 to 85.",
            parser=real_number(-math.inf),
            metavar="degC",
        ),
    ] = None
    notes: Notes = ""
    as_json: AsJson = False
    debug: Debug = False

    def fields(self, kind: Kind, date: datetime, operator: str = "") -> dict[str, Any]:
        """Return the fields of a record that was measured at `date`.

        Raises ConfigurationError for a temperature that is not that of a room, and for texts that
        are not UTF-8.
        """
        import rig
        from rig.instruments.calibration import VALID_DAYS

        days = VALID_DAYS[kind] if self.valid is None else _days(self.valid)
        low, high = TEMPERATURES_degC
        if self.temperature is not None and not low <= self.temperature <= high:
            raise ConfigurationError(
                f"--temperature {self.temperature:g}: must be {low:g} to {high:g} degC, "
                "that of the room"
            )
        return {
            "date": date,
            "valid_until": date + timedelta(days=days),
            "operator": as_utf8("--operator", self.operator or operator or _login(), "a record"),
            "temperature_degC": self.temperature,
            "notes": as_utf8("--notes", self.notes, "a record"),
            "program": f"tactile-rig {rig.__version__}",
        }


@option_group
class WeighingOptions:
    """Options that both calibrations with weights have in common."""

    bench: BenchFile = None
    tolerance: Annotated[
        float,
        typer.Option(
            help=f"Relative tolerance of the weight set, 0 to {LARGEST_TOLERANCE_PERCENT:g}.",
            parser=real_number(0),
            metavar="percent",
        ),
    ] = 0.02
    duration: Annotated[str, typer.Option(help="Duration of a reading.", metavar="s")] = "2s"
    settling: Annotated[str, typer.Option(help="Wait before a reading.", metavar="s")] = "1s"
    preload: Annotated[
        str,
        typer.Option(help="Constant force on the sensor in addition to the weights.", metavar="N"),
    ] = "0N"
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter (simulated bench only).")
    ] = False
    results: Annotated[
        Path, typer.Option(help="Folder with the guard's report.", metavar="FOLDER")
    ] = RESULTS
    seed: Seed = 0
    world: World = None
    world_log: WorldLog = None


def sensor_name(option: str, text: str) -> str:
    """Return the name of a sensor as a record can keep it, before a weight is put on.

    Raises ConfigurationError, which names the option, for a text that is too long or not UTF-8.
    """
    from rig.instruments.calibration import LONGEST_SENSOR_NAME

    if len(text) > LONGEST_SENSOR_NAME:
        raise ConfigurationError(
            f"{option} has {len(text)} characters: a record keeps at most {LONGEST_SENSOR_NAME}",
            "use a shorter name",
        )
    return as_utf8(option, text, "a record")


def directions(text: str) -> list[Vector]:
    """Return the unit vectors of --axes.

    Raises ConfigurationError for an unknown direction, and if an axis is left out.
    """
    found: list[Vector] = []
    for word in text.split(","):
        if word.strip() not in DIRECTIONS:
            known = ", ".join(sorted(DIRECTIONS))
            raise ConfigurationError(
                f"--axes: {word.strip()!r} is not a direction", f"choose among {known}"
            )
        found.append(DIRECTIONS[word.strip()])
    if missing := [axis for k, axis in enumerate("xyz") if not any(d[k] for d in found)]:
        raise ConfigurationError(
            f"--axes {text} leaves out {' and '.join(missing)}: the matrix needs all three"
        )
    return found


def weights_of(text: str) -> list[float]:
    """Return the forces of --weights, ascending, in N.

    Raises ConfigurationError for fewer than two weights, and for weights that do not ascend.
    """
    weights = [number(word, "N", "--weights") for word in text.split(",") if word.strip()]
    if len(weights) < 2 or weights[0] <= 0:
        raise ConfigurationError(
            f"--weights {text}: at least two different weights above 0 N are needed",
            "for example --weights 5N,10N,20N",
        )
    if any(after <= before for before, after in pairwise(weights)):
        raise ConfigurationError(
            f"--weights {text}: every weight must be larger than the one before",
            "for example --weights 5N,10N,20N",
        )
    return weights


def conditions(options: WeighingOptions, weights_N: list[float]) -> dict[str, Any]:
    """Return the conditions under which the weights are put on, as a record keeps them.

    Raises ConfigurationError for a tolerance out of range.
    """
    if not 0 <= options.tolerance <= LARGEST_TOLERANCE_PERCENT:
        raise ConfigurationError(
            f"--tolerance {options.tolerance:g}: must be 0 to {LARGEST_TOLERANCE_PERCENT:g} percent"
        )
    return {
        "weights_N": weights_N,
        "weight_tolerance_percent": options.tolerance,
        "preload_N": number(options.preload, "N", "--preload"),
    }


def reading_times(options: WeighingOptions) -> Timing:
    """Return how long readings are, and how long to wait before them.

    Raises ConfigurationError for a time out of range.
    """
    from rig.run.streams.scales import Timing

    timing = Timing(
        settling_s=number(options.settling, "s", "--settling"),
        duration_s=number(options.duration, "s", "--duration"),
    )
    for option, value, low in (
        ("--settling", timing.settling_s, 0.0),
        ("--duration", timing.duration_s, SHORTEST_READING_S),
    ):
        if not low <= value <= LONGEST_WAIT_S:
            raise ConfigurationError(
                f"{option} {value:g} s: must be {low:g} to {LONGEST_WAIT_S:g} s"
            )
    return timing


def number(text: str, unit: str, option: str) -> float:
    """Return a finite number from an option's text, with or without its unit.

    Raises ConfigurationError for any other text and for a number below 0.
    """
    from rig.core.units import quantity

    try:
        value = quantity(text, unit)
    except ValueError as error:
        raise ConfigurationError(f"{option} {text}: {error}", "see --help for the units") from error
    if not math.isfinite(value) or value < 0:
        raise ConfigurationError(f"{option} {text}: must be a number, not below 0")
    return value


def _days(text: str) -> int:
    match = re.fullmatch(r"\s*(\d{1,4})\s*(d|days?)?\s*", text)
    if match is None or not 1 <= int(match[1]) <= 3650:
        raise ConfigurationError(
            f"--valid {text}: must be 1 to 3650 days", "write it as --valid 90d"
        )
    return int(match[1])


def _login() -> str:
    with contextlib.suppress(OSError, KeyError):
        return getpass.getuser()
    return ""
