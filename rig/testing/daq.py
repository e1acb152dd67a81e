"""The script of the role `daq`: two channels, sampled once and in blocks."""

from __future__ import annotations

from typing import Any

import numpy as np

from rig.core.errors import LimitError
from rig.instruments.interfaces import INTERFACES
from rig.instruments.roles import Acquisition, InputChannel, Record
from rig.testing.raising import raising
from rig.testing.script import Role, Step, at_rest, near, rest, same
from rig.testing.signals import WAVE_LARGEST_V, WAVE_SLOPE_V_s, carried

NAMES = ("film", "load_cell")
SINGLE = 10_000.0, 300
"""Largest rate in samples/s and number of samples of an acquisition."""
BLOCKS = 1_000.0, 20


def _acquisition(daq: Any, rate_S_s: float, samples: int) -> Acquisition:
    """Return an acquisition of both channels at this rate, or the largest that the DAQ has if that
    is less, in ranges that hold what the terminals carry: two different ones where there are."""
    ranges = [range_V for range_V in daq.ranges_V() if range_V >= WAVE_LARGEST_V]
    assert ranges, f"no range of {daq.ranges_V()} V holds +-{WAVE_LARGEST_V:g} V"
    channels = tuple(
        InputChannel(name, range_V)
        for name, range_V in zip(NAMES, (ranges[-1], ranges[-2:][0]), strict=True)
    )
    limits = daq.limits()["rate"]
    return Acquisition(channels, min(max(rate_S_s, limits.low), limits.high), samples)


def _check_record(record: Record, wanted: Acquisition, service: Any, since_s: float) -> None:
    """Check that the record shows what the terminals carried, at instants after `since_s`."""
    names = tuple(channel.name for channel in wanted.channels)
    same("the channels of a record, in the order asked for", tuple(record.scaling.channels), names)
    same("the type of counts", str(record.counts.dtype), "int16")
    same("the shape of counts", record.counts.shape, (wanted.samples, len(wanted.channels)))
    rows = np.arange(wanted.samples) / record.scaling.rate_S_s
    for channel in wanted.channels:
        terminal = service.truth("terminals")[channel.name]
        volts = record.volts(channel.name) - carried(terminal, 0.0)
        starts = volts / WAVE_SLOPE_V_s - rows - record.delay_s(channel.name)  # each says when
        k = record.scaling.channels.index(channel.name)
        step = 2 * abs(record.scaling.volts_per_count[k]) / WAVE_SLOPE_V_s
        assert np.ptp(starts) <= 1.01 * step, (
            f"channel {channel.name}: the samples do not rise one after the other as the volts at "
            "its terminal do: scaling, order, delay_s or terminal is wrong"
        )
        begun = float(starts.mean()) - record.first_index / record.scaling.rate_S_s
        assert since_s - step <= begun <= service.now_s() + step, (
            f"channel {channel.name}: samples of another time: they began at {begun:.6g} s, the "
            f"acquisition at {since_s:.6g} s or later: another record, or first_index is wrong"
        )


def _acquire(daq: Any, service: Any) -> None:
    wanted, since = _acquisition(daq, *SINGLE), service.now_s()
    _check_record(daq.acquire(wanted), wanted, service, since)


def _stream(daq: Any, service: Any) -> None:
    wanted, since = _acquisition(daq, *BLOCKS), service.now_s()
    scaling = daq.start(wanted)
    near("the rate that start() returns", scaling.rate_S_s, wanted.rate_S_s, 1e-6, "1/s")
    assert daq.read() is None, "read() returns a block before anything was sampled"
    expected = 0
    for _ in range(3):
        service.sleep(wanted.samples / wanted.rate_S_s)
        record = daq.read()
        assert record is not None, "read() returns None although a block is due"
        same("first_index of a block", record.first_index, expected)
        _check_record(record, wanted, service, since)
        expected += len(record.counts)
    assert daq.read() is None, "read() returns a block twice"
    daq.stop()
    at_rest(service, "after stop()")


def _ranges(daq: Any, service: Any) -> None:
    ranges = daq.ranges_V()
    same("ranges_V(), which ascend,", ranges, tuple(sorted(set(ranges))))
    assert ranges[0] > 0, f"the smallest range is {ranges[0]:g} V"
    rate = _acquisition(daq, *BLOCKS).rate_S_s
    for range_V in ranges:
        daq.check(Acquisition((InputChannel(NAMES[0], range_V),), rate, 10))
    beyond = 1.5 * ranges[-1]
    with raising(LimitError, f"check() of a range of {beyond:g} V, beyond the widest"):
        daq.check(Acquisition((InputChannel(NAMES[0], beyond),), rate, 10))


def _check(daq: Any, service: Any) -> None:
    wanted = _acquisition(daq, *SINGLE)
    daq.check(wanted)
    with raising(LimitError, "check() of 1e12 samples/s"):
        daq.check(Acquisition(wanted.channels, 1e12, 10))


def _excite(daq: Any, service: Any) -> None:
    daq.start(_acquisition(daq, *BLOCKS))


DAQ = Role(
    *INTERFACES["daq"],
    (
        Step("ranges_V()", _ranges),
        Step("check()", _check),
        Step("acquire()", _acquire),
        Step("acquire() again", _acquire),
        Step("start(), read(), stop()", _stream),
        Step("acquire() after a stream", _acquire),
        Step("make_safe()", rest),
    ),
    excite=_excite,
)
