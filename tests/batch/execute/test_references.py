"""What a batch learns of references, force zero, disk and calibrations."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from procedures.roll_trial import RollTrial
from procedures.slip_trial import SlipTrial
from procedures.sweep import Sweep
from rig.batch.execute.drift import (
    HoldReason,
    ReferenceRun,
    disk_space,
    expiring,
    judge,
    part_names,
    watched_figures,
    zero_drift,
)
from rig.bench.settings import BenchSettings
from rig.instruments.calibration import CalibrationRecord

GAIN = "gain_near_200_Hz_dB"
S1, S2 = "mean_touch_gain_1_dB", "mean_touch_gain_2_dB"
CLAMP = {"film": "film 'F12' in the clamp"}
SKIN = {"strip_1": "strip 1 of skin 'B'", "strip_2": "strip 2 of skin 'B'"}


def swept(*gains: float | None) -> list[HoldReason]:
    """What the last of some reference sweeps shows; every tenth run is one."""
    runs = [ReferenceRun(1 + 10 * k, {GAIN: gain}) for k, gain in enumerate(gains)]
    return judge(runs[:-1], runs[-1], Sweep.drift, CLAMP)


def tried(first: tuple[float, float], now: dict[str, float]) -> list[HoldReason]:
    before = ReferenceRun(1, {S1: first[0], S2: first[1]})
    return judge([before], ReferenceRun(11, now), SlipTrial.drift, SKIN)


def test_a_gain_that_fell_is_reported_with_its_film_values_tolerance_and_first_run() -> None:
    (found,) = swept(12.1, 5.8)
    assert found.kind == "drift"
    assert found.text == (
        "film 'F12' in the clamp: gain near 200 Hz moved by -6.30 dB (from 12.10 to 5.80 dB; "
        "tolerance 0.5 dB) since run 1: worn or torn"
    )
    assert "replace it" in found.hint


@pytest.mark.parametrize("gains", [(12.1, 12.1), (12.1, 11.61), (12.1, 12.59), (12.1, 11.5, 12.0)])
def test_what_stays_within_the_tolerance_of_the_first_is_no_finding(gains: tuple[float]) -> None:
    assert swept(*gains) == []


def test_a_change_that_has_crept_is_reported_as_wear() -> None:
    (found,) = swept(12.1, 11.8, 11.5)
    assert found.text.endswith("since run 1: worn, little by little")


def test_a_gain_that_is_all_but_gone_is_torn_or_unplugged() -> None:
    (found,) = swept(12.1, 12.0, -31.0)
    assert found.text.endswith(": torn or unplugged")


@pytest.mark.parametrize("missing", [None, float("nan"), float("-inf")])
def test_a_gain_that_is_not_found_any_more_is_reported_with_what_it_was(
    missing: float | None,
) -> None:
    (found,) = swept(12.1, missing)
    assert "gain near 200 Hz could not be found any more (in run 1: 12.10 dB)" in found.text
    assert found.text.endswith(": torn or unplugged")


def test_a_gain_that_rose_is_no_wear() -> None:
    (found,) = swept(12.1, 13.1)
    assert "moved by +1.00 dB" in found.text
    assert "not wear" in found.text


def test_a_reference_that_does_not_have_its_figure_is_reported_at_once_and_only_then() -> None:
    (found,) = swept(None)
    assert found.kind == "no-figure"
    assert GAIN in found.text
    assert swept(None, None) == []
    assert len(swept(None, 12.1, 5.8)) == 1, "the first that has it counts"


def test_one_strip_of_two_is_named() -> None:
    (found,) = tried((-74.0, -72.0), {S1: -74.1, S2: -78.0})
    assert found.text.startswith("strip 2 of skin 'B': gain by touch-down and tap moved by -6.00")
    assert found.text.endswith("worn or torn")


def test_both_strips_that_move_differently_are_reported_each_for_itself() -> None:
    assert len(tried((-74.0, -72.0), {S1: -77.0, S2: -78.0})) == 2


@pytest.mark.parametrize("by_dB", [-3.0, 2.0])
def test_both_strips_that_move_alike_speak_of_what_they_share(by_dB: float) -> None:
    (found,) = tried((-74.0, -72.0), {S1: -74.0 + by_dB, S2: -71.9 + by_dB})
    assert "strip 1" in found.text
    assert "strip 2" in found.text
    assert "amplifier, load cell or force sensor rather than a film" in found.text


@pytest.mark.parametrize("now", [{}, {S1: -110.0, S2: -131.0}, {S2: -131.0}])
def test_both_strips_that_are_gone_speak_of_plugs_and_power(now: dict[str, float]) -> None:
    (found,) = tried((-74.0, -72.0), now)
    assert "unplugged, or an amplifier without power" in found.text


def test_a_figure_that_is_no_level_is_judged_in_its_own_unit() -> None:
    watched = watched_figures({}, {"mean_static_friction": 0.05, "mean_stiffness_N_mm": 10.0})
    before = ReferenceRun(3, {"mean_static_friction": 0.71, "mean_stiffness_N_mm": 140.0})
    now = ReferenceRun(9, {"mean_static_friction": 0.62, "mean_stiffness_N_mm": 145.0})
    (found,) = judge([before], now, watched, SKIN)
    assert found.text == (
        "mean static friction moved by -0.090 (from 0.710 to 0.620; tolerance 0.05) since run 3"
    )


def test_a_tolerance_of_the_batch_file_leaves_a_figure_its_part() -> None:
    watched = watched_figures(SlipTrial.drift, {S2: 2.0})
    assert list(watched) == [S2]
    assert watched[S2].part == "strip_2"
    assert watched[S2].tolerance == 2.0
    assert watched_figures(RollTrial.drift, {}) == RollTrial.drift


def test_parts_have_the_labels_of_the_bench_file() -> None:
    plain = BenchSettings(name="b", fixture={"mounted": "plate"})
    assert part_names(plain)["film"] == "the film in the clamp"
    assert part_names(plain)["strip_2"] == "strip 2 of the skin"
    labelled = BenchSettings(
        name="b",
        fixture={"mounted": "plate"},
        film={"name": "F12"},
        skin={"name": "B", "films": {"strip_1": "film 7"}},
    )
    assert part_names(labelled) == {
        "film": "film 'F12' in the clamp",
        "strip_1": "film 'film 7' in strip 1 of skin 'B'",
        "strip_2": "strip 2 of skin 'B'",
    }


def test_the_axis_whose_zero_moved_most_is_reported() -> None:
    assert zero_drift([0.1, 0.2, 1.77], [0.2, 0.1, 2.77], 1.0) == []
    (found,) = zero_drift([0.1, 0.2, 1.77], [0.3, -1.1, 2.97], 1.0, since_run=4)
    assert found.kind == "force-zero"
    assert "zero along y moved by -1.30 N (from 0.20 to -1.10 N; limit 1 N) since run 4" in (
        found.text
    )


def test_a_disk_is_to_hold_the_rest_of_the_batch_and_what_is_to_be_left() -> None:
    assert disk_space(10e9, 8.9e9, 1.0) == []
    (found,) = disk_space(10e9, 9.2e9, 1.0)
    assert "10 GB free; the rest of the batch takes about 9.2 GB; 1 GB have to remain free" in (
        found.text
    )
    (found,) = disk_space(0.5e9, 0.0, 1.0)
    assert "0.5 GB free; 1 GB" in found.text
    assert "begin a new one" in found.hint, "a batch keeps its folder"


NOW = datetime(2026, 11, 22, 22, 0, tzinfo=UTC)


def record(days: float) -> tuple[Path, CalibrationRecord]:
    fields = {
        "kind": "pvdf",
        "sensor": "film 7",
        "date": NOW - timedelta(days=90),
        "valid_until": NOW + timedelta(days=days),
        "simulated": True,
    }
    return Path("film-7.json"), CalibrationRecord(**fields)


def test_a_record_that_expires_during_the_night_is_reported_and_one_that_lasts_is_not() -> None:
    assert expiring([record(0.5)], NOW, timedelta(hours=11)) == []
    (found,) = expiring([record(0.25), record(2.0)], NOW, timedelta(hours=11))
    assert found.text == (
        "film-7.json: the calibration of 'film 7' of 2026-08-24 expires on 2026-11-23 04:00, "
        "before the run is over (about 2026-11-23 09:00)"
    )
    assert found.hint == (
        "stop the batch, calibrate with `rig calibrate pvdf FILE`, name the new record in the "
        "bench file, then: rig batch resume --despite-changes"
    ), "the batch has the bench, and its own copy of the batch file"
    (found,) = expiring([record(-1.0)], NOW, timedelta(hours=11))
    assert "expired on 2026-11-21 22:00" in found.text
