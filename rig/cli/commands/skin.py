"""Simulate the finger skin: slides, rolls, the paper's section 4.2, places for the strips.

Modules that are slow to import are imported inside the commands. stdout carries the summary,
stderr only errors. Every figure and every summary states that it is simulated.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.commands.model_errors import model_errors
from rig.cli.commands.skin_files import (
    Model,
    quantities_of_history,
    quantities_of_map,
    quantities_of_trial,
    save_model,
)
from rig.cli.options.groups import option_group, with_option_groups
from rig.cli.options.numbers import number_in, whole_number
from rig.cli.options.results_folder import require_results_folder
from rig.cli.options.settings_file import read_settings
from rig.cli.options.shared import RESULTS, Debug
from rig.cli.outcome import print_json, reported
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rig.core.settings import Settings
    from rig.physics.skin.condensed import CondensedSkin
    from rig.physics.skin.elasticity import ElasticSkin
    from rig.physics.skin.settings import SkinSettings
    from rig.physics.trials import RollSettings, SkinTrial


app = typer.Typer(
    name="skin",
    help=(__doc__ or "").split("\n", 1)[0],
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _settings_file(without_effect: str = "") -> Any:
    """Return the option --settings of a command; its help names the options that it replaces."""
    text = "JSON file with settings, as --show-settings prints them."
    if without_effect:
        text += f" With it, {without_effect}."
    return typer.Option(help=text, metavar="FILE")


At = Annotated[
    list[str] | None,
    typer.Option("--at", help="Time at which the deformed skin is drawn; repeatable.", metavar="s"),
]


@option_group
class OutputOptions:
    """Options that all commands of the skin have in common."""

    results: Annotated[
        Path, typer.Option(help="Folder for data and figures.", file_okay=False, metavar="FOLDER")
    ] = RESULTS
    show_settings: Annotated[
        bool, typer.Option("--show-settings", help="Print the settings as JSON and exit.")
    ] = False
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the summary as one JSON object.")
    ] = False
    debug: Debug = False


@option_group
class SkinOptions:
    """Options of the commands that press an object on the skin."""

    skin: Annotated[
        Path | None,
        typer.Option(
            help="JSON file with the settings of the skin; replaces --elements.", metavar="FILE"
        ),
    ] = None
    show_skin: Annotated[
        bool, typer.Option("--show-skin", help="Print the settings of the skin as JSON and exit.")
    ] = False
    elements: Annotated[
        int,
        typer.Option(
            help="Finite elements along a ridge, 2 to 40; fewer than 6 are fast but coarse.",
            parser=whole_number(2, 40),
            metavar="COUNT",
        ),
    ] = 8
    normal_force: Annotated[str, typer.Option(help="Normal force F_n.", metavar="N")] = "4N"

    def normal_newtons(self) -> float:
        """Return the normal force in N; raises ConfigurationError if the text is not a force."""
        return number_in(self.normal_force, "N", "--normal-force", above=0.0)

    def skin_settings(self) -> SkinSettings:
        """Return the settings of the skin. Raises ConfigurationError, which names the file, for one
        that is not valid."""
        from rig.physics.skin.settings import SkinSettings

        return read_settings(SkinSettings(elements_per_ridge=self.elements), self.skin)


LABELS = {
    "slip_order": "ridges that slipped as a whole, in order (1 is the leftmost)",
    "ridge_first_slip_s": "slip of the first node of each ridge (s)",
    "ridge_whole_slip_s": "slip of each whole ridge (s)",
    "gross_slip_s": "gross slip (s)",
    "v_d_min_mV": "lowest v_d during the motion (mV)",
    "v_d_max_mV": "highest v_d during the motion (mV)",
    "stable_step_us": "largest stable step (µs)",
    "ridge_whole_slip_step": "slip of each whole ridge (step)",
    "gross_slip_step": "gross slip (step)",
    "bottoms_mm": "rows: lower edges of the strips above the foot of the ridge (mm)",
    "offsets_mm": "columns: distances of the strips from the axis of the ridge (mm)",
    "hump_mV": "v_d before the ridge slips (mV)",
    "hf_peak_mV": "largest v_d above 100 Hz when the ridge slips (mV)",
}
"""Labels of the printed summary; the keys of --json are not translated."""
SHAPES = ("cylinder", "sphere")
RELIEF_TITLES = {
    "normal_raised": "relief by a raised $F_n$",
    "tangential_lowered": "relief by a lowered $F_t$",
}


@app.command()
@with_option_groups
def slide(
    *,
    speed: Annotated[str, typer.Option(help="Speed of the plate.", metavar="mm/s")] = "0.5mm/s",
    at: At = None,
    settings: Annotated[
        Path | None, _settings_file("--speed and --normal-force have no effect")
    ] = None,
    pressed: SkinOptions,
    output: OutputOptions,
) -> None:
    """Press a plate on and slide it.

    Draws v_d, forces, stick-slip map and the deformed skin.
    """
    from rig.physics.trials import PressSettings, SlideSettings
    from rig.physics.trials import slide as run

    with reported(output.debug, output.as_json), model_errors():
        default = SlideSettings(
            press=PressSettings(normal_force_N=pressed.normal_newtons()),
            speed_mm_s=number_in(speed, "mm/s", "--speed", above=0.0),
        )
        chosen = read_settings(default, settings)
        if chosen.speed_mm_s == 0:
            raise ConfigurationError(
                f"{settings}: speed_mm_s = 0 mm/s: the plate does not slide",
                "choose a speed above 0, for example 0.5",
            )
        instants = _times(at)
        if _shown(output, pressed, chosen):
            return
        require_results_folder(output.results)
        elastic, skin = _skin(pressed.skin_settings())
        trial = run(skin, chosen, keep_forces=True)
        name = f"Slide at {chosen.speed_mm_s:g} mm/s under {chosen.press.normal_force_N:g} N"
        _report(trial, chosen, elastic, skin, instants, output, "skin-slide", name)


@app.command()
@with_option_groups
def roll(
    *,
    start: Annotated[
        str, typer.Option(help="Position x of the contact before the roll.", metavar="mm")
    ] = "-5mm",
    shape: Annotated[
        str, typer.Option(help="Shape of the object.", metavar="[cylinder|sphere]")
    ] = "cylinder",
    at: At = None,
    settings: Annotated[
        Path | None, _settings_file("--start, --shape and --normal-force have no effect")
    ] = None,
    pressed: SkinOptions,
    output: OutputOptions,
) -> None:
    """Press a cylinder or sphere on and roll it.

    Draws v_d, forces, sticking and the deformed skin.
    """
    from rig.physics.trials import RollSettings
    from rig.physics.trials import roll as run

    with reported(output.debug, output.as_json), model_errors():
        if shape not in SHAPES:
            raise ConfigurationError(f"--shape {shape}: must be one of {', '.join(SHAPES)}")
        default = RollSettings.model_validate(
            {
                "body": {"shape": shape},
                "press": {"normal_force_N": pressed.normal_newtons()},
                "start_x_mm": number_in(start, "mm", "--start"),
            }
        )
        instants = _times(at)
        chosen = read_settings(default, settings)
        if _shown(output, pressed, chosen):
            return
        if settings is None:
            start = f"--start {start}"
        else:
            start = f"{settings}: start_x_mm = {chosen.start_x_mm:g} mm"
        _refuse_out_of_reach(start, chosen, pressed.skin_settings())
        require_results_folder(output.results)
        elastic, skin = _skin(pressed.skin_settings())
        trial = run(skin, chosen, keep_forces=True)
        what = f"Roll of a {chosen.body.shape} by {chosen.angle_deg:g}°"
        name = f"{what} from x = {chosen.start_x_mm:g} mm"
        _report(trial, chosen, elastic, skin, instants, output, "skin-roll", name)


@app.command()
@with_option_groups
def history(
    *,
    relief: Annotated[
        str,
        typer.Option(
            help="Relief of the contact at step 300.", metavar="[normal_raised|tangential_lowered]"
        ),
    ] = "normal_raised",
    at: Annotated[
        list[float] | None,
        typer.Option(help="Step at which the deformed skin is drawn; repeatable.", metavar="STEP"),
    ] = None,
    settings: Annotated[Path | None, _settings_file("--relief has no effect")] = None,
    output: OutputOptions,
) -> None:
    """Run the simulation of the paper's 4.2.

    Draws stress difference, rate and the deformed skin.
    """
    from rig.physics.loading_history import RELIEFS, HistorySettings, run_history
    from rig.physics.skin.elasticity import STRESSES, ElasticSkin
    from rig.physics.skin.field import deformed

    with reported(output.debug, output.as_json), model_errors():
        if relief not in RELIEFS:
            raise ConfigurationError(f"--relief {relief}: must be one of {', '.join(RELIEFS)}")
        chosen = read_settings(HistorySettings(loads=RELIEFS[relief]), settings)
        if output.show_settings:
            _show(chosen)
            return
        steps = _steps(at, chosen.steps)
        require_results_folder(output.results)
        found = run_history(chosen, shots=tuple(steps))
        from rig.figures import skin as figures

        elastic = ElasticSkin(chosen.skin)
        instants = [
            (f"step {step}", deformed(elastic, found.shots[step], found.shots[step]))
            for step in steps
        ]
        name = next((known for known, loads in RELIEFS.items() if loads == chosen.loads), "edited")
        title = f"The paper's 4.2, {RELIEF_TITLES.get(name, 'edited loads')}"
        component = STRESSES.index(chosen.component)
        drawn = {
            f"skin-history-{name}": figures.draw_history(found, chosen.ridge, title),
            f"skin-history-{name}-deformed": figures.draw_deformed(
                instants, chosen.skin, component, title
            ),
        }
        data = Model(
            f"skin-history-{name}", title, {"settings": chosen}, quantities_of_history(found)
        )
        files = save_model(data, drawn, output.results)
        _print_summary(
            {
                "stable_step_us": found.stable_step_us,
                "ridge_whole_slip_step": _plain(found.truth.whole_slip_s / chosen.step_us * 1e6),
                "gross_slip_step": _plain(found.truth.gross_slip_s / chosen.step_us * 1e6),
            },
            files,
            output.as_json,
        )


@app.command(name="map")
@with_option_groups
def map_(
    *,
    settings: Annotated[Path | None, _settings_file()] = None,
    output: OutputOptions,
) -> None:
    """Map v_d of a slide against the places of the strips.

    Draws v_d for each ridge, place of the strips and stress component.
    """
    from rig.physics.design_map import MapSettings, design_map

    with reported(output.debug, output.as_json), model_errors():
        chosen = read_settings(MapSettings(), settings)
        if output.show_settings:
            _show(chosen)
            return
        require_results_folder(output.results)
        found = design_map(chosen)
        from rig.figures import skin as figures

        ridge = chosen.slide.ridge
        data = Model(
            "skin-map",
            "v_d in a slide by strip position",
            {"settings": chosen},
            quantities_of_map(found),
        )
        files = save_model(data, {"skin-map": figures.draw_map(found, ridge)}, output.results)
        tables = {
            f"{quantity}_mV": {
                component: _plain(values[ridge - 1, :, :, k] * 1e3)
                for k, component in enumerate(found.components)
            }
            for quantity, values in (("hump", found.hump_V), ("hf_peak", found.peak_V))
        }
        places = {"bottoms_mm": chosen.bottoms_mm, "offsets_mm": chosen.offsets_mm}
        _print_summary({"ridge": ridge, **places, **tables}, files, output.as_json)


def _report(
    trial: SkinTrial,
    settings: Any,
    elastic: ElasticSkin,
    skin: CondensedSkin,
    at: list[float] | None,
    output: OutputOptions,
    stem: str,
    title: str,
) -> None:
    """Draw a trial and print its summary."""
    from rig.figures import skin as figures

    drawn = {stem: figures.draw_trial(trial, skin.ridge, settings.ridge, title)}
    # The slices of a sphere have no common section that could be drawn.
    if settings.body.shape != "sphere":
        instants = _instants(trial, settings, elastic, at)
        drawn[f"{stem}-deformed"] = figures.draw_deformed(instants, skin.settings, 1, title)
    used = {"settings": settings, "skin": skin.settings}
    files = save_model(Model(stem, title, used, quantities_of_trial(trial)), drawn, output.results)
    truth = trial.truth
    moving = trial.v_d[trial.sample_time_s > trial.motion_s] * 1e3
    summary = {
        "slip_order": truth.slip_order(),
        "ridge_first_slip_s": _plain(truth.first_slip_s),
        "ridge_whole_slip_s": _plain(truth.whole_slip_s),
        "gross_slip_s": _plain(truth.gross_slip_s),
        "v_d_min_mV": float(moving.min()),
        "v_d_max_mV": float(moving.max()),
    }
    _print_summary(summary, files, output.as_json)


def _refuse_out_of_reach(start: str, roll: RollSettings, skin: SkinSettings) -> None:
    """Raise ConfigurationError where the object touches no ridge at the start of a roll, which
    `start` names as it was given: its contact would have no solution."""
    from rig.physics.contact.settings import Plate

    if isinstance(roll.body, Plate):  # refused by the roll itself
        return
    axes_mm, radius_mm = skin.ridge_axes_mm(), roll.body.radius_mm
    if not axes_mm[0] - radius_mm < roll.start_x_mm < axes_mm[-1] + radius_mm:
        raise ConfigurationError(
            f"{start}: an object with a radius of {radius_mm:g} mm touches no ridge there",
            f"the ridges lie from {axes_mm[0]:g} to {axes_mm[-1]:g} mm",
        )


def _instants(
    trial: SkinTrial, settings: Any, elastic: ElasticSkin, at: list[float] | None
) -> list[tuple[str, Any]]:
    """Return the section at the requested times, or at rest, at slip and at the end."""
    import numpy as np

    from rig.physics.skin.field import deformed, relaxed_forces

    whole = trial.truth.whole_slip_s[settings.ridge - 1]
    middle = whole if np.isfinite(whole) else (trial.motion_s + trial.time_s[-1]) / 2
    times = sorted(at) if at else [trial.motion_s, float(middle), float(trial.time_s[-1])]
    _within(times, 0.0, float(trial.time_s[-1]), " s")
    contact = settings.contact
    forces = trial.block.forces_N
    felt = relaxed_forces(forces, contact.relaxation_time_ms, contact.step_us)
    loads = elastic.contact_loads()
    shown = []
    for time in times:
        row = int(np.abs(trial.time_s - time).argmin())
        both = elastic.solve(loads @ np.stack([felt[row], forces[row]], axis=1))
        shown.append((f"t = {trial.time_s[row]:.3f} s", deformed(elastic, both[:, 0], both[:, 1])))
    return shown


def _steps(at: list[float] | None, last: int) -> list[int]:
    """Return the requested steps, or one of each part of the history."""
    if at:
        _within(at, 1, last, "", " (a step)")
        if parts := [step for step in at if not step.is_integer()]:
            raise ConfigurationError(
                f"--at {parts[0]:g} (a step) must be a whole number",
                "write the number of a step, for example 140",
            )
        return sorted({int(step) for step in at})
    return sorted({min(step, last) for step in (140, 290, 440, last)})


def _within(at: list[float], first: float, last: float, unit: str, what: str = "") -> None:
    for value in at:
        if not first <= value <= last:
            raise ConfigurationError(
                f"--at {value:g}{unit}{what} must lie between {first:g}{unit} and {last:g}{unit}: "
                "outside it there is nothing to draw"
            )


def _times(at: list[str] | None) -> list[float] | None:
    return [number_in(text, "s", "--at") for text in at] if at else None


def _skin(settings: SkinSettings) -> tuple[ElasticSkin, CondensedSkin]:
    from rig.core.cache import user_cache
    from rig.physics.skin.condensed import build_skin
    from rig.physics.skin.elasticity import ElasticSkin

    return ElasticSkin(settings), build_skin(settings, user_cache())


def _shown(output: OutputOptions, pressed: SkinOptions, settings: Settings) -> bool:
    """Print the settings that were asked for instead of a trial; return False if none were."""
    if output.show_settings and pressed.show_skin:
        raise ConfigurationError(
            "--show-settings and --show-skin print one object each", "give one of them"
        )
    if output.show_settings:
        _show(settings)
    elif pressed.show_skin:
        _show(pressed.skin_settings())
    else:
        return False
    return True


def _show(settings: Any) -> None:
    typer.echo(settings.model_dump_json(indent=2))


def _plain(values: float | NDArray[np.float64]) -> Any:
    """Return rounded numbers for JSON; None for events that did not happen."""
    import numpy as np

    if np.ndim(values) > 0:
        return [_plain(value) for value in np.asarray(values)]
    return round(float(values), 6) if np.isfinite(values) else None


def _print_summary(summary: dict[str, Any], files: list[Path], as_json: bool) -> None:
    full = {"simulated": True, **summary, "files": [str(file) for file in files]}
    if as_json:
        print_json(full)
        return
    typer.echo("simulated (model)")
    for key, value in full.items():
        if key != "simulated":
            for line in _lines(LABELS.get(key, key), value):
                typer.echo(line)


def _lines(name: str, value: Any) -> Iterator[str]:
    """Return a value as text: a list in one line, a table with one line per row below its name."""
    if isinstance(value, dict):
        yield f"{name}:"
        for key, part in value.items():
            yield from (f"  {line}" for line in _lines(key, part))
    elif isinstance(value, list | tuple) and value and isinstance(value[0], list):
        yield f"{name}:"
        yield from ("  " + "  ".join(f"{_word(cell):>10}" for cell in row) for row in value)
    elif isinstance(value, list | tuple):
        yield f"{name}: {', '.join(_word(item) for item in value)}"
    else:
        yield f"{name}: {_word(value)}"


def _word(value: Any) -> str:
    """Return a value as text. Events that did not happen are None."""
    if value is None:
        return "never"
    return f"{value:g}" if isinstance(value, float) else str(value)
