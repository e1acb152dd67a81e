"""The filter design that is written out gives what SciPy gives."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import butter

from rig.detector.filter_design import butterworth_high_pass, root_between


@pytest.mark.parametrize("rate_Hz", [500.0, 1000.0, 1024.0, 48e3])
def test_the_high_pass_filter_is_that_of_scipy(rate_Hz: float) -> None:
    for corner_Hz in (0.5, 20.0, 100.0, 113.7, rate_Hz / 4, 0.49 * rate_Hz):
        expected = butter(3, corner_Hz, "highpass", fs=rate_Hz, output="sos")
        found = butterworth_high_pass(corner_Hz, rate_Hz)
        np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("corner_Hz", [0.0, -1.0, 500.0, math.nan])
def test_a_corner_beyond_half_the_rate_is_refused(corner_Hz: float) -> None:
    with pytest.raises(ValueError, match="between 0 and half the sampling rate of 1000 Hz"):
        butterworth_high_pass(corner_Hz, 1000.0)


def test_a_root_is_that_of_scipy_to_the_last_bit() -> None:
    functions = (
        (lambda x: x**3 - 2, 0.0, 5.0),
        (lambda x: math.cos(x) - x, -1.0, 3.0),
        (lambda x: math.exp(-30 * x) - 0.01, 0.0, 10.0),
        (lambda x: math.tanh(50 * (x - 0.3)), -4.0, 1.0),
        (lambda x: x, 0.0, 1.0),
        (lambda x: x - 1, 0.0, 1.0),
    )
    for function, low, high in functions:
        for tolerance in (1e-3, 1e-6, 1e-12):
            expected = brentq(function, low, high, xtol=tolerance)
            assert root_between(function, low, high, tolerance) == expected


def test_what_has_no_change_of_sign_has_no_root() -> None:
    with pytest.raises(ValueError, match="the same sign at 0 and at 1"):
        root_between(lambda x: x + 1, 0.0, 1.0, 1e-9)


def test_a_detector_is_made_without_the_slow_parts_of_scipy() -> None:
    program = (
        "import sys, numpy; from rig.detector.settings import named_detectors;"
        "from rig.detector.detector import IncipientSlipDetector;"
        "IncipientSlipDetector(named_detectors()['rig'], 1000.0).add(numpy.zeros((1, 2)));"
        "print(*{'scipy.signal', 'scipy.optimize', 'scipy.stats'} & sys.modules.keys())"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert ended.stdout.strip() == b""
