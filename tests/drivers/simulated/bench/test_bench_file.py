"""The bench file of a simulated bench: what its World settings state in it."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from drivers.simulated.bench.bench_file import Endpoints, bench_toml
from drivers.simulated.bench.options import Fixture, Options
from drivers.simulated.world.settings import WorldSettings
from rig.bench.settings import FixtureSettings


def tables(fixture: Fixture, world: WorldSettings) -> dict[str, Any]:
    """The tables of the bench file."""
    sensor = {"force_sensor": {"driver": "me-gsv8"}}
    endpoints = Endpoints("daq", {"stage_z": 1, "stage_x": 2}, sensor, "generator", "rotary")
    return tomllib.loads(bench_toml(Options(fixture), world, endpoints))


@pytest.mark.parametrize(("fixture", "usual_N_mm"), [("film-clamp", 1000.0), ("plate", 250.0)])
def test_a_stiffest_contact_is_declared_and_recorded_where_the_world_states_one(
    fixture: Fixture, usual_N_mm: float
) -> None:
    usual = tables(fixture, WorldSettings())
    assert "stiffest_contact_N_mm" not in usual["fixture"]
    assert FixtureSettings.model_validate(usual["fixture"]).stiffest_N_mm == usual_N_mm

    stated = tables(fixture, WorldSettings(stiffest_contact_N_mm=150.0))
    assert FixtureSettings.model_validate(stated["fixture"]).stiffest_N_mm == 150.0
    assert stated["simulation"]["stiffest_contact_N_mm"] == 150.0
    assert stated["simulation"]["world"]["stiffest_contact_N_mm"] == 150.0
