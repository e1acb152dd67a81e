"""What the detector of another package returns is put in order and checked."""

from __future__ import annotations

import numpy as np
import pytest

from rig.core.settings import Settings
from rig.detector.checking import CheckedDetector, DetectorError, event_fault
from rig.detector.contract import Detector, Reals
from rig.detector.events import SlipEvent


class ByChannel(Detector):
    """Looks for what it looks for in one channel after the other."""

    version = "1"

    def reset(self) -> None:
        """Nothing is kept."""

    def judge(self, volts: Reals) -> list[SlipEvent]:
        """Return events out of order, two of them in one row."""
        kinds = (("roll", 7), ("incipient slip", 2), ("roll", 2), ("cannot judge", 5))
        return [self.event(kind, row, 0.5) for kind, row in kinds]  # type: ignore[arg-type]


def test_events_of_a_block_are_taken_in_the_order_of_their_rows() -> None:
    settings = Settings()
    checked = CheckedDetector(lambda rate: ByChannel(settings, rate), "x", "x", settings, 1000.0)
    found = checked.add(np.zeros((10, 2)), 0)
    assert [(event.kind, event.sample) for event in found] == [
        ("incipient slip", 2),
        ("roll", 2),
        ("cannot judge", 5),
        ("roll", 7),
    ]


def test_texts_that_no_file_can_hold_are_refused_with_the_detector_s_name() -> None:
    def fault(reason: str = "", name: str = "jump_mV", value: object = 1.0) -> str | None:
        event = SlipEvent("rejected", 3, 0.003, 0.5, reason, {name: value})  # type: ignore[dict-item]
        return event_fault(event, 0, 10, 1000.0)

    assert fault("no motion µ, 滑") is None
    assert fault("nul\0after") == "an event whose reason a file cannot hold: 'nul\\x00after'"
    assert fault("half \udc80") == "an event whose reason a file cannot hold: 'half \\udc80'"
    assert "whose name a file cannot hold: 'a\\x00b'" in str(fault(name="a\0b"))
    assert fault(value=np.int8(3)) is None
    for value in (np.nan, np.complex64(1), "3", 10**400):
        assert fault(value=value) == "an event whose feature 'jump_mV' is not a finite number"


class WithoutReturn(ByChannel):
    """Forgets to return what it has found."""

    def judge(self, volts: Reals) -> list[SlipEvent]:  # type: ignore[return]
        """Returns nothing."""
        super().judge(volts)


def test_a_judge_without_a_return_is_named_as_that() -> None:
    settings = Settings()
    checked = CheckedDetector(lambda rate: WithoutReturn(settings, rate), "x", "x", settings, 1e3)
    with pytest.raises(DetectorError, match="judge returned None where a list of events is expect"):
        checked.add(np.zeros((10, 2)), 0)
