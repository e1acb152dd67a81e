"""The static force under a vibration, read from frames that do not hold whole cycles."""

import numpy as np
import pytest

from rig.analysis.response.static_force import static_force

RATE_HZ = 1000.0


def frames(n, frequency_Hz, load_N, noise_N=0.002, phase=0.7, seed=0):
    """Means over 1 ms of 25 N and a vibration, with the sensor's noise."""
    fine_s = (np.arange(20 * n) + 0.5) / (20 * RATE_HZ)
    force = 25 + load_N * np.cos(2 * np.pi * frequency_Hz * fine_s + phase)
    noise = np.random.default_rng(seed).standard_normal(n)
    return force.reshape(n, 20).mean(axis=1) + noise_N * noise


def test_a_vibration_is_no_static_force():
    """50 ms of 25.18 Hz read 23.4 N as their mean."""
    at_25_Hz = frames(50, 25.18, 10.0, phase=2.3)
    assert abs(at_25_Hz.mean() - 25) > 0.5
    assert static_force(at_25_Hz, RATE_HZ, 25.18, 10.0)[0] == pytest.approx(25, abs=0.01)


@pytest.mark.parametrize("frequency_Hz", [25.18, 254.89, 482.0, 500.0, 747.7, 893.4, 964.6, 1082.3])
@pytest.mark.parametrize("n", [7, 14, 50])
def test_the_stated_error_covers_the_error(frequency_Hz, n):
    if frequency_Hz * n < RATE_HZ:
        return  # A record holds one cycle at least.
    errors, stated = [], []
    for seed in range(40):
        phase = 2 * np.pi * seed / 40
        found = static_force(
            frames(n, frequency_Hz, 10.0, phase=phase, seed=seed), RATE_HZ, frequency_Hz, 10.0
        )
        errors.append(found[0] - 25)
        stated.append(found[1])
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * np.sqrt(np.mean(np.square(stated)))
    assert max(stated) < 1.0
