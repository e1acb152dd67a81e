"""Which checks of the contract are left to the thorough tier."""

from __future__ import annotations

import pytest

LATER = (
    "rst-serial-one_fault_anywhere",
    "az-rtu-one_fault_anywhere",
    "cmmt-modbus-one_fault_anywhere",
    "33500b-socket-an_instrument_that_goes_away",
)
"""Beginnings of the ids of checks that take seconds each; other links are walked by default."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark them before pytest chooses by marks."""
    for item in items:
        if item.name.startswith(tuple(f"test_driver[{name}" for name in LATER)):
            item.add_marker(pytest.mark.thorough)
