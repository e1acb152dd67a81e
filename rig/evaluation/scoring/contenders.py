"""Detectors and baselines to be scored, at their own thresholds and at thresholds around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rig.core.settings import Settings, fingerprint
from rig.detector.blocks import BlockFeed
from rig.detector.events import says_inverted, unjudged_s
from rig.detector.notices import Notice
from rig.detector.registered import ChosenDetector
from rig.evaluation.scoring.baselines import BaselineSettings, baseline_reports
from rig.evaluation.scoring.outcomes import DetectorReport
from rig.evaluation.scoring.seeds import SeedRange

Floats = NDArray[np.float64]

FACTORS: tuple[float, ...] = tuple(2.0 ** (-half / 2) for half in range(-6, 7))
"""Factors on the threshold, descending: the points of a ROC. For a probability, the odds are
multiplied by the square of the factor."""


class Named(Protocol):
    """What a table states of the one whose alarms are scored."""

    @property
    def name(self) -> str:
        """Name in the tables."""
        ...

    @property
    def settings(self) -> Settings:
        """Parameters of the detector."""
        ...

    @property
    def tuned_on(self) -> tuple[SeedRange, ...]:
        """Seeds of the trials on which its parameters were chosen; empty if unknown."""
        ...


class Contender(Named, Protocol):
    """A detector or baseline that can be scored: it sees the recording and what the bench knew, and
    nothing else."""

    def reports(
        self,
        volts: Floats,
        rate_Hz: float,
        factors: tuple[float, ...],
        notices: tuple[Notice, ...] = (),
    ) -> list[DetectorReport]:
        """Return its reports on a recording (n, 2) in V with these notices, one for each factor
        on its threshold."""
        ...


@dataclass(frozen=True)
class DetectorContender:
    """A registered detector."""

    name: str
    """Name in the tables."""
    detector: ChosenDetector
    """The detector with its parameters."""

    @property
    def settings(self) -> Settings:
        """Parameters of the detector."""
        return self.detector.settings

    @property
    def tuned_on(self) -> tuple[SeedRange, ...]:
        """Seeds of the trials on which its parameters were chosen; empty where it names none."""
        return tuple(
            SeedRange(first=first, end=last + 1) for first, last in self.detector.seeds_seen()
        )

    def reports(
        self,
        volts: Floats,
        rate_Hz: float,
        factors: tuple[float, ...],
        notices: tuple[Notice, ...] = (),
    ) -> list[DetectorReport]:
        """Return the events that it detects at each threshold."""
        reports: dict[str, DetectorReport] = {}
        found = []
        for factor in factors:
            detector = self.detector.at_threshold(factor)
            key = fingerprint(detector.settings)  # a detector without a threshold is run once
            if key not in reports:
                reports[key] = self._report(volts, BlockFeed(detector, rate_Hz, notices), rate_Hz)
            found.append(reports[key])
        return found

    @staticmethod
    def _report(volts: Floats, detector: BlockFeed, rate_Hz: float) -> DetectorReport:
        events = [*detector.add(volts, first_sample=0), *detector.finish()]
        slips = [one.time_s for one in events if one.kind == "incipient slip"]
        armings = [one.time_s for one in events if one.kind == "predictive"]
        rolls = [one.time_s for one in events if one.kind == "roll"]
        return DetectorReport(
            alarms_s=np.array(slips, dtype=np.float64),
            armings_s=np.array(armings, dtype=np.float64),
            rolls_s=np.array(rolls, dtype=np.float64),
            inverted=says_inverted(events),
            unjudged_s=unjudged_s(events, len(volts) / rate_Hz),
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
    def tuned_on(self) -> tuple[SeedRange, ...]:
        """Seeds of the trials on which its thresholds were chosen."""
        return () if self.settings.tuned_on is None else (self.settings.tuned_on,)

    def reports(
        self,
        volts: Floats,
        rate_Hz: float,
        factors: tuple[float, ...],
        notices: tuple[Notice, ...] = (),
    ) -> list[DetectorReport]:
        """Return its alarms and armings at each threshold; it does not use notices."""
        return baseline_reports(volts, rate_Hz, self.settings, factors)
