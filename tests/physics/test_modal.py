"""The modal system against an independent integration by matrix exponentials."""

import numpy as np
import pytest
from scipy.linalg import expm

from rig.physics.modal import ModalSystem, SineDrive, ZeroPoleGain, lag, resonance
from rig.physics.pvdf import SWEEP_FILM
from rig.physics.vibrator import VibratorOutput, VibratorSettings, drawn_film, vibrator_line

DRIVE = SineDrive(frequency_Hz=770.0, amplitude=1.3, phase_rad=0.4, offset=0.25)


def cascade(sections):
    """State space of sections (numerator, denominator, highest power first) in series."""
    a, b, c, d = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), 1.0
    for numerator, denominator in sections:
        den = np.asarray(denominator, float) / denominator[0]
        num = np.zeros(len(den))
        num[len(den) - len(numerator) :] = np.asarray(numerator, float) / denominator[0]
        n, direct = len(den) - 1, num[0]
        a2 = np.zeros((n, n))
        a2[:-1, 1:] = np.eye(n - 1)
        a2[-1] = -den[:0:-1]
        b2 = np.eye(n)[:, -1:]
        c2 = (num[1:] - direct * den[1:])[::-1][None]
        a = np.block([[a, np.zeros((len(a), n))], [b2 @ c, a2]])
        b = np.concatenate([b, b2 * d])
        c = np.concatenate([direct * c, c2], axis=1)
        d *= direct
    return a, b, c, d


def integrated(sections, drive, t):
    """Outputs from rest by the matrix exponential of system, oscillator and constant together."""
    a, b, c, d = cascade(sections)
    n, w = len(a), 2 * np.pi * drive.frequency_Hz
    whole = np.zeros((n + 3, n + 3))
    whole[:n, :n] = a
    whole[:n, n : n + 1], whole[:n, n + 2 : n + 3] = b, b
    whole[n, n + 1], whole[n + 1, n] = w, -w
    start = np.zeros(n + 3)
    start[n:] = (
        drive.amplitude * np.sin(drive.phase_rad),
        drive.amplitude * np.cos(drive.phase_rad),
        drive.offset,
    )
    scale = np.concatenate([1 / np.maximum(np.abs(np.diag(whole[:n, :n])), 1.0), np.ones(3)])
    balanced = whole / scale[:, None] * scale
    row = (np.concatenate([c[0], [d, 0, d]]) * scale)[None]
    return np.array([(row @ expm(balanced * at) @ (start / scale))[0] for at in t])


def biquad(f, q, level):
    w, g = 2 * np.pi * f, 10 ** (level / 20)
    return [1, w * g / q, w * w], [1, w / q, w * w]


SECTIONS = [biquad(95, 1.3, 6), biquad(512, 11, -14), biquad(2300, 8, -9), ([3e3], [1, 3e3])]
CHAIN = resonance(95, 1.3, 6) * resonance(512, 11, -14) * resonance(2300, 8, -9)
CHAIN = CHAIN * lag(3e3 / (2 * np.pi))


def test_transients_agree_with_the_matrix_exponential():
    system = ModalSystem.from_chains([CHAIN])
    t = np.array([0.0, 1e-5, 3e-4, 1.1e-3, 0.01, 0.0503, 0.2])
    expected = integrated(SECTIONS, DRIVE, t)
    got = system.evaluate(system.rest(), DRIVE, t)[:, 0]
    assert got == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def test_a_bi_proper_system_passes_a_jump_at_once():
    system = ModalSystem.from_chains([resonance(95, 1.3, 6)])
    drive = SineDrive(offset=2.0)
    assert system.evaluate(system.rest(), drive, [0.0])[0, 0] == pytest.approx(2.0, abs=1e-12)


def test_an_even_grid_gives_what_single_times_give():
    line = vibrator_line(*drawn_film(3))
    t = 0.7e-4 + np.arange(40_000) / 250e3
    grid = line.evaluate(line.rest(), DRIVE, t)
    chosen = np.r_[0:700:37, 20_000:40_000:997, 39_999]
    single = line.evaluate(line.rest(), DRIVE, t[chosen])
    scale = np.abs(grid).max(axis=0)
    assert np.all(np.abs(grid[chosen] - single) <= 1e-11 * scale)


def test_advancing_in_pieces_is_evaluating_at_once():
    line = vibrator_line(VibratorSettings(), SWEEP_FILM)
    state, drive = line.rest(), DRIVE
    for interval in (1e-6, 3.3e-4, 0.02, 0.0071):
        state, drive = line.advance(state, drive, interval), drive.after(interval)
    late = np.array([0.0, 1e-4, 0.01])
    whole = line.evaluate(line.rest(), DRIVE, late + 0.027431)
    assert line.evaluate(state, drive, late) == pytest.approx(whole, rel=1e-9, abs=1e-12)


def test_a_change_of_drive_starts_from_the_state_it_found():
    system = ModalSystem.from_chains([lag(10.0)])
    state = system.advance(system.rest(), SineDrive(offset=1.0), 0.02)
    decay = np.exp(-2 * np.pi * 10 * 0.02)
    late = system.evaluate(state, SineDrive(), [0.0, 0.05])[:, 0]
    assert late == pytest.approx((1 - decay) * np.exp(-2 * np.pi * 10 * np.array([0, 0.05])))


def test_steady_state_is_the_response_of_every_chain():
    settings = VibratorSettings()
    line = vibrator_line(settings, SWEEP_FILM)
    t = 30.0 + np.arange(5000) / 250e3
    for f in (2.0, 95.0, 505.0, 9000.0, 20000.0):
        drive = SineDrive(f, 1.0, np.pi / 2)
        settled = line.evaluate(line.settled(drive), drive, t)
        wave = np.exp(2j * np.pi * f * t)
        expected = (wave[:, None] * line.steady_state(f)).real
        assert settled == pytest.approx(expected, abs=1e-8)
        rung_down = line.evaluate(line.rest(), drive, t)
        assert rung_down == pytest.approx(expected, abs=1e-8)


def test_a_transient_counts_until_it_is_below_1e_minus_12():
    system = ModalSystem.from_chains([lag(100.0)])
    drive = SineDrive(offset=1.0)
    for decades in (3, 8, 11):
        t = decades * np.log(10) / (2 * np.pi * 100)
        short_of_one = 1 - system.evaluate(system.rest(), drive, [t])[0, 0]
        assert short_of_one == pytest.approx(10.0**-decades, rel=1e-3)
    gone = system.evaluate(system.rest(), drive, [13 * np.log(10) / (2 * np.pi * 100)])[0, 0]
    assert gone == pytest.approx(1.0, abs=1e-15)


def test_picked_outputs_are_the_columns_asked_for():
    line = vibrator_line(VibratorSettings(), SWEEP_FILM)
    t = np.arange(100) / 250e3
    every = line.evaluate(line.rest(), DRIVE, t)
    picked = line.evaluate(line.rest(), DRIVE, t, [VibratorOutput.FILM, VibratorOutput.CELL])
    assert np.array_equal(picked, every[:, [3, 1]])


def test_ring_down_is_when_the_slowest_mode_is_at_one_per_cent():
    system = ModalSystem.from_chains([lag(5.0), lag(500.0)])
    assert np.exp(-2 * np.pi * 5 * system.ring_down(0.01)) == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("chain", "reason"),
    [
        (lag(10.0) * lag(10.0), "repeated"),
        (ZeroPoleGain((0j,), (), 1.0), "improper"),
        (ZeroPoleGain((), (0j,), 1.0), "unstable"),
        (ZeroPoleGain((), (complex(-1, 1),), 1.0), "conjugate"),
    ],
)
def test_what_has_no_real_partial_fractions_is_refused(chain, reason):
    with pytest.raises(ValueError, match=reason):
        ModalSystem.from_chains([chain])
