"""The tiers of tests (docs/contributing.md)."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def mostly_thorough(values: Iterable[Any], default: Collection[Any]) -> list[Any]:
    """Return parameters of a test of which only those in `default` are in the default tier.

    Raises ValueError for a default that is not among the values, so that no test loses its place in
    the default tier by a change of its parameters.
    """
    given = list(values)
    if missing := [value for value in default if value not in given]:
        raise ValueError(f"{missing} are not among the parameters {given}")
    return [
        value if value in default else pytest.param(value, marks=pytest.mark.thorough)
        for value in given
    ]


def mostly_nightly(
    values: Iterable[Any], thorough: Collection[Any], default: Collection[Any] = ()
) -> list[Any]:
    """Return parameters of a test that walks all combinations: those in `default` are in the
    default tier, those in `thorough` in the thorough one, all others in the nightly one.

    Raises ValueError as `mostly_thorough` does.
    """
    given = list(values)
    if missing := [value for value in (*thorough, *default) if value not in given]:
        raise ValueError(f"{missing} are not among the parameters {given}")
    marks = {False: pytest.mark.nightly, True: pytest.mark.thorough}
    return [
        value if value in default else pytest.param(value, marks=marks[value in thorough])
        for value in given
    ]
