"""What the simulated bench says of the benches that it can be."""

from __future__ import annotations

import pytest

from drivers.simulated.bench.options import Options
from drivers.simulated.bench.start import variant_for, variants


@pytest.mark.parametrize(
    ("drivers", "variant"),
    [
        ({"stage_z": "festo-cmmt", "stage_x": "festo-cmmt"}, "festo"),
        ({"stage_z": "oriental-az", "stage_x": "oriental-az"}, "az"),
        ({"stage_z": "festo-cmmt", "stage_x": "oriental-az"}, "festo-az"),
        ({"stage_z": "oriental-az", "stage_x": "festo-cmmt", "rotary": "zaber-rst"}, "az-festo"),
        ({"stage_z": "oriental-az"}, "az"),
        ({"stage_z": "another", "stage_x": "oriental-az"}, None),
        ({"generator": "keysight-33500b"}, None),
    ],
)
def test_a_bench_is_stood_in_for_by_the_variant_with_its_stages(
    drivers: dict[str, str], variant: str | None
) -> None:
    assert variant_for(drivers) == variant


def test_every_variant_can_stand_in_for_a_bench_and_the_usual_one_comes_first() -> None:
    names = ("festo-cmmt", "oriental-az")
    reached = {variant_for({"stage_z": z, "stage_x": x}) for z in names for x in names}
    assert reached == set(variants())
    assert variants()[0] == Options().stages
