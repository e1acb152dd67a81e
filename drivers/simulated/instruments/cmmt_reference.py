"""Where a CMMT drive believes its axis to be: its own positions, with its software limits."""

from __future__ import annotations

from drivers.simulated.instruments.cmmt_parameters import CmmtParameters
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings

SOFTWARE_LIMIT_FAULTS = (109, 110)  # negative, positive
LIMIT_PARAMETERS_FAULT = 113


class CmmtReference:
    """The drive's own zero among the positions of the World, which are the carriage's.

    Both are equal after homing. Before, the drive's are off, and `homed` is false.
    """

    def __init__(self, settings: SimulatedCmmtSettings, parameters: CmmtParameters):
        self.homed = False
        self._settings, self._parameters = settings, parameters
        self._zero_mm = -settings.unhomed_offset_mm

    def found(self, position_mm: float) -> None:
        """Take this position of the World as the one at which homing has ended; the drive is then
        homed."""
        self.homed = True
        self._zero_mm = position_mm - self._settings.home_mm

    def own_mm(self, position_mm: float) -> float:
        """Return what the drive takes a position of the World for."""
        return position_mm - self._zero_mm

    def world_mm(self, units: int) -> float:
        """Return the position of the World of one of the drive's own, in units of position."""
        return units * self._settings.position_unit_mm + self._zero_mm

    def limits_mm(self) -> tuple[float, float]:
        """Return the software limits as positions of the World."""
        low, high = (self.world_mm(limit) for limit in self._parameters.limits)
        return low, high

    def limit_fault(self, target_mm: float) -> int:
        """Return the fault of a target beyond the software limits; 0 for one within them."""
        low, high = self.limits_mm()
        if low >= high:
            return LIMIT_PARAMETERS_FAULT
        if target_mm < low - 1e-9:
            return SOFTWARE_LIMIT_FAULTS[0]
        return SOFTWARE_LIMIT_FAULTS[1] if target_mm > high + 1e-9 else 0
