"""Settings of a roll trial, and the constants that its modules share."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator
from pydantic.config import JsonDict

from procedures.pressed.settings import PressedSettings, TICK_Hz
from procedures.roll_trial.profile import Curve, Profile, ThereAndBack

NUDGES = (0, 1, 0, -1, 0)
"""Places to either side of the middle, in nudges, at which the axis is measured."""
NUDGE_mm, NUDGE_deg = 0.02, 0.5
"""Nudges of x and of the object that measure the axis: far too small for a slip."""
NUDGED_S = 0.48
"""Mean time expected of a nudge, including the time until the rubber is at rest."""
TURN_deg_s = 12.0
"""Largest speed of the turn at `TICK_Hz` ticks of the servo (paper 5)."""
SETTLED_S = 0.05
"""Time by which a stage may be late at the end of its profile."""
HOMING_ROTARY_S = 1.0
"""Expected time of homing the rotary stage and bringing the object upright."""

LEAST_THERE_S, LONGEST_PROFILE_S = 0.02, 3600.0
"""Shortest time to the largest angle, in which the strips' peaks are looked for, and longest
duration of a curve of angles."""

NO_PROFILE: JsonDict = {"not_with": "profile_times_s"}
"""Marks a field of the roll there and back, which has no effect with a curve of angles."""


class RollTrialSettings(PressedSettings):
    """Settings of a roll trial."""

    angle_deg: float = Field(default=3.5, json_schema_extra=NO_PROFILE)
    """Angle of the roll from upright and back (paper 5); positive rolls towards +x."""
    turn_speed_deg_s: float | None = Field(default=None, gt=0)
    """Largest speed of the turn. Default: 12 deg/s (paper 5); less in proportion where the servo
    has fewer than 100 ticks a second: 3 deg/s at 25 Hz."""
    turn_acceleration_deg_s2: float = Field(default=60.0, gt=0)
    """Acceleration of the turn."""
    stay_s: float = Field(default=0.3, ge=0, le=60, json_schema_extra=NO_PROFILE)
    """Stay at the angle, before the way back."""
    profile_times_s: tuple[float, ...] = ()
    """Times of a curve of angles, from 0, that replaces --angle."""
    profile_angles_deg: tuple[float, ...] = ()
    """Angles of that curve, from 0 back to 0."""
    start_mm: float = -5.0
    """Position on the skin, from its middle, at which the roll begins: -5 mm rolls over the third
    ridge (Figure 19 b), -6.5 mm up to it (19 a)."""
    alignment: Literal["compensate", "measure", "none"] = "compensate"
    """Before the first trial: measure the offset of the rotary axis and compensate for it by x;
    only measure it; or neither."""
    largest_offset_mm: float = Field(
        default=1.0, gt=0, json_schema_extra={"only_with": {"alignment": ["compensate", "measure"]}}
    )
    """Largest offset of the rotary axis that may remain; the roll is refused beyond it. With
    --alignment compensate it is what x cannot compensate for, with measure the whole offset.
    (2 mm already produces half the tangential force needed to slip.)"""
    angle_error_deg: float = Field(default=0.02, gt=0)
    """Largest error of the angle at the ends of the roll; a trial above it is marked invalid."""
    force_error_rms_percent: float = Field(default=3.0, gt=0)
    """Maximum rms normal-force error during the roll; a trial above it is marked invalid."""
    force_error_peak_percent: float = Field(default=10.0, gt=0)
    """Maximum normal-force error at any time of the roll; a trial above it is marked invalid."""

    @model_validator(mode="after")
    def _can_be_rolled(self) -> RollTrialSettings:
        times, angles = self.profile_times_s, self.profile_angles_deg
        if len(times) != len(angles):
            raise ValueError(
                f"profile_times_s has {len(times)} values, profile_angles_deg has {len(angles)}: "
                "each time needs its angle"
            )
        if times and (len(times) < 3 or times[0] != 0 or sorted(set(times)) != list(times)):
            raise ValueError("profile_times_s must ascend from 0 and have at least 3 times")
        if angles and (angles[0] != 0 or angles[-1] != 0):
            raise ValueError("profile_angles_deg must begin and end with 0 deg, upright")
        if times and times[-1] > LONGEST_PROFILE_S:
            raise ValueError(
                f"profile_times_s ends at {times[-1]:g} s, later than {LONGEST_PROFILE_S:g} s"
            )
        there_s = self.profile_at(TICK_Hz).there_s
        if there_s < LEAST_THERE_S:
            asked = f"angle_deg {self.angle_deg:g} deg with stay_s {self.stay_s:g} s has"
            raise ValueError(
                f"{'profile_times_s has' if times else asked} its largest angle after "
                f"{there_s:.3g} s, less than {LEAST_THERE_S:g} s: there would be no roll to record"
            )
        return self

    @property
    def kind_of_press(self) -> str:
        """See `PressedSettings`: a head touches other ridges from each start, and the strips answer
        to it differently."""
        return f"{self.object} at {self.start_mm:g} mm".lstrip()

    def turn_speed_at_deg_s(self, tick_Hz: float) -> float:
        """Return the largest speed of the turn where the servo has this many ticks a second. By
        default a tick is 0.12 deg of the turn, or less: that far the force is held within the
        default errors on every model of stage (docs/safety.md)."""
        return self.turn_speed_deg_s or TURN_deg_s * min(1.0, tick_Hz / TICK_Hz)

    def profile_at(self, tick_Hz: float) -> Profile:
        """Return the profile of the roll where the servo has this many ticks a second."""
        if self.profile_times_s:
            own = (self.profile_times_s, self.profile_angles_deg)
            return Curve(*own, acceleration_deg_s2=self.turn_acceleration_deg_s2)
        return ThereAndBack(
            self.angle_deg,
            self.turn_speed_at_deg_s(tick_Hz),
            self.turn_acceleration_deg_s2,
            self.stay_s,
        )

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Smallest and largest angle of the roll."""
        angles = self.profile_angles_deg or (0.0, self.angle_deg)
        return min(angles), max(angles)

    @property
    def updates_a_tick(self) -> int:
        """Updates per tick; see `PressedSettings`. x may have to follow the turn."""
        return 2 if self.alignment == "compensate" else 1
