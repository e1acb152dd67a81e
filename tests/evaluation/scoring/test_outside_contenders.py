"""A detector of another package is scored as a trial uses it, and named where it fails."""

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
from rig.detector.notices import HeldForce, XMove
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


class Noting(Never):
    """Alarms at the largest v_1 of each block, and notes what it is given."""

    given: list[Any]

    def reset(self) -> None:
        """Forgets nothing."""

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Alarms where v_1 is largest, which a block without an end shows before it happens."""
        type(self).given.append(len(volts))
        if not len(volts) or volts[:, 0].max() < 1:
            return []
        return [self.event("incipient slip", int(volts[:, 0].argmax()), 1.0)]

    def commanded(self, before_mm_s: float, after_mm_s: float) -> None:
        """Notes the speed."""
        type(self).given.append(("x", after_mm_s))

    def commanded_force(self, before_N: float | None, after_N: float) -> None:
        """Notes the force."""
        type(self).given.append(("force", after_N))


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
    assert contender.tuned_on == ()
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


def test_one_sees_no_row_of_the_future(
    installed: Callable[[type[Detector]], DetectorContender],
) -> None:
    """An alarm at the largest signal of the whole recording would find every slip at once."""
    Noting.given = []
    volts = np.zeros((500, 2))
    volts[300:400, 0] = np.linspace(1.0, 2.0, 100)
    (report,) = installed(Noting).reports(volts, 1000.0, (1.0,))
    assert Noting.given == [2] * 250
    assert report.alarms_s[0] == 0.301, "the largest of its own block, not that of all rows"
    assert len(report.alarms_s) == 50


def test_one_is_given_each_command_when_it_takes_effect(
    installed: Callable[[type[Detector]], DetectorContender],
) -> None:
    Noting.given = []
    # The second move takes the place of the first before that has begun.
    notices = (XMove(9, 0.5, 400), XMove(4, -0.5, 7), HeldForce(2, 4.0), HeldForce(8, 3.0))
    contender = installed(Noting)
    contender.reports(np.zeros((12, 2)), 1000.0, (1.0,), notices)
    said = [one for one in Noting.given if isinstance(one, tuple)]
    assert said == [("force", 4.0), ("x", -0.5), ("x", 0.0), ("force", 3.0)]
    assert sum(one for one in Noting.given if isinstance(one, int)) == 12
