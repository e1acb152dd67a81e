"""docs/add-a-figure.md, followed literally."""

from __future__ import annotations

import re
from typing import Any

import pytest
import recorded
from page import Page

from procedures.pressed.record.layout import STREAMS
from rig.figures import style
from rig.files.runfile.reader import RunFile, Waveform

PAGE = "add-a-figure.md"


@pytest.mark.thorough
def test_the_figure_is_drawn_as_the_page_says(rig: Any) -> None:
    page = Page(PAGE, rig)
    assert page.strange_commands() == []
    page.make()
    ended = page.run_rig()
    assert len(ended) == 2
    for command, done in ended.items():
        assert done.code == 0, (command, done.stderr)
        assert "friction-speed" not in done.stderr or "warning" not in done.stderr
    file = rig.only("*.h5")
    for ending in (".png", ".svg", "-friction-speed.png", "-friction-speed.svg"):
        assert (file.parent / f"{file.stem}{ending}").stat().st_size > 10_000
    drawn = (file.parent / f"{file.stem}-friction-speed.svg").read_text("utf-8")
    assert "SIMULATED" in drawn
    assert "Speed of the slide (mm/s)" in drawn


@pytest.mark.thorough
def test_a_figure_that_fails_is_a_warning_and_costs_nothing_else(rig: Any) -> None:
    page = Page(PAGE, rig)
    page.make(('run.column("slide_from")', 'run.column("slid_from")'))
    file = recorded.unpack(rig.folder) / recorded.TWO_SLIDES
    done = rig.run("show", "--figures", str(file))
    assert done.code == 0, done.stderr
    assert "slip-trial.friction-speed (lab_figures.mu_figure:draw) of lab-figures" in done.stderr
    assert "slid_from" in done.stderr
    assert file.with_suffix(".png").exists()
    assert not (file.parent / f"{file.stem}-friction-speed.png").exists()


@pytest.mark.thorough
def test_the_figure_of_several_runs_is_drawn_as_the_page_says(rig: Any) -> None:
    page = Page(PAGE, rig)
    (entry,) = re.findall(
        r'^\[project.entry-points."rig.overlays"\]\n.*\n', page.text, re.MULTILINE
    )
    (function,) = re.findall(r"^```python\n(def draw_several.*?)^```$", page.text, re.M | re.DOTALL)
    (imported,) = re.findall(r"with `(from rig[^`]*)` above", page.text)
    module = "lab_figures/mu_figure.py"
    page.files[module] = page.files[module].replace(
        "\n\n\ndef draw(", f"\n{imported}\n\n\n{function}\n\ndef draw("
    )
    assert "def draw_several" in page.files[module]
    page.files["pyproject.toml"] += f"\n{entry}"
    page.make()
    folder = recorded.unpack(rig.folder)
    names = (recorded.FAST_SLIDE, recorded.TWO_SLIDES)
    done = rig.run("show", "--overlay", *(str(folder / name) for name in names))
    assert done.code == 0, done.stderr
    assert "lab-figures" not in done.stderr
    stem = recorded.FAST_SLIDE.removesuffix(".h5")
    drawn = (folder / f"{stem}-overlay-friction-speed.svg").read_text("utf-8")
    assert "SIMULATED 2 runs" in drawn
    assert "speed 1 mm/s" in drawn
    assert "Time (s)" in drawn
    assert (folder / f"{stem}-overlay.png").exists(), "this project's own is drawn as well"


@pytest.mark.thorough
def test_the_page_s_own_test_passes(rig: Any) -> None:
    page = Page(PAGE, rig)
    page.make()
    tested = page.run_test()
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert "1 passed" in tested.stdout


def test_the_page_s_tables_name_what_there_is(rig: Any) -> None:
    text = Page(PAGE, rig).text
    streams = {stream.name: stream.channels for stream in STREAMS}
    for name in ("signals", "force", "position", "ticks", "strips"):
        channels = ", ".join(f"`{channel}`" for channel in streams[name])
        assert f"| `{name}` | {channels} |" in text
    for name in ("STYLE", "set_margins", "legend_above", "decades", "show_at_least"):
        assert f"`{name}" in text
        assert hasattr(style, name)
    for name in ("point_ids", "columns", "column", "waveforms", "settings", "outcome", "header"):
        assert f"`run.{name}" in text
        assert hasattr(RunFile, name)
    for name in ("stream", "rate_Hz", "units"):
        assert f"samples.{name}`" in text
        assert name in Waveform.__dataclass_fields__
