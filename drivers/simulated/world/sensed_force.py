"""What reaches the force sensor's amplifier of the force that acts on the sensor.

It is the force itself until a fault of a plan begins: a sensor that is dead, that has another
scale, or whose zero drifts. None of them changes the World's own account of the force.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import DeadSensor, SensedFault, WrongScale

AXES = "xyz"


class SensedForce:
    """The faults of the sensor so far, in the order in which they began."""

    def __init__(self) -> None:
        self._faults: list[tuple[float, SensedFault]] = []
        """Each with its begin in World seconds."""

    def begin(self, fault: SensedFault, t_us: int) -> None:
        """A fault begins."""
        self._faults.append((t_us * 1e-6, fault))

    def of(
        self, times_s: npt.NDArray[np.float64], force_N: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return what is sensed of forces (n, 3) in N at World times (n,) in s."""
        for begin_s, fault in self._faults:
            since_s = np.maximum(times_s - begin_s, 0.0)
            begun = times_s >= begin_s
            if isinstance(fault, DeadSensor):
                force_N = np.where(begun[:, None], 0.0, force_N)
            elif isinstance(fault, WrongScale):
                force_N = np.where(begun[:, None], fault.factor * force_N, force_N)
            else:
                force_N = force_N.copy()
                force_N[:, AXES.index(fault.axis)] += fault.rate_N_s * since_s
        return force_N
