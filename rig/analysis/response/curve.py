"""A measured frequency response as arrays, checked once: the input of every analysis of a sweep.

Points may be in any order, repeat a frequency or leave some out. They are sorted here, so that no
result depends on the order of measurement.

If the preload of each point is known, the gain may depend on it by an unknown factor: a film that
creeps under its stage is followed in steps, and its points then differ slightly. Whatever such a
factor could explain is removed from residuals and derivatives alike. This is equivalent to a joint
fit with that factor free, and every interval includes the cost of not knowing it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.response.complex_response import DB_PER_RELATIVE, Complexes, Reals
from rig.core.errors import ExitCode, RigError

SAME_PRELOAD_N = 1e-6
"""Preloads that differ by less than this, in N, carry no information about their effect."""


class CurveError(RigError):
    """Raised when a measured response cannot be analysed."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True, eq=False)
class ResponseCurve:
    """Complex responses over ascending frequency with their errors. Create it with :meth:`of`."""

    frequencies: Reals
    """Frequencies in Hz, (n,), ascending; they may repeat."""
    responses: Complexes
    """Complex responses in V/N, (n,)."""
    covariances: Reals
    """Covariances of the (real, imaginary) parts in (V/N)², (n, 2, 2)."""
    preloads_N: Reals | None = None
    """Static force at each point, (n,); None if unknown or the same everywhere."""
    preload_errors_N: Reals | None = None
    """Standard error of this force, (n,); None if unknown."""

    @classmethod
    def of(
        cls,
        frequencies: ArrayLike,
        responses: ArrayLike,
        covariances: ArrayLike,
        degrees: ArrayLike | None = None,
        preloads: ArrayLike | None = None,
        preload_errors: ArrayLike | None = None,
    ) -> ResponseCurve:
        """Checks and sorts frequencies (n,) in Hz, responses (n,) in V/N, covariances (n, 2, 2) and
        preloads (n,) in N.

        ``degrees`` (n,) are the degrees of freedom from which each covariance was estimated
        (samples minus fitted parameters of a record). Without them covariances are taken as known.
        A mean whose weights were estimated is less accurate than these weights suggest: its
        variance is larger by 1 + 4 / degrees (P. Meier, Biometrics 9 (1953) 59, for many points),
        and the covariances are enlarged by this factor. Preloads that are not finite are taken as
        unknown, and so are ``preload_errors`` (n,), their standard errors.

        Raises CurveError, which names the argument and the value, for unequal lengths, values that
        are not finite, frequencies that are not positive, covariances that are not positive
        definite and degrees below 1.
        """
        frequency = np.asarray(frequencies, dtype=float)
        response = np.asarray(responses, dtype=complex)
        covariance = np.asarray(covariances, dtype=float)
        _check(frequency, response, covariance)
        if degrees is not None:
            covariance = covariance * _estimated_weights(frequency, degrees)[:, None, None]
        order = np.lexsort((response.imag, response.real, frequency))
        preload = _varied(preloads, frequency.size)
        uncertain = None if preload is None else _finite(preload_errors, frequency.size)
        return cls(
            frequency[order],
            response[order],
            covariance[order],
            None if preload is None else preload[order],
            None if uncertain is None else uncertain[order],
        )

    def __len__(self) -> int:
        """Returns the number of points."""
        return self.frequencies.size

    @property
    def gains_dB(self) -> Reals:  # noqa: N802
        """Gains, 20 log10 of the magnitudes, in dB re 1 V/N (paper eq. 1)."""
        gains: Reals = 20 * np.log10(np.abs(self.responses))
        return gains

    @cached_property
    def relative_covariances(self) -> Reals:
        """Covariances of (relative gain, phase in rad), first order, (n, 2, 2)."""
        unit = self.responses / np.abs(self.responses) ** 2
        turn = np.stack([unit.real, unit.imag, -unit.imag, unit.real], axis=1).reshape(-1, 2, 2)
        turned: Reals = turn @ self.covariances @ turn.transpose(0, 2, 1)
        return turned

    @property
    def gain_errors_dB(self) -> Reals:  # noqa: N802
        """Standard errors of the gains in dB, first order."""
        errors: Reals = DB_PER_RELATIVE * np.sqrt(self.relative_covariances[:, 0, 0])
        return errors

    def with_relative_error(self, gain: float | Reals, phase: float) -> ResponseCurve:
        """Returns the same points with additional errors of the gain (relative; one for all or one
        for each) and the phase (rad)."""
        along = np.stack([self.responses.real, self.responses.imag], axis=1)
        across = np.stack([-self.responses.imag, self.responses.real], axis=1)
        squared = np.broadcast_to(np.square(gain), len(self))[:, None, None]
        extra = squared * along[:, :, None] * along[:, None, :]
        extra += phase**2 * across[:, :, None] * across[:, None, :]
        return replace(self, covariances=self.covariances + extra)

    def at(self, chosen: NDArray[np.bool_]) -> ResponseCurve:
        """Returns the points for which ``chosen`` (n,) is true."""
        return ResponseCurve(
            self.frequencies[chosen],
            self.responses[chosen],
            self.covariances[chosen],
            None if self.preloads_N is None else self.preloads_N[chosen],
            None if self.preload_errors_N is None else self.preload_errors_N[chosen],
        )

    def with_preload_errors(self, effect: float) -> ResponseCurve:
        """Returns the same points with the error of the gain that comes from the error of each
        preload, for a relative ``effect`` by newton."""
        if self.preload_errors_N is None:
            return self
        return self.with_relative_error(effect * self.preload_errors_N, 0.0)

    def log_ratio(self, expected: Complexes) -> Complexes:
        """Returns ln(measured / expected), (n,): difference of the gains (neper) + j that of the
        phases."""
        ratio = self.responses / expected
        result: Complexes = np.log(np.abs(ratio)) + 1j * np.angle(ratio)
        return result

    def whitened(self, relative: Complexes) -> Reals:
        """Returns gain + j phase (..., n) as (..., 2 n) reals, of unit variance if the errors are
        right.

        Whatever an unknown effect of the preload could explain is removed.
        """
        white = self._scaled(relative)
        if self._preload_direction is not None:
            along = self._preload_direction
            white -= (white @ along)[..., None] * along
        return white

    def freed(self, relative: Complexes) -> Complexes:
        """Returns gain + j phase (n,) without the effect of the preload that explains most of
        them."""
        if self.preload_excess is None:
            return relative
        return relative - self.preload_effect(relative) * self.preload_excess

    def preload_effect(self, relative: Complexes) -> float:
        """Returns the change of the gain per N of preload that explains most of `relative` (n,)."""
        assert self.preload_excess is not None, "the preloads are not known"
        push = self._scaled(self.preload_excess)
        return float(push @ self._scaled(relative)) / float(push @ push)

    @cached_property
    def preload_excess(self) -> Complexes | None:
        """Preloads minus their mean in N, (n,), as a change of the gain alone; None if they are
        unknown."""
        if self.preloads_N is None:
            return None
        excess: Complexes = self.preloads_N - self.preloads_N.mean() + 0j
        return excess

    def _scaled(self, relative: Complexes) -> Reals:
        gain, mixed, phase = self._factor
        first = relative.real / gain
        return np.concatenate([first, (relative.imag - mixed * first) / phase], axis=-1)

    @cached_property
    def _preload_direction(self) -> Reals | None:
        if self.preload_excess is None:
            return None
        push = self._scaled(self.preload_excess)
        direction: Reals = push / np.linalg.norm(push)
        return direction

    @cached_property
    def _factor(self) -> tuple[Reals, Reals, Reals]:
        """Cholesky factor of each relative covariance: (0, 0), (1, 0) and (1, 1), (n,) each."""
        gain = np.sqrt(self.relative_covariances[:, 0, 0])
        mixed = self.relative_covariances[:, 1, 0] / gain
        return gain, mixed, np.sqrt(self.relative_covariances[:, 1, 1] - mixed**2)


def _finite(values: ArrayLike | None, size: int) -> Reals | None:
    """Returns the values if they are known at all points."""
    if values is None:
        return None
    found = np.asarray(values, dtype=float)
    return found if found.shape == (size,) and np.isfinite(found).all() else None


def _varied(preloads: ArrayLike | None, size: int) -> Reals | None:
    """Returns the preloads if they are known and not all the same."""
    if preloads is None:
        return None
    found = np.asarray(preloads, dtype=float)
    if found.shape != (size,):
        raise CurveError(f"preloads: {found.size} values for {size} frequencies")
    return found if np.isfinite(found).all() and np.ptp(found) > SAME_PRELOAD_N else None


def points_of(column: Callable[[str], Reals]) -> tuple[Reals, Complexes, Reals]:
    """Returns frequencies (n,) in Hz, responses (n,) in V/N and covariances (n, 2, 2) from a
    sweep's table.

    `column` returns a column of the table by name.
    """
    real, mixed = column("response_var_real"), column("response_cov")
    covariances = np.stack([real, mixed, mixed, column("response_var_imag")], axis=1)
    responses = column("response_real") + 1j * column("response_imag")
    return column("frequency"), responses, covariances.reshape(-1, 2, 2)


def _estimated_weights(frequency: Reals, degrees: ArrayLike) -> Reals:
    freedom = np.asarray(degrees, dtype=float)
    if freedom.shape != frequency.shape:
        raise CurveError(f"degrees: {freedom.size} values for {frequency.size} frequencies")
    if not (freedom >= 1).all():
        where = frequency[int(np.argmin(freedom >= 1))]
        raise CurveError(f"degrees: the value at {where:g} Hz is below 1")
    factor: Reals = 1 + 4 / freedom
    return factor


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
