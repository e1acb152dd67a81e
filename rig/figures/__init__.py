"""Figures of run files: the only importer of matplotlib, and only inside a call.

A figure is one or several functions of a run file that may be called side by side. Each gives
figures by the name that is added to the run's, "" for the first one. Whatever is drawn from a
simulated bench says so in the picture.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.figures.style import Together

FIGURES = {
    "sweep": ("rig.figures.sweep:draw_data", "rig.figures.sweep:draw_model"),
    "slip_trial": ("rig.figures.slip_trial:draw_trials",),
    "roll_trial": ("rig.figures.roll_trial:draw_trials",),
    "import": ("rig.figures.imported:draw_recording",),
}
"""The functions by the figure's name: known before anything heavy is imported."""


def draw(name: str, run_file: Path, folder: Path | None = None) -> list[Path]:
    """Draw the figures of a run file as PNG and SVG, in the folder or beside it; their paths."""
    if name not in FIGURES:
        raise ConfigurationError(f"{run_file}: there is no figure for a {name}")
    return [path for part in FIGURES[name] for path in draw_part(part, run_file, folder)]


def draw_part(
    part: str, run_file: Path, folder: Path | None = None, together: Together | None = None
) -> list[Path]:
    """Draw what one of the functions gives; `together` may draw the pictures side by side."""
    from rig.figures.style import one_by_one, save
    from rig.files.runfile.reader import RunFile

    beside = run_file if folder is None else folder / run_file.name
    module, _, function = part.partition(":")
    draw_figures = getattr(import_module(module), function)
    with RunFile.open(run_file) as run:
        return [
            path
            for added, figure in draw_figures(run).items()
            for path in save(
                figure,
                beside.with_stem(beside.stem + added),
                bool(run.outcome.simulated),
                together or one_by_one,
            )
        ]


def draw_processed(file: Path, folder: Path | None = None) -> list[Path]:
    """Draw what a processed file holds as PNG and SVG, in the folder or beside it; their paths."""
    from rig.figures.processed import draw_trials
    from rig.figures.style import save
    from rig.files.processed.reader import ProcessedFile

    beside = file if folder is None else folder / file.name
    with ProcessedFile.open(file) as processed:
        simulated = bool(processed.source.simulated)
        return [
            path
            for added, figure in draw_trials(processed).items()
            for path in save(figure, beside.with_stem(beside.stem + added), simulated)
        ]
