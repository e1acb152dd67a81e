"""One contract for all drivers of this project: every role method, every documented error, no wrong
value ever."""

from __future__ import annotations

from importlib.metadata import entry_points

import pytest

from rig.core.entry_points import DRIVERS, OWN_PACKAGE, package
from rig.testing import contract_of

from .cases import CASES

test_driver = contract_of(*CASES)
test_driver_with_every_kind_at_each_request = pytest.mark.nightly(
    contract_of(*CASES, further_deals=(1, 2, 3, 4))
)


def test_every_driver_of_this_project_has_a_case() -> None:
    own = {entry.name for entry in entry_points(group=DRIVERS) if package(entry) == OWN_PACKAGE}
    assert own == {case.driver for case in CASES}
