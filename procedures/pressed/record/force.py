"""The force in a trial: what its latest frames say, how old that is, and the frames' record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.approach.contact import FORCE_RATE_S_S
from procedures.pressed.record.lost_frames import COMPARED_LOOKS

if TYPE_CHECKING:
    from procedures.pressed.rates import ServoRates
    from procedures.pressed.record.trial_record import TrialRecord
    from rig.run.context import Run

FORCE_WINDOW_S = 0.004
"""Stretch of force that a tick takes the mean of: shorter is noisier, longer is later. Where that
is less than a frame, it is one frame."""
FORCE_AGE_S = 0.003
"""Age of that mean at `FORCE_RATE_S_S`: half of the window, half a frame, and the rubber."""
BLOCK_S = 0.05
"""Forces and positions are recorded in blocks of this length: each block has a checksum of its own
and its place in the run file."""


@dataclass(frozen=True)
class ForceTiming:
    """Times that follow from the frame rate of the force sensor."""

    rate_S_s: float

    @property
    def window_s(self) -> float:
        """Stretch of force in s that a tick takes the mean of: whole frames, one at least."""
        return max(1, round(FORCE_WINDOW_S * self.rate_S_s)) / self.rate_S_s

    @property
    def block_frames(self) -> int:
        """Number of frames in a block of the record, one at least."""
        return max(1, round(BLOCK_S * self.rate_S_s))

    @property
    def older_s(self) -> float:
        """Additional age in s of a tick's force compared with `FORCE_RATE_S_S`: half of the
        additional length of window and frame."""
        longer_s = self.window_s - FORCE_WINDOW_S + 1 / self.rate_S_s - 1 / FORCE_RATE_S_S
        return longer_s / 2

    @property
    def age_s(self) -> float:
        """Age of a tick's force."""
        return FORCE_AGE_S + self.older_s

    def delay_s(self, rates: ServoRates) -> float:
        """Return the time in s from a command to the first force that shows it."""
        return rates.delay_s + self.older_s


class TrialForce:
    """The force sensor's stream as a trial uses it: the latest force and its age for the servo,
    and every frame for the record."""

    def __init__(self, run: Run, record: TrialRecord):
        self._run, self._record = run, record
        self.timing = ForceTiming(record.force_rate_S_s)
        self.tangential_N = 0.0
        """Force along x of the latest `update`."""
        self.measured_s = 0.0
        """Time on the run's clock at which the force of the latest `update` acted."""
        self.older_s = 0.0
        """Additional age of that force compared with the usual one."""
        self._lacking = [column for column, axis in enumerate("xyz") if axis not in run.force.axes]
        """Columns of the frames of axes that the sensor lacks."""
        self._first_frame = self._frames_sent = 0
        """Number of the record's first frame, and frames since then when the tick began."""

    def update(self) -> float:
        """Take the mean of the latest frames, and return the force along z in N: what presses is
        positive."""
        self.older_s = self._run.force.older_s
        self.measured_s = self._run.clock.now() - self.timing.age_s - self.older_s
        force_N = self._run.force.mean_N(self.timing.window_s)
        self.tangential_N = float(force_N[0])
        return float(force_N[2])

    def start_recording(self) -> None:
        """Start the record with the next frame."""
        self._first_frame = self._run.force.frames_seen
        self._record.frame_looks.clear()
        self.count_frames()

    def count_frames(self) -> None:
        """Note how many frames have come: the next `record_frames` records these."""
        self._frames_sent = self._run.force.frames_seen - self._first_frame
        self._record.frame_looks.append((self._run.clock.now(), self._frames_sent))

    def count_later_frames(self, seconds: float) -> None:
        """Wait so long after the record's end and note how many frames come meanwhile: from these
        it shows whether frames were lost in its last moments."""
        for _ in range(COMPARED_LOOKS):
            self._run.clock.sleep(seconds / COMPARED_LOOKS)
            later = self._run.force.frames_seen - self._first_frame
            self._record.frame_looks.append((self._run.clock.now(), later))

    def record_frames(self, least: int = 1) -> None:
        """Record what `count_frames` has counted and is not recorded, if it is `least` frames."""
        run, record = self._run, self._record
        fresh = self._frames_sent - record.frames
        if fresh < least:
            return
        frames = run.force.frames_since(self._first_frame + record.frames)
        assert frames is not None, "they have been seen"
        first, record.frames = record.frames, record.frames + fresh
        rate_S_s = self.timing.rate_S_s
        raw, force_N = frames.raw[:fresh], frames.force_N[:fresh]
        if self._lacking:  # their zeros are no measurement
            raw, force_N = raw.copy(), force_N.copy()
            raw[:, self._lacking] = force_N[:, self._lacking] = np.nan
        run.streams.record_rows("bridges", first, raw, rate_S_s, units=frames.raw_unit)
        # The sensor's z points up out of the object: what presses on it is F_n.
        newton = np.ascontiguousarray(force_N[:, [2, 0, 1]])
        run.streams.record_rows("force", first, newton, rate_S_s, units="N")
        record.force.append(newton)
