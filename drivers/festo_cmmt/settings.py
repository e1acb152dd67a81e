"""The settings of a CMMT drive in a bench file, and the meanings of the drive's fault numbers.

Plain data: nothing here communicates with a drive or knows a sequence. Fault numbers:
``icp_map.csv`` of the vendor's client festo-edcon 0.14.12.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.festo_cmmt.frames import FULL_SCALE
from rig.core.settings import Address, CommunicationTimeout, Deceleration, Settings, Wiring

LARGEST_COUNT = 2**31 - 1
"""Positions travel as signed 32-bit integers; speeds are held to the same."""


@dataclass(frozen=True)
class Fault:
    """Meaning and remedy of a fault number."""

    meaning: str
    remedy: str


COMMUNICATION_FAULT = 391
"""The drive's own communication time-out has expired."""
_LIMIT_REMEDY = "correct the travel limits in the bench file, or the position asked for"
_SWITCH_REMEDY = "check the axis, move it off the switch with the vendor's software, home again"
FAULTS: Mapping[int, Fault] = {
    56: Fault("the homing method is not valid", "choose another in the drive's parameters"),
    57: Fault("homing took too long", "check the homing switch and the drive's homing time-out"),
    58: Fault("homing searched its whole path", "check the reference switch and the search path"),
    109: Fault("negative software limit", _LIMIT_REMEDY),
    110: Fault("positive software limit", _LIMIT_REMEDY),
    113: Fault("software limits contradict each other", "correct low_limit_mm and high_limit_mm"),
    114: Fault("negative limit switch reached", _SWITCH_REMEDY),
    115: Fault("positive limit switch reached", _SWITCH_REMEDY),
    116: Fault("held by the negative limit switch", _SWITCH_REMEDY),
    117: Fault("held by the positive limit switch", _SWITCH_REMEDY),
    118: Fault("both limit switches at once", "check the switches' wiring"),
    126: Fault("following error: the axis did not follow", "check what blocks the axis"),
    279: Fault("no fixed stop was found", "make diagnosis 279 a warning in the drive's parameters"),
    280: Fault("the fixed stop was lost", "check what gave way under the axis"),
    294: Fault("control by PLC is not set", "end the vendor's software: it has taken control"),
    COMMUNICATION_FAULT: Fault(
        "communication time-out: no request reached the drive",
        "the program hung or the network failed; check the bench and start again",
    ),
}
"""Numbers from the vendor's icp_map.csv, in our words."""


def fault_in_words(number: int) -> tuple[str, str]:
    """Return meaning and remedy of a fault number."""
    known = FAULTS.get(number)
    if known is None:
        return "see the drive's manual", "look the number up in the vendor's software"
    return known.meaning, known.remedy


class FestoCmmtSettings(Settings):
    """Address, units and limits of the drive."""

    driver: Literal["festo-cmmt"] = "festo-cmmt"
    axis: Wiring[Literal["z", "x"]]
    """Axis of the bench that the drive moves."""
    host: Address[str] = Field(min_length=1)
    """Address or name of the drive."""
    port: Address[int] = Field(default=502, ge=1, le=65535)
    """Modbus TCP port."""
    unit_id: Address[int] = Field(default=1, ge=0, le=255)
    """Modbus unit identifier."""
    timeout_s: Wiring[float] = Field(default=0.4, gt=0, le=10)
    """Longest wait for an answer; two have to fit into `communication_timeout_ms`, so that one lost
    answer does not stop the drive."""
    position_unit_mm: Wiring[float] = Field(default=0.001, gt=0, le=1)
    """Length of one count of position in the drive's parametrisation."""
    speed_unit_mm_s: Wiring[float] = Field(default=0.001, gt=0, le=1)
    """Speed of one count."""
    trust_units: bool = False
    """Move although the drive does not report its units, because a person has checked them."""
    low_limit_mm: float
    """Lowest position allowed, set in the drive too."""
    high_limit_mm: float
    """Highest position allowed, set in the drive too."""
    max_speed_mm_s: float = Field(gt=0, le=1000)
    """Fastest motion allowed."""
    acceleration_mm_s2: float = Field(default=200, gt=0, le=50_000)
    """Acceleration of every motion."""
    deceleration_mm_s2: Deceleration[float] = Field(default=200, gt=0, le=50_000)
    """Deceleration of every motion and of a controlled stop."""
    full_acceleration_mm_s2: float = Field(default=1000, gt=0, le=50_000)
    """Acceleration and deceleration that the drive's parameters define as 100 %."""
    communication_timeout_ms: CommunicationTimeout[int] = Field(default=1000, ge=100, le=10_000)
    """Time without a request after which the drive stops by itself."""
    torque_limit_percent: float | None = Field(default=None, gt=0, le=100)
    """Every motion travels to a fixed stop with this clamping torque: the barrier behind the force
    limit. Left out, the drive pushes with all it has; an axis that presses needs it."""
    position_tolerance_mm: float = Field(default=0.02, gt=0, le=1)
    """Largest distance from its target at which a motion may end."""
    homing_timeout_s: float = Field(default=60, gt=0, le=600)
    """Longest time in s that homing may take."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.low_limit_mm < self.high_limit_mm:
            raise ValueError(
                f"low_limit_mm = {self.low_limit_mm:g} mm must be below high_limit_mm = "
                f"{self.high_limit_mm:g} mm"
            )
        if max(self.acceleration_mm_s2, self.deceleration_mm_s2) > self.full_acceleration_mm_s2:
            raise ValueError("acceleration and deceleration cannot exceed full_acceleration_mm_s2")
        if min(self.acceleration_mm_s2, self.deceleration_mm_s2) < (
            self.full_acceleration_mm_s2 / FULL_SCALE
        ):
            raise ValueError("acceleration or deceleration is below the drive's resolution")
        farthest_mm = max(abs(self.low_limit_mm), abs(self.high_limit_mm))
        if farthest_mm / self.position_unit_mm > LARGEST_COUNT:
            raise ValueError("low_limit_mm and high_limit_mm do not fit the drive's counts")
        if self.max_speed_mm_s / self.speed_unit_mm_s > LARGEST_COUNT:
            raise ValueError("max_speed_mm_s does not fit the drive's counts")
        return self

    @property
    def role(self) -> str:
        """The role it plays on the bench."""
        return f"stage_{self.axis}"
