"""A bench of the population: skin, friction, strips and head drawn by the seed.

What is not drawn has its default. The result states every drawn value explicitly, so that a bench
can be made again from its bench file without this module.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from drivers.simulated.world.plate_world import HeadWorldSettings, PlateWorldSettings
from rig.physics.population import PopulationSettings, StripFrontEndSettings, placed_mm

POPULATION = "population"
"""Word that stands for a drawn World in the place of a file of World settings."""
_KEY = 7001
"""Keys the draw, so that it shares no random numbers with films and noise."""

W = TypeVar("W", bound=PlateWorldSettings)


def drawn_world(kind: type[W], seed: int) -> W:
    """Return the World of a seed: always the same one, and the same skin under a plate or a
    head."""
    ranges, front_end = PopulationSettings(), StripFrontEndSettings()
    chance = np.random.default_rng([_KEY, seed])

    def draw(name: str) -> float:
        return round(float(getattr(ranges, name).draw(chance)), 6)

    static = draw("static_coefficient")
    kinetic = round(static * draw("friction_ratio"), 6)
    tables: dict[str, Any] = {
        "contact": {
            "friction": {
                "static_coefficient": static,
                "kinetic_coefficient": kinetic,
                "weakening_distance_um": draw("weakening_distance_um"),
            },
            "relaxation_time_ms": draw("relaxation_time_ms"),
        },
        "skin": {
            **ranges.skin.model_dump(mode="json", exclude_unset=True),
            "youngs_modulus_MPa": draw("youngs_modulus_MPa"),
            "strips": {"offset_mm": placed_mm(draw("strip_offset_mm"))},
        },
        "skin_mount": {
            "ridge": ranges.ridge,
            "gain_mismatch": round(front_end.gain_mismatch.draw(chance), 6),
        },
    }
    radius_mm = draw("radius_mm")
    if issubclass(kind, HeadWorldSettings):
        tables["head"] = {"body": {"shape": "cylinder", "radius_mm": radius_mm}}
    return kind.model_validate(tables)
