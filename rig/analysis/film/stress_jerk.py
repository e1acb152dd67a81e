"""Test of an alternative model: stress rate and stress jerk in series, with a break at 1.2 kHz.

The paper (3.2) withdraws an earlier report that the gain rises by 20 dB/decade up to a break and by
40 above it. Both statements are fitted as one model each: the same circuit with the same notches,
the second with a further factor 1 + j f / break, whose break is free between 0.5 and 2 kHz. The
pole of the circuit is free in both, so that saturation does not count against the alternative. The
alternative may use the notches of the first-order fit or as many found against its own trend,
whichever suits it better. Akaike's criterion compares them: AIC = -2 ln L + 2 (number of
parameters), each model with the model errors it needs.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from rig.analysis.film.drops import fit_with_drops
from rig.analysis.film.fit import BREAK_BAND_HZ, FilmFit, fit_film
from rig.analysis.response.curve import CurveError, ResponseCurve

CLAIMED_BREAK_HZ = 1200.0
"""Break of the earlier report (paper 3.2)."""
PAPER_DROPS = 3
"""Number of notches that the paper names. The alternative may have as many, however many first
order found."""
CLEAR_DIFFERENCE = 10.0
"""AIC difference above which the poorer model has essentially no support (Burnham, Anderson)."""


@dataclass(frozen=True)
class StressJerkTest:
    """Comparison of first order with the alternative model."""

    aic_difference: float
    """AIC of the alternative minus that of first order: positive speaks against the alternative."""
    break_Hz: float
    """Best break of the alternative model."""
    first_order_misfit_dB: float
    """Root mean square of measured minus fitted gain, first order."""
    claim_misfit_dB: float
    """Root mean square of measured minus fitted gain, alternative model."""

    @property
    def verdict(self) -> str:
        """Verdict on the alternative: ``refuted``, ``supported`` or ``undecided``."""
        if self.aic_difference > CLEAR_DIFFERENCE:
            return "refuted"
        return "supported" if self.aic_difference < -CLEAR_DIFFERENCE else "undecided"

    def sentence(self) -> str:
        """Return the result in words."""
        low, high = BREAK_BAND_HZ
        at_edge = min(abs(self.break_Hz / low - 1), abs(self.break_Hz / high - 1)) < 1e-3
        where = "at the edge of its range" if at_edge else "inside its range"
        verdict = {"refuted": "rejected", "supported": "supported"}.get(self.verdict, "undecided")
        return (
            f"Alternative model (20, then 40 dB/decade above about 1.2 kHz): {verdict}, "
            f"ΔAIC = {self.aic_difference:+.1f} against first order; best break "
            f"{self.break_Hz:.0f} Hz, {where} of {low:g} to {high:g} Hz; rms misfit of the gain "
            f"{self.claim_misfit_dB:.3f} dB against {self.first_order_misfit_dB:.3f} dB."
        )


def stress_jerk_test(curve: ResponseCurve, first_order: FilmFit) -> StressJerkTest:
    """Test the alternative on the points to which ``first_order`` was fitted."""
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
