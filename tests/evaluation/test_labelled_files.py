"""A line of a list of labelled files, and what is taken for its truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rig.core.errors import ConfigurationError
from rig.evaluation.labelled_files import _Recorded, _rows, _truth


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


@pytest.mark.parametrize(
    ("column", "cell"),
    [("motion_mm", "3"), ("lift_off_mm", ""), ("points", "12"), ("top", "0.5"), ("stops", "")],
)
def test_numbers_that_are_no_time_are_a_trait_whatever_their_name_is_like(
    column: str, cell: str, tmp_path: Path
) -> None:
    listing = tmp_path / "list.csv"
    listing.write_text(f"file,{column}\na.h5,{cell}\n")
    (row,) = _rows(listing)
    assert row.cells[column] == cell


@pytest.mark.parametrize(
    ("column", "cell"), [("motion", "3"), ("lift_of_s", ""), ("points", "trial-1"), ("lable", "1;")]
)
def test_a_truth_under_a_wrong_name_is_not_ignored(column: str, cell: str, tmp_path: Path) -> None:
    listing = tmp_path / "list.csv"
    listing.write_text(f"file,{column}\na.h5,{cell}\n")
    with pytest.raises(ConfigurationError, match="is not known: did you mean"):
        _rows(listing)
