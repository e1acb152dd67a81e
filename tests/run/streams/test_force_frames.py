"""Frames by number: every one once, none patched."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from rig.core.clock import WallClock
from rig.core.errors import InstrumentError
from rig.instruments.roles import ForceFrames
from rig.run.holds import Holds
from rig.run.streams.force_monitor import ForceMonitor
from rig.run.streams.frame_buffer import FrameBuffer
from rig.run.streams.scales import FrameCollector


class Sensor:
    """Hands over what it is given, as a force sensor's driver does."""

    bytes_consumed = 0
    frames_behind = 0.0

    def __init__(self) -> None:
        self.coming: list[ForceFrames] = []

    def read(self) -> ForceFrames | None:
        return self.coming.pop(0) if self.coming else None

    def tare(self, zero: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = (2 * value for value in zero)
        return x, y, z


class Clock:
    now_s = 0.0
    is_virtual = False
    in_background = contextlib.nullcontext

    def now(self) -> float:
        return self.now_s


def frames(first: int, count: int) -> ForceFrames:
    numbers = np.arange(first, first + count, dtype=np.float64)
    values = np.stack([numbers, -numbers, 0.01 * numbers], axis=1)
    return ForceFrames(first, values.astype(np.float32), values, np.zeros(count, bool))


@pytest.fixture
def sensor() -> Sensor:
    return Sensor()


@pytest.fixture
def monitor(sensor: Sensor) -> ForceMonitor:
    return ForceMonitor(sensor, Clock(), Holds(), lambda: [])  # type: ignore[arg-type]


def feed(monitor: ForceMonitor, sensor: Sensor, *batches: ForceFrames) -> None:
    sensor.coming += batches
    for _ in batches:
        monitor.read()


def test_every_frame_comes_once(monitor: ForceMonitor, sensor: Sensor) -> None:
    assert monitor.frames_since(0) is None
    seen, sizes = [], [10, 1, 7, 25, 3]
    for size in sizes:
        feed(monitor, sensor, frames(sum(sizes[: sizes.index(size)]), size))
        got = monitor.frames_since(len(seen))
        assert got is not None
        assert got.first_index == len(seen)
        seen += got.force_N[:, 0].tolist()
    assert seen == list(range(sum(sizes)))
    assert monitor.frames_since(len(seen)) is None
    assert monitor.frames_seen == len(seen)


def test_several_batches_come_as_one_from_the_middle(monitor: ForceMonitor, sensor: Sensor) -> None:
    feed(monitor, sensor, frames(0, 10), frames(10, 10), frames(20, 5))
    got = monitor.frames_since(7)
    assert got is not None
    assert got.raw[:, 0].tolist() == list(range(7, 25))
    assert len(got.saturated) == 18


def test_forgotten_frames_are_an_error() -> None:
    buffer = FrameBuffer(batches=2)
    for first in (0, 10, 20):
        buffer.add(frames(first, 10))
    with pytest.raises(InstrumentError, match="5 frames from number 5 on are no longer in"):
        buffer.since(5)


def follow(monitor: ForceMonitor, sensor: Sensor, clock: Clock, seconds: float) -> None:
    """A batch every 10 ms, and what the watchers make of it."""
    for _ in range(round(seconds / 0.01)):
        clock.now_s += 0.01
        feed(monitor, sensor, frames(0, 10))


def test_frames_that_are_late_are_a_hold_until_they_come(sensor: Sensor) -> None:
    clock, holds = Clock(), Holds()
    monitor = ForceMonitor(sensor, clock, holds, lambda: [])  # type: ignore[arg-type]
    follow(monitor, sensor, clock, 1.0)
    sensor.frames_behind = 40.0
    follow(monitor, sensor, clock, 0.45)
    assert holds.count == 0
    follow(monitor, sensor, clock, 4.0)
    assert holds.active == ("the force sensor's frames are late",)
    sensor.frames_behind = 3.0
    follow(monitor, sensor, clock, 0.01)
    assert holds.active == ()
    assert holds.count == 1


def test_frames_that_are_ahead_of_a_clock_for_once_are_no_gap_afterwards(sensor: Sensor) -> None:
    """A slaved clock hears that its time has jumped after the frames of that time are there."""
    clock, holds = Clock(), Holds()
    monitor = ForceMonitor(sensor, clock, holds, lambda: [])  # type: ignore[arg-type]
    follow(monitor, sensor, clock, 1.0)
    sensor.frames_behind = -110.0
    follow(monitor, sensor, clock, 0.01)
    sensor.frames_behind = 0.0
    follow(monitor, sensor, clock, 10.0)
    assert holds.count == 0


def test_frames_that_do_not_come_are_a_gap_over_which_the_bench_is_made_safe(
    sensor: Sensor,
) -> None:
    clock, acts = Clock(), list[float]()

    def act() -> list[str]:
        acts.append(clock.now_s)
        return []

    monitor = ForceMonitor(sensor, clock, Holds(), act)  # type: ignore[arg-type]
    follow(monitor, sensor, clock, 1.0)
    sensor.frames_behind = 26.0
    with pytest.raises(InstrumentError, match="26 frames are missing: the stream has a gap"):
        follow(monitor, sensor, clock, 20.0)
    assert acts == [pytest.approx(6.0, abs=0.05)]


def test_a_tare_forgets_the_earlier_force_and_continues_to_count(
    monitor: ForceMonitor, sensor: Sensor
) -> None:
    feed(monitor, sensor, frames(0, 400))
    monitor._rate = 1000.0
    zero_N = monitor.tare(0.2)
    assert zero_N == pytest.approx((2 * 299.5, -2 * 299.5, 2 * 2.995))
    assert monitor.frames_seen == 400
    assert monitor.frames_since(400) is None
    feed(monitor, sensor, frames(400, 5))
    got = monitor.frames_since(400)
    assert got is not None
    assert len(got) == 5


def alike(first: int, count: int) -> ForceFrames:
    """Frames that repeat number 9 of `frames`."""
    one = frames(9, 1)
    return ForceFrames(
        first, np.repeat(one.raw, count, 0), np.repeat(one.force_N, count, 0), np.zeros(count, bool)
    )


def test_frames_that_repeat_themselves_end_the_stream_and_make_the_bench_safe(
    sensor: Sensor,
) -> None:
    acted: list[str] = []

    def act() -> list[str]:
        acted.append("stopped")
        return []

    monitor = ForceMonitor(sensor, Clock(), Holds(), act)  # type: ignore[arg-type]
    feed(monitor, sensor, frames(0, 10), alike(10, 12))
    assert acted == []
    with pytest.raises(InstrumentError, match="20 frames in a row are the same to the last bit"):
        feed(monitor, sensor, alike(22, 12))
    assert acted == ["stopped"]
    with pytest.raises(InstrumentError, match="same to the last bit"):
        monitor.check_trip()


def test_a_few_frames_alike_are_chance(monitor: ForceMonitor, sensor: Sensor) -> None:
    batches = [frames(0, 10), alike(10, 19), frames(29, 1), alike(30, 19)]
    feed(monitor, sensor, *batches)
    assert monitor.frames_seen == 49


def test_the_newest_frame_is_as_old_as_frames_are_missing(
    monitor: ForceMonitor, sensor: Sensor
) -> None:
    """Against what is usual, and as it has been there; frames that have been read and are not yet
    handed on make it no younger. Nothing where bench time stands while they come."""
    clock: Clock = monitor._clock  # type: ignore[assignment]
    assert monitor.older_s == 0.0
    monitor._rate = 1000.0
    monitor._delay.take_as_usual(2.0)
    first = 0
    for behind, older_s in ((2.0, 0.0), (0.5, 0.0), (8.5, 0.0065)):
        sensor.frames_behind = behind
        feed(monitor, sensor, frames(first, 5))
        first += 5
        assert monitor.older_s == pytest.approx(older_s, abs=1e-5)
        clock.now_s += 0.004
        sensor.frames_behind = 0.0
        assert monitor.older_s == pytest.approx(older_s + 0.004, abs=1e-5)
    clock.is_virtual = True
    assert monitor.older_s == 0.0


def test_the_unit_of_what_the_sensor_sends_stays_with_the_frames(
    monitor: ForceMonitor, sensor: Sensor
) -> None:
    feed(
        monitor, sensor, replace(frames(0, 10), raw_unit="N"), replace(frames(10, 5), raw_unit="N")
    )
    got = monitor.frames_since(3)
    assert got is not None
    assert got.raw_unit == "N"


class SlowSensor(Sensor):
    """It has one rate, whatever it is asked for."""

    def start(self, rate_S_s: float) -> float:
        return 250.0

    def stop(self) -> None:
        pass


def test_the_rate_is_the_one_that_the_sensor_reports() -> None:
    monitor = ForceMonitor(SlowSensor(), WallClock(), Holds(), lambda: [])  # type: ignore[arg-type]
    try:
        assert monitor.start(1000.0) == 250.0
        assert monitor.rate_S_s == 250.0
    finally:
        monitor.stop()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_force_that_is_no_number_makes_the_bench_safe_and_reaches_nobody(
    sensor: Sensor, value: float
) -> None:
    done: list[str] = []

    def act() -> list[str]:
        done.append("made safe")
        return []

    monitor = ForceMonitor(sensor, Clock(), Holds(), act)  # type: ignore[arg-type]
    feed(monitor, sensor, frames(0, 10))
    wrong = frames(10, 10)
    wrong.force_N[3, 2] = value
    sensor.coming.append(wrong)
    with pytest.raises(InstrumentError, match="the force of 1 of 10 frames is not a finite number"):
        monitor.read()
    assert done == ["made safe"]
    assert monitor.frames_seen == 10
    with pytest.raises(InstrumentError, match="not a finite number"):
        monitor.check_trip()


def test_a_reading_of_a_scale_has_no_frame_without_a_number(sensor: Sensor) -> None:
    source = FrameCollector(sensor)  # type: ignore[arg-type]
    wrong = frames(0, 10)
    wrong.force_N[0, 1] = np.nan
    sensor.coming += [frames(0, 10), wrong]
    source.read()
    with pytest.raises(InstrumentError, match="the force of 1 of 10 frames is not a finite number"):
        source.read()
    source.read()  # nothing has come
    assert [len(batch) for batch in source.batches] == [10]
