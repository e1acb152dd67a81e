"""docs/figures.md describes every figure that the program draws of files."""

from importlib.metadata import entry_points
from pathlib import Path

from rig.core.entry_points import OWN_PACKAGE
from rig.core.file_entry_points import FIGURES

DOCUMENTS = Path(__file__).parents[2] / "docs"
PICTURES = ("sweep", "linearity", "slip-trial", "roll-trial", "series", "overlay")
MOST_BYTES = 200_000


def test_every_figure_that_the_program_declares_is_described() -> None:
    text = (DOCUMENTS / "figures.md").read_text("utf-8")
    table = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    described = {
        name for cell in table for name in cell.replace("`", "").replace(" ", "").split(",")
    }
    declared = {
        entry.name
        for entry in entry_points(group=FIGURES)
        if entry.dist is not None and entry.dist.name == OWN_PACKAGE
    }
    assert declared
    assert declared <= described, f"not described: {declared - described}"


def test_its_pictures_are_there_and_small() -> None:
    text = (DOCUMENTS / "figures.md").read_text("utf-8")
    for name in PICTURES:
        picture = DOCUMENTS / "images" / f"figure-{name}.png"
        assert f"images/{picture.name}" in text
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size < MOST_BYTES
