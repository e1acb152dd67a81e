"""Recordings at other rates than a detector judges are resampled, causally and block by block."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.signal import resample_poly, upfirdn

from rig.detector.registered import chosen_detector
from rig.detector.resampling import (
    DELAY_FEATURE,
    ResampledDetector,
    StreamingResampler,
    ratio_of,
)

RATES_Hz = (500.0, 800.0, 1024.0, 2000.0, 5000.0, 10_000.0, 25_600.0, 44_100.0, 50_000.0)


def trial(rate_Hz: float, seed: int = 0) -> np.ndarray:
    """A slip at 1.5 s, as a film sees it: v_d rises while the skin is sheared and then drops by an
    impulse of some milliseconds; noise of 0.1 mV rms in each kilohertz."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(2.2 * rate_Hz)) / rate_Hz
    shear = 8e-3 * np.clip(t - 0.8, 0, 0.7) / 0.7
    fall = np.where(t > 1.5, np.exp(-(t - 1.5) / 0.2), 1.0)
    impulse = 60e-3 * np.exp(-(((t - 1.503) / 1.5e-3) ** 2) / 2) * np.sin(2 * np.pi * 180 * t)
    v_d = shear * fall + impulse
    noise = 1e-4 * math.sqrt(rate_Hz / 1000) * rng.standard_normal((len(t), 2))
    return np.column_stack([v_d / 2, -v_d / 2]) + noise


@pytest.mark.parametrize("rate_Hz", RATES_Hz)
def test_the_output_does_not_depend_on_the_cutting(rate_Hz: float) -> None:
    volts = np.random.default_rng(1).standard_normal((4000, 2))
    whole = StreamingResampler(rate_Hz, 1000.0, 2).add(volts)
    rng = np.random.default_rng(2)
    cut = StreamingResampler(rate_Hz, 1000.0, 2)
    ends = np.sort(rng.integers(0, len(volts), 60))
    blocks = [cut.add(part) for part in np.split(volts, ends)]
    assert np.concatenate(blocks).tobytes() == whole.tobytes()


@pytest.mark.parametrize("rate_Hz", RATES_Hz)
def test_it_is_scipys_polyphase_filter(rate_Hz: float) -> None:
    resampler = StreamingResampler(rate_Hz, 1000.0, 1)
    ratio = resampler.ratio
    taps = resampler._phases[:, ::-1].T.ravel()  # phase by phase, as upfirdn takes them
    samples = np.random.default_rng(3).standard_normal(3000)
    expected = upfirdn(taps, samples, ratio.up, ratio.down)
    found = resampler.add(samples[:, None])[:, 0]
    first = resampler.outputs - len(found)
    assert resampler.outputs == math.ceil(3000 * ratio.up / ratio.down)
    assert first / resampler.rate_Hz <= 2 * resampler.delay_s + 2e-3
    assert found == pytest.approx(expected[first : resampler.outputs], abs=1e-12)


def test_no_output_depends_on_a_later_row() -> None:
    resampler = StreamingResampler(25_600.0, 1000.0, 1)
    first = resampler.outputs
    for row in range(400):
        found = resampler.add(np.full((1, 1), float(row)))
        due = [k for k in range(first, 20) if resampler.ratio.row_of(k) == row]
        assert len(found) == len(due)


@pytest.mark.parametrize("rate_Hz", RATES_Hz)
def test_an_offset_is_kept_and_makes_no_tone(rate_Hz: float) -> None:
    found = StreamingResampler(rate_Hz, 1000.0, 1).add(np.full((3000, 1), 1.25))
    assert found == pytest.approx(np.full(found.shape, 1.25), abs=1e-12)


def test_what_would_fold_back_is_attenuated_and_what_matters_is_kept() -> None:
    t = np.arange(50_000) / 50_000

    def left(tone_Hz: float) -> float:
        tone = np.sin(2 * np.pi * tone_Hz * t)[:, None]
        out = StreamingResampler(50_000.0, 1000.0, 1).add(tone)[100:, 0]
        return float(np.sqrt(2 * np.mean(out**2)))

    assert left(200.0) == pytest.approx(1.0, abs=0.02)
    assert left(340.0) == pytest.approx(1.0, abs=0.02)
    for folding in (700.0, 900.0, 1200.0, 8300.0):
        assert left(folding) < 0.012, folding  # 40 dB is 0.010


def test_the_delay_that_is_stated_is_the_delay() -> None:
    for rate_Hz in RATES_Hz:
        resampler = StreamingResampler(rate_Hz, 1000.0, 1)
        ramp = np.arange(6000.0)[:, None] / rate_Hz  # in s: the output says when it is from
        found = resampler.add(ramp)[:, 0]
        at = np.arange(resampler.outputs - len(found), resampler.outputs) / resampler.rate_Hz
        # The phases, each of gain 1, differ by a few hundredths of a millisecond.
        assert at - found == pytest.approx(np.full(len(at), resampler.delay_s), abs=5e-5)
        assert resampler.delay_s < (0.0041 if rate_Hz > 1000 else 0.0081)


def test_a_measured_rate_gets_a_ratio_of_small_terms() -> None:
    for rate_Hz in (25_600.7, 51.2e3 / 3, 9999.37, 1013.1):
        ratio = ratio_of(rate_Hz, 1000.0)
        assert ratio.up < 200
        assert rate_Hz * ratio.factor == pytest.approx(1000.0, rel=2e-4)


@pytest.mark.parametrize("name", ["paper-hp"])
def test_the_same_trial_at_any_rate_has_the_same_slips(name: str) -> None:
    slips = {}
    for rate_Hz in (1000.0, 2000.0, 5000.0, 10_000.0, 25_600.0, 50_000.0):
        detector = chosen_detector(name).make(rate_Hz)
        events = [*detector.add(trial(rate_Hz)), *detector.finish()]
        slips[rate_Hz] = [one for one in events if one.kind == "incipient slip"]
        assert all(one.time_s == one.sample / rate_Hz for one in events)
    assert {rate: len(found) for rate, found in slips.items()} == dict.fromkeys(slips, 1)
    at_own = slips[1000.0][0].time_s
    for found in slips.values():
        (slip,) = found
        delay_s = 1e-3 * slip.features.get(DELAY_FEATURE, 0.0)
        assert slip.time_s - delay_s == pytest.approx(at_own, abs=0.003)


@pytest.mark.parametrize("rate_Hz", [5000.0, 44_100.0])
def test_events_do_not_depend_on_the_cutting_with_a_gap(rate_Hz: float) -> None:
    volts, gap = trial(rate_Hz), range(round(0.5 * rate_Hz), round(0.5 * rate_Hz) + 7)

    def events(cuts: list[int]) -> list[object]:
        detector = chosen_detector("paper-hp").make(rate_Hz)
        assert isinstance(detector, ResampledDetector)
        found: list[object] = []
        ends = sorted({0, gap.start, gap.stop, len(volts), *cuts})
        for begin, end in itertools.pairwise(ends):
            if begin != gap.start:
                found += detector.add(volts[begin:end], first_sample=begin)
        assert detector.rows == len(volts)
        return [*found, *detector.finish()]

    whole = events([])
    assert whole == events([n for n in range(0, len(volts), 997) if n not in gap])
    gaps = [one for one in whole if one.reason.startswith("gap")]  # type: ignore[attr-defined]
    assert [one.kind for one in gaps] == ["cannot judge", "judges again"]  # type: ignore[attr-defined]
    assert gap.stop <= gaps[0].sample <= gap.stop + 0.01 * rate_Hz  # type: ignore[attr-defined]


def test_the_noise_of_a_fast_recording_is_no_unrest_at_its_begin() -> None:
    """The first row alone has the noise of the fast rate: held, it was a step of seven times the
    noise that is left, and some recordings were never judged."""
    rate_Hz = 50_000.0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        noise = 1e-4 * math.sqrt(50) * rng.standard_normal((14_000, 2))  # one piece of 0.25 s
        noise[0] = 2e-3, -2e-3
        detector = chosen_detector("rig").make(rate_Hz)
        events = [*detector.add(noise), *detector.finish()]
        assert "cannot judge" not in [one.kind for one in events], seed


def test_saturation_is_not_filtered_away() -> None:
    volts = trial(50_000.0)
    volts[60_000:60_003, 0] = 10.0  # 60 us: filtered, it would be 0.6 V
    detector = chosen_detector("paper-hp").make(50_000.0)
    reasons = [one.reason for one in detector.add(volts)]
    assert "saturated" in reasons


@pytest.mark.parametrize("rate_Hz", [499.0, 50_001.0, 0.0, math.nan])
def test_other_rates_are_refused_with_the_limits(rate_Hz: float) -> None:
    for name in ("paper-hp", "rig"):
        with pytest.raises(ValueError, match="must be between 500 and 50000 Hz"):
            chosen_detector(name).make(rate_Hz)


def test_a_value_that_is_no_number_is_named_by_its_row_of_the_recording() -> None:
    volts = trial(10_000.0)
    volts[12_345, 1] = math.nan
    detector = chosen_detector("paper-hp").make(10_000.0)
    detector.add(volts[:10_000])
    with pytest.raises(ValueError, match="v_2 is nan V at sample 12345"):
        detector.add(volts[10_000:])


def test_the_predictive_signal_has_a_value_for_each_row() -> None:
    """And lags by no more than its own filter, the resampling and one judged row."""
    rate_Hz = 10_000.0
    v_d = np.sin(2 * np.pi * 2 * np.arange(30_000) / rate_Hz)
    fast = chosen_detector("paper-hp").make(rate_Hz).predictive(v_d)
    slow = chosen_detector("paper-hp").make(1000.0).predictive(resample_poly(v_d, 1, 10))
    assert fast.shape == v_d.shape
    delay = round(0.0038 * rate_Hz)
    assert fast[10_000 + delay :: 10][:1500] == pytest.approx(slow[1000:2500], abs=0.02)
