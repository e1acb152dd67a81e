"""Decimation to 1000 Hz: flat where it should be, nothing folds, the same bytes for every cut."""

import numpy as np
import pytest

from rig.analysis.trial.decimation import Decimator

RATES = [10_000.0, 16_000.0, 20_000.0, 50_000.0]


def decibels(response: np.ndarray) -> np.ndarray:
    return 20 * np.log10(np.abs(response))


@pytest.mark.parametrize("rate", RATES)
def test_the_response_table(rate: float) -> None:
    decimator = Decimator(rate)
    flat = decibels(decimator.response(np.linspace(0, 400, 401)))
    assert np.abs(flat).max() < 0.001
    assert decibels(decimator.response(np.linspace(600, rate / 2 - 1, 5000))).max() < -82.0
    # 500 Hz is where the band folds onto itself; half-way down the transition
    assert decibels(decimator.response(500.0))[0] == pytest.approx(-6.02, abs=0.01)


@pytest.mark.parametrize("rate", RATES)
def test_the_delay_is_that_of_the_low_frequencies(rate: float) -> None:
    decimator = Decimator(rate)
    late = decimator.group_delay_s([0.1, 200.0, 400.0]) * 1e3
    assert decimator.delay_s == pytest.approx(late[0] * 1e-3, rel=1e-4)
    assert late == pytest.approx([2.18, 2.47, 4.38], rel=0.025)


@pytest.mark.parametrize("rate", [10_000.0, 50_000.0])
@pytest.mark.parametrize("tone_Hz", [700.0, 1030.0, 1997.0, 3600.0, 4950.0])
def test_nothing_folds_onto_the_pass_band(rate: float, tone_Hz: float) -> None:
    time = np.arange(round(rate)) / rate
    out = Decimator(rate, 1).add(np.sin(2 * np.pi * tone_Hz * time)[:, None])
    assert np.abs(out[300:]).max() < 10 ** (-81.9 / 20)  # after its transient


def test_tones_of_the_pass_band_keep_their_size() -> None:
    time = np.arange(20_000) / 20_000
    for tone_Hz in (3.0, 50.0, 390.0):
        out = Decimator(20_000.0, 1).add(np.cos(2 * np.pi * tone_Hz * time)[:, None])[500:, 0]
        assert np.sqrt(2 * np.mean(out**2)) == pytest.approx(1.0, rel=2e-3)


def test_blocks_of_any_length_give_the_same_bytes() -> None:
    rng = np.random.default_rng(1)
    samples = rng.normal(0.4, 1.0, (5000, 2))
    whole = Decimator(10_000.0).add(samples)
    cut = Decimator(10_000.0)
    parts, at = [], 0
    while at < len(samples):
        length = int(rng.integers(0, 37))
        parts.append(cut.add(samples[at : at + length]))
        at += length
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    assert len(whole) == 500


def test_it_begins_without_a_step() -> None:
    out = Decimator(10_000.0).add(np.tile([3.0, -7.0], (1000, 1)))
    np.testing.assert_allclose(out, np.tile([3.0, -7.0], (100, 1)), rtol=1e-9)


@pytest.mark.parametrize("at_ms", [100.0, 100.3, 100.9])
def test_a_pulse_is_found_where_it_was(at_ms: float) -> None:
    """Corrected by the delay, the centroid of a pulse of 2 ms is right to a microsecond."""
    time_ms = np.arange(4000) / 20.0
    pulse = np.exp(-(((time_ms - at_ms) / 2.0) ** 2))
    decimator = Decimator(20_000.0, 1)
    out = decimator.add(pulse[:, None])[:, 0]
    found_ms = float((out * np.arange(len(out))).sum() / out.sum()) - decimator.delay_s * 1e3
    assert found_ms == pytest.approx(at_ms, abs=1e-3)


@pytest.mark.parametrize("rate", [1000.0, 9000.0, 10_500.0, 51_000.0])
def test_other_rates_are_refused(rate: float) -> None:
    with pytest.raises(ValueError, match="multiple of 1000 Hz"):
        Decimator(rate)
