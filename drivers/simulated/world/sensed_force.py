"""The force that reaches the force sensor's amplifier.

It is the force itself until a fault of a plan begins: a sensor that is dead, that has another
scale, or whose zero drifts. None of them changes the World's own account of the force.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import DeadSensor, SensedFault, WrongScale

AXES = "xyz"
NOISE_SEED, NOISE_CHUNK = 7919, 256


class SensedForce:
    """The faults of the sensor so far, in the order in which they began."""

    def __init__(self) -> None:
        self._faults: list[tuple[float, SensedFault]] = []
        """Each with its beginning in World seconds."""

    def begin(self, fault: SensedFault, t_us: int) -> None:
        """Begin a fault."""
        self._faults.append((t_us * 1e-6, fault))

    def of(
        self, times_s: npt.NDArray[np.float64], force_N: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return what is sensed of forces (n, 3) in N at World times (n,) in s."""
        for begin_s, fault in self._faults:
            since_s = np.maximum(times_s - begin_s, 0.0)
            begun = times_s >= begin_s
            if isinstance(fault, DeadSensor):
                noise_N = fault.noise_N * _noise(times_s) if fault.noise_N else 0.0
                shown_N = noise_N + np.array([0.0, 0.0, fault.shows_N])
                force_N = np.where(begun[:, None], shown_N, force_N)
            elif isinstance(fault, WrongScale):
                force_N = np.where(begun[:, None], fault.factor * force_N, force_N)
            else:
                force_N = force_N.copy()
                force_N[:, AXES.index(fault.axis)] += fault.rate_N_s * since_s
        return force_N


def _noise(times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return noise of standard deviation 1 at World times (n,), (n, 3): another value each
    millisecond, always the same at the same time."""
    ms = np.floor(times_s * 1e3).astype(int)
    first = int(ms.min()) // NOISE_CHUNK
    chunks = range(first, int(ms.max()) // NOISE_CHUNK + 1)
    drawn = np.concatenate([_noise_chunk(chunk) for chunk in chunks])
    noise: npt.NDArray[np.float64] = drawn[ms - first * NOISE_CHUNK]
    return noise


@lru_cache(maxsize=4)
def _noise_chunk(chunk: int) -> npt.NDArray[np.float64]:
    source = np.random.default_rng([NOISE_SEED, chunk])
    return source.standard_normal((NOISE_CHUNK, 3))
