"""All figures of the program's own files are legible in one column of a journal."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import pytest
from legible import faults, words
from matplotlib.figure import Figure
from recorded import FAST_SLIDE, FITTED_SWEEP, ROLL, SWEEP, TWO_SLIDES, unpack
from tiers import mostly_thorough

from rig.figures import style
from rig.figures.drawing import draw


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Figure]:
    """Every figure that the registered functions draw of the recorded files, laid out as they are
    saved, by the name of its picture."""
    folder = unpack(tmp_path_factory.mktemp("runs"))
    figures: dict[str, Figure] = {}

    def keep(figure: Figure, file: Path, simulated: bool, pdf: bool = False) -> list[Path]:
        assert simulated
        style.mark_simulated(figure)
        figures[file.stem.split("_", 1)[1]] = figure
        return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "save", keep)
        for name in (SWEEP, FITTED_SWEEP, FAST_SLIDE, TWO_SLIDES, ROLL):
            assert draw(folder / name).warnings == ()
    return figures


NAMES = (
    "sweep_r001", "sweep_r004", "sweep_r004-gain", "sweep_r004-linearity", "sweep_r004-readings",
    "slip-trial_r002", "slip-trial_r003", "slip-trial_r003-trial-002", "slip-trial_r003-series",
    "roll-trial_r004",
)  # fmt: skip
MANIFOLD = ("sweep_r004-gain", "slip-trial_r003-trial-002", "roll-trial_r004")
"""A figure of each procedure, those with the most in them."""


def test_these_are_all_of_them(drawn: dict[str, Figure]) -> None:
    assert set(drawn) == set(NAMES)


@pytest.mark.parametrize("name", mostly_thorough(NAMES, default=MANIFOLD))
def test_a_figure_is_legible_at_84_mm(drawn: dict[str, Figure], name: str) -> None:
    with mpl.rc_context(style.STYLE):
        assert faults(drawn[name]) == []


@pytest.mark.parametrize("name", mostly_thorough(NAMES, default=MANIFOLD))
def test_a_figure_is_understood_without_its_file(drawn: dict[str, Figure], name: str) -> None:
    said = words(drawn[name])
    sample = "film-A" if name.startswith("sweep") else "KE12-1"
    conditions = {
        "sweep": ("simulated film 0", "0.5, 2 N peak load", "25 N preload"),
        "slip-trial": ("4 N", "object: plate", "mm/s", "start 10 mm"),
        "roll-trial": ("4 N", "object: semi-spherical", "2 deg", "start -5 mm"),
    }[name.partition("_")[0]]
    day = "2026-11-30" if name.startswith("sweep_r004") else "2026-11-25"
    for text in ("SIMULATED", f"sample {sample}", "bench simulated", day, *conditions):
        assert text in said.replace("\n", " ")


def test_the_checks_find_what_they_are_for() -> None:
    figure = style.column_figure(50)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], label="a long name of a curve")
    axes.legend(loc="center")
    axes.text(0.1, 0.8, "small", fontsize=4)
    axes.text(0.1, 0.6, "one")
    axes.text(0.1, 0.6, "other")
    axes.text(0.9, 0.1, "beyond the right edge of the picture")
    found = faults(figure)
    for text in (
        "'small' is set in 4 pt",
        "'one' is written on 'other'",
        "'beyond the right edge of the picture' leaves the picture",
        "a curve runs through the legend 'a long name of a curve'",
    ):
        assert any(fault.startswith(text) for fault in found), found
    assert faults(Figure(figsize=(7.2, 2)))[0] == "it is 182.9 mm wide"
