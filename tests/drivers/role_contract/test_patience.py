"""A fault whose time-out a busy computer met too is tried again with a longer one."""

from __future__ import annotations

import pytest

from rig.testing import Case
from rig.testing.checks import PATIENT_S, dealt_places, faulty_experiment

from .cases import CASES, LineAxisCase

DRIVES = [case for case in CASES if case.driver in ("festo-cmmt", "oriental-az")]


@pytest.mark.parametrize("case", DRIVES, ids=lambda case: case.name)
def test_the_longer_time_out_is_shorter_than_that_of_a_drive(case: Case) -> None:
    """Else a drive that nobody has spoken to for as long would stop: a fault of its own."""
    with case.serve() as service:
        assert 1e-3 * service.settings["communication_timeout_ms"] > 2 * PATIENT_S


def test_a_late_answer_in_a_motion_stops_no_drive() -> None:
    case = LineAxisCase()
    at = max(dealt_places(case))
    failures, heard, unexplained = faulty_experiment(case, "stale", at, PATIENT_S)
    assert not unexplained, heard
    assert len(failures) <= 1
