"""The settings of an AZ drive in a bench file, and the meanings of the drive's alarm numbers.

Plain data: nothing here communicates with a drive or knows a sequence. Alarms 30h, 62h, 66h, 67h,
84h and 85h: the manuals HP-5142E and HM-60262E, public code; the others from memory of the latter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from rig.core.settings import Address, CommunicationTimeout, Deceleration, Settings, Wiring

LARGEST_STEP = 2**31 - 1
"""Positions travel as signed 32-bit integers."""
FASTEST_Hz = 4_000_000
LARGEST_RATE = 1_000_000_000
"""Largest acceleration and deceleration, in 0.001 kHz/s, which are steps/s2."""


@dataclass(frozen=True)
class Alarm:
    """Meaning and remedy of an alarm number."""

    meaning: str
    remedy: str


COMMUNICATION_ALARM = 0x85
"""No request has come over the line within the drive's communication time-out."""
_BLOCKED = (
    "check what blocks the axis; if it belongs there, check that the force sensor shows it, then "
    "raise torque_limit_percent"
)
_POWER = "check the drive's power supply, then switch it off and on"
_SERVICE = "switch the drive off and on; if it happens again, have it repaired"
_COOL = "let it cool down; check for friction and for too much current at rest"
ALARMS: Mapping[int, Alarm] = {
    0x10: Alarm("position deviation: the axis did not follow", _BLOCKED),
    0x20: Alarm("overcurrent", _SERVICE),
    0x21: Alarm("the drive is too hot", _COOL),
    0x22: Alarm("overvoltage", _POWER),
    0x25: Alarm("undervoltage", _POWER),
    0x26: Alarm("the motor is too hot", _COOL),
    0x28: Alarm("the position sensor failed", _SERVICE),
    0x30: Alarm("overload", _BLOCKED),
    0x31: Alarm("overspeed", "check what drives the axis, and its load"),
    0x33: Alarm("absolute position error: the axis has lost its reference", "home it again"),
    0x41: Alarm("the drive's memory failed", _SERVICE),
    0x4A: Alarm("no coordinates: the axis has not been homed", "home it first"),
    0x60: Alarm("both limit switches at once", "check the switches' wiring"),
    0x61: Alarm("the limit switches are swapped", "check the switches' wiring"),
    0x62: Alarm("homing failed", "check the home sensor and the homing method in the drive"),
    0x66: Alarm(
        "limit switch reached",
        "check the axis, move it off the switch with the vendor's software, home again",
    ),
    0x67: Alarm(
        "software limit", "correct the travel limits in the bench file, or the position asked for"
    ),
    0x68: Alarm("emergency stop (HWTO)", "release the emergency stop, then start again"),
    0x70: Alarm("the operation data cannot be carried out", "check speed, rates and steps_per_mm"),
    0x84: Alarm("RS-485 communication error", "check the cable, its shield and its termination"),
    COMMUNICATION_ALARM: Alarm(
        "communication time-out: no request on the line",
        "the program hung or the cable failed; check the bench and start again",
    ),
}
"""Alarms by number, described in our own words."""


def alarm_in_words(number: int) -> tuple[str, str]:
    """Return meaning and remedy of an alarm."""
    known = ALARMS.get(number)
    if known is None:
        return "see the drive's manual", "look the number up in the vendor's software"
    return known.meaning, known.remedy


class OrientalAzSettings(Settings):
    """Address, units and limits of the drive."""

    driver: Literal["oriental-az"] = "oriental-az"
    axis: Wiring[Literal["z", "x"]]
    """Axis of the bench that the drive moves."""
    port: Address[str] = Field(min_length=1)
    """Serial port of the RS-485 line, for example /dev/ttyUSB0; both axes may share it."""
    baudrate: Literal[9600, 19_200, 38_400, 57_600, 115_200, 230_400] = 230_400
    """Baud rate set by the drive's BAUD switch; a servo needs the fastest."""
    parity: Wiring[Literal["E", "O", "N"]] = "E"
    """Even, odd or none, with one stop bit."""
    unit_id: Wiring[int] = Field(ge=1, le=31)
    """The drive's address on the line, as its ID switch says."""
    timeout_s: Wiring[float] = Field(default=0.4, gt=0, le=10)
    """Longest wait for an answer; two have to fit into `communication_timeout_ms`, so that one lost
    answer does not stop the drive."""
    steps_per_mm: Wiring[float] = Field(gt=0, le=100_000)
    """Resolution in steps a revolution by lead in mm. The drive cannot be asked for it."""
    low_limit_mm: float
    """Lowest position allowed, set in the drive too."""
    high_limit_mm: float
    """Highest position allowed, set in the drive too."""
    max_speed_mm_s: float = Field(gt=0, le=1000)
    """Fastest motion allowed."""
    acceleration_mm_s2: float = Field(default=200, gt=0, le=50_000)
    """Acceleration of every motion."""
    deceleration_mm_s2: Deceleration[float] = Field(default=200, gt=0, le=50_000)
    """Deceleration of every motion and of a stop."""
    communication_timeout_ms: CommunicationTimeout[int] = Field(default=1000, ge=200, le=10_000)
    """Time without a request over its line after which the drive stops by itself."""
    torque_limit_percent: float | None = Field(default=None, ge=0.1, le=100)
    """Operating current of every motion, in steps of 0.1 %: the barrier behind the force limit.
    Left out, the drive pushes with all it has; an axis that presses needs it."""
    position_tolerance_mm: float = Field(default=0.02, gt=0, le=1)
    """Largest distance from its target at which a motion may end."""
    following_limit_mm: float = Field(default=0.2, gt=0, le=10)
    """Largest distance by which the axis may lag behind its command; beyond it, it is reported as
    held back."""
    homing_timeout_s: float = Field(default=60, gt=0, le=600)
    """Longest time in s that homing may take."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.low_limit_mm < self.high_limit_mm:
            raise ValueError(
                f"low_limit_mm = {self.low_limit_mm:g} mm must be below high_limit_mm = "
                f"{self.high_limit_mm:g} mm"
            )
        farthest_mm = max(abs(self.low_limit_mm), abs(self.high_limit_mm))
        if farthest_mm * self.steps_per_mm > LARGEST_STEP:
            raise ValueError("low_limit_mm and high_limit_mm do not fit the drive's steps")
        if self.max_speed_mm_s * self.steps_per_mm > FASTEST_Hz:
            raise ValueError(f"max_speed_mm_s is above the drive's {FASTEST_Hz} steps/s")
        fastest = max(self.acceleration_mm_s2, self.deceleration_mm_s2)
        slowest = min(self.acceleration_mm_s2, self.deceleration_mm_s2)
        if fastest * self.steps_per_mm > LARGEST_RATE or slowest * self.steps_per_mm < 1:
            raise ValueError("acceleration or deceleration does not fit the drive's steps/s2")
        return self

    @property
    def current_percent(self) -> float:
        """Operating current of every motion, in percent: the torque limit, or 100 without one."""
        return 100.0 if self.torque_limit_percent is None else self.torque_limit_percent

    @property
    def role(self) -> str:
        """The role it plays on the bench."""
        return f"stage_{self.axis}"
