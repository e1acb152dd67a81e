"""Noise of the converters, keyed by the run's point and never continued.

The noise of a point depends on the seed, the run, the point and the stream, and not on what came
before it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

NOISE_CHUNK = 4096
TERMINALS_SAMPLED = 4
"""Largest number of terminals that are sampled together."""
FORCE_NOISE = 900
"""Stream number that keys the force sensor's noise; terminals are the DAQ's streams."""


class SampledNoise:
    """White noise of a bench's converters, of a World's seed."""

    def __init__(self, seed: int):
        self._seed = seed
        self._point = (0, 0)
        self._acquisitions_of_point = 0
        self._acquisitions: dict[int, tuple[int, int, int]] = {}
        """Point of each acquisition, and its place in it."""

    @property
    def force_key(self) -> tuple[int, ...]:
        """Seeds of the force sensor's noise: those of the World and of the present point."""
        return (self._seed, *self._point, FORCE_NOISE)

    def begin_point(self, run: int, point: int) -> None:
        """Begin the next point of the run, which keys the noise."""
        self._point = (run, point)
        self._acquisitions_of_point = 0

    def begin_acquisition(self) -> int:
        """Return a fresh acquisition number; its noise is keyed by the point and its place in
        it."""
        number = len(self._acquisitions)
        self._acquisitions[number] = (*self._point, self._acquisitions_of_point)
        self._acquisitions_of_point += 1
        return number

    def of(
        self, acquisition: int, terminal: int, first: int, count: int
    ) -> npt.NDArray[np.float64]:
        """Return noise of unit variance at the samples from `first` on, (count,), made in whole
        chunks so that blocks do not matter."""
        key = (self._seed, *self._acquisitions[acquisition], terminal)
        chunks = range(first // NOISE_CHUNK, (first + count - 1) // NOISE_CHUNK + 1)
        drawn = [_noise_chunk((*key, chunk)) for chunk in chunks]
        begin = first - chunks[0] * NOISE_CHUNK
        return np.concatenate(drawn)[begin : begin + count]


@lru_cache(maxsize=2 * TERMINALS_SAMPLED)
def _noise_chunk(key: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Return the standard normal, (NOISE_CHUNK,): a block often wants the same as the one
    before."""
    drawn = np.random.default_rng(key).standard_normal(NOISE_CHUNK)
    drawn.flags.writeable = False
    return drawn
