"""Figures of run files: the only importer of matplotlib, and only inside `draw`.

A figure is a module here with a function ``draw(run)`` that gives the figures by the name that is
added to the run's, "" for the first one. Whatever is drawn from a simulated bench says so in the
picture.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from rig.errors import ConfigurationError

FIGURES = {"sweep": "rig.figures.sweep"}


def draw(name: str, run_file: Path) -> list[Path]:
    """Draw the figures of a run file beside it as PNG and SVG; returns their paths."""
    if name not in FIGURES:
        raise ConfigurationError(f"{run_file}: there is no figure for a {name}")
    import matplotlib

    matplotlib.use("Agg")
    from rig.figures.style import save
    from rig.recording.runfile import RunFile

    with RunFile.open(run_file) as run:
        saved = []
        for added, figure in import_module(FIGURES[name]).draw(run).items():
            path = run_file.with_stem(run_file.stem + added)
            saved += save(figure, path, simulated=run.outcome.simulated)
        return saved
