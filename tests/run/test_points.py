"""What points require of the bench, before anything moves."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rig.core.errors import ConfigurationError, LimitError
from rig.instruments.roles import Acquisition, InputChannel, Limits
from rig.run.points import RANGE_FOUND_LATER_V, Move, Point, check_points


class Converter:
    """A DAQ with the ranges 2 and 10 V."""

    def ranges_V(self) -> tuple[float, ...]:  # noqa: N802
        return (2.0, 10.0)

    def check(self, acquisition: Acquisition) -> None:
        for channel in acquisition.channels:
            if channel.range_V not in self.ranges_V():
                raise LimitError(f"daq: range {channel.range_V:g} V", None)


BENCH: Any = SimpleNamespace(
    daq=Converter(),
    limits=dict,
    settings=SimpleNamespace(fixtures=()),
    plan=SimpleNamespace(source="bench.toml"),
)


def test_a_range_that_is_found_later_fits_a_daq_with_any_ranges() -> None:
    def point(range_V: float) -> Point:
        channels = InputChannel("film", range_V), InputChannel("load_cell", RANGE_FOUND_LATER_V)
        return Point("20Hz", None, (), (Acquisition(channels, 5000.0, 100),))

    check_points([point(RANGE_FOUND_LATER_V)], BENCH)
    check_points([point(2.0)], BENCH)
    with pytest.raises(LimitError, match=r"point 20Hz: daq: range 1\.25 V"):
        check_points([point(1.25)], BENCH)


def test_a_quantity_that_an_instrument_lacks_is_not_called_a_missing_table() -> None:
    there = Limits(0.0, 1e6, "Hz", "generator")
    bench: Any = SimpleNamespace(**vars(BENCH))
    bench.limits = lambda: {"generator.frequency": there, "generator.amplitude": there}

    def refused(quantity: str) -> str:
        with pytest.raises(ConfigurationError) as caught:
            check_points([Point("20Hz", None, (Move(quantity, 20.0),))], bench)
        return caught.value.one_line()

    assert refused("generator.freq") == (
        "point 20Hz needs generator.freq, but generator has no limit 'freq'; it has "
        "generator.amplitude, generator.frequency: correct the point's Move, or limits() of the "
        "driver"
    )
    assert refused("stage_x.position").endswith("add a [stage_x] table to bench.toml")
