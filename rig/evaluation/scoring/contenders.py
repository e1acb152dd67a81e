"""Detectors and baselines to be scored, at their own thresholds and at thresholds around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rig.core.settings import Settings
from rig.detector import kernel
from rig.detector.detector import IncipientSlipDetector
from rig.detector.settings import DetectorSettings
from rig.evaluation.scoring.baselines import BaselineSettings, baseline_reports
from rig.evaluation.scoring.outcomes import DetectorReport
from rig.evaluation.scoring.seeds import SeedRange

Floats = NDArray[np.float64]

FACTORS: tuple[float, ...] = tuple(2.0 ** (-half / 2) for half in range(-6, 7))
"""Factors on the threshold, descending: the points of a ROC. For a probability, the odds are
multiplied by the square of the factor."""


CANNOT_JUDGE = tuple(
    kernel.REASONS[reason]
    for reason in (
        kernel.SATURATED, kernel.NOT_QUIET, kernel.FIRST_DEAD, kernel.SECOND_DEAD,
        kernel.ONE_INVERTED,
    )
)  # fmt: skip
"""Reasons of a rejected event that say that a recording, or a part of it, cannot be judged."""


class Named(Protocol):
    """What a table states of the one whose alarms are scored."""

    @property
    def name(self) -> str:
        """Name in the tables."""
        ...

    @property
    def settings(self) -> Settings:
        """All of its parameters."""
        ...

    @property
    def tuned_on(self) -> SeedRange | None:
        """Seeds of the trials on which its parameters were chosen; None if unknown."""
        ...


class Contender(Named, Protocol):
    """A detector or baseline that can be scored: it sees the recording and nothing else."""

    def reports(
        self, volts: Floats, rate_Hz: float, factors: tuple[float, ...]
    ) -> list[DetectorReport]:
        """Returns its reports on a recording (n, 2) in V, one for each factor on its threshold."""
        ...


@dataclass(frozen=True)
class DetectorContender:
    """A detector of `rig.detector`."""

    name: str
    """Name in the tables."""
    settings: DetectorSettings
    """Parameters of the detector."""

    @property
    def tuned_on(self) -> SeedRange | None:
        """Seeds of the trials on which its network was trained; None without a network."""
        network = self.settings.network
        if network is None:
            return None
        return SeedRange(first=network.first_seed, end=network.last_seed + 1)

    def reports(
        self, volts: Floats, rate_Hz: float, factors: tuple[float, ...]
    ) -> list[DetectorReport]:
        """Returns the events that it detects at each threshold."""
        return [self._report(volts, rate_Hz, at_threshold(self.settings, one)) for one in factors]

    @staticmethod
    def _report(volts: Floats, rate_Hz: float, settings: DetectorSettings) -> DetectorReport:
        detector = IncipientSlipDetector(settings, rate_Hz)
        events = [*detector.add(volts), *detector.finish()]
        slips = [one.time_s for one in events if one.kind == "incipient slip"]
        armings = [one.time_s for one in events if one.kind == "predictive"]
        rolls = [one.time_s for one in events if one.kind == "roll"]
        return DetectorReport(
            alarms_s=np.array(slips, dtype=np.float64),
            armings_s=np.array(armings, dtype=np.float64),
            rolls_s=np.array(rolls, dtype=np.float64),
            cannot_judge=any(one.reason in CANNOT_JUDGE for one in events),
        )


@dataclass(frozen=True)
class BaselineContender:
    """A plain detector for comparison."""

    settings: BaselineSettings
    """Parameters of the baseline."""

    @property
    def name(self) -> str:
        """Name of its statistic."""
        return self.settings.statistic

    @property
    def tuned_on(self) -> SeedRange | None:
        """Seeds of the trials on which its thresholds were chosen."""
        return self.settings.tuned_on

    def reports(
        self, volts: Floats, rate_Hz: float, factors: tuple[float, ...]
    ) -> list[DetectorReport]:
        """Returns its alarms and early warnings at each threshold."""
        return baseline_reports(volts, rate_Hz, self.settings, factors)


def at_threshold(settings: DetectorSettings, factor: float) -> DetectorSettings:
    """Returns the settings of a detector with `factor` times its threshold."""
    if settings.logic != "rig":
        fire = {
            "fire_mV": factor * settings.fire_mV, "fire_sigmas": factor * settings.fire_sigmas
        }  # fmt: skip
        return settings.model_copy(update=fire)
    odds = factor**2 * settings.fire_probability / (1 - settings.fire_probability)
    return settings.model_copy(update={"fire_probability": odds / (1 + odds)})
