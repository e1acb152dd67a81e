"""Settings of one simulated CMMT drive."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivers.simulated.faults.plan import MoveFault
from drivers.simulated.world.axis import Mechanics


@dataclass(frozen=True)
class SimulatedCmmtSettings:
    """The settings of one simulated drive, and its faults."""

    name: str = "stage_z"
    """Name of the drive in the World, its log and fault plans."""
    model: str = "CMMT-ST-C8-1C-MP-S0"
    serial: str = "SIMZ1"
    """Serial number, at most five characters."""
    position_unit_mm: float = 0.001
    speed_unit_mm_s: float = 0.001
    full_acceleration_mm_s2: float = 1000.0
    force_at_full_torque_N: float = 100.0
    home_mm: float = 0.0
    homing_speed_mm_s: float = 20.0
    jog_speed_mm_s: float = 10.0
    unhomed_offset_mm: float = 37.5
    """Error of the drive's position before it has been homed."""
    enable_delay_us: int = 20_000
    mechanics: Mechanics = field(default_factory=Mechanics)
    faults: tuple[MoveFault, ...] = ()
