"""Settings of a slip trial, and the constants that its modules share."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator
from pydantic.config import JsonDict

from procedures.pressed.grip import GripSettings
from procedures.pressed.settings import DELAY_S

UNREHEARSED_mm = 0.0175
"""Travel within delay and tick up to which the servo holds the force in an unrehearsed slide,
whatever the friction (decision 0035)."""
SLID_ON_mm = 0.3
"""Length of the slide that follows a ramp, for the kinetic coefficient."""
FRICTION = 0.7
"""Expected friction coefficient of the skin on the plate, from which the end of a ramp is
estimated."""
SEEN_S = 0.04
"""Expected time from the end of a slide until it is noticed."""


RAMPS_ONLY: JsonDict = {"only_with": {"loading": "ramp"}}
"""Marks a field that has an effect on ramps only; as an option it is refused for a slide."""
WEIGHTS_ONLY: JsonDict = {"needs": "hold_at_N"}
"""Marks a field that has an effect only together with `hold_at_N`; as an option it is refused
without it."""


class SlipTrialSettings(GripSettings):
    """Settings of a slip trial."""

    loading: Literal["slide", "ramp"] = "slide"
    """Loading of the skin: a slide at constant speed, or a tangential force that rises linearly."""
    speed_mm_s: float = Field(default=0.5, gt=0)
    """Speed of the slide; for a ramp, the largest speed and the speed after gross slip."""
    distance_mm: float = Field(default=1.0, gt=0)
    """Length of the slide; for a ramp, the largest length."""
    ramp_N_s: float = Field(default=2.0, gt=0, json_schema_extra=RAMPS_ONLY)
    """Rate of the tangential force in a ramp."""
    ramp_to_N: float = Field(
        default=10.0, gt=0, json_schema_extra={**RAMPS_ONLY, "not_with": "hold_at_N"}
    )
    """Tangential force at which a ramp ends if nothing has slipped."""
    hold_at_N: float | None = Field(default=None, gt=0, json_schema_extra=RAMPS_ONLY)
    """Tangential force to which a ramp rises and which it then holds, as a weight does; by default
    a ramp ends at --ramp-to."""
    hold_for_s: float = Field(default=1.0, gt=0, le=60, json_schema_extra=WEIGHTS_ONLY)
    """Time for which the weight of --hold-at has to rest on the contact to be held."""
    lost_mm: float = Field(default=0.5, gt=0, json_schema_extra=WEIGHTS_ONLY)
    """Travel of the skin, from where the tangential force last followed the ramp, beyond which the
    weight of --hold-at is lost; one that never comes to rest is lost, too."""
    direction: Literal["+x", "-x"] = "+x"
    """Direction of the slide."""
    start_mm: float = 10.0
    """Position of the x stage at which a trial begins."""
    rehearsal: Literal["auto", "always", "never"] = "auto"
    """Unrecorded practice slide for the force servo to learn from. auto: only when needed."""

    @model_validator(mode="after")
    def _ramp_fits(self) -> SlipTrialSettings:
        if self.hold_at_N is not None:
            if self.hold_at_N >= self.largest_force_N:
                raise ValueError(
                    f"hold_at_N {self.hold_at_N:g} N is not below largest_force_N "
                    f"{self.largest_force_N:g} N"
                )
            if self.lost_mm >= self.distance_mm:
                raise ValueError(
                    f"lost_mm {self.lost_mm:g} mm is not below distance_mm {self.distance_mm:g} mm"
                )
        elif self.loading == "ramp" and self.ramp_to_N >= self.largest_force_N:
            raise ValueError(
                f"ramp_to_N {self.ramp_to_N:g} N is not below largest_force_N "
                f"{self.largest_force_N:g} N"
            )
        return self

    @property
    def longest_slide_s(self) -> float:
        """Longest time that a slide or a ramp may take."""
        ramps_s = 2 * self.speed_mm_s / self.acceleration_mm_s2
        rise_s = self.ramp_to_N / self.ramp_N_s if self.loading == "ramp" else 0.0
        if self.hold_at_N is not None:
            rise_s = self.hold_at_N / self.ramp_N_s + self.hold_for_s
        return rise_s + self.distance_mm / self.speed_mm_s + ramps_s + 1.0

    @property
    def slide_s(self) -> float:
        """Time that a slide or a ramp is expected to take."""
        way_s = self.distance_mm / self.speed_mm_s + self.speed_mm_s / self.acceleration_mm_s2
        if self.loading == "slide":
            return way_s + SEEN_S
        if self.hold_at_N is not None:
            return self.hold_at_N / self.ramp_N_s + self.hold_for_s + SEEN_S
        slips_N = min(self.ramp_to_N, FRICTION * self.normal_force_N)
        on_mm = SLID_ON_mm if slips_N < self.ramp_to_N else 0.0
        return slips_N / self.ramp_N_s + min(on_mm / self.speed_mm_s, way_s) + SEEN_S

    @property
    def updates_a_tick(self) -> int:
        """Updates per tick; see `PressedSettings`."""
        return 2 if self.loading == "ramp" else 1

    def rehearsed(self, tick_s: float, delay_s: float = DELAY_S) -> bool:
        """Return whether a series begins with a rehearsal."""
        if self.rehearsal != "auto":
            return self.rehearsal == "always"
        return self.speed_mm_s * (delay_s + tick_s) > UNREHEARSED_mm

    @property
    def along(self) -> int:
        """Sign of the slide along x: 1 or -1."""
        return 1 if self.direction == "+x" else -1

    @property
    def end_mm(self) -> float:
        """Position of x at which the slide ends."""
        return self.start_mm + self.along * self.distance_mm
