"""Benchmarks measure runs as a user makes them."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def ways_as_usual(request: pytest.FixtureRequest) -> None:
    """Let z go where it has not been as on a bench whose file declares no contact, so that figures
    remain comparable."""
    if "rig" in request.fixturenames:
        request.getfixturevalue("rig").usual_ways = True
