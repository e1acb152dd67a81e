"""Checks whether the stages can reach the places that the bench file states of its fixtures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rig.bench.connected import Bench
from rig.bench.settings import FixtureSettings
from rig.core.errors import ConfigurationError


@dataclass(frozen=True)
class _PlaceKind:
    """A key of a fixture that is a position of a stage."""

    key: str
    role: str
    quantity: str
    """Quantity of the stage's limits, as in `Instrument.limits`."""


_PLACES = (
    _PlaceKind("parked_mm", "stage_z", "position"),
    _PlaceKind("contact_from_mm", "stage_z", "position"),
    _PlaceKind("contact_to_mm", "stage_z", "position"),
    _PlaceKind("centre_mm", "stage_x", "position"),
    _PlaceKind("upright_deg", "rotary", "angle"),
)


def out_of_reach(bench: Bench) -> Iterator[ConfigurationError]:
    """Yield an error for each place of a mounted fixture that lies outside the limits of its stage.

    All mounted fixtures are checked, since they are served by the same stages. An error names the
    table and key of the bench file, value, unit, and the limits with the stage that has them. A
    stage that the bench does not have limits nothing.
    """
    limits = bench.limits()
    for index, fixture in enumerate(bench.settings.fixtures):
        table = "[fixture]" if index == 0 else f"[[also_mounted]] {fixture.mounted}"
        for place in _PLACES:
            value = _value(fixture, place.key)
            own = limits.get(f"{place.role}.{place.quantity}")
            if value is None or own is None or own.holds(value):
                continue
            yield ConfigurationError(
                f"{bench.plan.source}: {table} {place.key} = {value:g} {own.unit} is outside "
                f"{own.low:g} to {own.high:g} {own.unit} of the {own.limited_by}",
                f"correct {place.key}, or the limits of [{place.role}] if the stage can go there",
            )


def _value(fixture: FixtureSettings, key: str) -> float | None:
    value: float | None = getattr(fixture, key)
    return value
