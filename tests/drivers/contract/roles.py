"""What each role promises, as scripts that any driver of the role can be put through.

A script is a sequence of steps in the order of an experiment. A step calls the instrument and
checks what came of it against the truth: what the simulated instrument did, or what its terminals
carried. A step may be repeated after a failure, so a call that failed half-way must not spoil the
next one. A new role is one more entry in `ROLES`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rig.instruments import (
    Acquisition,
    DataAcquisition,
    InputChannel,
    Record,
    SignalGenerator,
)


@dataclass(frozen=True)
class Step:
    """One thing a procedure does, with the check of its outcome."""

    name: str
    act: Callable[[Any, Any], None]
    """Takes the instrument and its `Service`; raises AssertionError where a wrong value came."""


@dataclass(frozen=True)
class Role:
    """A role's protocol and what its drivers are put through."""

    protocol: type
    quantities: frozenset[str]
    """What `reach` must tell."""
    script: tuple[Step, ...]
    excite: Callable[[Any, Any], None]
    """Leaves the instrument in a state from which it has to be made safe."""


# --- generator -------------------------------------------------------------------------------


def _sine(frequency_Hz: float, amplitude_V: float) -> Step:
    def act(generator: Any, service: Any) -> None:
        generator.sine(frequency_Hz, amplitude_V)
        assert service.truth("frequency") == frequency_Hz
        assert abs(service.truth("amplitude") - amplitude_V) < 1e-5 * amplitude_V

    return Step(f"sine({frequency_Hz:g}, {amplitude_V:g})", act)


def _output(on: bool) -> Step:
    def act(generator: Any, service: Any) -> None:
        generator.output(on)
        assert service.truth("on") is on

    return Step(f"output({on})", act)


def _ask_output(generator: Any, service: Any) -> None:
    assert generator.output_is_on() is service.truth("on")


def _rest(instrument: Any, service: Any) -> None:
    instrument.make_safe()
    assert service.at_rest()


GENERATOR = Role(
    SignalGenerator,
    frozenset({"frequency", "amplitude"}),
    (
        _sine(20, 0.5),
        _output(True),
        Step("output_is_on() while on", _ask_output),
        _sine(2000, 0.25),
        _sine(2, 1.5),
        _output(False),
        Step("output_is_on() while off", _ask_output),
        _output(True),
        Step("make_safe()", _rest),
    ),
    excite=lambda generator, service: generator.output(True),
)


# --- daq -------------------------------------------------------------------------------------

CHANNELS = (InputChannel("film", 10.0), InputChannel("load_cell", 5.0))
SINGLE = Acquisition(CHANNELS, 10_000.0, 300)
BLOCKS = Acquisition(CHANNELS, 1_000.0, 20)


def carried(terminal: int, time_s: Any) -> Any:
    """What a terminal carries: each its own level, rising with time, so that every record of
    every instant is different from every other."""
    return 0.5 * (terminal - 101) + 0.2 * time_s


def _check_record(record: Record, wanted: Acquisition, service: Any, since_s: float) -> None:
    """The record shows what the terminals carried, at instants after `since_s`."""
    assert set(record.scaling.channels) == {channel.name for channel in wanted.channels}
    assert record.counts.shape == (wanted.samples, len(wanted.channels))
    rows = np.arange(wanted.samples) / record.scaling.rate_S_s
    for channel in wanted.channels:
        terminal = service.settings["channels"][channel.name]
        volts = record.volts(channel.name) - carried(terminal, 0.0)
        starts = volts / 0.2 - rows - record.delay_s(channel.name)  # each sample says when
        step = 2 * channel.range_V / 2**12 / 0.2
        assert np.ptp(starts) <= 1.01 * step, "samples lie one after the other"
        begun = float(starts.mean()) - record.first_index / record.scaling.rate_S_s
        assert since_s - step <= begun <= service.now_s() + step, "an earlier record came instead"


def _acquire(daq: Any, service: Any) -> None:
    since = service.now_s()
    _check_record(daq.acquire(SINGLE), SINGLE, service, since)


def _stream(daq: Any, service: Any) -> None:
    since = service.now_s()
    scaling = daq.start(BLOCKS)
    assert scaling.rate_S_s == BLOCKS.rate_S_s
    assert daq.read() is None, "nothing has been sampled yet"
    expected = 0
    for _ in range(3):
        service.sleep(BLOCKS.samples / BLOCKS.rate_S_s)
        record = daq.read()
        assert record is not None, "a block is due"
        assert record.first_index == expected
        _check_record(record, BLOCKS, service, since)
        expected += len(record.counts)
    assert daq.read() is None
    daq.stop()
    assert service.at_rest()


def _check(daq: Any, service: Any) -> None:
    from rig.errors import LimitError

    daq.check(SINGLE)
    try:
        daq.check(Acquisition(CHANNELS, 1e12, 10))
    except LimitError:
        return
    raise AssertionError("1e12 S/s was not refused")


DAQ = Role(
    DataAcquisition,
    frozenset({"rate"}),
    (
        Step("check()", _check),
        Step("acquire()", _acquire),
        Step("acquire() again", _acquire),
        Step("start(), read(), stop()", _stream),
        Step("acquire() after a stream", _acquire),
        Step("make_safe()", _rest),
    ),
    excite=lambda daq, service: daq.start(BLOCKS),
)

ROLES: Mapping[str, Role] = {"generator": GENERATOR, "daq": DAQ}
