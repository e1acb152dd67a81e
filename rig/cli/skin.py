"""``rig skin``: run the skin model and draw it. Parses, calls, prints; no physics of its own.

What is expensive to import is imported inside the commands. stdout carries data, stderr nothing
but errors; every figure and every summary says that it is simulated.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from rig.errors import ConfigurationError, RigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rig.model.skin.condensed import CondensedSkin
    from rig.model.skin.elasticity import ElasticSkin
    from rig.model.skin.settings import SkinSettings
    from rig.model.trials import Trial
    from rig.settings import Settings

    Model = TypeVar("Model", bound=Settings)
else:
    Model = TypeVar("Model")

app = typer.Typer(
    name="skin",
    help="Simulate the finger skin: slides, rolls, the paper's 4.2, where strips belong.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

Output = Annotated[Path, typer.Option(help="Folder for the figures.", file_okay=False)]
SettingsFile = Annotated[
    Path | None,
    typer.Option("--settings", help="Settings as JSON; --show-settings prints them to edit."),
]
ShowSettings = Annotated[
    bool, typer.Option("--show-settings", help="Print the settings as JSON and stop.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object.")]
Elements = Annotated[
    int, typer.Option("--elements", help="Elements along a ridge; at least 6.", min=2, max=40)
]
At = Annotated[
    list[float] | None, typer.Option("--at", help="Instants of the deformed skin; repeatable.")
]


@app.command()
def slide(
    output: Output = Path("results"),
    settings: SettingsFile = None,
    show_settings: ShowSettings = False,
    as_json: AsJson = False,
    elements: Elements = 8,
    normal_force: Annotated[float, typer.Option(help="F_n in N.")] = 4.0,
    speed: Annotated[float, typer.Option(help="Speed in mm/s.")] = 0.5,
    at: At = None,
) -> None:
    """Press a plate on and slide it: v_d, forces, stick-slip map, deformed skin."""
    from rig.model.skin.settings import SkinSettings
    from rig.model.trials import PressSettings, SlideSettings
    from rig.model.trials import slide as run

    with _errors(settings):
        default = SlideSettings(press=PressSettings(normal_force_N=normal_force), speed_mm_s=speed)
        chosen = _settings(SlideSettings, settings, default)
        if show_settings:
            _show(chosen)
            return
        elastic, skin = _skin(SkinSettings(elements_per_ridge=elements))
        trial = run(skin, chosen, keep_forces=True)
        name = f"Slide at {chosen.speed_mm_s:g} mm/s under {chosen.press.normal_force_N:g} N"
        _report(trial, chosen, elastic, skin, at, output, "skin-slide", name, as_json)


@app.command()
def roll(
    output: Output = Path("results"),
    settings: SettingsFile = None,
    show_settings: ShowSettings = False,
    as_json: AsJson = False,
    elements: Elements = 8,
    normal_force: Annotated[float, typer.Option(help="F_n in N.")] = 4.0,
    start: Annotated[float, typer.Option(help="x of the contact before the roll, mm.")] = -5.0,
    shape: Annotated[str, typer.Option(help="cylinder or sphere.")] = "cylinder",
    at: At = None,
) -> None:
    """Press a cylinder or a sphere on and roll it: v_d, forces, stick-slip map, deformed skin."""
    from rig.model.skin.settings import SkinSettings
    from rig.model.trials import RollSettings
    from rig.model.trials import roll as run

    with _errors(settings):
        default = RollSettings.model_validate(
            {
                "body": {"shape": shape},
                "press": {"normal_force_N": normal_force},
                "start_x_mm": start,
            }
        )
        chosen = _settings(RollSettings, settings, default)
        if show_settings:
            _show(chosen)
            return
        elastic, skin = _skin(SkinSettings(elements_per_ridge=elements))
        trial = run(skin, chosen, keep_forces=True)
        what = f"Roll of a {chosen.body.shape} by {chosen.angle_deg:g}°"
        name = f"{what} from x = {chosen.start_x_mm:g} mm"
        _report(trial, chosen, elastic, skin, at, output, "skin-roll", name, as_json)


@app.command()
def history(
    output: Output = Path("results"),
    settings: SettingsFile = None,
    show_settings: ShowSettings = False,
    as_json: AsJson = False,
    relief: Annotated[
        str, typer.Option(help="How step 300 relieves: normal_raised or tangential_lowered.")
    ] = "normal_raised",
    at: At = None,
) -> None:
    """The paper's simulation 4.2: stress difference and its rate, stick-slip map, deformed skin."""
    from rig.model.loading_history import RELIEFS, HistorySettings, run_history
    from rig.model.skin.elasticity import STRESSES, ElasticSkin
    from rig.model.skin.field import deformed

    with _errors(settings):
        if relief not in RELIEFS:
            raise ConfigurationError(f"--relief {relief}: must be one of {', '.join(RELIEFS)}")
        chosen = _settings(HistorySettings, settings, HistorySettings(loads=RELIEFS[relief]))
        if show_settings:
            _show(chosen)
            return
        steps = sorted({int(step) for step in at or (140, 290, chosen.steps)})
        found = run_history(chosen, shots=tuple(steps))
        from rig.figures import skin as figures

        elastic = ElasticSkin(chosen.skin)
        instants = [
            (f"step {step}", deformed(elastic, found.shots[step], found.shots[step]))
            for step in steps
            if step in found.shots
        ]
        title = "Loading history of the paper's 4.2"
        stem = f"skin-history-{relief}" if settings is None else "skin-history"
        files = [
            figures.save(figures.draw_history(found, chosen.ridge, title), output / f"{stem}.png"),
            figures.save(
                figures.draw_deformed(
                    instants, chosen.skin, STRESSES.index(chosen.component), title
                ),
                output / f"{stem}-deformed.png",
            ),
        ]
        _print_summary(
            {
                "stable_step_us": found.stable_step_us,
                "ridge_whole_slip_step": _plain(found.truth.whole_slip_s / chosen.step_us * 1e6),
                "gross_slip_step": _plain(found.truth.gross_slip_s / chosen.step_us * 1e6),
            },
            files,
            as_json,
        )


@app.command(name="map")
def map_(
    output: Output = Path("results"),
    settings: SettingsFile = None,
    show_settings: ShowSettings = False,
    as_json: AsJson = False,
) -> None:
    """Where strips belong: hump and HF peak over ridge, place and stress component."""
    from rig.model.design_map import MapSettings, design_map

    with _errors(settings):
        chosen = _settings(MapSettings, settings, MapSettings())
        if show_settings:
            _show(chosen)
            return
        found = design_map(chosen)
        from rig.figures import skin as figures

        ridge = chosen.slide.ridge
        file = figures.save(figures.draw_map(found, ridge), output / "skin-map.png")
        tables = {
            f"{quantity}_mV": {
                component: _plain(values[ridge - 1, :, :, k] * 1e3)
                for k, component in enumerate(found.components)
            }
            for quantity, values in (("hump", found.hump_V), ("hf_peak", found.peak_V))
        }
        places = {"bottoms_mm": chosen.bottoms_mm, "offsets_mm": chosen.offsets_mm}
        _print_summary({"ridge": ridge, **places, **tables}, [file], as_json)


def _report(
    trial: Trial,
    settings: Any,
    elastic: ElasticSkin,
    skin: CondensedSkin,
    at: list[float] | None,
    output: Path,
    stem: str,
    title: str,
    as_json: bool,
) -> None:
    """Draw a trial and print what happened."""
    from rig.figures import skin as figures

    drawn = figures.draw_trial(trial, skin.ridge, settings.ridge, title)
    files = [figures.save(drawn, output / f"{stem}.png")]
    if settings.body.shape != "sphere":
        instants = _instants(trial, settings, elastic, at)
        shown = figures.draw_deformed(instants, skin.settings, 1, title)
        files.append(figures.save(shown, output / f"{stem}-deformed.png"))
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
    _print_summary(summary, files, as_json)


def _instants(
    trial: Trial, settings: Any, elastic: ElasticSkin, at: list[float] | None
) -> list[tuple[str, Any]]:
    """The section at the instants asked for, or at rest, at the ridge's slip and at the end."""
    import numpy as np

    from rig.model.skin.field import deformed, relaxed_forces

    whole = trial.truth.whole_slip_s[settings.ridge - 1]
    middle = whole if np.isfinite(whole) else (trial.motion_s + trial.time_s[-1]) / 2
    times = sorted(at) if at else [trial.motion_s, float(middle), float(trial.time_s[-1])]
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


def _skin(settings: SkinSettings) -> tuple[ElasticSkin, CondensedSkin]:
    from rig.cache import user_cache
    from rig.model.skin.condensed import build_skin
    from rig.model.skin.elasticity import ElasticSkin

    return ElasticSkin(settings), build_skin(settings, user_cache())


def _settings(kind: type[Model], file: Path | None, default: Model) -> Model:
    if file is None:
        return default
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{file}: {error.strerror}") from error
    return kind.model_validate_json(text)


def _show(settings: Any) -> None:
    typer.echo(settings.model_dump_json(indent=2))


def _plain(values: float | NDArray[np.float64]) -> Any:
    """Numbers as JSON can hold them: rounded, None for what did not happen."""
    import numpy as np

    if np.ndim(values) > 0:
        return [_plain(value) for value in np.asarray(values)]
    return round(float(values), 6) if np.isfinite(values) else None


def _print_summary(summary: dict[str, Any], files: list[Path], as_json: bool) -> None:
    full = {"simulated": True, **summary, "files": [str(file) for file in files]}
    if as_json:
        typer.echo(json.dumps(full))
        return
    typer.echo("simulated (model)")
    for key, value in full.items():
        if key != "simulated":
            typer.echo(f"{key}: {value}")


@contextmanager
def _errors(source: Path | None) -> Iterator[None]:
    """Refused values and steps without a solution as one-line errors."""
    from pydantic import ValidationError

    from rig.model.contact.stepper import ConvergenceError

    try:
        yield
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(source or "options")) from error
    except ConvergenceError as error:
        raise RigError(str(error)) from error
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


if __name__ == "__main__":
    app()
