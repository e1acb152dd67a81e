"""The examples in the docstrings of `rig.control` give the numbers that they state."""

from __future__ import annotations

import doctest

import pytest

from rig.control import approach, force_ramp, force_servo


@pytest.mark.parametrize("module", [approach, force_ramp, force_servo])
def test_examples_give_the_numbers_they_state(module) -> None:
    tried = doctest.testmod(module)
    assert tried.attempted > 0
    assert tried.failed == 0
