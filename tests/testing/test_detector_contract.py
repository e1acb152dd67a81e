"""The contract of detectors: ours fulfil it, and each of its checks fails for a detector that does
not."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tiers import mostly_thorough

from rig.detector import registered
from rig.detector.contract import Detector
from rig.detector.events import SlipEvent
from rig.detector.notices import Notice
from rig.testing import detector_contract
from rig.testing.detectors import checks_of

test_paper_hp = detector_contract("paper-hp")
test_impulse = detector_contract("impulse")
test_rig = pytest.mark.thorough(detector_contract("rig"))
test_paper_literal = pytest.mark.thorough(detector_contract("paper-literal"))


class Steps(Detector):
    """Reports each row in which |v_d| passes 20 mV."""

    version = "1"

    def reset(self) -> None:
        """Forgets the row before."""
        self.above = True

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Compares row by row."""
        events = []
        for row, v_d in enumerate(volts[:, 0] - volts[:, 1]):
            above = bool(abs(v_d) > 0.02)
            if above and not self.above:
                events.append(self.event("incipient slip", row, 0.5))
            self.above = above
        return events


class EachBlockAnew(Steps):
    """Forgets the row before the block."""

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Begins each block anew."""
        self.above = False
        return super().judge(volts)


class Late(Steps):
    """Reports an event with the next block."""

    waiting: list[SlipEvent] = []  # noqa: RUF012 - shared by all instances: that is the fault

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Returns the events of the block before."""
        self.waiting, due = super().judge(volts), self.waiting
        return due


class Shared(Steps):
    """Has one state for all instances."""

    state: dict[str, bool] = {}  # noqa: RUF012 - that is the fault

    @property
    def above(self) -> bool:  # type: ignore[override]
        """The row before, of any instance."""
        return self.state.get("above", True)

    @above.setter
    def above(self, above: bool) -> None:
        self.state["above"] = above


class WithoutReset(Steps):
    """Remembers the rows before a gap."""

    def reset(self) -> None:
        """Does not forget the row before a gap."""
        self.above = getattr(self, "above", True)


class CountsAcrossAGap(Steps):
    """Reports the third step within 0.1 s, and does not forget the steps before a gap."""

    def __init__(self, settings: Any, rate_Hz: float):
        super().__init__(settings, rate_Hz)
        self.row = 0
        self.steps: list[int] = []

    def reset(self) -> None:
        """Forgets only which row is next."""
        super().reset()
        self.row = 0

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Counts the steps of the last 0.1 s."""
        events = []
        for row in range(len(volts)):
            self.row += 1
            if super().judge(volts[row : row + 1]):
                self.steps.append(self.row)
                if len(self.steps) == 3:
                    events.append(self.event("incipient slip", row, 0.5))
            self.steps = [one for one in self.steps if one > self.row - round(self.rate_Hz / 10)]
        return events


class Tolerant(Steps):
    """Takes anything."""

    def checked(self, volts: Any) -> np.ndarray:
        """Replaces NaN and infinity by 0."""
        return np.nan_to_num(np.asarray(volts, dtype=np.float64)).reshape(-1, 2)


class AnyRate(Steps):
    """Judges any rate."""

    @classmethod
    def accepts(cls, rate_Hz: float) -> bool:
        """Accepts all."""
        return True


class Nervous(Steps):
    """Reports a slip in each 100th row."""

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Sees nothing."""
        rows = range(self.rows, self.rows + len(volts))
        return [self.event("incipient slip", n - self.rows, 0.5) for n in rows if n % 100 == 99]


class Changing(Steps):
    """Changes the rows."""

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Removes the offset in place."""
        volts -= 1e-3
        return super().judge(volts)


class AtOnce(Steps):
    """Acts on what the bench knows when it is given, not at its row."""

    reported = 0

    def notice(self, one: Notice) -> None:
        """Counts the notices."""
        self.reported += 1

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Finds nothing after seven notices, which are all that the check gives."""
        return super().judge(volts) if self.reported < 7 else []


class Slow(Steps):
    """Thinks for longer than two rows last."""

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        """Keeps a processor busy for 2.2 ms."""
        until_s = time.process_time() + 2.2e-3
        while time.process_time() < until_s:
            pass
        return super().judge(volts)


FAULTS: dict[str, type[Detector]] = {
    "blocks-give-the-events-of-the-whole": EachBlockAnew,
    "events-lie-in-the-rows-in-which-they-were-decided": Late,
    "notices-are-taken": AtOnce,
    "instances-share-nothing": Shared,
    "a-gap-begins-anew": WithoutReset,
    "rows-that-cannot-be-are-refused": Tolerant,
    "a-rate-that-it-does-not-judge-is-refused": AnyRate,
    "recordings-at-other-rates-are-judged": EachBlockAnew,
    "nothing-is-found-in-nothing": Nervous,
    "rows-are-left-as-they-are": Changing,
    "it-keeps-up-with-a-trial": Slow,
}


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[Detector]], None]:
    """Register a class as a detector of this project, so that nothing checks it but the kit."""

    def one(kind: type[Detector]) -> None:
        own = registered.detector_class
        monkeypatch.setattr(
            registered, "detector_class", lambda name: kind if name == "lab" else own(name)
        )
        monkeypatch.setattr(registered, "is_own", lambda name: True)

    return one


@pytest.mark.parametrize("what", mostly_thorough(checks_of("paper-hp"), default=()))
def test_a_sound_detector_passes(what: str, installed: Callable[[type[Detector]], None]) -> None:
    installed(Steps)
    checks_of("lab")[what]()


@pytest.mark.parametrize("what", mostly_thorough(FAULTS, default=("a-gap-begins-anew",)))
def test_each_check_finds_its_fault(what: str, installed: Callable[[type[Detector]], None]) -> None:
    installed(FAULTS[what])
    with pytest.raises(AssertionError):
        checks_of("lab")[what]()


def test_what_is_remembered_for_a_moment_across_a_gap_is_found(
    installed: Callable[[type[Detector]], None],
) -> None:
    installed(CountsAcrossAGap)
    with pytest.raises(AssertionError, match="rows behind a gap"):
        checks_of("lab")["a-gap-begins-anew"]()


def test_every_check_has_a_fault_that_it_finds() -> None:
    assert set(checks_of("paper-hp")) - set(FAULTS) == {"parameters-survive-json"}
