"""Whether the strips' samples are read in time for the grip; longer blocks where they are not.

An alarm can be answered no sooner than its sample is read. Where a block of samples takes longer on
the DAQ's link than it lasts, the samples come later and later, and longer blocks take less of the
link (`procedures.pressed.record.block_length`). Only a trial whose grip is to answer alarms needs
its samples in time, and only a block length that the user has not fixed (`--block`) is changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from procedures.pressed.record.block_length import BEHIND_S, READING_SHARE, longer_block_s

if TYPE_CHECKING:
    from procedures.pressed.record.strips import StripRecorder
    from procedures.pressed.record.trial_record import TrialRecord
    from procedures.pressed.series import PressedSeries
    from procedures.pressed.settings import PressedSettings
    from rig.run.context import Run


class LateSamples:
    """The delay of a trial's samples, and what follows from it for the trials after it."""

    def __init__(self, run: Run, series: PressedSeries, record: TrialRecord, strips: StripRecorder):
        self._run, self._series, self._record, self._strips = run, series, record, strips
        self._settings: PressedSettings = run.settings

    @property
    def too_late_for_grip(self) -> bool:
        """True if the samples are read too late for the alarms that the grip is to answer."""
        return self._settings.alarms_answered > 0 and self._strips.behind_s > BEHIND_S

    def lengthen_blocks(self, beyond_s: float) -> str | None:
        """Let later trials read longer blocks where the samples are read more than `beyond_s` late.
        Return what was found; None where nothing was, or nothing can be changed."""
        settings, strips = self._settings, self._strips
        if not settings.alarms_answered or settings.block_s is not None:
            return None
        behind_s, read_s, block_s = strips.behind_s, strips.mean_read_s, strips.block_s
        if behind_s <= beyond_s or (longer_s := longer_block_s(block_s, read_s)) is None:
            return None
        self._series.block_s = longer_s
        blocks = f"blocks of {1e3 * longer_s:g} ms from here on"
        # At once: a pause or a trip in the lift takes the place of the reason for it.
        self._run.event("info", "block-length", f"{self._record.point}: {blocks}")
        return (
            f"the strips are read {behind_s:.2g} s late, too late for the grip: a block of "
            f"{1e3 * block_s:g} ms takes {1e3 * read_s:.2g} ms on the DAQ's link; {blocks}"
        )

    def end_motion(self) -> None:
        """Lengthen the blocks after a motion in which the samples came too late, with a warning."""
        if self._strips.mean_read_s <= READING_SHARE * self._strips.block_s:
            return  # a stall, which longer blocks would not have prevented
        if (late := self.lengthen_blocks(BEHIND_S)) is not None:
            self._run.event("warning", "late-samples", f"{self._record.point}: {late}")
