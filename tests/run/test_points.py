"""What points require of the bench, before anything moves."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import Field

from rig.core.errors import ConfigurationError, LimitError
from rig.core.settings import Settings
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


class OneRate(Converter):
    """The same with a rate that cannot be changed."""

    def check(self, acquisition: Acquisition) -> None:
        FIXED.require("daq", "rate", acquisition.rate_S_s)


FIXED = Limits(5e3, 5e3, "S/s", "daq ONE")


class Rate(Settings):
    rate_S_s: float = Field(default=64e3, gt=0)


class FastRate(Settings):
    rate_S_s: float = Field(default=10e3, ge=10e3)


@pytest.mark.parametrize(
    ("settings", "remedy"),
    [
        (Rate(), "the daq ONE has this rate only: give --rate 5000Hz"),
        (FastRate(), "choose a value inside"),
        (Settings(), "choose a value inside"),
        (None, "choose a value inside"),
    ],
    ids=["a rate can be given", "not that one", "no rate can be given", "settings unknown"],
)
def test_the_only_rate_of_a_daq_is_named_as_an_option(
    settings: Settings | None, remedy: str
) -> None:
    bench: Any = SimpleNamespace(**vars(BENCH))
    bench.daq, bench.limits = OneRate(), lambda: {"daq.rate": FIXED}
    channels = (InputChannel("film", 2.0),)

    def point(rate_S_s: float) -> Point:
        return Point("20Hz", None, (), (Acquisition(channels, rate_S_s, 100),))

    check_points([point(5e3)], bench, settings=settings)
    with pytest.raises(LimitError) as refused:
        check_points([point(64e3)], bench, settings=settings)
    assert str(refused.value.hint).startswith(remedy)


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
