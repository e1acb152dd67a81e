"""The settings of a Zaber rotary stage in a bench file, and the meanings of its flags and refusals.

Plain data: nothing here communicates with a stage or knows a sequence. The names of the warning
flags are those of the vendor's client zaber-motion 10.2.0. NOT CONFIRMED on a stage, and to be
tried at the first bench; all of it stands here or is named here:

* the microstep of a model (`ZaberRstSettings.microstep_deg` has no default for that reason):
  0.00015625 deg for an X-RST120AK, 0.000234375 deg for an X-RSW60A, both at resolution 64;
* how long a flag stands: NC until the next command to move, NI until one from rest, the faults
  F... until ``warnings clear``, WR and WH until homed (the firmware's manual as public clients
  quote it, of firmware 6);
* the reasons of a rejection other than BADDATA and BADCOMMAND;
* that ``limit.cycle.dist`` is one turn in microsteps and ``encoder.pos`` the encoder's position in
  microsteps, where the stage knows these settings;
* that ``move abs`` takes a speed and an acceleration (the vendor's client sends them, and wants
  firmware 7.25), and that the acceleration counts for braking as well.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from rig.core.settings import Address, Settings, Wiring

SPEED_DATA = 1.6384
"""Speed in the stage's numbers, by microsteps/s (zaber.com/w, A and X series)."""
ACCELERATION_DATA = 1.6384e-4
"""Acceleration in the stage's numbers, by microsteps/s^2 (the same)."""
OLDEST_FIRMWARE = (7, 25)
"""The first whose ``move abs`` takes a speed and an acceleration."""
LARGEST_DATA = 2**31 - 1
_NETWORK = re.compile(r"socket://[\w.-]+:\d{1,5}")


@dataclass(frozen=True)
class Meaning:
    """Meaning and remedy of a flag or a reason."""

    meaning: str
    remedy: str


NOT_REFERENCED = frozenset({"WR", "WH"})
DISABLED = frozenset({"FH", "FV", "FO", "FD"})
"""Flags of a driver that gives the motor no current."""
NOTES = frozenset({"--", "NI", "ND", "NR", "NT", "NU", "NJ"})
"""Flags of which nothing has to follow; NI stands after every change of a motion under way."""

_POWER = "check the supply, then switch the stage off and on"
_BLOCKED = "check what blocks the stage, then home it"
_SERVICE = "home the stage; if it happens again, ask its maker"
_HAND = "make sure that no one is at the stage, then home it"
FLAGS: Mapping[str, Meaning] = {
    "FF": Meaning("critical system error", _POWER),
    "FN": Meaning("peripheral not supported", "check what is connected to the controller"),
    "FZ": Meaning("peripheral inactive", "activate it with the maker's program"),
    "FH": Meaning("hardware emergency stop: the driver is disabled", "release it, then enable it"),
    "FV": Meaning("supply voltage out of range: the driver is disabled", _POWER),
    "FO": Meaning("the driver is disabled", "enable it with the maker's program, then home it"),
    "FC": Meaning("current inrush error", _POWER),
    "FM": Meaning("motor temperature too high", "let it cool, then home it"),
    "FD": Meaning("the driver has disabled itself", "let it cool, switch it off and on, home it"),
    "FQ": Meaning("encoder error: the measured angle may be wrong", _SERVICE),
    "FI": Meaning("index error", _SERVICE),
    "FA": Meaning("analogue encoder lost its synchronisation", _SERVICE),
    "FR": Meaning("overdrive limit exceeded", _BLOCKED),
    "FS": Meaning("stalled, and stopped", _BLOCKED),
    "FB": Meaning("stream outside its bounds", _SERVICE),
    "FP": Meaning("deviated from its path", _BLOCKED),
    "FE": Meaning("limit sensor faulty or not to be reached", _SERVICE),
    "FT": Meaning("excessive twist", _BLOCKED),
    "WL": Meaning("a limit sensor ended a motion where none was expected", _BLOCKED),
    "WP": Meaning("calibration of another type", "correct it with the maker's program"),
    "WV": Meaning("supply voltage out of range", "check the supply"),
    "WT": Meaning("controller too hot", "let it cool"),
    "WS": Meaning("stalled, and continued", _BLOCKED),
    "WM": Meaning("pushed away while it stood", _HAND),
    "WR": Meaning("it has no reference: not homed, or lost", "home it"),
    "WH": Meaning("it has not been homed", "home it"),
    "NC": Meaning("its knob has been turned by hand", _HAND),
}
"""Warning flags, in our words."""
UNKNOWN_FLAG = Meaning("a flag that this program does not know", "look it up in the manual")

REASONS: Mapping[str, Meaning] = {
    "BADDATA": Meaning(
        "the value is outside what the stage accepts",
        "compare it with the stage's limit.min, limit.max, maxspeed and accel",
    ),
    "BADCOMMAND": Meaning(
        "it does not know the command or setting", "check model and firmware of the stage"
    ),
    "BADAXIS": Meaning("it has no such axis", "correct axis in the bench file"),
    "BADMESSAGEID": Meaning("it does not take the message's id", "check the stage's firmware"),
    "DEVICEONLY": Meaning("only the whole device takes it", "check the stage's firmware"),
    "DRIVERDISABLED": Meaning("its driver is disabled", "enable it with the maker's program"),
    "LOCKSTEP": Meaning("it is bound to another axis", "undo that with the maker's program"),
    "NOACCESS": Meaning("it is locked at this access level", "set system.access to 1"),
    "PARKED": Meaning("it is parked", "unpark it with the maker's program, then home it"),
    "REMOTE": Meaning("another program controls it", "end the other program"),
    "STATUSBUSY": Meaning("it is busy", "wait until it is at rest"),
    "AGAIN": Meaning("it cannot do it right now", "try again"),
    "FULL": Meaning("its memory is full", "clear what is stored in the stage"),
}
"""Reasons of a rejection, in our words."""
UNKNOWN_REASON = Meaning("for a reason that this program does not know", "look it up in the manual")


class ZaberRstSettings(Settings):
    """Address, units and limits of the stage."""

    driver: Literal["zaber-rst"] = "zaber-rst"
    port: Address[str] = Field(min_length=1)
    """Serial port, for example /dev/ttyUSB0, or socket://HOST:55550 for a chain on the network."""
    baudrate: int = Field(default=115_200, ge=9_600, le=921_600)
    """Bits a second; without meaning over USB and TCP."""
    device: Wiring[int] = Field(default=1, ge=1, le=99)
    """The device's number on its chain."""
    axis: Wiring[int] = Field(default=1, ge=1, le=9)
    """The axis of that device."""
    timeout_s: Wiring[float] = Field(default=0.5, gt=0, le=10)
    """Longest wait for an answer."""
    microstep_deg: Wiring[float] = Field(gt=0, le=0.01)
    """Angle of one microstep at `resolution`, from the stage's data sheet."""
    resolution: Wiring[int] = Field(default=64, ge=1, le=256)
    """Microsteps in a full step; the stage has to be set so."""
    low_limit_deg: float
    """Lowest angle allowed, set in the stage too."""
    high_limit_deg: float
    """Highest angle allowed, set in the stage too."""
    max_speed_deg_s: float = Field(gt=0, le=1000)
    """Fastest turn allowed, set in the stage too."""
    max_acceleration_deg_s2: float = Field(gt=0, le=50_000)
    """Largest acceleration allowed, set in the stage too; it brakes with it when it is stopped."""
    angle_tolerance_deg: float = Field(default=0.01, gt=0, le=1)
    """Largest distance from its target at which a turn may end."""
    homing_timeout_s: float = Field(default=60, gt=0, le=600)
    """Longest time in s that homing may take."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.port.startswith("socket:") and not _NETWORK.fullmatch(self.port):
            raise ValueError("port on the network must be socket://HOST:NUMBER")
        if not self.low_limit_deg < self.high_limit_deg:
            raise ValueError(
                f"low_limit_deg = {self.low_limit_deg:g} deg must be below high_limit_deg = "
                f"{self.high_limit_deg:g} deg"
            )
        farthest_deg = self.microstep_deg * LARGEST_DATA
        if max(abs(self.low_limit_deg), abs(self.high_limit_deg)) > farthest_deg:
            raise ValueError(
                f"low_limit_deg = {self.low_limit_deg:g} deg and high_limit_deg = "
                f"{self.high_limit_deg:g} deg do not fit the stage's numbers, which reach "
                f"{farthest_deg:.4g} deg to either side"
            )
        if self.speed_data(self.max_speed_deg_s) < 1:
            raise ValueError(
                f"max_speed_deg_s = {self.max_speed_deg_s:g} deg/s is below the slowest turn that "
                f"the stage's numbers can say, {self.lowest_speed_deg_s:.3g} deg/s"
            )
        if self.acceleration_data(self.max_acceleration_deg_s2) < 1:
            raise ValueError(
                f"max_acceleration_deg_s2 = {self.max_acceleration_deg_s2:g} deg/s^2 is below the "
                "smallest that the stage's numbers can say, "
                f"{self.lowest_acceleration_deg_s2:.3g} deg/s^2"
            )
        if self.angle_tolerance_deg < self.microstep_deg:
            raise ValueError(
                f"angle_tolerance_deg = {self.angle_tolerance_deg:g} deg is below one microstep, "
                f"{self.microstep_deg:g} deg"
            )
        return self

    def microsteps(self, angle_deg: float) -> int:
        """Return an angle in the stage's numbers."""
        return round(angle_deg / self.microstep_deg)

    def speed_data(self, speed_deg_s: float) -> int:
        """Return a speed in the stage's numbers, the nearest that is not above the limit."""
        return _nearest(speed_deg_s, self.max_speed_deg_s, self.lowest_speed_deg_s)

    def acceleration_data(self, acceleration_deg_s2: float) -> int:
        """Return an acceleration in the stage's numbers, the nearest that is not above the
        limit."""
        return _nearest(
            acceleration_deg_s2, self.max_acceleration_deg_s2, self.lowest_acceleration_deg_s2
        )

    @property
    def lowest_speed_deg_s(self) -> float:
        """The slowest turn that the stage's numbers can say, and their step."""
        return self.microstep_deg / SPEED_DATA

    @property
    def lowest_acceleration_deg_s2(self) -> float:
        """The smallest acceleration that the stage's numbers can say, and their step: 0.95 deg/s^2
        at microsteps of 0.00015625 deg."""
        return self.microstep_deg / ACCELERATION_DATA


def _nearest(value: float, highest: float, step: float) -> int:
    """Return the whole number of steps nearest to a value, and at most as many as fit the highest
    one, from which rounding shall not take a step."""
    return min(round(value / step), math.floor(highest / step * (1 + 1e-9)))
