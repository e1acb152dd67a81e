"""The promises of each role, as scripts that any driver of the role can run through.

A script is a sequence of steps in the order of an experiment. A step calls the instrument and
checks the result against the truth: what the simulated instrument did, or what its terminals
carried. A step may be repeated after a failure, so a call that failed half-way must not spoil the
next one. The last step of a script needs no other before it. A new role is one more entry in
`ROLES`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from rig.core.errors import InstrumentError, InstrumentTimeoutError, LimitError
from rig.instruments.roles import (
    Acquisition,
    DataAcquisition,
    ForceFrames,
    ForceSensor,
    InputChannel,
    LinearStage,
    Record,
    RotaryStage,
    SignalGenerator,
)
from rig.testing.raising import raising
from rig.testing.signals import USUAL_RATE_S_s, carried


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
    """Names of the quantities that `reach` must have."""
    script: tuple[Step, ...]
    excite: Callable[[Any, Any], None]
    """Leaves the instrument in a state from which it has to be made safe."""
    attend: Callable[[Any, Any], object] = lambda instrument, service: None
    """Do what the runner does by itself for a connected instrument of the role."""
    apart: tuple[Step, ...] = ()
    """Steps for an instrument that has just been connected. They are run without faults only,
    because they expect an error, or because the loss of an answer has no visible effect in them."""


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


def _ranges(daq: Any, service: Any) -> None:
    ranges = daq.ranges_V()
    assert ranges == tuple(sorted(set(ranges)))
    assert ranges[0] > 0
    assert {channel.range_V for channel in CHANNELS} <= set(ranges)
    for range_V in ranges:
        daq.check(Acquisition((InputChannel("film", range_V),), 1_000.0, 10))
    try:
        daq.check(Acquisition((InputChannel("film", 1.5 * ranges[-1]),), 1_000.0, 10))
    except LimitError:
        return
    raise AssertionError("a range beyond the widest was not refused")


def _check(daq: Any, service: Any) -> None:
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
        Step("ranges_V()", _ranges),
        Step("check()", _check),
        Step("acquire()", _acquire),
        Step("acquire() again", _acquire),
        Step("start(), read(), stop()", _stream),
        Step("acquire() after a stream", _acquire),
        Step("make_safe()", _rest),
    ),
    excite=lambda daq, service: daq.start(BLOCKS),
)

# --- stage -----------------------------------------------------------------------------------

ARRIVED_mm = 0.02
FED_s = 0.1
"""Shorter than a drive's communication time-out, and many of them longer."""


def _homed(stage: Any, service: Any) -> None:
    assert stage.homed() is service.truth("homed")


def _home(stage: Any, service: Any) -> None:
    """Home the axis, after a move away from the reference if it is homed already. At the reference,
    homing takes no time on the simulated drive, and a drive that reported "homed" before does not
    show whether homing has begun. The driver then reports an error."""
    if service.truth("homed"):
        stage.stop()
        stage.move_to(10.0, 200.0)
    stage.home()
    assert service.truth("homed")
    assert service.at_rest()


def _position(stage: Any, service: Any) -> None:
    assert abs(stage.position_mm() - service.truth("position")) < 1e-3


def _move_to(position_mm: float, speed_mm_s: float) -> Step:
    def act(stage: Any, service: Any) -> None:
        stage.move_to(position_mm, speed_mm_s)
        assert abs(service.truth("position") - position_mm) <= ARRIVED_mm
        assert service.at_rest()

    return Step(f"move_to({position_mm:g}, {speed_mm_s:g})", act)


def _retarget(stage: Any, service: Any) -> None:
    """A motion that is changed under way ends at its new target, without a stop between."""
    stage.start_move(70.0, 100.0)
    service.sleep(0.05)
    assert stage.moving()
    speed = service.truth("speed")
    assert abs(abs(speed) - 100.0) < 1e-6
    stage.start_move(60.0, 400.0)
    deadline = service.now_s() + 5.0
    while stage.moving():
        assert service.now_s() < deadline, "it never arrives"
        service.sleep(0.02)
    assert abs(service.truth("position") - 60.0) <= ARRIVED_mm


def _stop(stage: Any, service: Any) -> None:
    stage.start_move(5.0, 50.0)
    service.sleep(0.05)
    assert service.truth("speed") != 0
    stage.stop()
    assert service.at_rest()
    assert abs(service.truth("position") - 5.0) > 1.0
    assert not stage.moving()


def _keep_alive(stage: Any, service: Any) -> None:
    """Check that the axis continues while only keep-alives are sent."""
    stage.start_move(5.0, 10.0)
    before = service.truth("position")
    for _ in range(10):
        service.clock._pass(FED_s)
        stage.keep_alive()
        assert abs(service.truth("speed") + 10.0) < 1e-6
    assert abs(service.truth("position") - before) > 9.0
    stage.stop()


def _no_timeout(stage: Any, service: Any) -> None:
    """A drive without a fault has none to acknowledge, and stands."""
    assert stage.acknowledge_timeout() is False
    assert service.at_rest()


def _move_beyond(stage: Any, service: Any) -> None:
    stage.stop()
    beyond = stage.reach()["position"].high + 1.0, stage.reach()["speed"].high + 1.0
    for position_mm, speed_mm_s in ((beyond[0], 1.0), (40.0, beyond[1]), (40.0, 0.0)):
        try:
            stage.start_move(position_mm, speed_mm_s)
        except LimitError:
            continue
        raise AssertionError(f"{position_mm:g} mm at {speed_mm_s:g} mm/s was not refused")
    assert service.at_rest()


def _rest_from_motion(stage: Any, service: Any) -> None:
    stage.stop()  # also what lets an axis that was made safe move again
    stage.start_move(20.0, 20.0)
    service.sleep(0.05)
    _rest_stage(stage, service)


def _rest_stage(stage: Any, service: Any) -> None:
    """Check that `make_safe` returns before the axis is at rest: a watcher may call it while the
    bench's clock stands still."""
    before = service.now_s()
    stage.make_safe()
    stage.make_safe()
    assert service.now_s() == before, "making safe may not wait for bench time"
    service.sleep(0.2)
    assert service.at_rest()
    stage.stop()


def _refused(stage: Any, service: Any, act: Callable[[], None], words: str) -> None:
    with raising(InstrumentError) as caught:
        act()
    assert words in caught.error.message
    assert caught.error.hint
    service.sleep(0.2)
    assert service.at_rest()


def _move_unhomed(stage: Any, service: Any) -> None:
    assert not service.truth("homed")
    for act in (stage.start_move, stage.move_to):
        _refused(stage, service, partial(act, 10.0, 10.0), "homed")


def _move_after_make_safe(stage: Any, service: Any) -> None:
    """A procedure behind its watcher cannot set the axis going again."""
    _excite_stage(stage, service)
    stage.make_safe()
    _refused(stage, service, lambda: stage.start_move(60.0, 10.0), "made safe")
    _refused(stage, service, stage.home, "made safe")
    stage.stop()
    stage.move_to(10.0, 100.0)
    assert abs(service.truth("position") - 10.0) <= ARRIVED_mm


def _excite_stage(stage: Any, service: Any) -> None:
    stage.home()
    stage.start_move(70.0, 10.0)
    service.sleep(0.1)
    assert abs(service.truth("speed") - 10.0) < 1e-6


STAGE = Role(
    LinearStage,
    frozenset({"position", "speed", "update_rate"}),
    (
        Step("homed() at first", _homed),
        Step("home()", _home),
        Step("homed()", _homed),
        _move_to(20, 200),
        Step("position_mm()", _position),
        Step("start_move() under way", _retarget),
        _move_to(40, 400),
        Step("stop()", _stop),
        Step("acknowledge_timeout()", _no_timeout),
        Step("keep_alive()", _keep_alive),
        Step("start_move() beyond reach", _move_beyond),
        Step("make_safe() in motion", _rest_from_motion),
        _move_to(10, 200),
        Step("make_safe()", _rest_stage),
    ),
    excite=_excite_stage,
    attend=lambda stage, service: service.clock.each_slice(stage.keep_alive),
    apart=(
        Step("a move before homing", _move_unhomed),
        Step("a move after make_safe()", _move_after_make_safe),
    ),
)


# --- rotary stage ----------------------------------------------------------------------------

TURNED_deg = 0.02
SET_POINTS_Hz = 100.0


def _home_rotary(stage: Any, service: Any) -> None:
    stage.home()
    assert service.truth("homed")
    assert stage.homed()
    assert service.at_rest()


def _turn_to(angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float = 500.0) -> Step:
    def act(stage: Any, service: Any) -> None:
        stage.turn_to(angle_deg, speed_deg_s, acceleration_deg_s2)
        assert abs(service.truth("angle") - angle_deg) <= TURNED_deg
        assert service.at_rest()

    return Step(f"turn_to({angle_deg:g}, {speed_deg_s:g})", act)


def _angle(stage: Any, service: Any) -> None:
    assert abs(stage.angle_deg() - service.truth("angle")) < 1e-3


def _returned(stage: Any, service: Any) -> None:
    """There and back by 3.5 deg; the stage makes the trapezoid: speed and angle on its way."""
    stage.turn_to(10.0, 50.0, 500.0)
    for end, sign in ((13.5, 1.0), (10.0, -1.0)):
        begun_s, begun_deg = service.now_s(), service.truth("angle")
        stage.start_turn(end, 5.0, 20.0)
        service.sleep(0.45)
        assert stage.moving()
        assert abs(service.truth("speed") - sign * 5.0) < 0.05
        passed_s = service.now_s() - begun_s
        turned = (service.truth("angle") - begun_deg) * sign
        assert abs(turned - 5.0 * (passed_s - 0.125)) < 0.02
        while stage.moving():
            assert service.now_s() - begun_s < 5.0, "it never arrives"
            service.sleep(0.02)
        assert service.now_s() - begun_s > 3.5 / 5.0 + 5.0 / 20.0 - 0.05
        assert abs(service.truth("angle") - end) <= TURNED_deg


def _streamed(stage: Any, service: Any) -> None:
    """A profile given as data: every 10 ms a set point two steps ahead, at the profile's speed.
    The stage follows without standing between, and stands at the last one."""
    stage.turn_to(10.0, 50.0, 500.0)
    slowest = stage.reach()["speed"].low
    step_s = 1 / SET_POINTS_Hz
    profile = 10.0 + 3.5 * np.sin(np.pi / 2 * np.clip(step_s * np.arange(103), 0.0, 1.0)) ** 2
    for k in range(100):
        ahead = float(profile[k + 2])
        speed = max(ahead - float(profile[k]), 0.0) / (2 * step_s)
        stage.start_turn(ahead, max(speed, slowest), 1000.0)
        service.sleep(step_s)
        lag = service.truth("angle") - float(profile[k + 1])
        assert abs(lag) < 0.05, f"{lag:.3f} deg off at set point {k}"
        if 5 <= k < 95:
            assert service.truth("speed") > 0, k
    while stage.moving():
        service.sleep(0.02)
    assert abs(service.truth("angle") - 13.5) <= TURNED_deg


def _stop_rotary(stage: Any, service: Any) -> None:
    stage.start_turn(5.0, 20.0, 500.0)
    service.sleep(0.05)
    assert service.truth("speed") != 0
    stage.stop()
    assert service.at_rest()
    assert abs(service.truth("angle") - 5.0) > 1.0
    assert not stage.moving()


def _keep_alive_rotary(stage: Any, service: Any) -> None:
    """Check that the stage continues while only keep-alives are sent."""
    stage.start_turn(5.0, 5.0, 500.0)
    before = service.truth("angle")
    for _ in range(5):
        service.clock._pass(FED_s)
        stage.keep_alive()
        assert abs(abs(service.truth("speed")) - 5.0) < 0.01
    assert abs(service.truth("angle") - before) > 2.0
    stage.stop()


def _turn_beyond(stage: Any, service: Any) -> None:
    stage.stop()
    angle, speed, acceleration = (
        stage.reach()[quantity].high for quantity in ("angle", "speed", "acceleration")
    )
    for asked in (
        (angle + 1.0, 1.0, 100.0),
        (10.0, speed + 1.0, 100.0),
        (10.0, 0.0, 100.0),
        (10.0, 1.0, acceleration + 1.0),
        (10.0, 1.0, 0.0),
        (float("nan"), 1.0, 100.0),
    ):
        with raising(LimitError):
            stage.start_turn(*asked)
    assert service.at_rest()


def _rest_from_turn(stage: Any, service: Any) -> None:
    stage.stop()  # also what lets a stage that was made safe turn again
    stage.start_turn(20.0, 20.0, 500.0)
    service.sleep(0.05)
    _rest_stage(stage, service)


def _turn_unhomed(stage: Any, service: Any) -> None:
    assert not service.truth("homed")
    assert not stage.homed()
    for act in (stage.start_turn, stage.turn_to):
        _refused(stage, service, partial(act, 10.0, 10.0, 100.0), "homed")


def _turn_after_make_safe(stage: Any, service: Any) -> None:
    """A procedure behind its watcher cannot set the stage going again."""
    _excite_rotary(stage, service)
    stage.make_safe()
    _refused(stage, service, lambda: stage.start_turn(60.0, 10.0, 100.0), "made safe")
    _refused(stage, service, stage.home, "made safe")
    stage.stop()
    stage.turn_to(10.0, 50.0, 500.0)
    assert abs(service.truth("angle") - 10.0) <= TURNED_deg


def _excite_rotary(stage: Any, service: Any) -> None:
    stage.home()
    stage.start_turn(70.0, 10.0, 500.0)
    service.sleep(0.1)
    assert abs(service.truth("speed") - 10.0) < 0.01


ROTARY = Role(
    RotaryStage,
    frozenset({"angle", "speed", "acceleration"}),
    (
        Step("homed() at first", _homed),
        Step("home()", _home_rotary),
        Step("homed()", _homed),
        _turn_to(20, 50),
        Step("angle_deg()", _angle),
        Step("start_turn() there and back", _returned),
        Step("start_turn() in a stream", _streamed),
        Step("stop()", _stop_rotary),
        Step("keep_alive()", _keep_alive_rotary),
        Step("start_turn() beyond reach", _turn_beyond),
        Step("make_safe() in motion", _rest_from_turn),
        _turn_to(10, 50),
        Step("make_safe()", _rest_stage),
    ),
    excite=_excite_rotary,
    attend=lambda stage, service: service.clock.each_slice(stage.keep_alive),
    apart=(
        Step("a turn before homing", _turn_unhomed),
        Step("a turn after make_safe()", _turn_after_make_safe),
    ),
)


# --- force sensor ----------------------------------------------------------------------------

SLICE_FRAMES = 20.1
"""Frames that fall due between two looks: whole ones, and a rest that stays below half a frame over
three looks, so that how many are due is beyond doubt at any rate."""
SETTLES_S = 1.0
"""Wall time within which a command that is not acknowledged has to take effect."""


def _usual_rate(sensor: Any) -> float:
    """Return the frame rate asked for, or the nearest one that the sensor's `reach` has."""
    limits = sensor.reach()["rate"]
    return float(min(max(USUAL_RATE_S_s, limits.low), limits.high))


def _slice_s(service: Any) -> float:
    return SLICE_FRAMES / float(service.truth("rate"))


def _soon(holds: Callable[[], bool]) -> bool:
    """Return whether something holds now or shortly: the instrument may not acknowledge."""
    deadline = time.monotonic() + SETTLES_S
    while not (held := holds()) and time.monotonic() < deadline:
        time.sleep(0.001)
    return held


def _columns(service: Any) -> tuple[list[int], list[int]]:
    """Return the columns of the axes that the sensor has, and of those that it has not."""
    axes = service.truth("axes")
    there = ["xyz".index(axis) for axis in axes]
    return there, [column for column in range(3) if column not in there]


def _collected(sensor: Any, service: Any) -> list[ForceFrames]:
    """Return the frames that are due, as a reader collects them. Missing frames are an error, as
    there."""
    pieces: list[ForceFrames] = []
    deadline = time.monotonic() + service.settings["timeout_s"]
    while (missing := sensor.frames_behind) > 0.5:
        if time.monotonic() > deadline:
            raise InstrumentTimeoutError(
                "force_sensor", "stream", f"{missing:.0f} frames are missing", "check the cable"
            )
        if (piece := sensor.read()) is not None:
            pieces.append(piece)
    assert sensor.frames_behind > -0.5, "more frames than are due"
    return pieces


def _check_frames(pieces: list[ForceFrames], service: Any, first: int, since_s: float) -> int:
    """Check that the frames from index `first` on show what pressed on the sensor, one after the
    other, none twice and none left out, at instants after `since_s`; return the next index. Axes
    that the sensor lacks are 0."""
    there, missing = _columns(service)
    for piece in pieces:
        assert piece.first_index == first, "frames are counted from 0 since start(), without a gap"
        assert piece.raw.shape == piece.force_N.shape == (len(piece), 3), "(n, 3) with any axes"
        assert not piece.raw[:, missing].any(), "axes that the sensor lacks are 0 in raw"
        assert not piece.force_N[:, missing].any(), "axes that the sensor lacks are 0 in force_N"
        assert not piece.saturated.any()
        period = 1 / service.truth("rate")
        middles = (first + 0.5 + np.arange(len(piece))) * period
        law = service.truth("force law")
        rise_s = (piece.force_N - law.level_N)[:, there] / law.slope_N_s[there]
        begun = (rise_s - middles[:, None]).ravel()
        assert np.abs(begun - np.median(begun)).max() < 0.9 * period, (
            f"forces {piece.force_N[:, there]} N do not rise from frame to frame as the true force "
            "does: unit, sign, axis or order is wrong"
        )
        assert since_s - 0.5 * period <= np.median(begun) <= service.now_s() + 0.5 * period, (
            "frames of another time"
        )
        first += len(piece)
    return first


def _begin(sensor: Any, service: Any, rate_S_s: float | None = None) -> float:
    """Start a stream of calibrated forces; return when it began."""
    sensor.stop()
    sensor.calibrate(service.truth("matrix"))
    sensor.tare(service.truth("zero"))
    since: float = service.now_s()
    asked = _usual_rate(sensor) if rate_S_s is None else rate_S_s
    rate = sensor.start(asked)
    assert _soon(lambda: bool(service.truth("streaming"))), "the sensor does not stream"
    assert rate == service.truth("rate"), "start() returns the rate that the sensor has"
    has = service.truth("rates")
    nearest = min(has, key=lambda one: abs(one - asked)) if has else asked
    assert rate == nearest, f"asked for {asked:g} frames/s, the sensor's nearest is {nearest:g}"
    assert sensor.reach()["rate"].holds(rate)
    return since


def _force_stream(sensor: Any, service: Any) -> None:
    since = _begin(sensor, service)
    taken, sent = sensor.bytes_consumed, service.truth("bytes")
    assert sensor.read() is None, "no time has passed"
    index = 0
    for _ in range(3):
        service.sleep(_slice_s(service))
        index = _check_frames(_collected(sensor, service), service, index, since)
    assert index == int(3 * SLICE_FRAMES), "every frame that was due has come"
    assert sensor.bytes_consumed - taken == service.truth("bytes") - sent, (
        "bytes_consumed counts every byte that was taken off the link"
    )
    sensor.stop()
    assert _soon(service.at_rest), "the sensor continues to stream"
    assert sensor.frames_behind == 0


def _calibrated(sensor: Any, service: Any) -> None:
    """Matrix and tare apply from the next read on, and only to the forces."""
    _begin(sensor, service)
    _, missing = _columns(service)
    matrix, zero = np.array([[1.0, 2.0, 3.0], [0.0, 4.0, 5.0], [6.0, 0.0, 7.0]]), (0.1, -0.2, 0.3)
    for _ in range(2):
        own = matrix.copy()
        own[missing], own[:, missing] = 0.0, 0.0  # what no axis measures has no force
        tare = tuple(0.0 if axis in missing else zero[axis] for axis in range(3))
        service.sleep(_slice_s(service))
        sensor.calibrate(own.tolist())
        told = sensor.tare(tare)
        assert np.allclose(told, own @ tare), "tare() returns the force that the reading would be"
        pieces = _collected(sensor, service)
        assert pieces
        for piece in pieces:
            assert np.allclose(piece.force_N, (piece.raw - np.array(tare)) @ own.T, atol=1e-6)
        matrix, zero = 2 * matrix.T, (0.0, 0.5, 0.0)
    sensor.stop()


def _dropped(sensor: Any, service: Any) -> None:
    """Check that frames that were not read before `stop` are not in the next stream."""
    _begin(sensor, service)
    service.sleep(_slice_s(service))
    assert round(sensor.frames_behind) == int(SLICE_FRAMES)
    sensor.stop()
    service.sleep(_slice_s(service))
    assert sensor.read() is None
    _force_stream(sensor, service)


def _other_rate(sensor: Any, service: Any) -> None:
    """The other rate is half of the usual one, or what the sensor has that is nearest: the same
    where its rate is fixed."""
    half = max(_usual_rate(sensor) / 2, sensor.reach()["rate"].low)
    since = _begin(sensor, service, half)
    service.sleep(_slice_s(service))
    index = _check_frames(_collected(sensor, service), service, 0, since)
    assert index == int(SLICE_FRAMES)
    sensor.stop()


def _undisturbed(sensor: Any, service: Any) -> None:
    """Making a sensor safe leaves its stream, which guards the rest of the bench, alone."""
    since = _begin(sensor, service)
    service.sleep(_slice_s(service))
    sensor.make_safe()
    sensor.make_safe()
    service.sleep(_slice_s(service))
    index = _check_frames(_collected(sensor, service), service, 0, since)
    assert index == int(2 * SLICE_FRAMES)
    sensor.stop()
    assert _soon(service.at_rest), "the sensor continues to stream"


def _excite_sensor(sensor: Any, service: Any) -> None:
    sensor.start(_usual_rate(sensor))
    assert _soon(lambda: bool(service.truth("streaming"))), "the sensor does not stream"


FORCE_SENSOR = Role(
    ForceSensor,
    frozenset({"rate", "force"}),
    (
        Step("start(), read(), stop()", _force_stream),
        Step("calibrate(), tare()", _calibrated),
        Step("start() at another rate", _other_rate),
        Step("make_safe() of a stream", _undisturbed),
    ),
    excite=_excite_sensor,
    apart=(Step("stop() with frames unread", _dropped),),
)

ROLES: Mapping[str, Role] = {
    "generator": GENERATOR,
    "daq": DAQ,
    "stage_z": STAGE,
    "stage_x": STAGE,
    "rotary": ROTARY,
    "force_sensor": FORCE_SENSOR,
}
