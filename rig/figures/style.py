"""How every figure looks and is kept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.constrained_layout.use": True,
    "svg.hashsalt": "tactile-rig",
    "savefig.dpi": 150,
}


def save(figure: Figure, run_file: Path, simulated: bool) -> list[Path]:
    """Write the figure as PNG and SVG beside its run file, marked where it is simulated."""
    import matplotlib as mpl

    if simulated:
        figure.text(
            0.5,
            0.5,
            "SIMULATED",
            fontsize=48,
            color="0.5",
            alpha=0.15,
            ha="center",
            va="center",
            rotation=20,
        )
    saved = []
    with mpl.rc_context(STYLE):
        for suffix, metadata in ((".png", {}), (".svg", {"Date": None})):
            path = run_file.with_suffix(suffix)
            figure.savefig(path, metadata=metadata)
            saved.append(path)
    return saved
