"""A measured frequency response as arrays, checked once: what the analyses of a sweep start from.

Points may come in any order, repeat a frequency or leave some out; they are sorted here, so that no
result depends on the order of measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.response import DB_PER_RELATIVE, Complexes, Reals
from rig.errors import ExitCode, RigError


class CurveError(RigError):
    """A measured response that cannot be analysed as asked."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True, eq=False)
class ResponseCurve:
    """Complex responses (V/N) over frequency (Hz) with their errors, ascending; see :meth:`of`."""

    frequencies: Reals
    """Hz, (n,), ascending; repeats are allowed."""
    responses: Complexes
    """V/N, (n,)."""
    covariances: Reals
    """Of (real, imaginary) part, (V/N)^2, (n, 2, 2)."""

    @classmethod
    def of(
        cls, frequencies: ArrayLike, responses: ArrayLike, covariances: ArrayLike
    ) -> ResponseCurve:
        """Check and sort: frequencies (n,) Hz, responses (n,) V/N, covariances (n, 2, 2).

        Raises CurveError, naming the argument and the value, for unequal lengths, anything not
        finite, frequencies not above 0, and covariances that are not positive definite.
        """
        frequency = np.asarray(frequencies, dtype=float)
        response = np.asarray(responses, dtype=complex)
        covariance = np.asarray(covariances, dtype=float)
        _check(frequency, response, covariance)
        order = np.lexsort((response.imag, response.real, frequency))
        return cls(frequency[order], response[order], covariance[order])

    def __len__(self) -> int:
        """Number of points."""
        return self.frequencies.size

    @property
    def gains_dB(self) -> Reals:  # noqa: N802
        """20 log10 of the magnitude, dB re 1 V/N (paper eq. 1)."""
        gains: Reals = 20 * np.log10(np.abs(self.responses))
        return gains

    @property
    def gain_errors_dB(self) -> Reals:  # noqa: N802
        """Standard errors of the gains, first order."""
        unit = self.responses / np.abs(self.responses)
        along = np.stack([unit.real, unit.imag], axis=1)
        variance = np.einsum("ni,nij,nj->n", along, self.covariances, along)
        errors: Reals = DB_PER_RELATIVE * np.sqrt(variance) / np.abs(self.responses)
        return errors

    def with_relative_error(self, relative: float) -> ResponseCurve:
        """The same points, a further error of that fraction of |H| added to both parts."""
        extra = np.square(relative * np.abs(self.responses))[:, None, None] * np.eye(2)
        return ResponseCurve(self.frequencies, self.responses, self.covariances + extra)

    def at(self, chosen: NDArray[np.bool_]) -> ResponseCurve:
        """The points for which ``chosen`` (n,) is true."""
        return ResponseCurve(
            self.frequencies[chosen], self.responses[chosen], self.covariances[chosen]
        )

    def whitened(self, values: Complexes) -> Reals:
        """Complex ``values`` (..., n) as (..., 2 n) reals, of unit variance if errors are right."""
        lower = np.linalg.cholesky(self.covariances)
        first = values.real / lower[:, 0, 0]
        second = (values.imag - lower[:, 1, 0] * first) / lower[:, 1, 1]
        return np.concatenate([first, second], axis=-1)


def _check(frequency: Reals, response: Complexes, covariance: Reals) -> None:
    n = frequency.size
    if frequency.ndim != 1 or response.shape != (n,) or covariance.shape != (n, 2, 2):
        raise CurveError(
            f"frequencies, responses and covariances of shapes {frequency.shape}, "
            f"{response.shape} and {covariance.shape} do not belong together: "
            "(n,), (n,) and (n, 2, 2) are needed"
        )
    for index, value in enumerate(frequency):
        if not (np.isfinite(value) and value > 0):
            raise CurveError(f"frequencies: number {index + 1} is {value:g} Hz, not above 0 Hz")
    for name, bad in (
        ("responses", ~np.isfinite(response) | (response == 0)),
        ("covariances", ~np.isfinite(covariance).all(axis=(1, 2))),
    ):
        if bad.any():
            where = frequency[int(np.argmax(bad))]
            raise CurveError(f"{name}: the value at {where:g} Hz is zero or not finite")
    determinant = covariance[:, 0, 0] * covariance[:, 1, 1] - covariance[:, 0, 1] ** 2
    symmetric = np.isclose(covariance[:, 0, 1], covariance[:, 1, 0], rtol=1e-6, atol=0)
    wrong = ~(symmetric & (covariance[:, 0, 0] > 0) & (determinant > 0))
    if wrong.any():
        where = frequency[int(np.argmax(wrong))]
        raise CurveError(f"covariances: the matrix at {where:g} Hz is not positive definite")
