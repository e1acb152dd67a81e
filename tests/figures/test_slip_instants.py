"""When a trial slipped, by three accounts that are distinguished."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import matplotlib as mpl
import numpy as np
import pytest
from legible import faults, words
from matplotlib.figure import Figure
from recorded import FAST_SLIDE, ROLL, unpack

from rig.analysis.trial.friction import FrictionError
from rig.detector.events import SlipEvent
from rig.detector.registered import chosen_detector
from rig.figures import style
from rig.figures.path_trial import strokes_of
from rig.figures.slip_instants import (
    DETECTED,
    MEASURED,
    ROWS_LEFT,
    TRUE,
    Detections,
    RidgeSlip,
    SlipInstants,
    TrueSlips,
    detections_of,
    draw_rows,
    instants_of,
    mark,
    measured_slip,
    true_slips,
)
from rig.figures.slip_trial import draw_trial
from rig.files.journal.detections import Detection, to_text
from rig.files.runfile.reader import RunFile
from rig.processing.detection import DetectionJob, DetectionResult, detect_file

TRIAL = "trial-001"
TRUTH = {
    "ridge": 3, "record_begun_us": 1_000_000, "slide_us": 2_000_000,
    "first_slip_us": [None, 2_100_000, 2_150_000, 2_050_000, None],
    "whole_slip_us": [None, 2_200_000, 2_300_000, None, None], "gross_slip_us": 9_000_000,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpack(tmp_path_factory.mktemp("runs"))


def test_the_worlds_account_has_the_neighbours_and_nothing_after_the_record() -> None:
    found = true_slips({"simulated_truth": json.dumps(TRUTH)}, record_s=3.0)
    assert found is not None
    rounded = [(s.ridge, round(s.first_node_s or 0, 6), s.whole_s) for s in found.ridges]
    assert rounded == [(2, 1.1, 1.2), (3, 1.15, 1.3), (4, 1.05, None)]
    assert found.gross_s is None
    assert found.whole_s == pytest.approx(1.3)
    assert true_slips({}, record_s=3.0) is None, "a real bench has no true slips"


def test_measured_detected_and_true_slips_of_a_slide_lie_where_its_file_has_them(
    folder: Path,
) -> None:
    with RunFile.open(folder / FAST_SLIDE) as run:
        series = {w.stream: w for w in run.waveforms(TRIAL)}
        slide = float(run.column("slide_from")[0]), float(run.column("slide_to")[0])
        found = instants_of(run, 0, series, detections_of(run)[TRIAL], slide)
    assert found.true is not None
    whole_s, gross_s = found.true.whole_s, found.true.gross_s
    assert whole_s is not None
    assert gross_s is not None
    assert found.detected.detector.startswith("paper-hp ")
    assert found.detected.detector.endswith(" (default)"), "this file is from before live detection"
    # The detector sees the ridge with the strips slip; F_t is largest at gross slip.
    assert found.detected.slip_s == pytest.approx(whole_s, abs=0.02)
    assert found.measured_s == pytest.approx(gross_s, abs=0.03)


def test_a_processed_file_is_believed_before_the_default_detector(
    folder: Path, tmp_path: Path
) -> None:
    run_file = tmp_path / FAST_SLIDE
    run_file.write_bytes((folder / FAST_SLIDE).read_bytes())
    result = detect_file(DetectionJob(run_file, chosen_detector("paper-literal")))
    assert isinstance(result, DetectionResult)
    with RunFile.open(run_file) as run:
        found = detections_of(run)[TRIAL]
    assert found.detector.startswith("paper-literal ")
    assert found.detector.endswith(" (processed)")


def test_a_file_whose_strips_cannot_be_judged_says_why_and_is_drawn_all_the_same(
    folder: Path,
) -> None:
    why = Detections(why_not="strips of another rate")
    with RunFile.open(folder / FAST_SLIDE) as run:
        figure = draw_trial(run, 0, TRIAL, why)
    assert "detected: strips of another rate" in words(figure)


def test_what_the_trial_itself_recorded_is_shown_as_live() -> None:
    found = to_text([Detection("incipient slip", 1250, 1.25, 1.26, 0.7)])
    columns = {"detector": ["paper-hp", "paper-hp"], "detections": [found, "[]"]}
    run = SimpleNamespace(
        path=Path("nowhere/run.h5"), columns=lambda: list(columns), column=columns.__getitem__,
        point_ids=lambda: ["trial-001", "trial-002"],
    )  # fmt: skip
    first, second = detections_of(cast("RunFile", run)).values()
    assert (first.detector, first.slip_s) == ("paper-hp (live)", 1.25)
    assert (second.detector, second.slip_s) == ("paper-hp (live)", None)


def rows_of(instants: SlipInstants) -> list[str]:
    axes = Figure().subplots()
    draw_rows(axes, instants, (1.0, 1.3))
    return [text.get_text() for text in (*axes.get_yticklabels(), *axes.texts)]


def test_each_account_has_a_row_and_a_real_bench_no_true_ones() -> None:
    slip = SlipEvent("incipient slip", 1250, 1.25, 0.7)
    detected = Detections("paper-hp 1 (default)", (slip,))
    true = TrueSlips(3, (RidgeSlip(2, 1.1, 1.2), RidgeSlip(3, 1.15, None)), 1.4)
    assert rows_of(SlipInstants(true, 1.35, detected)) == [
        "true, ridge 2", "true, ridge 3", "true, gross", "measured", "detected",
        "1.200 s", "never whole", "1.400 s →", "1.350 s →", "1.250 s",
    ]  # fmt: skip
    assert rows_of(SlipInstants(None, 0.9, Detections(why_not="no strips"))) == [
        "measured", "detected", "← 0.900 s",
    ]  # fmt: skip
    assert rows_of(SlipInstants(detected=Detections("x"))) == [
        "measured", "detected", "not evaluated", "none",
    ]  # fmt: skip
    assert rows_of(SlipInstants(measurable=False, detected=Detections("x"))) == ["detected", "none"]


def test_the_lines_of_the_accounts_differ_in_colour_and_dashes() -> None:
    axes = Figure().subplots()
    slip = SlipEvent("incipient slip", 1250, 1.25, 0.7)
    true = TrueSlips(3, (RidgeSlip(3, 1.15, 1.24),), None)
    mark((axes,), SlipInstants(true, 1.35, Detections("x", (slip,))))
    assert [(line.get_xdata()[0], line.get_color()) for line in axes.lines] == [
        (1.24, TRUE), (1.35, MEASURED), (1.25, DETECTED),
    ]  # fmt: skip
    assert len({str(line._dash_pattern) for line in axes.lines}) == 3


SLIPS_S = (1.2, 1.5, 1.9, 2.4)
"""Of a stick-slip, a re-grip or a path to and fro; each lasts 50 ms."""


def several_slips() -> SlipInstants:
    """A record of several slips, each detected 4 ms later, of which the forces show two."""
    events = [SlipEvent("incipient slip", 0, at_s + 0.004, 0.7) for at_s in SLIPS_S]
    later = tuple((at_s, at_s + 0.05) for at_s in SLIPS_S[1:])
    ridges = (RidgeSlip(2, 1.1, 1.15), RidgeSlip(3, 1.12, SLIPS_S[0]), RidgeSlip(4, 1.15, 1.25))
    true = TrueSlips(3, ridges, 1.3, later)
    detected = Detections("paper-hp 3 (default)", tuple(events))
    return SlipInstants(true, 1.3, detected, later_measured_s=(1.98,))


def test_the_world_records_every_slip_of_the_ridge_with_the_strips() -> None:
    slips = {
        "ridge_slip_begins_us": [2_300_000, 2_500_000, 3_900_000, 4_200_000],
        "ridge_slip_ends_us": [2_350_000, 2_600_000],
    }
    found = true_slips({"simulated_truth": json.dumps(TRUTH | slips)}, record_s=3.0)
    assert found is not None
    assert found.whole_s == pytest.approx(1.3)
    rounded = [(round(begin_s, 6), round(end_s, 6)) for begin_s, end_s in found.later]
    assert rounded == [(1.5, 1.6), (2.9, 3.0)], "the last is not over, one came after the record"


def test_every_slip_of_a_record_is_marked_in_its_accounts_row_and_band() -> None:
    """The figure of a path trial had the true times of its first slip only."""
    axes = Figure().subplots()
    draw_rows(axes, several_slips(), (1.0, 3.0))
    names = [label.get_text() for label in axes.get_yticklabels()]
    written = [text.get_text() for text in axes.texts]
    assert written == ["1.150 s", "4 ×", "1.250 s", "1.300 s", "2 ×", "4 ×"]
    assert all(text.get_bbox_patch() for text in axes.texts), "a bar strikes none through"

    def marked_s(name: str, marker: str) -> set[float]:
        lines = [line for line in axes.lines if line.get_marker() == marker]
        row = names.index(name)
        return {
            float(x) for line in lines for x, y in zip(*line.get_data(), strict=True) if y == row
        }

    assert marked_s("true, ridge 3", "o") == set(SLIPS_S)
    assert marked_s("measured", "v") == {1.3, 1.98}
    assert marked_s("detected", "^") == {at_s + 0.004 for at_s in SLIPS_S}
    axes = Figure().subplots()
    mark((axes,), several_slips())
    for colour, count in ((TRUE, 4), (MEASURED, 2), (DETECTED, 4)):
        lines = [line for line in axes.lines if line.get_color() == colour]
        assert len(lines) == count
        assert len({tuple(line.get_ydata()) for line in lines}) == 1
    bands = sorted({tuple(line.get_ydata()) for line in axes.lines})
    assert all(high <= low for (_, high), (low, _) in itertools.pairwise(bands)), "none hides one"


def test_several_slips_are_legible_at_84_mm() -> None:
    with mpl.rc_context(style.STYLE):
        figure = style.column_figure(70)
        above, rows = figure.subplots(2, 1, sharex=True)
        above.plot([1.0, 3.0], [0.0, 0.0])
        draw_rows(rows, several_slips(), (1.0, 3.0))
        mark((above,), several_slips())
        style.letter([above, rows])
        style.set_margins(figure, top=0.3, gap_mm=12.0, left=ROWS_LEFT)
        assert faults(figure) == []


def test_a_stroke_is_a_motion_in_one_direction() -> None:
    settings = {
        "path_times_s": (0.0, 0.5, 1.0, 1.5, 2.0, 2.5),
        "path_positions_mm": (0.0, 0.2, 0.4, 0.4, 0.0, 0.1),
    }
    run = cast("RunFile", SimpleNamespace(settings=settings))
    assert strokes_of(run, 3.0) == [(3.0, 4.0), (4.5, 5.0), (5.0, 5.5)]
    assert strokes_of(cast("RunFile", SimpleNamespace(settings={})), 3.0) == []


def test_the_forces_show_the_slip_of_each_stroke_to_and_fro() -> None:
    """F_t rises to 0.7 F_n, slides at 0.65 F_n, and goes the other way after the turn."""
    t = np.arange(1200) / 1000.0
    x_mm = np.where(t < 0.6, t, 1.2 - t)
    rises = np.clip(4.0 * np.minimum(t, 0.6), 0.0, 0.7)
    rises[t > 0.2] = 0.65
    falls = np.maximum(0.65 - 4.0 * (t - 0.6), -0.7)
    falls[t > 0.6 + 1.37 / 4.0 + 0.02] = -0.65
    noise = 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    dragging = 4.0 * (np.where(t < 0.6, rises, falls) + noise)

    def stream(rate_Hz: float | None, **values: Any) -> Any:
        return SimpleNamespace(rate_Hz=rate_Hz, values=values.__getitem__)

    series = {
        "force": stream(1000.0, F_n=np.full(t.size, 4.0), F_t=dragging),
        "position": stream(None, x=x_mm),
        "ticks": stream(None, elapsed=t),
    }
    first, second = measured_slip(series, 0.0, 0.599), measured_slip(series, 0.6, 1.199)
    assert first == pytest.approx(0.2, abs=0.03)
    assert second == pytest.approx(0.6 + 1.37 / 4.0, abs=0.03)
    # Stopped soon after the peak the stroke does not determine it, which is not "no slip".
    with pytest.raises(FrictionError, match="samples of steady sliding"):
        measured_slip(series, 0.0, 0.25)
    run = SimpleNamespace(readings=lambda: [{}])
    signals = SimpleNamespace(rate_Hz=1000.0, counts={"v_d": t})
    instants = instants_of(
        cast("RunFile", run), 0, series | {"signals": cast("Any", signals)}, Detections("x"),
        (0.0, 0.25),
    )  # fmt: skip
    (measured,) = (text for text in rows_of(instants) if text.startswith("not evaluated"))
    assert re.fullmatch(r"not evaluated: only \d+ samples of steady sliding", measured)


def test_the_slip_is_enlarged_with_p_a_the_neighbours_slip_and_p_b(folder: Path) -> None:
    with RunFile.open(folder / FAST_SLIDE) as run:
        figure = draw_trial(run, 0, TRIAL, detections_of(run)[TRIAL])
        true = true_slips(run.readings()[0], 60.0)
        begin_s = float(run.column("slide_from")[0])
    assert true is not None
    assert "lines as in (g)" in figure.axes[0].get_title(loc="left")
    zoom = next(axes for axes in figure.axes if "enlarged" in axes.get_title(loc="left"))
    first, last = zoom.get_xlim()
    assert last - first == pytest.approx(0.3)
    assert first <= begin_s, "P_A is seen from its begin"
    written = {text.get_text(): text for text in zoom.texts}
    assert {"$P_A$ (slow pattern)", "$P_B$", "ridge 2 slips\n(true)"} <= set(written)
    neighbour = next(slip.whole_s for slip in true.ridges if slip.ridge == 2)
    assert written["ridge 2 slips\n(true)"].xy[0] == pytest.approx(neighbour)
    p_a, p_b = (written[name].xy[0] for name in ("$P_A$ (slow pattern)", "$P_B$"))
    assert p_a < p_b
    assert p_b == pytest.approx(true.whole_s, abs=0.02)


def test_a_roll_shows_warnings_and_no_slip(folder: Path) -> None:
    with RunFile.open(folder / ROLL) as run:
        assert detections_of(run)[TRIAL].slip_s is None
