"""Filters of finite length: what was asked of them, least delay, the same bytes for every cut."""

import numpy as np
import pytest
import scipy.signal

from rig.detector.fir import StreamingFir, frequency_response, kaiser_low_pass, minimum_phase


def decibels(response):
    return 20 * np.log10(np.abs(response))


@pytest.mark.parametrize("rate", [1000.0, 10_000.0, 50_000.0])
@pytest.mark.parametrize("stop_dB", [40.0, 60.0, 83.0])
def test_a_low_pass_keeps_its_bands(rate, stop_dB):
    taps = kaiser_low_pass(0.08 * rate, 0.12 * rate, stop_dB, rate)
    ripple = 10 ** (-(stop_dB - 1.5) / 20)  # Kaiser's formulas are good to 1.5 dB
    passed = np.abs(frequency_response(taps, np.linspace(0, 0.08, 200) * rate, rate))
    stopped = np.abs(frequency_response(taps, np.linspace(0.12, 0.499, 2000) * rate, rate))
    assert np.abs(passed - 1).max() < 2 * ripple  # its gain is 1 at 0 Hz, not in the middle
    assert stopped.max() < ripple


def test_minimum_phase_keeps_the_magnitude_and_has_the_least_delay():
    taps = kaiser_low_pass(400.0, 600.0, 83.0, 10_000.0)
    least = minimum_phase(taps)
    frequency = np.linspace(0, 4999, 3000)
    before = np.abs(frequency_response(taps, frequency, 10_000.0))
    after = np.abs(frequency_response(least, frequency, 10_000.0))
    np.testing.assert_allclose(after, before, atol=1e-6)
    # of all filters of one magnitude it has let out the most energy at any time
    assert (np.cumsum(least**2) >= np.cumsum(taps**2) - 1e-8).all()
    assert float(least @ np.arange(least.size)) < 0.2 * float(taps @ np.arange(taps.size))


def test_minimum_phase_agrees_with_scipy():
    taps = kaiser_low_pass(60.0, 120.0, 60.0, 1000.0)
    theirs = scipy.signal.minimum_phase(taps, half=False, n_fft=1 << 18)
    np.testing.assert_allclose(minimum_phase(taps), theirs, atol=1e-5)


@pytest.mark.parametrize("every", [1, 3, 10])
def test_blocks_of_any_length_give_the_same_bytes(every):
    rng = np.random.default_rng(2)
    samples, taps = rng.normal(size=(3000, 2)), rng.normal(size=211)
    whole = StreamingFir(taps, 2, every).add(samples)
    for longest in (1, 2, 17, 400):
        cut, parts, at = StreamingFir(taps, 2, every), [], 0
        while at < len(samples):
            length = int(rng.integers(0, longest + 1))
            parts.append(cut.add(samples[at : at + length]))
            at += length
        assert np.concatenate(parts).tobytes() == whole.tobytes()


def test_it_is_the_convolution():
    rng = np.random.default_rng(3)
    samples, taps = rng.normal(size=(500, 1)), rng.normal(size=31)
    samples[0] = 0  # it begins at rest
    expected = np.convolve(samples[:, 0], taps)[:500]
    np.testing.assert_allclose(StreamingFir(taps, 1).add(samples)[:, 0], expected, atol=1e-12)


def test_a_single_tap_passes_through():
    samples = np.arange(10.0)[:, None]
    np.testing.assert_array_equal(StreamingFir([2.0], 1).add(samples), 2 * samples)


def test_another_number_of_channels_is_refused():
    with pytest.raises(ValueError, match=r"must be \(n, 2\)"):
        StreamingFir([1.0], 2).add(np.zeros((3, 1)))
