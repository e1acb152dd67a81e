"""``rig filter`` designs a low-pass filter, prints its numbers and draws the paper's Figure 14."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options.results_folder import require_results_folder
from rig.cli.options.shared import RESULTS, AsJson, Debug
from rig.cli.outcome import print_json, reported
from rig.core.errors import ConfigurationError, OutputError

if TYPE_CHECKING:
    from rig.analysis.low_pass_curves import LowPassCurves
    from rig.detector.low_pass import LowPass, LowPassSettings

OPTIONS = {
    "half_power_Hz": "--half-power",
    "stop_dB": "--attenuation",
    "lag_deg": "--lag",
    "lag_Hz": "--lag-at",
    "stop_Hz": "--stop-from",
}
"""Option of each field of the specification. Messages about fields are translated with it."""
CURVES = ("frequency_Hz", "gain_dB", "phase_deg", "group_delay_ms")
"""Columns of the frequency file."""
RESPONSES = ("time_ms", "tap", "step_response")
"""Columns of the step file."""
LABELS = {
    "rate_Hz": ("sampling rate", "Hz"),
    "taps": ("taps", ""),
    "half_power_Hz": ("-3 dB frequency", "Hz"),
    "lag_Hz": ("frequency of the specified lag", "Hz"),
    "lag_deg": ("phase lag at that frequency", "deg"),
    "delay_ms": ("group delay at that frequency", "ms"),
    "stop_Hz": ("stop band ({stop_dB:.4g} dB) from", "Hz"),
    "largest_lobe_dB": ("largest side lobe of the stop band", "dB"),
    "lobes_from_Hz": ("gain first below the largest side lobe at", "Hz"),
    "step_half_ms": ("step response reaches 50 % after", "ms"),
    "overshoot_percent": ("overshoot of the step response", "%"),
    "settled_ms": ("step response within 1 % after", "ms"),
}
"""Label and unit of each printed number; --json prints the keys. `stop_dB` is the gain that the
filter was designed for."""


def filter_(
    name: Annotated[
        str, typer.Argument(help="Filter to start from.", metavar="paper|fast|faster")
    ] = "paper",
    half_power: Annotated[
        str | None,
        typer.Option(
            help="Frequency at which the gain is -3 dB.  [default: that of the filter]",
            metavar="Hz",
        ),
    ] = None,
    attenuation: Annotated[
        str | None,
        typer.Option(
            help="Attenuation of the stop band.  [default: that of the filter]", metavar="dB"
        ),
    ] = None,
    lag: Annotated[
        str | None,
        typer.Option(
            help="Phase lag at --lag-at; replaces --stop-from.  [default: that of the filter]",
            metavar="deg",
        ),
    ] = None,
    lag_at: Annotated[
        str | None,
        typer.Option(
            help="Frequency at which the phase lag is specified.  [default: that of the filter]",
            metavar="Hz",
        ),
    ] = None,
    stop_from: Annotated[
        str | None,
        typer.Option(help="Frequency at which the stop band begins; replaces --lag.", metavar="Hz"),
    ] = None,
    rate: Annotated[str, typer.Option(help="Sampling rate.", metavar="Hz")] = "1000",
    results: Annotated[
        Path,
        typer.Option(help="Folder for the figure and its data.", file_okay=False, metavar="FOLDER"),
    ] = RESULTS,
    figures: Annotated[
        bool, typer.Option(help="Draw the figure (PNG and SVG) and write its data (CSV).")
    ] = True,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Design the low-pass filter of the predictive signal and draw its curves (Figure 14)."""
    texts = dict(zip(OPTIONS, (half_power, attenuation, lag, lag_at, stop_from), strict=True))
    with reported(debug, as_json):
        from rig.analysis.low_pass_curves import low_pass_curves, low_pass_summary
        from rig.detector.low_pass import NAMED_LOW_PASSES

        low_pass = _designed(_specification(name, texts), _quantity("--rate", rate, "Hz"))
        if figures:  # not before: a specification that is refused leaves no empty folder behind
            require_results_folder(results)
        summary = low_pass_summary(low_pass)
        changed = low_pass.settings != NAMED_LOW_PASSES[name]
        files: list[Path] = []
        if figures:
            from rig.figures.low_pass import draw_low_pass

            curves = low_pass_curves(low_pass)
            named = f"{name}, changed" if changed else name
            figure = draw_low_pass(named, low_pass.settings.stop_dB, curves, summary)
            files = _save(results, _stem(name, changed, low_pass), figure, curves)
        _print_summary(name, low_pass, asdict(summary), files, as_json)


def _specification(name: str, texts: dict[str, str | None]) -> LowPassSettings:
    from pydantic import ValidationError

    from rig.cli.options.detector import low_pass_values
    from rig.core.settings import unit_of
    from rig.detector.low_pass import NAMED_LOW_PASSES, LowPassSettings

    if name not in NAMED_LOW_PASSES:
        raise ConfigurationError(
            f"low-pass {name}: must be one of {', '.join(NAMED_LOW_PASSES)}",
            "options such as --lag change the named filter",
        )
    given = {
        field: _quantity(OPTIONS[field], text, unit_of(field) or "")
        for field, text in texts.items()
        if text is not None
    }
    try:
        return LowPassSettings.model_validate(low_pass_values(NAMED_LOW_PASSES[name], given))
    except ValidationError as error:
        wrong = ConfigurationError.from_validation(error, f"low-pass {name}")
        raise ConfigurationError(_by_options(wrong.message)) from error


def _designed(settings: LowPassSettings, rate_Hz: float) -> LowPass:
    """Design the filter. Raises ConfigurationError, with the bound, if no filter can do it."""
    from rig.detector.low_pass import design_low_pass

    if not 0 < rate_Hz < float("inf"):
        raise ConfigurationError(f"--rate {rate_Hz:g} Hz: must be above 0 Hz")
    try:
        return design_low_pass(settings, rate_Hz)
    except ValueError as error:
        raise ConfigurationError(_by_options(str(error))) from error


def _by_options(message: str) -> str:
    """Return a message with the names of fields replaced by those of options."""
    import re

    names = "|".join(sorted(OPTIONS, key=len, reverse=True))
    return re.sub(rf"\b({names})\b", lambda match: OPTIONS[match[1]], message)


def _quantity(option: str, text: str, unit: str) -> float:
    from rig.core.units import quantity

    try:
        return quantity(text, unit)
    except ValueError as error:
        raise ConfigurationError(f"{option} {text}: {error}", "see --help for the units") from error


def _stem(name: str, changed: bool, low_pass: LowPass) -> str:
    """Return a file name that is the same for the same specification and rate."""
    from rig.core.settings import fingerprint

    shown = fingerprint(low_pass.settings)[:8] if changed else name
    return f"low-pass-{shown}-{low_pass.rate_Hz:g}Hz"


def _save(results: Path, stem: str, figure: Any, curves: LowPassCurves) -> list[Path]:
    from rig.figures.style import save

    try:
        results.mkdir(parents=True, exist_ok=True)
        return [
            *save(figure, results / f"{stem}.png", simulated=False),
            _table(results / f"{stem}-frequency.csv", curves, CURVES),
            _table(results / f"{stem}-step.csv", curves, RESPONSES),
        ]
    except OSError as error:
        raise OutputError(
            f"figure and data cannot be written to {results}: {error.strerror or error}",
            "choose another folder with --results, or omit them with --no-figures",
        ) from error


def _table(path: Path, curves: LowPassCurves, columns: Sequence[str]) -> Path:
    """Write columns as CSV with all digits of the numbers."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(
            zip(*(getattr(curves, column).tolist() for column in columns), strict=True)
        )
    return path


def _print_summary(
    name: str, low_pass: LowPass, summary: dict[str, Any], files: list[Path], as_json: bool
) -> None:
    if as_json:
        specification = low_pass.settings.model_dump()
        document = {
            "file": str(files[0]) if files else None,
            "outcome": "complete",
            "exit": 0,
            "simulated": None,
            "summary": {"name": name, "specification": specification, **summary},
            "files": [str(file) for file in files],
        }
        print_json(document)
        return
    for key, value in summary.items():
        label, unit = LABELS[key]
        shown = "never" if value is None else f"{value:.6g} {unit}".rstrip()
        typer.echo(f"{label.format(stop_dB=-low_pass.settings.stop_dB)}: {shown}")
    for file in files:
        typer.echo(f"saved {file}")
