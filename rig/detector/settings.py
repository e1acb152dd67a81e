"""Parameters of the incipient-slip detectors: one object, stored with every result."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, Self

from pydantic import Field, model_validator

from rig.core.settings import Settings
from rig.detector.low_pass import LowPassSettings
from rig.detector.network import Network, trained_network

Logic = Literal["rig", "paper-literal", "paper-hp"]


class DetectorSettings(Settings):
    """How v_1 and v_2 become events.

    Thresholds are the larger of an absolute floor and a multiple of the noise while nothing
    touches: relative ones alone fail where there is hardly any noise.
    """

    logic: Logic = "rig"
    """``paper-literal``: v_d itself over a threshold while armed (paper 4.3); ``paper-hp``: v_d
    above `impulse_Hz`; ``rig``: both channels, judged by `network`."""
    low_pass: LowPassSettings = LowPassSettings()
    """Shows the predictive signal."""
    impulse_Hz: float = Field(100.0, gt=0)
    """-3 dB frequency of the high-pass that shows the impulse (Butterworth, third order)."""
    quiet_s: float = Field(0.25, gt=0)
    """Offset and noise are judged over so long a piece, and again over every fourth later one."""
    least_noise_mV: float = Field(0.02, gt=0)
    """Noise is never taken to be less."""
    arm_mV: float = Field(0.4, gt=0)
    """The predictive signal arms beyond this ..."""
    arm_sigmas: float = Field(5.0, gt=0)
    """... and beyond so many standard deviations of its own noise."""
    armed_s: float = Field(0.15, gt=0)
    """How long it stays armed after the predictive signal was last beyond half its threshold."""
    fire_mV: float = Field(10.0, gt=0)
    """The impulse fires beyond this (the published logics) ..."""
    fire_sigmas: float = Field(5.0, gt=0)
    """... and beyond so many standard deviations of its noise."""
    look_mV: float = Field(0.15, gt=0)
    """The network looks while the impulse was beyond this ..."""
    look_sigmas: float = Field(3.0, gt=0)
    """... and beyond so many standard deviations within the last 12 ms, and else every 8 ms."""
    fire_probability: float = Field(0.8, gt=0, lt=1)
    """The network's probability of a slip that fires."""
    roll_probability: float = Field(0.9, gt=0, lt=1)
    """The network's probability of a roll that is told."""
    silence_s: float = Field(0.15, gt=0)
    """After a slip was told none is told for so long."""
    saturation_V: float = Field(9.95, gt=0)
    """A channel at or beyond this is saturated: nothing is judged until 50 ms after."""
    dead_s: float = Field(0.5, gt=0)
    """A channel that did not change at all for so long ..."""
    dead_mV: float = Field(5.0, gt=0)
    """... while the other moved by more than this is dead."""
    hum_mV: float = Field(2.0, gt=0)
    """Mains hum of a larger amplitude than this is told."""
    network: Network | None = None
    """Weights of the logic ``rig``, trained on simulated trials."""

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if (self.network is None) == (self.logic == "rig"):
            raise ValueError(
                f"logic {self.logic!r} and network "
                f"{'none' if self.network is None else self.network.name!r}: the logic 'rig' wants "
                "a trained network, the published ones have none"
            )
        return self


@lru_cache(maxsize=1)
def named_detectors() -> dict[str, DetectorSettings]:
    """The detectors that have a name; `rig.detector.DEFAULT_DETECTOR` names the default."""
    return {
        "rig": DetectorSettings(network=trained_network()),
        "paper-literal": DetectorSettings(logic="paper-literal", fire_mV=30.0),
        "paper-hp": DetectorSettings(logic="paper-hp"),
    }
