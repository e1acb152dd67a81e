"""A measured frequency response as arrays, checked once: the input of every analysis of a sweep.

Points may be in any order, repeat a frequency or leave some out. They are sorted here, so that no
result depends on the order of measurement.

If the preload of each point is known, the gain may depend on it by an unknown factor: a film that
creeps under its stage is followed in steps, and its points then differ slightly. Under several
loads it may depend on the load as well, by an unknown slope over its logarithm. Whatever these two
could explain is removed from residuals and derivatives alike. This is equivalent to a joint fit
with both free, and every interval includes the cost of not knowing them. Removing one of them alone
would not do: the preload is slightly different under each load, so that an effect of the load would
pass for one of the preload.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.response.complex_response import DB_PER_RELATIVE, Complexes, Reals
from rig.analysis.scatter import explaining_error
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
    """Static force at each point, (n,), as :func:`likely_preloads` makes it of the measured ones;
    None if unknown or the same everywhere."""
    preload_errors_N: Reals | None = None
    """Standard error of this force, (n,); None if unknown."""
    loads_N: Reals | None = None
    """Peak load at each point, (n,), if the gain may depend on it; None otherwise."""

    @classmethod
    def of(
        cls,
        frequencies: ArrayLike,
        responses: ArrayLike,
        covariances: ArrayLike,
        degrees: ArrayLike | None = None,
        preloads: ArrayLike | None = None,
        preload_errors: ArrayLike | None = None,
        loads: ArrayLike | None = None,
    ) -> ResponseCurve:
        """Check and sort frequencies (n,) in Hz, responses (n,) in V/N, covariances (n, 2, 2) and
        preloads (n,) in N.

        ``degrees`` (n,) are the degrees of freedom from which each covariance was estimated
        (samples minus fitted parameters of a record). Without them covariances are taken as known.
        A mean whose weights were estimated is less accurate than these weights suggest: its
        variance is larger by 1 + 4 / degrees (P. Meier, Biometrics 9 (1953) 59, for many points),
        and the covariances are enlarged by this factor. Preloads that are not finite are taken as
        unknown, and so are ``preload_errors`` (n,), their standard errors. ``loads`` (n,) are peak
        loads in N, positive and different at some frequency, on which the gain may depend.

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
        if preload is not None and uncertain is not None:
            preload, uncertain = likely_preloads(preload, uncertain)
            preload = _varied(preload, frequency.size)
        return cls(
            frequency[order],
            response[order],
            covariance[order],
            None if preload is None else preload[order],
            None if uncertain is None else uncertain[order],
            None if loads is None else np.asarray(loads, dtype=float)[order],
        )

    def __len__(self) -> int:
        """Return the number of points."""
        return self.frequencies.size

    @property
    def gains_dB(self) -> Reals:  # noqa: N802
        """Gains, 20 log10 of the magnitudes, in dB re 1 V/N (paper eq. 1). Shape (n,)."""
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
        """Standard errors of the gains in dB, first order. Shape (n,)."""
        errors: Reals = DB_PER_RELATIVE * np.sqrt(self.relative_covariances[:, 0, 0])
        return errors

    def with_relative_error(self, gain: float | Reals, phase: float) -> ResponseCurve:
        """Return the same points with additional errors of the gain (relative; one for all or one
        for each) and the phase (rad)."""
        along = np.stack([self.responses.real, self.responses.imag], axis=1)
        across = np.stack([-self.responses.imag, self.responses.real], axis=1)
        squared = np.broadcast_to(np.square(gain), len(self))[:, None, None]
        extra = squared * along[:, :, None] * along[:, None, :]
        extra += phase**2 * across[:, :, None] * across[:, None, :]
        return replace(self, covariances=self.covariances + extra)

    def at(self, chosen: NDArray[np.bool_]) -> ResponseCurve:
        """Return the points for which ``chosen`` (n,) is true."""
        return ResponseCurve(
            self.frequencies[chosen],
            self.responses[chosen],
            self.covariances[chosen],
            None if self.preloads_N is None else self.preloads_N[chosen],
            None if self.preload_errors_N is None else self.preload_errors_N[chosen],
            None if self.loads_N is None else self.loads_N[chosen],
        )

    def with_preload_errors(self, effect: float) -> ResponseCurve:
        """Return the same points with the error of the gain that comes from the error of each
        preload, for a relative ``effect`` by newton."""
        if self.preload_errors_N is None:
            return self
        return self.with_relative_error(effect * self.preload_errors_N, 0.0)

    def log_ratio(self, expected: Complexes) -> Complexes:
        """Return ln(measured / expected), (n,): difference of the gains (neper) + j that of the
        phases."""
        ratio = self.responses / expected
        result: Complexes = np.log(np.abs(ratio)) + 1j * np.angle(ratio)
        return result

    def whitened(self, relative: Complexes) -> Reals:
        """Return gain + j phase (..., n) as (..., 2 n) reals, of unit variance if the errors are
        right.

        Whatever unknown effects of preload and load could explain is removed.
        """
        white = self._scaled(relative)
        along = self._unknown_directions
        white -= (white @ along) @ along.T
        return white

    def freed(self, relative: Complexes) -> Complexes:
        """Return gain + j phase (n,) without the effects of preload and load that explain most of
        them."""
        return relative - self._amounts(relative) @ self.unknown_effects

    def preload_effect(self, relative: Complexes) -> float:
        """Return the relative change of the gain per newton of preload, in 1/N, that explains most
        of `relative` (n,), with an effect of the load where there may be one."""
        assert self.preload_excess is not None, "the preloads are not known"
        return float(self._amounts(relative)[0])

    @cached_property
    def preload_excess(self) -> Complexes | None:
        """Preloads minus their mean in N, (n,), as a change of the gain alone; None if they are
        unknown."""
        if self.preloads_N is None:
            return None
        excess: Complexes = self.preloads_N - self.preloads_N.mean() + 0j
        return excess

    @cached_property
    def unknown_effects(self) -> Complexes:
        """Changes of the gain, (k, n), whose amounts are free in every fit: that by a newton of
        preload, if the preloads are known, then that by a decade of load, if there are several."""
        found = [] if self.preload_excess is None else [self.preload_excess]
        if self.loads_N is not None:
            decades = np.log10(self.loads_N)
            found.append(decades - decades.mean() + 0j)
        return np.array(found, dtype=complex).reshape(len(found), len(self))

    def _amounts(self, relative: Complexes) -> Reals:
        """Return the amounts (k,) of the unknown effects that explain most of `relative` (n,)."""
        columns = self._scaled(self.unknown_effects).T
        return np.asarray(np.linalg.lstsq(columns, self._scaled(relative), rcond=None)[0], float)

    def _scaled(self, relative: Complexes) -> Reals:
        gain, mixed, phase = self._factor
        first = relative.real / gain
        return np.concatenate([first, (relative.imag - mixed * first) / phase], axis=-1)

    @cached_property
    def _unknown_directions(self) -> Reals:
        """Orthonormal columns (2 n, k) that span the unknown effects, scaled as residuals are."""
        directions: Reals = np.linalg.qr(self._scaled(self.unknown_effects).T)[0]
        return directions

    @cached_property
    def _factor(self) -> tuple[Reals, Reals, Reals]:
        """Cholesky factor of each relative covariance: (0, 0), (1, 0) and (1, 1), (n,) each."""
        gain = np.sqrt(self.relative_covariances[:, 0, 0])
        mixed = self.relative_covariances[:, 1, 0] / gain
        return gain, mixed, np.sqrt(self.relative_covariances[:, 1, 1] - mixed**2)


def _finite(values: ArrayLike | None, size: int) -> Reals | None:
    """Return the values if they are known at all points."""
    if values is None:
        return None
    found = np.asarray(values, dtype=float)
    return found if found.shape == (size,) and np.isfinite(found).all() else None


def _varied(preloads: ArrayLike | None, size: int) -> Reals | None:
    """Return the preloads if they are known and not all the same."""
    if preloads is None:
        return None
    found = np.asarray(preloads, dtype=float)
    if found.shape != (size,):
        raise CurveError(f"preloads: {found.size} values for {size} frequencies")
    return found if np.isfinite(found).all() and np.ptp(found) > SAME_PRELOAD_N else None


def likely_preloads(preloads: Reals, errors: Reals) -> tuple[Reals, Reals]:
    """Return the most likely preloads and their standard errors, from measured ones, all (n,).

    A mean force that vibration has disturbed may be off by more than the preloads differ. Taken as
    it is, it makes the effect of the preload look smaller (regression dilution). Each is therefore
    moved towards the middle of all by the part of its deviation that its error accounts for
    (regression calibration: Carroll et al., Measurement Error in Nonlinear Models, 2006, ch. 4).
    """
    middle = np.median(preloads)
    variances = np.square(np.maximum(errors, SAME_PRELOAD_N))
    spread = explaining_error(preloads - middle, variances, preloads.size)
    kept = spread**2 / (spread**2 + variances)
    return middle + kept * (preloads - middle), errors * np.sqrt(kept)


def points_of(column: Callable[[str], Reals]) -> tuple[Reals, Complexes, Reals]:
    """Return frequencies (n,) in Hz, responses (n,) in V/N and covariances (n, 2, 2) from a
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
