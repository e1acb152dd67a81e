"""The zero of the force sensor in free air: taken at rest, refused where it drifts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.analysis.slope import slopes
from rig.core.errors import InstrumentError
from rig.files.journal.layout import Column

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rig.run.context import Run
    from rig.run.points import Reading

TARE_S = 0.2
"""Stretch of force that the zero is the mean of; the rest before it is twice as long."""
DRIFT_N_s, DRIFT_S, SIGMAS = 0.2, 1.0, 5.0
"""Largest drift of the zero in free air, far above what a warm amplifier shows; the stretch of
force that confirms one; and the ratio to its standard error above which it is more than noise."""
DRIFT_PARTS, LASTING_SHARE = 3, 1 / 3
"""Parts of that stretch, and the share of its slope that each of them has to have: a drift lasts,
while something that pushes on the probe for a moment shows in one or two of them."""
PUSHED_N = 0.05
"""Difference of mean and median of the force from which something has pushed for a moment."""
MEDIAN_ERROR = 0.76
"""Standard error of that difference for normal noise, in standard deviations over the root of the
number of frames: (pi / 2 - 1)**0.5."""
TARE_TRIES = 3
"""How often the force is looked at for a stretch that nothing disturbs."""


class ForceZero(NamedTuple):
    """Force sensor's reading in free air, in N along its axes; z points up out of the object."""

    x_N: float = 0.0
    y_N: float = 0.0
    z_N: float = 0.0

    def columns(self, axes: str) -> Reading:
        """Return the zero as columns of a reading, without a value for what is not one of the
        sensor's `axes`."""
        return {
            f"force_zero_{axis}_N": value if axis in axes else None
            for axis, value in zip("xyz", self, strict=True)
        }


ZERO_COLUMNS = tuple(
    Column(f"force_zero_{axis}", "N", f"Force zero along {axis}") for axis in "xyz"
)
"""Columns with the force sensor's zero."""

ZERO_LABEL = "force sensor offset before taring (x, y, z); N"
"""Label of ``force_zero_N`` in a summary, see `Procedure.summary_labels`."""


def force_zero_of(readings: Sequence[Reading]) -> dict[str, Any]:
    """Return ``force_zero_N`` of a run's summary: x, y, z of the last reading, where the sensor has
    them all. Its drift from run to run shows a sensor that is overloaded, warm or touched by
    something."""
    names = [column.key for column in ZERO_COLUMNS]
    found = [zero for r in readings if None not in (zero := [r.get(name) for name in names])]
    return {"force_zero_N": found[-1]} if found else {}


def tare_in_free_air(run: Run) -> ForceZero:
    """Zero the force sensor once what has moved is at rest, and return the reading in free air that
    is the zero, in N.

    What pushes for a moment is waited for. Raises InstrumentError for a zero that drifts, and where
    the force does not come to rest.
    """
    run.clock.sleep(2 * TARE_S)
    for _ in range(TARE_TRIES):
        latest_N = run.force.latest_N(TARE_S)
        if drift_of(latest_N, run.force.rate_S_s) is None and not was_pushed(latest_N):
            return ForceZero(*run.force.tare(TARE_S))
        run.clock.sleep(DRIFT_S)
        drift = lasting_drift_of(run.force.latest_N(DRIFT_S), run.force.rate_S_s)
        if drift is not None:
            raise InstrumentError(
                "force_sensor",
                "tare",
                f"its zero drifts {drift} in free air, more than {DRIFT_N_s:g} N/s",
                "let the amplifier warm up; check cable and supply, and that nothing touches the "
                "sensor",
            )
    raise InstrumentError(
        "force_sensor",
        "tare",
        f"the force was not steady in free air during any of {TARE_TRIES} attempts of {TARE_S:g} s",
        "check that nothing touches the sensor and nothing shakes the bench; check cable and plug",
    )


def drift_of(force_N: npt.NDArray[np.float64], rate_S_s: float) -> str | None:
    """Return by how much and along which axis the force (n, 3) drifts, in words; None where no axis
    drifts beyond its noise and `DRIFT_N_s`."""
    slopes_N_s, errors_N_s = slopes(force_N, rate_S_s)
    for axis, slope, error in zip("xyz", slopes_N_s, errors_N_s, strict=True):
        if abs(slope) > max(DRIFT_N_s, SIGMAS * error):
            return f"by {slope:.2g} N/s along {axis}"
    return None


def lasting_drift_of(force_N: npt.NDArray[np.float64], rate_S_s: float) -> str | None:
    """Return the same as `drift_of`, for the axes whose force changes all the time: each of
    `DRIFT_PARTS` has at least `LASTING_SHARE` of the slope of the whole."""
    whole_N_s, _ = slopes(force_N, rate_S_s)
    size = len(force_N) // DRIFT_PARTS
    lasts = whole_N_s != 0
    for part in range(DRIFT_PARTS):
        slopes_N_s, _ = slopes(force_N[part * size : (part + 1) * size], rate_S_s)
        lasts &= slopes_N_s * whole_N_s >= LASTING_SHARE * whole_N_s**2
    return drift_of(force_N * lasts, rate_S_s)


def was_pushed(force_N: npt.NDArray[np.float64]) -> bool:
    """Return whether something has pushed for a moment within the force (n, 3): then its mean along
    an axis differs from its median by more than `PUSHED_N` and the noise."""
    import numpy as np  # as in rig.analysis.slope

    median_N = np.median(force_N, axis=0)
    noise_N = 1.4826 * np.median(np.abs(force_N - median_N), axis=0)
    error_N = MEDIAN_ERROR * noise_N / len(force_N) ** 0.5
    off_N = np.abs(force_N.mean(axis=0) - median_N)
    return bool((off_N > np.maximum(PUSHED_N, SIGMAS * error_N)).any())
