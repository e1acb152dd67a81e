"""The population of benches and trials: ranges from which skin, friction, motion and front end are
drawn (all assumed).

Labelled trials (`rig.evaluation`) and simulated benches draw from the same ranges. A bench also
draws its skin's stiffness and the place of its strips; labelled trials do where `drawn_skin` says
so.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from rig.core.settings import Settings
from rig.physics.skin.settings import SkinSettings


class Range(Settings):
    """A range from which a number is drawn."""

    low: float
    """Lowest value."""
    high: float
    """Highest value."""
    logarithmic: bool = False
    """True if the logarithm of the number is drawn evenly."""

    @model_validator(mode="after")
    def _can_be_drawn_from(self) -> Self:
        if self.high < self.low:
            raise ValueError(f"low {self.low:g} is above high {self.high:g}: exchange them")
        if self.logarithmic and self.low <= 0:
            raise ValueError(
                f"low {self.low:g} of a logarithmic range: must be above 0; or set logarithmic "
                "to false"
            )
        return self

    def draw(self, chance: np.random.Generator) -> float:
        """Return a number of the range, evenly distributed in itself or in its logarithm."""
        if self.logarithmic:
            return math.exp(chance.uniform(math.log(self.low), math.log(self.high)))
        return float(chance.uniform(self.low, self.high))


def _evenly(low: float, high: float) -> Range:
    return Range(low=low, high=high)


def _by_ratio(low: float, high: float) -> Range:
    return Range(low=low, high=high, logarithmic=True)


STRIP_PLACE_mm = 0.05
"""Strips are placed in multiples of it, so that few skins have to be condensed."""


def placed_mm(offset_mm: float) -> float:
    """Return the nearest place at which a skin's strips may lie.

    >>> placed_mm(0.337)
    0.35
    """
    return round(round(offset_mm / STRIP_PLACE_mm) * STRIP_PLACE_mm, 6)


class PopulationSettings(Settings):
    """Ranges of the random trials (all assumed). Units are in the names; ratios have none."""

    skin: SkinSettings = SkinSettings(elements_per_ridge=16)
    """The skin on which the trials are simulated; its mesh follows from decision 0083."""
    youngs_modulus_MPa: Range = _by_ratio(0.85, 3.4)
    """Young's modulus of a bench's skin."""
    strip_offset_mm: Range = _evenly(0.25, 0.45)
    """Distance of a bench's strips from the axis of their ridge, to 0.05 mm."""
    drawn_skin: bool = False
    """True if labelled trials draw modulus and strips, too; else they have those of `skin`."""
    ridge: int = Field(3, ge=1)
    """Ridge whose strips are read; 1 is the leftmost."""
    static_coefficient: Range = _evenly(0.3, 1.2)
    """Static friction coefficient μ_s."""
    friction_ratio: Range = _evenly(0.65, 0.97)
    """Ratio of the friction coefficients, μ_k / μ_s."""
    weakening_distance_um: Range = _by_ratio(1.0, 20.0)
    """Distance over which friction falls from static to kinetic."""
    relaxation_time_ms: Range = _by_ratio(0.25, 1.3)
    """Relaxation time of the rubber."""
    normal_force_N: Range = _evenly(2.0, 8.0)
    """Normal force F_n."""
    speed_mm_s: Range = _by_ratio(0.3, 6.0)
    """Speed of a slide."""
    loading_s: Range = _evenly(0.15, 0.4)
    """Duration of pressing on."""
    rest_s: Range = _evenly(0.1, 0.25)
    """Rest between pressing on and the motion."""
    jitter_um: Range = _evenly(0.0, 0.3)
    """Amplitude of the vibration of the stage along x, in every second trial."""
    jitter_Hz: Range = _evenly(20.0, 120.0)
    """Frequency of that vibration."""
    radius_mm: Range = _evenly(15.0, 60.0)
    """Radius of the head that rolls."""
    angle_deg: Range = _evenly(3.5 * 0.7, 3.5 * 1.3)
    """Angle of a roll, in either direction."""
    start_x_mm: Range = _evenly(-7.5, -0.5)
    """Position at which a roll begins."""
    roll_s: Range = _evenly(0.12, 0.8)
    """Duration of a roll."""
    held_share: Range = _evenly(0.15, 0.6)
    """Position at which a hold stops, as a share of the travel to gross slip."""
    held_s: float = Field(0.4, gt=0)
    """Duration of the stop."""
    tap_share: Range = _evenly(0.05, 0.5)
    """Rise of the normal force in a tap on the finger, as a share of F_n."""
    tap_um: Range = _evenly(0.0, 5.0)
    """Sideways motion of the object in a tap, there and back."""
    tap_s: Range = _by_ratio(0.005, 0.04)
    """Duration of a tap, half a sine."""
    ramp_s: Range = _by_ratio(0.05, 0.05)
    """Time in which the object reaches its speed, and comes to a stop."""
    tick_Hz: Range = _by_ratio(50.0, 500.0)
    """Rate of the servo of the normal force, where it has steps."""
    tick_share: Range = _evenly(0.0, 0.0)
    """Steps of the normal force at each tick, rms, as a share of F_n. At 4 N and 1 % they put about
    10 mV on v_s. Labelled trials have none unless this is set."""
    sheared_share: Range = _evenly(0.2, 0.6)
    """Shear of a reversal or tremor, as a share of the way to the slip of the whole ridge."""
    reversals: Range = _evenly(2.0, 5.0)
    """Number of turns of a reversal; fractions are cut."""
    tremor_Hz: Range = _evenly(5.0, 12.0)
    """Frequency of a tremor."""
    tremor_share: Range = _evenly(0.03, 0.15)
    """Amplitude of a tremor, as a share of that way."""
    loaded_share: Range = _evenly(0.4, 0.9)
    """Shear at which the normal force changes, as a share of that way."""
    fall_s: Range = _by_ratio(0.15, 2.0)
    """Duration of the fall of the normal force."""
    grip_share: Range = _evenly(0.1, 0.4)
    """Rise of the normal force in a firmer grip, as a share of F_n."""
    grip_s: Range = _by_ratio(0.005, 0.1)
    """Duration of that rise."""
    quiet_s: float = Field(0.3, ge=0)
    """Time before a trial in which nothing touches."""

    @field_validator("normal_force_N", "speed_mm_s")
    @classmethod
    def _is_positive(cls, value: Range) -> Range:
        if value.low <= 0:
            raise ValueError(f"low {value.low:g}: must be above 0")
        return value


class StripFrontEndSettings(Settings):
    """Ranges of what amplifiers, converter and mains do to the strips' signals (assumed)."""

    noise_mV: Range = _by_ratio(0.1, 2.0)
    """White noise of each channel at the sampling rate, rms."""
    mains_mV: Range = _evenly(0.0, 1.0)
    """Amplitude of the mains on each channel."""
    mains_Hz: float = 50.0
    """Mains frequency."""
    gain_mismatch: Range = _evenly(-0.08, 0.08)
    """Relative excess of the first channel's gain over the second's."""
    gain: Range = _by_ratio(1.0, 1.0)
    """Factor on both channels' gains; noise and mains are those behind the amplifier."""
    coupling_Hz: Range = _evenly(0.0, 0.0)
    """Corner of an AC coupling; 0 is none."""
    flicker_mV: Range = _evenly(0.0, 0.0)
    """Noise with a power of 1/f, rms over the record, on each channel."""
    drift_mV: Range = _evenly(0.0, 0.0)
    """Pyroelectric drift on each channel: how far it goes, with a time constant of `drift_s`."""
    drift_s: Range = _by_ratio(0.3, 5.0)
    """Time constant of that drift."""
    bursts_Hz: Range = _evenly(0.0, 0.0)
    """Rate of bursts: 2 to 20 ms of white noise on both channels."""
    burst_mV: Range = _evenly(2.0, 10.0)
    """Size of a burst, rms."""
    step_mV: Range = _evenly(0.0, 0.0)
    """Step of the converter; 0 is none."""
