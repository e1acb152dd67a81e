"""A detector of another package that fails while it is scored is named, with its package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rig.core.settings import Settings
from rig.detector import registered
from rig.detector.checking import DetectorError
from rig.detector.contract import Detector
from rig.detector.events import SlipEvent
from rig.detector.registered import chosen_detector
from rig.evaluation.scoring.contenders import FACTORS, DetectorContender


class Never(Detector):
    """Finds nothing, and has no threshold."""

    version = "1"
    made = 0

    def reset(self) -> None:
        """Counts how often it was made."""
        type(self).made += 1

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Finds nothing."""
        return []


class Broken(Never):
    """Fails in all that scoring asks."""

    @classmethod
    def seeds_seen(cls, settings: Settings) -> Any:
        """Returns no range of seeds."""
        return "all"

    @classmethod
    def with_threshold(cls, settings: Settings, factor: float) -> Any:
        """Divides by zero below 1."""
        return settings if factor >= 1 else 1 // 0


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[Detector]], DetectorContender]:
    """Register a class as the detector of another package."""

    def one(kind: type[Detector]) -> DetectorContender:
        monkeypatch.setattr(registered, "detector_class", lambda name: kind)
        monkeypatch.setattr(registered, "_package_of", lambda name: ("lab", "1.0"))
        return DetectorContender("lab", chosen_detector("lab"))

    return one


def test_one_without_a_threshold_is_run_once(
    installed: Callable[[type[Detector]], DetectorContender],
) -> None:
    contender = installed(Never)
    assert contender.tuned_on is None
    Never.made = 0
    reports = contender.reports(np.zeros((500, 2)), 1000.0, FACTORS)
    assert len(reports) == len(FACTORS)
    assert all(report.alarms_s.size == 0 for report in reports)
    assert Never.made == 1


def test_one_that_fails_is_named(
    installed: Callable[[type[Detector]], DetectorContender],
) -> None:
    contender = installed(Broken)
    with pytest.raises(DetectorError, match="'lab' of the package lab has seen the seeds 'all'"):
        _ = contender.tuned_on
    with pytest.raises(DetectorError, match="package lab failed at with_threshold: ZeroDivision"):
        contender.reports(np.zeros((500, 2)), 1000.0, FACTORS)
