"""What is mounted on a simulated bench, as the World sees it: a film in its clamp, or a skin."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from rig.physics.front_end import FrontEndSettings

Reals = npt.NDArray[np.float64]


class Mounted(Protocol):
    """What the stages press and the DAQ's input terminals are wired to. All times are those of the
    World, none in the future."""

    @property
    def failure(self) -> str | None:
        """Reason why its physics is not valid any more, if there is one."""
        ...

    def settle(self, now_us: int) -> None:
        """Bring it up to the present."""
        ...

    def begin_point(self, now_us: int) -> None:
        """Begin the record of what really happens with the next point of the run."""
        ...

    def truth(self) -> dict[str, Any]:
        """Return what a measurement should find, as JSON."""
        ...

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force in N along an axis on its carriage, which stands at `position_mm`."""
        ...

    def force_N(self, times_s: Reals) -> Reals:  # noqa: N802
        """Return the force in N, (n, 3), that reaches the force sensor at ascending times in s,
        (n,)."""
        ...

    def terminal_V(  # noqa: N802
        self, terminal: int, times_s: Reals, weight_N: float
    ) -> Reals:
        """Return the volts at an input terminal of the DAQ, without hum and noise, at ascending
        times in s; shape of `times_s`. `weight_N` lies on the sensors along z."""
        ...

    def front_end(self, terminal: int) -> FrontEndSettings:
        """Return the noise and hum of the channel that an input terminal belongs to."""
        ...
