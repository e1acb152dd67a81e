"""What x is commanded to do in a trial, for the detector: it need not guess a stop or a turn."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rig.analysis.trial.decimation import DECIMATED_Hz
from rig.detector.notices import XMove

if TYPE_CHECKING:
    from procedures.pressed.record.detection import LiveDetection
    from procedures.pressed.record.trial_record import TrialRecord
    from rig.core.clock import Clock

SAME_SPEED = 0.1
"""Change of the speed, as a share of it, below which a command is not passed on: a ramp commands x
in every tick."""


class CommandedX:
    """Follows the commands of x while a trial records, and passes on those that change its motion.

    Where x is, is reckoned from the commands, as if it sped up and braked at once: the detector
    needs to know when x comes to its target to some 10 ms. Called by the procedure's thread.
    """

    def __init__(self, clock: Clock, record: TrialRecord, detection: LiveDetection):
        self._clock, self._record, self._detection = clock, record, detection
        self._recording = False
        self._at_mm = self._target_mm = self._speed_mm_s = 0.0
        self._at_s = 0.0
        """Time since the record began at which x was at `_at_mm`."""
        self._passed_mm_s = 0.0
        """Speed of the latest command that was passed on."""

    def begin(self, at_mm: float) -> None:
        """Begin with the record; x rests at `at_mm`."""
        self._recording, self._at_s = True, 0.0
        self._at_mm = self._target_mm = at_mm
        self._speed_mm_s = self._passed_mm_s = 0.0

    def end(self) -> None:
        """End with the record."""
        self._recording = False

    def command(self, to_mm: float, speed_mm_s: float) -> None:
        """Note that x was commanded to go somewhere at a speed, without a sign; 0 for a stop."""
        if not self._recording:
            return
        now_s = self._clock.now() - self._record.begun_s
        gone_mm = abs(self._speed_mm_s) * (now_s - self._at_s)
        left_mm = self._target_mm - self._at_mm
        arrived = gone_mm >= abs(left_mm)
        self._at_mm = self._target_mm if arrived else self._at_mm + math.copysign(gone_mm, left_mm)
        way_mm = to_mm - self._at_mm if speed_mm_s else 0.0
        self._at_s, self._target_mm = now_s, self._at_mm + way_mm
        self._speed_mm_s = math.copysign(speed_mm_s, way_mm) if way_mm else 0.0
        if arrived:
            self._passed_mm_s = 0.0
        change_mm_s = abs(self._speed_mm_s - self._passed_mm_s)
        if change_mm_s <= SAME_SPEED * abs(self._passed_mm_s):
            return
        self._passed_mm_s = self._speed_mm_s
        way_s = way_mm / self._speed_mm_s if self._speed_mm_s else 0.0
        sample, until = (math.ceil(at_s * DECIMATED_Hz) for at_s in (now_s, now_s + way_s))
        self._detection.notice(XMove(sample, self._speed_mm_s, until))
