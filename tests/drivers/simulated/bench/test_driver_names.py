"""The drivers that a command imports while its simulated bench boots."""

from __future__ import annotations

import tomllib
from itertools import product
from typing import get_args

from drivers.simulated.bench.bench_file import Endpoints, bench_toml
from drivers.simulated.bench.options import Fixture, Options, Stages, driver_names, world_settings


def test_they_are_those_of_the_bench_file() -> None:
    own = {"force_sensor": {"driver": "me-gsv8"}}
    endpoints = Endpoints(daq="", stages={"stage_z": 1, "stage_x": 2}, own=own)
    for fixture, stages in product(get_args(Fixture), get_args(Stages)):
        options = Options(fixture=fixture, stages=stages)
        tables = tomllib.loads(bench_toml(options, world_settings(options), endpoints)).values()
        named = {table["driver"] for table in tables if "driver" in table}
        assert set(driver_names(options)) == named, options
