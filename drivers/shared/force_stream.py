"""What every driver of a force sensor keeps of its stream: frames counted from 0, matrix and zero.

No I/O and no protocol. A driver derives its instrument from `ForceStream` and calls its four
methods that begin with an underscore where its stream begins, runs, ends and yields readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rig.instruments.roles import ForceFrames

if TYPE_CHECKING:
    import numpy.typing as npt

    from rig.core.clock import Clock


class ForceStream:
    """The part of a `ForceSensor` that does not depend on its protocol."""

    def __init__(self, clock: Clock, matrix: Sequence[Sequence[float]]):
        self._clock = clock
        self._matrix = np.array(matrix, dtype=np.float64)
        self._zero = np.zeros(3)
        self._rate = 0.0
        """Frame rate of the stream in frames/s."""
        self._started_s: float | None = None
        """Bench time at which the stream has begun; None while there is none."""
        self._next = 0
        """Index of the first frame that `read` has not returned yet."""

    @property
    def frames_behind(self) -> float:
        """Number of frames that are due since `start` by bench time and that `read` has not
        returned. A few on the way are normal; a lost one remains. The sensor's own clock makes it
        drift by some 50 parts in a million. 0 while no stream runs."""
        started_s = self._started_s  # once: another thread may end the stream meanwhile
        if started_s is None:
            return 0.0
        return (self._clock.now() - started_s) * self._rate - self._next

    def calibrate(self, matrix_N_mV_V: Sequence[Sequence[float]]) -> None:
        """Use this matrix, force in N by raw value, from the next `read` on."""
        self._matrix = np.array(matrix_N_mV_V, dtype=np.float64)

    def tare(self, zero_mV_V: tuple[float, float, float]) -> tuple[float, float, float]:
        """Take this raw value as no force, from the next `read` on; return what it is in N."""
        self._zero = np.array(zero_mV_V, dtype=np.float64)
        x, y, z = (float(force) for force in self._matrix @ self._zero)
        return x, y, z

    def _begins(self) -> None:
        """Count frames from 0. Call it before the sensor is asked to stream: a frame may come
        before the answer."""
        self._next = 0

    def _begun(self, rate_S_s: float) -> None:
        """Note that the sensor streams from now on."""
        self._rate = rate_S_s
        self._started_s = self._clock.now()

    def _ended(self) -> None:
        """Note that no frame is due any more."""
        self._started_s = None

    def _frames(
        self, raw: npt.NDArray[np.float32], saturated: npt.NDArray[np.bool_], raw_unit: str
    ) -> ForceFrames:
        """Count these readings, (n, 3), and return them with their forces."""
        first, self._next = self._next, self._next + len(raw)
        force = (raw.astype(np.float64) - self._zero) @ self._matrix.T
        return ForceFrames(first, raw, force, saturated, raw_unit)
