"""A line of a list of labelled files, and what is taken for its truth."""

from __future__ import annotations

import numpy as np

from rig.evaluation.labelled_files import _Recorded, _truth


def recorded(**truth: float) -> _Recorded:
    """A trial of 2 s, and what its file says of it."""
    return _Recorded("trial-001", np.zeros((2000, 2)), 1000.0, truth, (), False, "", "", False, ())


def test_a_slip_of_which_only_the_whole_ridge_is_known_can_be_scored() -> None:
    """As `rig import --labels` takes it; it was refused for a time that nobody had stated."""
    row = {"file": "a.h5", "label": "slip", "motion_s": "0.5", "ridge_slip_s": "1.2"}
    truth = _truth(row, recorded(), "list.csv, line 2")
    assert (truth.node_slip_s, truth.ridge_slip_s) == (1.2, 1.2)
    assert _truth(row, recorded(node_slip_s=1.1), "").node_slip_s == 1.1, "the file's own"
    assert _truth(row | {"node_slip_s": "1.0"}, recorded(), "").node_slip_s == 1.0
