"""The chi-square distribution against SciPy's."""

from __future__ import annotations

import math

import pytest
from scipy.special import chdtrc

from rig.analysis.chi_square import probability_above


@pytest.mark.parametrize("degrees", [1, 2, 3, 10, 31, 333, 5000])
def test_the_probability_is_scipys(degrees: int) -> None:
    for share in (0.0, 1e-9, 0.2, 0.9, 1.0, 1.1, 2.0, math.inf):
        chi_square = share * degrees
        expected = pytest.approx(float(chdtrc(degrees, chi_square)), rel=1e-9, abs=1e-300)
        assert probability_above(chi_square, degrees) == expected


@pytest.mark.parametrize(("chi_square", "degrees"), [(-1.0, 3), (math.nan, 3), (1.0, 0)])
def test_what_has_no_probability_is_nan(chi_square: float, degrees: int) -> None:
    assert math.isnan(probability_above(chi_square, degrees))
