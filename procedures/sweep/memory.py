"""What a sweep carries from point to point: what it has learned, and what vibrates at present."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from procedures.sweep.settings import CHANNELS
from rig.analysis.response.levelling import LearnedGain, LearnedMains

if TYPE_CHECKING:
    from procedures.sweep.preload import Preload
    from rig.analysis.response.sine_fit import SineFit
    from rig.run.context import Run
    from rig.run.points import Reading

FOLLOW_S = 0.05
"""Least stretch of the static force that is followed."""
FOLLOWED_S = 0.02
"""What a move after the creep takes."""


@dataclass
class SweepMemory:
    """What a sweep has learned so far, and the vibration under way."""

    preload: Preload
    vibrator: LearnedGain = field(default_factory=LearnedGain)
    """Load by drive, N/V."""
    film: LearnedGain = field(default_factory=LearnedGain)
    """Film voltage by load, V/N."""
    mains: dict[str, LearnedMains] = field(
        default_factory=lambda: {channel: LearnedMains() for channel in CHANNELS}
    )
    """By channel, in the channel's unit."""
    error_of_one_second: dict[str, float] = field(default_factory=dict)
    """Standard error of each channel's amplitude from one second of record, in its unit."""
    surprise: float = 1.0
    """How far the load was from the one foretold, relative, at the latest point."""
    drive_V: float = 0.0
    """Amplitude that the generator is set to."""
    frequency_Hz: float = 0.0
    """Frequency that it is set to."""
    since_s: float = 0.0
    """When the present frequency began."""
    slow_until_s: float = 0.0
    """When a vibration so slow that a short mean of the force does not average it out ended."""
    followed_s: float = 0.0
    """When the latest move after the creep was over: what came before says nothing of it."""

    def recall(self, reading: Reading) -> None:
        """Learn from a reading that an earlier attempt has kept."""
        frequency, load = (
            float(reading["frequency_Hz"] or 0),
            float(reading["load_amplitude_N"] or 0),
        )
        self.vibrator.learn(frequency, load / float(reading["drive_V"] or 1))
        self.film.learn(frequency, 10 ** (float(reading["gain_dB"] or 0) / 20))

    def learn_noise(self, channel: str, tone: SineFit) -> None:
        """How well one second would tell an amplitude, from what a fit has left over."""
        self.error_of_one_second[channel] = tone.residual_rms * math.sqrt(2 / tone.rate_Hz)

    def begin_vibration(self, frequency_Hz: float, amplitude_V: float, now_s: float) -> None:
        """From a film at rest."""
        self.frequency_Hz, self.drive_V = frequency_Hz, amplitude_V
        self.since_s = self.slow_until_s = now_s

    def change_vibration(self, frequency_Hz: float, amplitude_V: float, now_s: float) -> None:
        """To another frequency or amplitude; a frequency that stays goes on counting."""
        if frequency_Hz != self.frequency_Hz:
            self.frequency_Hz, self.since_s = frequency_Hz, now_s
        self.drive_V = amplitude_V

    def hold_preload(self, run: Run) -> None:
        """While nothing vibrates yet: follow the film's creep until it is slow."""
        self.preload.hold(run, FOLLOW_S, FOLLOWED_S)

    def follow_preload(self, run: Run) -> None:
        """Follow the film's creep by the mean force over whole periods of the present vibration."""
        now, f = run.clock.now(), self.frequency_Hz
        stretch_s = math.ceil(FOLLOW_S * f) / f
        slow = stretch_s > FOLLOW_S + 1e-3
        if slow:
            self.slow_until_s = now
        begun_s = self.since_s if slow else self.slow_until_s
        if now - max(begun_s, self.followed_s) >= stretch_s and self.preload.follow(run, stretch_s):
            self.followed_s = now + FOLLOWED_S
