"""Settings of a roll trial, and the constants that its modules share."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from procedures.pressed.settings import PressedSettings
from procedures.roll_trial.profile import Curve, Profile, ThereAndBack

NUDGES = (0, 1, 0, -1, 0)
NUDGED_S = 0.35
"""For a nudge, which measures the axis, and until the rubber is at rest."""
SETTLED_S = 0.05
"""What a stage may be late at the end of its profile."""
HOMING_ROTARY_S = 1.0
"""Expected of a rotary stage without a reference, and of bringing the object upright."""


class RollTrialSettings(PressedSettings):
    """What a roll trial may be asked for."""

    angle_deg: float = 3.5
    """Angle that is rolled from upright and back (paper 5); positive rolls towards +x."""
    turn_speed_deg_s: float = Field(default=12.0, gt=0)
    """Largest speed of the turn."""
    turn_acceleration_deg_s2: float = Field(default=60.0, gt=0)
    """Of the turn."""
    stay_s: float = Field(default=0.3, ge=0, le=60)
    """Stay at the angle, before the way back."""
    profile_times_s: tuple[float, ...] = ()
    """Times of a curve of angles that is rolled instead, from 0."""
    profile_angles_deg: tuple[float, ...] = ()
    """Its angles, from 0 back to 0."""
    start_mm: float = -5.0
    """Place on the skin, from its middle, at which the roll begins: -5 mm rolls over the third
    ridge (Figure 19 b), -6.5 mm up to it (19 a)."""
    alignment: Literal["compensate", "measure", "none"] = "compensate"
    """Before the first trial: measure how far the rotary axis is off and have x take it back; only
    measure it; or neither."""
    largest_offset_mm: float = Field(default=1.0, gt=0)
    """Offset of the axis, as measured, that is left uncompensated and refused: 2 mm drag the skin
    by half of what makes it slip."""
    angle_error_deg: float = Field(default=0.02, gt=0)
    """Error of the angle at the ends of the roll beyond which a trial does not count."""
    force_error_rms_percent: float = Field(default=3.0, gt=0)
    """Error of the normal force during the roll, rms, beyond which a trial does not count."""
    force_error_peak_percent: float = Field(default=10.0, gt=0)
    """Its largest error beyond which a trial does not count."""

    @model_validator(mode="after")
    def _can_be_rolled(self) -> RollTrialSettings:
        times, angles = self.profile_times_s, self.profile_angles_deg
        if len(times) != len(angles):
            raise ValueError(
                f"profile_times_s has {len(times)} values, profile_angles_deg has {len(angles)}: "
                "each time needs its angle"
            )
        if times and (len(times) < 3 or times[0] != 0 or sorted(set(times)) != list(times)):
            raise ValueError("profile_times_s has to ascend from 0 and to hold at least 3 times")
        if angles and (angles[0] != 0 or angles[-1] != 0):
            raise ValueError("profile_angles_deg has to begin and to end with 0 deg, upright")
        return self

    @property
    def profile(self) -> Profile:
        """What is rolled."""
        if self.profile_times_s:
            own = (self.profile_times_s, self.profile_angles_deg)
            return Curve(*own, acceleration_deg_s2=self.turn_acceleration_deg_s2)
        return ThereAndBack(
            self.angle_deg, self.turn_speed_deg_s, self.turn_acceleration_deg_s2, self.stay_s
        )

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Between which it is rolled."""
        angles = self.profile_angles_deg or (0.0, self.angle_deg)
        return min(angles), max(angles)

    @property
    def updates_a_tick(self) -> int:
        """See `PressedSettings`: x may follow the turn."""
        return 2 if self.alignment == "compensate" else 1
