"""Several runs of one kind in one figure."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from importlib import invalidate_caches
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import recorded_trials as trials
from legible import faults
from matplotlib.axes import Axes
from recorded import FAST_SLIDE, ROLL, SWEEP, TWO_SLIDES, unpack

from rig.core.errors import ConfigurationError
from rig.figures.overlay import (
    _in_words,
    draw_overlay,
    draw_rolls,
    draw_slips,
    draw_sweeps,
    names_of,
    trials_in_words,
)
from rig.figures.slip_instants import true_slips
from rig.figures.style import STYLE
from rig.files.runfile.reader import RunFile


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpack(tmp_path_factory.mktemp("runs"))


def legend(axes: Axes) -> list[str]:
    shown = axes.get_legend()
    assert shown is not None
    return [text.get_text() for text in shown.get_texts()]


def test_slides_are_aligned_where_the_ridge_slips_and_named_by_what_differs(folder: Path) -> None:
    with RunFile.open(folder / FAST_SLIDE) as fast, RunFile.open(folder / TWO_SLIDES) as two:
        figure = draw_slips([fast, two])
        record = next(fast.waveforms("trial-001", stream="signals"))
        true = true_slips(fast.readings()[0], 60.0)
    assert true is not None
    assert true.whole_s is not None
    difference, tangential, _ = figure.axes
    assert legend(difference) == [
        "speed 1 mm/s, distance 0.3 mm",
        "speed 0.7 mm/s, distance 0.25 mm",
    ]
    assert figure.axes[-1].get_xlabel() == "Time since the whole ridge slipped (true) (s)"
    curves = [line for line in difference.get_lines() if len(line.get_xdata()) > 2]
    assert len(curves) == 3, "both trials of the second run"
    t, v_d = curves[0].get_data()
    np.testing.assert_allclose(t[0], -true.whole_s)
    np.testing.assert_allclose(v_d, 1e3 * record.values("v_d"))
    assert curves[1].get_color() == curves[2].get_color() != curves[0].get_color()
    for axes in (difference, tangential):
        assert axes.get_xlim()[1] == pytest.approx(0.25)
    with mpl.rc_context(STYLE):
        assert faults(figure) == []


def test_every_load_of_a_sweep_has_a_curve_and_its_difference_to_the_first(folder: Path) -> None:
    with RunFile.open(folder / SWEEP) as run:
        figure = draw_sweeps([run, run])
        frequency, gain, load = (run.column(n) for n in ("frequency", "gain", "load_set"))
    gains, differences = figure.axes
    stem = Path(SWEEP).stem
    assert legend(gains) == [f"{stem}, {n:g} N peak" for n in (0.5, 2, 0.5, 2)], "nothing differs"
    _, second = differences.get_lines()[:2]
    assert len(second.get_xdata()) == 10
    expected = [
        float((gain[(frequency == f) & (load == 2)] - gain[(frequency == f) & (load == 0.5)])[0])
        for f in second.get_xdata()
    ]
    np.testing.assert_allclose(second.get_ydata(), expected)
    with mpl.rc_context(STYLE):
        assert faults(figure) == []


def test_rolls_are_drawn_over_the_angle(folder: Path) -> None:
    with RunFile.open(folder / ROLL) as run:
        figure = draw_rolls([run, run])
    there, back = figure.axes[0].get_lines()[:2]
    assert np.max(there.get_xdata()) == pytest.approx(2.0, abs=0.05)
    assert there.get_xdata()[0] == pytest.approx(0.0, abs=0.05)
    assert back.get_xdata()[-1] == pytest.approx(0.0, abs=0.05)
    assert there.get_linestyle() != back.get_linestyle()


def test_invalid_trials_are_drawn_and_counted(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found by an attack: nothing in an overlay said that a trial in it is invalid."""
    with RunFile.open(folder / ROLL) as run:
        assert trials_in_words([run, run]) == "2 trials"
        column = run.column
        monkeypatch.setattr(
            run, "column", lambda name: ["force error"] if name == "invalid" else column(name)
        )
        heading = draw_rolls([run, run]).texts[0].get_text()
    assert "2 roll runs, 2 trials, 2 of them invalid" in heading


def test_a_setting_that_another_version_lacks_is_no_difference(folder: Path) -> None:
    with RunFile.open(folder / FAST_SLIDE) as fast, RunFile.open(folder / TWO_SLIDES) as old:
        for name in ("distance_mm", "rest_s"):
            del old.header.settings[name]
        assert names_of([fast, old]) == ["speed 1 mm/s", "speed 0.7 mm/s"]


def test_a_name_with_dollar_signs_is_shown_as_it_is(folder: Path) -> None:
    """It was read as a formula: `rig show --overlay` ended with a traceback."""
    with RunFile.open(folder / SWEEP) as first, RunFile.open(folder / SWEEP) as second:
        first.header.settings["price"] = r"5 $\frac{5$"
        second.header.settings["price"] = "none"
        figure = draw_sweeps([first, second])
    figure.draw_without_rendering()
    shown = legend(figure.axes[0])[0]
    assert shown.replace(r"\$", "$").startswith(r"price 5 $\frac{5$, 0.5 N peak")
    assert r"\$" in shown


def test_names_that_are_too_long_for_a_legend_are_replaced_by_those_of_the_files(
    folder: Path,
) -> None:
    with RunFile.open(folder / SWEEP) as first, RunFile.open(folder / SWEEP) as second:
        first.header.settings["remark"] = "what a student typed in on a long afternoon"
        second.header.settings["remark"] = "none"
        assert names_of([first, second]) == [Path(SWEEP).stem] * 2
        figure = draw_sweeps([first, second])
    with mpl.rc_context(STYLE):
        assert faults(figure) == []


def test_names_that_would_be_too_long_with_their_files_are_those_of_the_files(folder: Path) -> None:
    with ExitStack() as stack:
        runs = [stack.enter_context(RunFile.open(folder / SWEEP)) for _ in range(3)]
        for run, remark in zip(runs, ("dry", "wiped with acetone", "dry"), strict=True):
            run.header.settings["remark"] = remark
        assert names_of(runs) == [Path(SWEEP).stem] * 3
        for run in runs:
            run.header.settings["remark"] = run.header.settings["remark"][:1]
        assert names_of(runs)[1] == f"remark w, {Path(SWEEP).stem}"


def test_files_of_one_name_are_distinguished_by_their_folders(folder: Path, tmp_path: Path) -> None:
    paths = []
    for day in ("2026-11-13", "2026-11-14"):
        (tmp_path / day).mkdir()
        paths.append(shutil.copy(folder / SWEEP, tmp_path / day / "a.h5"))
    paths.append(shutil.copy(folder / SWEEP, tmp_path / "b.h5"))
    with ExitStack() as stack:
        runs = [stack.enter_context(RunFile.open(path)) for path in paths]
        assert names_of(runs) == ["2026-11-13/a", "2026-11-14/a", "b"]


@pytest.mark.thorough
def test_the_picture_has_a_name_of_its_own_each_time(folder: Path, tmp_path: Path) -> None:
    files = [folder / ROLL, shutil.copy(folder / ROLL, tmp_path / "another.h5")]
    first = draw_overlay(files, tmp_path).files
    before = first[0].read_bytes()
    second = draw_overlay(files, tmp_path, pdf=True).files
    stem = Path(ROLL).stem
    assert [path.name for path in first] == [f"{stem}-overlay.png", f"{stem}-overlay.svg"]
    assert [path.name for path in second] == [
        f"{stem}-overlay-2{kind}" for kind in (".png", ".svg", ".pdf")
    ]
    assert first[0].read_bytes() == before
    assert "SIMULATED" in first[1].read_text("utf-8")


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ([ROLL, SWEEP], "is a roll-trial, .* is a sweep"),
        ([ROLL], "several runs in one figure"),
        ([ROLL, ROLL], "is named twice"),
    ],
)
def test_what_cannot_be_laid_over_each_other_is_refused(
    folder: Path, files: list[str], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        draw_overlay([folder / name for name in files])


def test_a_setting_that_is_on_or_off_is_named_in_words() -> None:
    assert _in_words("regrip", True) == "with regrip"
    assert _in_words("regrip", False) == "without regrip"
    assert _in_words("normal_force_N", 4.0) == "normal force 4 N"
    assert _in_words("path_times_s", [0.0, 0.4]) == "path times 0, 0.4 s"
    assert _in_words("force_times_s", []) == "force times none"
    assert _in_words("hold_at_N", None) == "hold at none"


def test_paths_are_named_by_their_times_and_positions_or_by_their_files(folder: Path) -> None:
    """Found in a review: lists were left out, so that two paths were named by their stay."""
    with RunFile.open(folder / FAST_SLIDE) as one, RunFile.open(folder / TWO_SLIDES) as other:
        other.header.settings.clear()
        other.header.settings.update(one.header.settings)
        one.header.settings["path_times_s"] = [0.0, 0.4]
        other.header.settings["path_times_s"] = [0.0, 0.8]
        assert names_of([one, other]) == ["path times 0, 0.4 s", "path times 0, 0.8 s"]
        one.header.settings["stay_s"], other.header.settings["stay_s"] = 2.0, 0.3
        one.header.settings["path_positions_mm"] = [0.0, 0.2]
        other.header.settings["path_positions_mm"] = [0.0, 0.1]
        assert names_of([one, other]) == [Path(FAST_SLIDE).stem, Path(TWO_SLIDES).stem]


def test_a_setting_that_one_run_has_not_set_is_named(folder: Path) -> None:
    with RunFile.open(folder / FAST_SLIDE) as one, RunFile.open(folder / FAST_SLIDE) as other:
        one.header.settings["hold_at_N"], other.header.settings["hold_at_N"] = None, 3.0
        assert names_of([one, other]) == ["hold at none", "hold at 3 N"]


def test_frequencies_and_loads_are_seen_and_not_named(folder: Path) -> None:
    with RunFile.open(folder / SWEEP) as one, RunFile.open(folder / SWEEP) as other:
        one.header.settings["remark"] = "dry"
        other.header.settings.update(remark="wet", frequencies_Hz=[20.0], loads_N=[1.0])
        assert names_of([one, other]) == ["remark dry", "remark wet"]


PACKAGE = """
from matplotlib.figure import Figure

def plain(runs):
    figure = Figure()
    figure.suptitle(" and ".join(run.header.procedure for run in runs))
    return figure

def fails(runs):
    raise RuntimeError("no such column")

def number(runs):
    return 3

def formula(runs):
    figure = Figure()
    figure.suptitle("$\\\\frac{5$")
    return figure
"""


@pytest.fixture
def declare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Declares overlays of a package of a laboratory."""
    info = tmp_path / "site" / "lab_overlays-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lab-overlays\nVersion: 1\n")
    (tmp_path / "site" / "lab_overlays.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))

    def declare(lines: str) -> None:
        (info / "entry_points.txt").write_text(f"[rig.overlays]\n{lines}\n")
        invalidate_caches()

    return declare


def lab_trials(folder: Path) -> list[Path]:
    """Two run files of a procedure that this project does not know."""
    return [
        trials.write_trials(
            folder / f"lab-{n}.rigj", {"trial-1": trials.slipping()}, procedure="lab-trial"
        )
        for n in (1, 2)
    ]


def test_a_package_draws_its_own_procedures_over_each_other(
    declare: Callable[[str], None], tmp_path: Path
) -> None:
    files = lab_trials(tmp_path)
    with pytest.raises(ConfigurationError, match="does not know how to draw a lab-trial"):
        draw_overlay(files)
    declare("lab-trial = lab_overlays:plain\nlab-trial.more = lab_overlays:plain")
    drawn = draw_overlay(files)
    assert [path.name for path in drawn.files if path.suffix == ".png"] == [
        "lab-1-overlay.png",
        "lab-1-overlay-more.png",
    ]
    assert "lab-trial and lab-trial" in drawn.files[1].read_text("utf-8")
    assert drawn.warnings == ()
    again = draw_overlay(files)
    assert again.files[-1].name == "lab-1-overlay-2-more.svg", "nothing is overwritten"


def test_a_packages_overlay_stands_beside_that_of_this_project(
    declare: Callable[[str], None], folder: Path, tmp_path: Path
) -> None:
    declare(
        "sweep = lab_overlays:plain\nsweep.bad = lab_overlays:fails\n"
        "sweep.no = lab_overlays:number\nswep.x = lab_overlays:plain"
    )
    another = shutil.copy(folder / SWEEP, tmp_path / "another.h5")
    drawn = draw_overlay([folder / SWEEP, another], tmp_path)
    assert [path.name for path in drawn.files] == [
        f"{Path(SWEEP).stem}-overlay.png",
        f"{Path(SWEEP).stem}-overlay.svg",
    ]
    stray, own_first, fails, number = drawn.warnings
    assert "the overlay swep.x" in stray
    assert "did you mean sweep?" in stray
    assert "left out: another figure has its file name" in own_first
    assert "of lab-overlays could not be drawn: lab_overlays.py line " in fails
    assert fails.endswith(": RuntimeError: no such column")
    assert "returned int where a Figure is expected" in number


def test_where_every_overlay_fails_the_command_says_why(
    declare: Callable[[str], None], tmp_path: Path
) -> None:
    declare("lab-trial = lab_overlays:fails\nlab-trial.x = lab_overlays:formula")
    with pytest.raises(
        ConfigurationError, match=r"(?s)no overlay was drawn: .*no such column.*frac"
    ):
        draw_overlay(lab_trials(tmp_path))
