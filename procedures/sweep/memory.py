"""The knowledge that a sweep carries from point to point, and the present vibration."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from procedures.sweep.settings import CHANNELS
from rig.analysis.response.levelling import LearnedGain, LearnedMains
from rig.files.journal.layout import TRUTH

if TYPE_CHECKING:
    from procedures.sweep.preload import Preload
    from rig.analysis.response.sine_fit import SineFit
    from rig.run.context import Run
    from rig.run.points import Reading

FOLLOW_S = 0.05
"""Shortest time over which the static force is averaged to follow it."""
FOLLOWED_S = 0.02
"""Duration of a move that follows the creep."""


@dataclass
class SweepMemory:
    """The knowledge of a sweep so far, and the present vibration."""

    preload: Preload
    vibrator: LearnedGain = field(default_factory=LearnedGain)
    """Ratio of load to drive in N/V."""
    film: LearnedGain = field(default_factory=LearnedGain)
    """Ratio of film voltage to load in V/N."""
    mains: dict[str, LearnedMains] = field(
        default_factory=lambda: {channel: LearnedMains() for channel in CHANNELS}
    )
    """Mains lines by channel, in the channel's unit."""
    error_of_one_second: dict[str, float] = field(default_factory=dict)
    """Standard error of each channel's amplitude from one second of record, in its unit."""
    surprise: float = 1.0
    """Relative error of the predicted load at the latest point."""
    drive_V: float = 0.0
    """Present amplitude of the generator."""
    frequency_Hz: float = 0.0
    """Present frequency of the generator."""
    since_s: float = 0.0
    """Time at which the present frequency began."""
    slow_until_s: float = 0.0
    """Time at which a vibration ended that was too slow for a short mean of the force to average it
    out."""
    followed_s: float = 0.0
    """Time at which the latest move after the creep ended; earlier force values do not include its
    effect."""
    _truth_reported: bool = False
    decay_s: float | None = None
    """Time constant of the latest ringing that was seen to decay; None before the first."""

    def film_truth(self, run: Run) -> Reading:
        """Return the simulated bench's own account of its film for the first reading that asks;
        empty afterwards, and on a real bench. No measurement uses it."""
        if self._truth_reported:
            return {}
        self._truth_reported = True
        truth = run.clock.truth()
        return {TRUTH: json.dumps(truth)} if truth else {}

    def recall(self, reading: Reading) -> None:
        """Learn from a reading that an earlier attempt has recorded."""
        frequency, load = (
            float(reading["frequency_Hz"] or 0),
            float(reading["load_amplitude_N"] or 0),
        )
        self.vibrator.learn(frequency, load / float(reading["drive_V"] or 1))
        self.film.learn(frequency, 10 ** (float(reading["gain_dB"] or 0) / 20))

    def learn_noise(self, channel: str, tone: SineFit) -> None:
        """Learn the standard error of an amplitude from one second of record from the residuals of
        a fit."""
        self.error_of_one_second[channel] = tone.residual_rms * math.sqrt(2 / tone.rate_Hz)

    def begin_vibration(self, frequency_Hz: float, amplitude_V: float, now_s: float) -> None:
        """Note the beginning of a vibration of the film at rest."""
        self.frequency_Hz, self.drive_V = frequency_Hz, amplitude_V
        self.since_s = self.slow_until_s = now_s

    def change_vibration(self, frequency_Hz: float, amplitude_V: float, now_s: float) -> None:
        """Note a change of frequency or amplitude; `since_s` changes with the frequency only."""
        if frequency_Hz != self.frequency_Hz:
            self.frequency_Hz, self.since_s = frequency_Hz, now_s
        self.drive_V = amplitude_V

    def hold_preload(self, run: Run) -> None:
        """Follow the film's creep until it is slow, before anything vibrates."""
        self.preload.hold(run, FOLLOW_S, FOLLOWED_S)

    def follow_preload(self, run: Run) -> float:
        """Follow the film's creep by the mean force over whole periods of the present vibration.
        Return the time in s that the stage takes for it, 0 without a move."""
        now, f = run.clock.now(), self.frequency_Hz
        stretch_s = math.ceil(FOLLOW_S * f) / f
        slow = stretch_s > FOLLOW_S + 1e-3
        if slow:
            self.slow_until_s = now
        begun_s = self.since_s if slow else self.slow_until_s
        if now - max(begun_s, self.followed_s) >= stretch_s and self.preload.follow(run, stretch_s):
            self.followed_s = now + FOLLOWED_S
            return FOLLOWED_S
        return 0.0
