"""Blocks of a running acquisition: each as it comes, and a converter that stops is reported."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rig.core.errors import InstrumentError
from rig.instruments.roles import Acquisition, InputChannel
from rig.run.streams.sample_stream import SampleStream

BLOCK = Acquisition((InputChannel("film", 1.25),), 1000.0, 100)


class Daq:
    """Hands over what it is given; bench time is its own affair."""

    def __init__(self) -> None:
        self.coming: list[str] = []
        self.now_s = self.takes_s = 0.0

    def now(self) -> float:
        return self.now_s

    def start(self, acquisition: Acquisition) -> Any:
        return SimpleNamespace(rate_S_s=acquisition.rate_S_s)

    def read(self) -> str | None:
        self.now_s += self.takes_s
        return self.coming.pop(0) if self.coming else None


@pytest.fixture
def daq() -> Daq:
    return Daq()


@pytest.fixture
def stream(daq: Daq) -> SampleStream:
    made = SampleStream(daq, daq)  # type: ignore[arg-type]
    made.start(BLOCK)
    return made


def test_blocks_come_in_order_and_waiting_for_one_is_no_silence(
    daq: Daq, stream: SampleStream
) -> None:
    seen = []
    for name in ("first", "second", "third"):
        daq.now_s += 0.1
        daq.coming.append(name)
        seen.append(stream.read())
        daq.now_s += 0.45
        assert stream.read() is None
    assert seen == ["first", "second", "third"]


def test_a_converter_that_stops_is_reported_with_how_long_it_has_been_silent(
    daq: Daq, stream: SampleStream
) -> None:
    daq.now_s += 0.5
    assert stream.read() is None
    daq.now_s += 0.11
    with pytest.raises(InstrumentError, match=r"daq: stream: no block for 0\.61 s") as caught:
        stream.read()
    assert caught.value.hint


def test_whoever_asks_late_finds_what_the_buffer_has_bridged(
    daq: Daq, stream: SampleStream
) -> None:
    daq.now_s += 60.0
    daq.coming += ["first", "second"]
    assert [stream.read() for _ in range(3)] == ["first", "second", None]
    daq.now_s += 0.7
    with pytest.raises(InstrumentError, match="no block"):
        stream.read()


def test_a_link_that_brings_less_than_is_sampled_is_noticed(daq: Daq, stream: SampleStream) -> None:
    daq.takes_s = 0.3  # for blocks of 0.1 s
    daq.coming += ["block"] * 20
    for _ in range(10):
        assert stream.read() == "block"
    with pytest.raises(InstrumentError, match=r"blocks of 0\.1 s .* the latest 0\.3 s: the link"):
        stream.read()


def test_a_stall_or_a_link_that_is_slow_for_a_while_is_caught_up(
    daq: Daq, stream: SampleStream
) -> None:
    daq.coming += ["block"] * 100
    for takes_s in (60.0, *4 * [0.3], *30 * [0.001], *4 * [0.4], *30 * [0.05]):
        daq.takes_s = takes_s
        assert stream.read() == "block"
