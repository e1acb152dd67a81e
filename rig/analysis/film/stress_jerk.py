"""The withdrawn claim: stress rate and stress jerk in series, with a break at 1.2 kHz.

The paper (3.2) takes back an earlier report that the gain rises by 20 dB/decade up to a break and
by 40 above it. Both statements are fitted as one model each, the same circuit with the same drops,
the second with a further factor 1 + j f / break whose break is free between 0.5 and 2 kHz. The pole
of the circuit is free in both, so that saturation is not held against the claim; and the claim may
take the drops of the first-order fit or as many found against its own trend, whichever suits it.
Akaike's criterion compares them: AIC = -2 ln L + 2 (number of parameters), each model with the
model errors it needs.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from rig.analysis.film.drops import fit_with_drops
from rig.analysis.film.fit import BREAK_BAND_HZ, FilmFit, fit_film
from rig.analysis.response.curve import CurveError, ResponseCurve

CLAIMED_BREAK_HZ = 1200.0
"""Where the earlier report had its break (paper 3.2)."""
PAPER_DROPS = 3
"""Drops the paper names: the claim may have so many, whatever first order found."""
CLEAR_DIFFERENCE = 10.0
"""AIC difference beyond which the poorer model has essentially no support (Burnham, Anderson)."""


@dataclass(frozen=True)
class StressJerkTest:
    """First order against first and second order with a break."""

    aic_difference: float
    """AIC of the claim less that of first order: positive speaks against the claim."""
    break_Hz: float
    """The best break of the claim's model."""
    first_order_misfit_dB: float
    """Root mean square of measured less fitted gain, first order."""
    claim_misfit_dB: float
    """The same for the claim."""

    @property
    def verdict(self) -> str:
        """``refuted``, ``supported`` or ``undecided``."""
        if self.aic_difference > CLEAR_DIFFERENCE:
            return "refuted"
        return "supported" if self.aic_difference < -CLEAR_DIFFERENCE else "undecided"

    def sentence(self) -> str:
        """The result in words."""
        low, high = BREAK_BAND_HZ
        at_edge = min(abs(self.break_Hz / low - 1), abs(self.break_Hz / high - 1)) < 1e-3
        where = "at the edge of its range" if at_edge else "inside its range"
        said = {
            "refuted": "is refuted: first order describes these points better",
            "supported": "is supported: first order describes these points worse",
            "undecided": "is not decided by these points",
        }[self.verdict]
        return (
            f"The withdrawn claim of 20, then 40 dB/decade with a break near 1.2 kHz {said} "
            f"(AIC of the claim {self.aic_difference:+.1f} against first order; its best break is "
            f"{self.break_Hz:.0f} Hz, {where} of {low:g} to {high:g} Hz; rms misfit of the gain "
            f"{self.claim_misfit_dB:.3f} dB against {self.first_order_misfit_dB:.3f} dB)."
        )


def stress_jerk_test(curve: ResponseCurve, first_order: FilmFit) -> StressJerkTest:
    """Test the claim on the points that ``first_order`` was fitted to."""
    starts = (BREAK_BAND_HZ[0] * 1.05, CLAIMED_BREAK_HZ, BREAK_BAND_HZ[1] * 0.95)
    fits = [fit_film(curve, replace(first_order.model, break_Hz=start)) for start in starts]
    with contextlib.suppress(CurveError):
        most_drops = max(PAPER_DROPS, len(first_order.model.notches))
        fits.append(fit_with_drops(curve, CLAIMED_BREAK_HZ, most_drops))
    claim = min(fits, key=lambda fit: fit.aic)
    return StressJerkTest(
        aic_difference=claim.aic - first_order.aic,
        break_Hz=claim.model.break_Hz or np.nan,
        first_order_misfit_dB=_misfit_dB(curve, first_order),
        claim_misfit_dB=_misfit_dB(curve, claim),
    )


def _misfit_dB(curve: ResponseCurve, fit: FilmFit) -> float:  # noqa: N802
    fitted = 20 * np.log10(np.abs(fit.model.response(curve.frequencies)))
    return float(np.sqrt(np.square(curve.gains_dB - fitted).mean()))
