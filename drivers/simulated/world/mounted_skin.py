"""A skin on a simulated bench, which two stages press and slide on an object."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import STAGE_X, STAGE_Z
from drivers.simulated.world.skin_contact import SkinContact
from rig.physics.front_end import FrontEndSettings

STRIP_TERMINALS = {101: 1, 102: 2}
"""Terminals of the strips' amplifiers."""

Reals = npt.NDArray[np.float64]


class MountedSkin:
    """A skin above an object; its strips' amplifiers are wired to the DAQ."""

    def __init__(self, contact: SkinContact, strips: FrontEndSettings, below: dict[str, Any]):
        """Mount the skin of a contact; `strips` are its channels' noise and hum, `below` is the
        shape of the object."""
        self._contact, self._strips, self._below = contact, strips, below

    @property
    def failure(self) -> str | None:
        """Reason why the contact is frozen since a step had no solution, if it is."""
        return self._contact.failure

    def settle(self, now_us: int) -> None:
        """Do every step of the contact up to the present."""
        self._contact.catch_up(now_us)

    def begin_point(self, now_us: int) -> None:
        """Begin the record of touches and slips with the next point of the run."""
        self._contact.catch_up(now_us)
        self._contact.record.begin(now_us)

    def truth(self) -> dict[str, Any]:
        """Return what really happened to the skin since the point began."""
        return {**self._contact.truth(), "object": self._below}

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force in N with which the object pushes back along an axis, whose carriage
        stands where the skin will ask for it."""
        tangential_N, normal_N = self._contact.push_N(t_us)
        return {STAGE_Z: -normal_N, STAGE_X: -tangential_N}.get(axis, 0.0)

    def force_N(self, times_s: Reals) -> Reals:  # noqa: N802
        """Return the force in N of the skin on the object, (n, 3)."""
        return self._contact.force_N(times_s)

    def terminal_V(  # noqa: N802
        self, terminal: int, times_s: Reals, weight_N: float
    ) -> Reals:
        """Return the volts of a strip's amplifier; 0 at other terminals."""
        strip = STRIP_TERMINALS.get(terminal)
        return np.zeros(times_s.shape) if strip is None else self._contact.strip_V(strip, times_s)

    def front_end(self, terminal: int) -> FrontEndSettings:
        """Return the noise and hum of the strips' channels."""
        return self._strips
