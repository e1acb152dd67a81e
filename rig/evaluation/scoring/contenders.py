"""What is scored: a detector or a baseline, at its own thresholds and at those around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rig.core.settings import Settings
from rig.detector.detector import IncipientSlipDetector
from rig.detector.settings import DetectorSettings
from rig.evaluation.scoring.baselines import BaselineSettings, baseline_reports
from rig.evaluation.scoring.outcomes import DetectorReport
from rig.evaluation.scoring.seeds import SeedRange

Floats = NDArray[np.float64]

FACTORS: tuple[float, ...] = tuple(2.0 ** (-half / 2) for half in range(-6, 7))
"""On the threshold, falling: the points of a ROC. The odds of a probability go with the square."""


class Contender(Protocol):
    """Anything that alarms."""

    @property
    def name(self) -> str:
        """By which tables call it."""
        ...

    @property
    def settings(self) -> Settings:
        """All its parameters."""
        ...

    @property
    def tuned_on(self) -> SeedRange | None:
        """Seeds of the trials that its parameters were chosen on, where they are known."""
        ...

    def reports(
        self, volts: Floats, rate_Hz: float, factors: tuple[float, ...]
    ) -> list[DetectorReport]:
        """Of a recording (n, 2) in V, once for each factor on its threshold."""
        ...


@dataclass(frozen=True)
class DetectorContender:
    """A detector of this program."""

    name: str
    settings: DetectorSettings

    @property
    def tuned_on(self) -> SeedRange | None:
        """The seeds that its network was trained on."""
        network = self.settings.network
        if network is None:
            return None
        return SeedRange(first=network.first_seed, end=network.last_seed + 1)

    def reports(
        self, volts: Floats, rate_Hz: float, factors: tuple[float, ...]
    ) -> list[DetectorReport]:
        """Its events at each threshold."""
        return [self._report(volts, rate_Hz, at_threshold(self.settings, one)) for one in factors]

    @staticmethod
    def _report(volts: Floats, rate_Hz: float, settings: DetectorSettings) -> DetectorReport:
        detector = IncipientSlipDetector(settings, rate_Hz)
        events = [*detector.add(volts), *detector.finish()]
        slips = [one.time_s for one in events if one.kind == "incipient slip"]
        armings = [one.time_s for one in events if one.kind == "predictive"]
        rolls = [one.time_s for one in events if one.kind == "roll"]
        return DetectorReport(
            *(np.array(times, dtype=np.float64) for times in (slips, armings, rolls))
        )


@dataclass(frozen=True)
class BaselineContender:
    """A plain detector to compare with."""

    settings: BaselineSettings

    @property
    def name(self) -> str:
        """That of its statistic."""
        return self.settings.statistic

    @property
    def tuned_on(self) -> SeedRange | None:
        """The seeds that its thresholds were chosen on."""
        return self.settings.tuned_on

    def reports(
        self, volts: Floats, rate_Hz: float, factors: tuple[float, ...]
    ) -> list[DetectorReport]:
        """Its alarms and armings at each threshold."""
        return baseline_reports(volts, rate_Hz, self.settings, factors)


def at_threshold(settings: DetectorSettings, factor: float) -> DetectorSettings:
    """A detector that fires at `factor` times its threshold."""
    if settings.logic != "rig":
        fire = {
            "fire_mV": factor * settings.fire_mV, "fire_sigmas": factor * settings.fire_sigmas
        }  # fmt: skip
        return settings.model_copy(update=fire)
    odds = factor**2 * settings.fire_probability / (1 - settings.fire_probability)
    return settings.model_copy(update={"fire_probability": odds / (1 + odds)})
