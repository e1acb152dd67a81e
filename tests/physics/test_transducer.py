"""The chain from stress to volts: the circuit's level, its exact step, the clip, the blocks."""

import numpy as np
import pytest
from scipy.linalg import expm

from rig.physics import transducer
from rig.physics.pvdf import CircuitSettings
from rig.physics.transducer import TransducerChain, TransducerSettings


def test_the_strips_are_those_of_table_1_behind_a_gain_of_1000():
    """20 log10(1000 · 8 mm²) = 78.062 dB above the level of the bare circuit in V/N."""
    response = TransducerSettings().response(np.array([2.0, 20, 200, 2000, 20000]))
    level = 20 * np.log10(np.abs(response)) - 78.062
    assert level == pytest.approx([-83.281, -63.281, -43.281, -23.313, -5.701], abs=2e-3)


@pytest.mark.parametrize("series_ohm", [0.0, 1.0e5, 1.0e6])
def test_a_step_is_exact_for_stress_that_is_linear_between_steps(series_ohm: float):
    circuit = CircuitSettings(series_resistance_ohm=series_ohm)
    settings = TransducerSettings(circuit=circuit, output_limit_V=1e6)
    rng = np.random.default_rng(4)
    corners = np.concatenate([[0.0], rng.normal(0, 1e-3, 30)])
    fine = np.interp(np.arange(0, 30.0001, 0.01), np.arange(31), corners)
    coarse = TransducerChain(settings, 1e-4, 1).advance(corners[:, None])
    dense = TransducerChain(settings, 1e-6, 1).advance(fine[:, None])
    assert coarse[:, 0] == pytest.approx(dense[::100, 0], rel=1e-9, abs=1e-12)


def test_a_slow_sine_has_the_response_of_the_formula():
    settings = TransducerSettings()
    step, frequency = 1e-5, 20.0
    time = np.arange(20000) * step
    stress = 1e-3 * np.sin(2 * np.pi * frequency * time)
    volts = TransducerChain(settings, step, 1).advance(stress[:, None])[:, 0]
    expected = np.abs(settings.response(np.array([frequency])))[0] * 1e-3
    assert np.abs(volts[5000:]).max() == pytest.approx(expected, rel=1e-4)


def test_blocks_of_any_length_give_the_same_bytes():
    stress = np.random.default_rng(1).normal(0, 1e-3, (50, 2))
    whole = TransducerChain(TransducerSettings(), 1e-4).advance(stress)
    chain = TransducerChain(TransducerSettings(), 1e-4)
    parts = [chain.advance(part) for part in np.split(stress, [1, 1, 7, 30])]
    assert np.array_equal(whole, np.concatenate(parts))


def test_the_output_clips_at_its_limit():
    stress = np.outer(np.arange(10), [1.0, -1.0])
    volts = TransducerChain(TransducerSettings(), 1e-4).advance(stress)
    assert volts[-1] == pytest.approx([10.0, -10.0])
    assert np.abs(volts).max() == 10.0


@pytest.mark.parametrize("a", [-300.0, -1.5, -1.0, -0.3, -1e-4, 0.0, 1e-9, 0.7])
def test_a_step_of_one_state_is_the_matrix_exponential(a: float) -> None:
    moved = expm(np.array([[a, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))
    assert transducer._exponentials(a) == pytest.approx(tuple(moved[0]), rel=1e-13)
