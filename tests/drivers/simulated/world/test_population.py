"""A bench of the population: drawn by its seed, and stated whole in its bench file."""

from __future__ import annotations

import tomllib

import pytest

from drivers.simulated.bench.bench_file import Endpoints, bench_toml
from drivers.simulated.bench.options import Fixture, Options, world_settings
from drivers.simulated.world.plate_world import HeadWorldSettings, PlateWorldSettings
from drivers.simulated.world.population import drawn_world
from drivers.simulated.world.settings import WorldSettings
from rig.core.errors import ConfigurationError
from rig.physics.contact.settings import Cylinder
from rig.physics.population import PopulationSettings, Range, StripFrontEndSettings


def written(options: Options, world: WorldSettings) -> dict[str, object]:
    own = {"force_sensor": {"driver": "me-gsv8"}}
    endpoints = Endpoints(daq="", stages={"stage_z": 1, "stage_x": 2}, own=own)
    found: dict[str, object] = tomllib.loads(bench_toml(options, world, endpoints))["simulation"]
    return found


def test_the_seed_alone_draws_the_bench_and_a_plate_has_the_skin_of_a_head() -> None:
    worlds = [drawn_world(PlateWorldSettings, seed) for seed in range(20)]
    assert worlds == [drawn_world(PlateWorldSettings, seed) for seed in range(20)]
    for trait in ("skin.youngs_modulus_MPa", "contact.friction", "skin_mount.gain_mismatch"):
        table, key = trait.split(".")
        assert len({str(getattr(getattr(world, table), key)) for world in worlds}) == 20
    assert len({world.skin.strips.offset_mm for world in worlds}) == 5
    head = drawn_world(HeadWorldSettings, 3)
    for name in ("skin", "contact", "skin_mount"):
        assert getattr(head, name) == getattr(worlds[3], name)


def test_what_is_drawn_lies_in_the_ranges_of_the_labelled_trials() -> None:
    ranges, front_end = PopulationSettings(), StripFrontEndSettings()

    def inside(value: float, within: Range) -> bool:
        return within.low - 1e-6 <= value <= within.high + 1e-6

    for seed in range(50):
        world = drawn_world(HeadWorldSettings, seed)
        friction = world.contact.friction
        assert inside(friction.static_coefficient, ranges.static_coefficient)
        ratio = friction.kinetic_coefficient / friction.static_coefficient
        assert inside(ratio, ranges.friction_ratio.model_copy(update={"low": 0.65 - 1e-5}))
        assert inside(friction.weakening_distance_um, ranges.weakening_distance_um)
        assert inside(world.contact.relaxation_time_ms, ranges.relaxation_time_ms)
        assert inside(world.skin.youngs_modulus_MPa, ranges.youngs_modulus_MPa)
        assert inside(world.skin.strips.offset_mm, ranges.strip_offset_mm)
        assert inside(world.skin_mount.gain_mismatch, front_end.gain_mismatch)
        assert isinstance(world.head.body, Cylinder)
        assert inside(world.head.body.radius_mm, ranges.radius_mm)
        assert world.skin.elements_per_ridge == ranges.skin.elements_per_ridge


@pytest.mark.parametrize("fixture", ["film-clamp", "plate", "semi-spherical-object"])
def test_a_bench_file_states_the_whole_world_and_what_makes_it_again(fixture: Fixture) -> None:
    word = None if fixture == "film-clamp" else "population"
    options = Options(fixture=fixture, seed=4, world=word)
    world = world_settings(options)
    simulation = written(options, world)
    whole = simulation.pop("world")
    film = whole.pop("mounted_film", {})
    assert (film.keys() == {"vibrator", "circuit"}) == (fixture == "film-clamp")
    assert whole == world.model_dump(mode="json", exclude_none=True)
    assert simulation.pop("seed") == 4
    again = type(world).model_validate(simulation)
    assert again == world
    assert (simulation != {}) == (word is not None)


def test_the_film_clamp_has_no_skin_to_draw() -> None:
    with pytest.raises(ConfigurationError, match="draws a skin, and the film clamp has none"):
        world_settings(Options(world="population"))
