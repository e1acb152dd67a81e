"""The script of the role `force_sensor`: one axis or three, with a rate that is fixed or not."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rig.core.errors import InstrumentTimeoutError
from rig.instruments.interfaces import INTERFACES
from rig.instruments.roles import ForceFrames, axes_of
from rig.testing.script import Role, Step, same, soon
from rig.testing.signals import USUAL_RATE_S_s

SLICE_FRAMES = 20.1
"""Frames that fall due between two looks: whole ones, and a rest that stays below half a frame over
three looks, so that how many are due is beyond doubt at any rate."""


def _usual_rate(sensor: Any) -> float:
    """Return the frame rate asked for, or the nearest one that the sensor's `limits` has."""
    limits = sensor.limits()["rate"]
    return float(min(max(USUAL_RATE_S_s, limits.low), limits.high))


def _slice_s(service: Any) -> float:
    return SLICE_FRAMES / float(service.truth("rate"))


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
        same("first_index, counted from 0 since start() without a gap,", piece.first_index, first)
        same("the shape of raw, with any axes,", piece.raw.shape, (len(piece), 3))
        same("the shape of force_N, with any axes,", piece.force_N.shape, (len(piece), 3))
        finite = np.isfinite(piece.force_N)
        assert finite.all(), f"force_N has {int((~finite).sum())} values that are no finite number"
        assert not piece.raw[:, missing].any(), "axes that the sensor lacks are 0 in raw"
        assert not piece.force_N[:, missing].any(), "axes that the sensor lacks are 0 in force_N"
        assert not piece.saturated.any(), "frames are marked saturated within the range"
        period = 1 / service.truth("rate")
        middles = (first + 0.5 + np.arange(len(piece))) * period
        law = service.truth("force law")
        rise_s = (piece.force_N - law.level_N)[:, there] / law.slope_N_s[there]
        begun = (rise_s - middles[:, None]).ravel()
        assert np.abs(begun - np.median(begun)).max() < 0.9 * period, (
            f"forces {piece.force_N[:, there]} N do not rise from frame to frame as the true force "
            f"does: unit, sign, axis or order is wrong, or the `matrix` of the simulator's core, "
            f"{np.array(service.truth('matrix')).tolist()}, with which the contract calibrates the "
            "driver (without one it is the identity, for a sensor that sends N)"
        )
        assert since_s - 0.5 * period <= np.median(begun) <= service.now_s() + 0.5 * period, (
            "frames of another time"
        )
        first += len(piece)
    return first


def _begin(
    sensor: Any, service: Any, rate_S_s: float | None = None, calibrate: bool = True
) -> float:
    """Start a stream of forces, calibrated with the true matrix unless the driver's own is to be
    used; return when it began."""
    sensor.stop()
    if calibrate:
        sensor.calibrate(service.truth("matrix"))
    sensor.tare(service.truth("zero"))
    since: float = service.now_s()
    asked = _usual_rate(sensor) if rate_S_s is None else rate_S_s
    rate = sensor.start(asked)
    assert soon(lambda: bool(service.truth("streaming"))), "the sensor does not stream"
    same("the rate that start() returns", rate, service.truth("rate"))
    has = service.truth("rates")
    nearest = min(has, key=lambda one: abs(one - asked)) if has else asked
    assert rate == nearest, f"asked for {asked:g} frames/s, the sensor's nearest is {nearest:g}"
    assert sensor.limits()["rate"].holds(rate), f"limits() does not hold the rate of {rate:g} 1/s"
    return since


def _stated_axes(sensor: Any, service: Any) -> None:
    """Check that the class of a sensor that lacks axes says which ones it has."""
    there = service.truth("axes")
    assert axes_of(sensor) == there, (
        f"the sensor measures {' and '.join(there)}, and its class states axes = "
        f"{axes_of(sensor)!r}: write axes = {there!r} in the class of the driver, so that no run "
        "that needs another axis takes its zeros for a force"
    )


def _own_scale(sensor: Any, service: Any) -> None:
    """Check that forces are in N with the matrix that the driver begins with: a bench file without
    a calibration record changes nothing about it, and z presses by what it gives."""
    matrix, zero = np.array(service.truth("matrix")), np.array(service.truth("zero"))
    there, _ = _columns(service)
    _begin(sensor, service, calibrate=False)
    service.sleep(_slice_s(service))
    pieces = _collected(sensor, service)
    assert pieces, "read() returns no frames although some are due"
    for piece in pieces:
        true_N = (piece.raw - zero) @ matrix.T
        assert np.allclose(piece.force_N[:, there], true_N[:, there], rtol=1e-3, atol=1e-6), (
            f"before calibrate(), raw {piece.raw[-1, there]} gives "
            f"{piece.force_N[-1, there]} N, and {true_N[-1, there]} N with the `matrix` of the "
            "simulator's core: the driver's unit and that matrix must agree (a core without a "
            "`matrix` sends N)"
        )
    sensor.stop()


def _force_stream(sensor: Any, service: Any) -> None:
    since = _begin(sensor, service)
    # This also takes what a late answer has left on the link, before bytes are counted.
    assert sensor.read() is None, "read() returns frames although no time has passed"
    taken, sent = sensor.bytes_consumed, service.truth("bytes")
    index = 0
    for _ in range(3):
        service.sleep(_slice_s(service))
        index = _check_frames(_collected(sensor, service), service, index, since)
    same("the number of frames of three waits", index, int(3 * SLICE_FRAMES))
    counted, sent = sensor.bytes_consumed - taken, service.truth("bytes") - sent
    same("bytes_consumed, every byte taken off the link,", counted, sent)
    sensor.stop()
    assert soon(service.at_rest), "the sensor continues to stream"
    same("frames_behind after stop()", sensor.frames_behind, 0)


def _calibrated(sensor: Any, service: Any) -> None:
    """Check that matrix and tare apply from the next read on, and only to the forces."""
    _begin(sensor, service)
    _, missing = _columns(service)
    matrix, zero = np.array([[1.0, 2.0, 3.0], [0.0, 4.0, 5.0], [6.0, 0.0, 7.0]]), (0.1, -0.2, 0.3)
    for _ in range(2):
        own = matrix.copy()
        own[missing], own[:, missing] = 0.0, 0.0  # what no axis measures has no force
        tare = tuple(0.0 if axis in missing else zero[axis] for axis in range(3))
        service.sleep(_slice_s(service))
        sensor.calibrate(own.tolist())
        returned = sensor.tare(tare)
        assert np.allclose(returned, own @ tare), (
            f"tare() returns {returned} N; the reading {tare} is a force of {own @ tare} N"
        )
        pieces = _collected(sensor, service)
        assert pieces, "read() returns no frames although some are due"
        for piece in pieces:
            wanted = (piece.raw - np.array(tare)) @ own.T
            assert np.allclose(piece.force_N, wanted, atol=1e-6), (
                "force_N is not (raw - zero) @ matrix.T with the latest matrix and zero"
            )
        matrix, zero = 2 * matrix.T, (0.0, 0.5, 0.0)
    sensor.stop()


def _dropped(sensor: Any, service: Any) -> None:
    """Check that frames that were not read before `stop` are not in the next stream."""
    _begin(sensor, service)
    service.sleep(_slice_s(service))
    same("frames_behind before read()", round(sensor.frames_behind), int(SLICE_FRAMES))
    sensor.stop()
    service.sleep(_slice_s(service))
    assert sensor.read() is None, "read() returns frames after stop()"
    _force_stream(sensor, service)


def _other_rate(sensor: Any, service: Any) -> None:
    """Check a second rate: half of the usual one, or the nearest that the sensor has.

    It is the same rate where that is fixed.
    """
    half = max(_usual_rate(sensor) / 2, sensor.limits()["rate"].low)
    since = _begin(sensor, service, half)
    service.sleep(_slice_s(service))
    index = _check_frames(_collected(sensor, service), service, 0, since)
    same("the number of frames", index, int(SLICE_FRAMES))
    sensor.stop()


def _undisturbed(sensor: Any, service: Any) -> None:
    """Check that making a sensor safe does not stop its stream, which guards the rest of the
    bench."""
    since = _begin(sensor, service)
    service.sleep(_slice_s(service))
    sensor.make_safe()
    sensor.make_safe()
    service.sleep(_slice_s(service))
    index = _check_frames(_collected(sensor, service), service, 0, since)
    same("the number of frames", index, int(2 * SLICE_FRAMES))
    sensor.stop()
    assert soon(service.at_rest), "the sensor continues to stream"


def _excite_sensor(sensor: Any, service: Any) -> None:
    sensor.start(_usual_rate(sensor))
    assert soon(lambda: bool(service.truth("streaming"))), "the sensor does not stream"


FORCE_SENSOR = Role(
    *INTERFACES["force_sensor"],
    (
        Step("axes", _stated_axes),
        Step("start(), read(), stop()", _force_stream),
        Step("calibrate(), tare()", _calibrated),
        Step("start() at another rate", _other_rate),
        Step("make_safe() of a stream", _undisturbed),
    ),
    excite=_excite_sensor,
    apart=(
        Step("force_N before calibrate()", _own_scale),
        Step("stop() with frames unread", _dropped),
    ),
)
