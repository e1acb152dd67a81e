"""When the error of a held force is judged, and over what it is averaged."""

import numpy as np
import pytest

from rig.analysis.trial.force_error import averaged, judged

T = np.arange(100) / 100


def test_what_follows_a_squeeze_is_not_judged_unless_it_is_the_whole_motion():
    assert T[judged(T, (0.2, 0.8), [])] == pytest.approx(np.arange(20, 81) / 100)
    left = T[judged(T, (0.2, 0.8), [0.395])]
    assert left == pytest.approx([*np.arange(20, 40) / 100, *np.arange(50, 81) / 100])
    assert judged(T, (0.2, 0.25), [0.195]).sum() == 6


@pytest.mark.parametrize(("rate_Hz", "frames"), [(1000.0, 5), (600.0, 3), (100.0, 1)])
def test_the_force_is_averaged_over_5_ms(rate_Hz, frames):
    step = np.repeat([0.0, 1.0], 50)
    rises = averaged(step, rate_Hz)
    assert np.count_nonzero((rises > 1e-9) & (rises < 1 - 1e-9)) == frames - 1
    assert rises.size == 100
