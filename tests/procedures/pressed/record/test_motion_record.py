"""What a procedure's `reading` is given of the detector's findings."""

from __future__ import annotations

import numpy as np
import pytest

from procedures.pressed.record.motion import motion_record
from procedures.pressed.record.trial_record import TrialRecord
from rig.files.journal.detections import Detection


def test_the_record_has_the_slips_of_the_motion_among_the_times_of_the_signals() -> None:
    recorded = TrialRecord(1, 100.0, 1000.0, 4.0)
    recorded.motion_from_s, recorded.motion_to_s = 1.0, 2.0
    recorded.filter_delay_s = 0.01
    recorded.force, recorded.frames = [np.zeros((3000, 3))], 3000
    recorded.frame_looks = [(100.0, 0), (103.0, 3000)]
    recorded.position = [(1.5, 12.5, 10.0, 12.5, 10.0)]
    recorded.ages_s = [(0.0, 0.0)]
    recorded.volts = [np.zeros((3000, 2))]
    found = [(1.61, "incipient slip"), (1.2, "predictive"), (0.5, "incipient slip")]
    recorded.detections = [
        Detection(kind, round(1e3 * at_s), at_s, at_s, 0.9)  # type: ignore[arg-type]
        for at_s, kind in found
    ]
    motion = motion_record(recorded)
    assert motion.slip_t_s == pytest.approx([0.6])
    assert abs(motion.signal_t_s - motion.slip_t_s).min() < 1e-9
    recorded.detections = []
    assert motion_record(recorded).slip_t_s.shape == (0,)
