"""What a driver of another package returns is checked before anything is concluded from it.

When it is connected: that there is an instrument, with the methods and limits of its role
(`connect_foreign`). Later: every position of a stage (`CheckedStage`), every frame of a force
sensor (`CheckedForceSensor`), every record of a DAQ (`CheckedDaq`), and the output of a generator
that was made safe (`CheckedGenerator`). A driver of this package judges its own positions
(`drivers.shared.stage.TravelBound`) and is left as it is.

Only what is returned is judged, never what is sent: stops, motions and keep-alives reach the driver
whatever its positions look like, and what the driver asks itself is not seen here.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint
from numbers import Real
from typing import Any, cast

from rig.bench.plan import InstrumentPlan
from rig.core.entry_points import DRIVERS, OWN_PACKAGE, BrokenPackageError, cause, find, package
from rig.core.errors import (
    ConfigurationError,
    InstrumentError,
    RigError,
    WrongFramesError,
    WrongPositionError,
    shortened,
)
from rig.instruments.interfaces import INTERFACES, members
from rig.instruments.roles import (
    Acquisition,
    ForceFrames,
    Identity,
    Instrument,
    Limits,
    Record,
    Scaling,
    axes_of,
)

BEYOND = 1.0
"""How far outside its limits a stage may be seen, in mm or deg: more than an axis overshoots, and
far less than a position of another unit or of another drive is off."""

ROUNDED = 0.01
"""How much the rate of a DAQ may differ from the one asked for, relative: it has only some."""


def foreign(part: InstrumentPlan) -> EntryPoint | None:
    """Return the entry point of a driver of another package; None for one of this package."""
    with contextlib.suppress(ConfigurationError):
        entry = find(DRIVERS, part.driver_name)
        if entry is not None and package(entry) != OWN_PACKAGE:
            return entry
    return None


def connect_foreign(
    part: InstrumentPlan, entry: EntryPoint, connect: Callable[[], Any]
) -> Instrument:
    """Connect with a driver of another package, and return its checked instrument: a
    `CheckedStage`, `CheckedForceSensor`, `CheckedDaq` or `CheckedGenerator`.

    Raises BrokenPackageError, which names the package, where `connect` raises something else than a
    RigError, or returns what does not fulfil its role; that is closed.
    """
    try:
        instrument = connect()
    except (RigError, OSError):
        raise
    except Exception as error:
        raise BrokenPackageError(entry, f"cannot connect: {cause(error, entry)}") from error
    try:
        fault = _fault(part.role, instrument)
    except RigError:
        _close(instrument)
        raise
    except Exception as error:
        _close(instrument)
        raise BrokenPackageError(entry, f"cannot be used: {cause(error)}") from error
    if fault is not None:
        _close(instrument)
        raise BrokenPackageError(entry, fault)
    driver = f"{entry.name!r} of the package {package(entry)}"
    if part.role in ("stage_z", "stage_x", "rotary"):
        instrument = checked_stage(part.role, instrument, driver)
    elif part.role == "force_sensor":
        instrument = checked_force_sensor(instrument, driver)
    elif part.role == "daq":
        instrument = checked_daq(instrument, driver)
    elif part.role == "generator":
        instrument = checked_generator(instrument, driver)
    found: Instrument = instrument
    return found


def _close(instrument: Any) -> None:
    with contextlib.suppress(Exception):
        instrument.close()


def _fault(role: str, instrument: Any) -> str | None:
    """Return what an instrument lacks for its role, as the end of a sentence that begins with its
    driver; None if it lacks nothing."""
    if instrument is None:
        return "cannot be used: connect() returned None"
    interface = INTERFACES[role]
    methods = [name for name, it in members(interface.protocol).items() if callable(it)]
    missing = [name for name in methods if not callable(getattr(instrument, name, None))]
    if missing:
        returned = f"connect() returned {_shown(instrument)} without {', '.join(missing)}"
        return f"cannot be used: {returned}, which a {role} needs"
    identity = getattr(instrument, "identity", None)
    if not isinstance(identity, Identity):
        return f"cannot be used: identity is {_shown(identity)}, not an Identity"
    for name, text in vars(identity).items():
        if not isinstance(text, str):
            return f"cannot be used: identity has {name} = {_shown(text)}, not a text"
    limits = instrument.limits()
    if not isinstance(limits, Mapping):
        return f"cannot be used: limits() returned {_shown(limits)}, not a mapping"
    for quantity, limit in limits.items():
        if not isinstance(limit, Limits):
            return f"cannot be used: limits() has {quantity} = {_shown(limit)}, not a Limits"
        if (wrong := _wrong_limits(limit)) is not None:
            return f"cannot be used: limits() has {quantity} with {wrong}"
    lacking = [quantity for quantity in sorted(interface.quantities) if quantity not in limits]
    if lacking:
        return f"cannot be used: limits() lacks {', '.join(lacking)}"
    return None


def _wrong_limits(limit: Limits) -> str | None:
    """Return what is wrong with the limits of a quantity; None if a value can be compared with
    them. One side may be infinite."""
    for name in ("low", "high"):
        value: Any = getattr(limit, name)
        if not isinstance(value, Real) or isinstance(value, bool) or math.isnan(value):
            return f"{name} = {_shown(value)}, not a number"
    for name in ("unit", "limited_by"):
        if not isinstance(text := getattr(limit, name), str):
            return f"{name} = {_shown(text)}, not a text"
    if limit.low > limit.high:
        return f"low = {limit.low:g} {limit.unit}, above high = {limit.high:g} {limit.unit}"
    return None


def _shown(value: Any) -> str:
    """Return a wrong value in words: a short one as it is, else its type."""
    if value is None or isinstance(value, (str, float, int)):
        return shortened(repr(value))
    return f"a {type(value).__name__}"


class CheckedStage:
    """A stage of another package, whose positions are checked; all else is the driver's own.

    A position is a finite number, and within its `limits` or `BEYOND` outside. An axis may stand
    farther outside when it is connected, as after a change of limits, and come back: so
    limits are judged once it has been seen inside, or has ended a motion.
    """

    def __init__(self, role: str, stage: Any, driver: str):
        self._role, self._stage, self._driver = role, stage, driver
        limits = stage.limits()["angle" if role == "rotary" else "position"]
        self._low, self._high, self._unit = limits.low - BEYOND, limits.high + BEYOND, limits.unit
        self._judged = False
        """True once the axis has to be within its limits."""
        self._under_way = False
        """True from a motion's start until it has ended or was stopped."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)

    def position_mm(self) -> float:
        """See `LinearStage`. Raises WrongPositionError."""
        judged = self._judged  # before it is asked: another thread may end a motion meanwhile
        return self._checked("position_mm", self._stage.position_mm(), judged)

    def angle_deg(self) -> float:
        """See `RotaryStage`. Raises WrongPositionError."""
        judged = self._judged
        return self._checked("angle_deg", self._stage.angle_deg(), judged)

    def home(self) -> None:
        """See `LinearStage`: positions have another reference afterwards."""
        self._judged = self._under_way = False
        self._stage.home()

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        """See `LinearStage`."""
        self._under_way = True
        self._stage.start_move(position_mm, speed_mm_s)

    def start_turn(self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """See `RotaryStage`."""
        self._under_way = True
        self._stage.start_turn(angle_deg, speed_deg_s, acceleration_deg_s2)

    def moving(self) -> bool:
        """See `LinearStage`."""
        is_moving: bool = self._stage.moving()
        if not is_moving and self._under_way:
            self._judged, self._under_way = True, False
        return is_moving

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """See `LinearStage`."""
        self._stage.move_to(position_mm, speed_mm_s)
        self._judged = True

    def turn_to(self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """See `RotaryStage`."""
        self._stage.turn_to(angle_deg, speed_deg_s, acceleration_deg_s2)
        self._judged = True

    def stop(self) -> None:
        """See `LinearStage`."""
        self._under_way = False
        self._stage.stop()

    def make_safe(self) -> None:
        """See `Instrument`."""
        self._under_way = False
        self._stage.make_safe()

    def _checked(self, command: str, value: Any, judged: bool) -> float:
        if type(value) is not float:
            if not isinstance(value, Real) or isinstance(value, bool):
                what = f"returned {_shown(value)}, not a number"
                raise self._wrong(command, what, math.nan)
            value = float(value)
        if self._low <= value <= self._high:
            self._judged = True
            return float(value)
        if not math.isfinite(value):
            raise self._wrong(command, f"returned {value}", math.nan)
        if judged:
            low, high = self._low + BEYOND, self._high - BEYOND
            limits = f"its limits of {low:g} to {high:g} {self._unit}"
            raise self._wrong(command, f"returned {value:g} {self._unit}, outside {limits}", value)
        return float(value)

    def _wrong(self, command: str, what: str, position: float) -> WrongPositionError:
        hint = f"check where the axis stands, and the driver {self._driver}"
        return WrongPositionError(self._role, command, what, hint, position)


class CheckedForceSensor:
    """A force sensor of another package, whose frames are checked; all else is the driver's own.

    Frames are `ForceFrames` of n rows and 3 columns, every force is a finite number, and so is the
    rate of a stream.
    """

    def __init__(self, sensor: Any, driver: str):
        self._sensor, self._driver = sensor, driver

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sensor, name)

    def start(self, rate_S_s: float) -> float:
        """See `ForceSensor`. Raises InstrumentError for a rate that is not one."""
        rate: Any = self._sensor.start(rate_S_s)
        if isinstance(rate, Real) and not isinstance(rate, bool) and 0 < float(rate) < math.inf:
            return float(rate)
        raise InstrumentError(
            "force_sensor",
            "start",
            f"its driver returned {_shown(rate)}, not the rate of the stream in frames/s",
            f"check the driver {self._driver}",
        )

    def read(self) -> ForceFrames | None:
        """See `ForceSensor`. Raises WrongFramesError."""
        frames = self._sensor.read()
        if frames is None or (wrong := _wrong_in(frames, axes_of(self._sensor))) is None:
            return cast("ForceFrames | None", frames)
        hint = f"check the sensor and its cable, and the driver {self._driver}"
        raise WrongFramesError("force_sensor", "read", f"its driver returned {wrong}", hint)


class CheckedDaq:
    """A DAQ of another package, whose records are checked; all else is the driver's own.

    A record has counts (n, channels) of int16 that follow the one before without a gap, and the
    scaling of what was asked for.
    """

    def __init__(self, daq: Any, driver: str):
        self._daq, self._driver = daq, driver
        self._wanted: Acquisition | None = None
        """The acquisition that was started last."""
        self._next = 0
        """Index of the row that has to come next."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._daq, name)

    def ranges_V(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        """See `DataAcquisition`. Raises InstrumentError for other values than ascending full
        scales."""
        ranges: Any = self._daq.ranges_V()
        self._require("ranges_V", _wrong_ranges(ranges))
        return tuple(float(one) for one in ranges)

    def acquire(self, acquisition: Acquisition) -> Record:
        """See `DataAcquisition`. Raises InstrumentError for a wrong record."""
        record = self._daq.acquire(acquisition)
        self._require("acquire", _wrong_record(record, acquisition, 0))
        if len(record.counts) != acquisition.samples:
            found = f"{len(record.counts)} samples, not {acquisition.samples}"
            self._require("acquire", found)
        return cast("Record", record)

    def start(self, acquisition: Acquisition) -> Scaling:
        """See `DataAcquisition`. Raises InstrumentError for a wrong scaling."""
        scaling = self._daq.start(acquisition)
        self._require("start", _wrong_scaling(scaling, acquisition))
        self._wanted, self._next = acquisition, 0
        return cast("Scaling", scaling)

    def read(self) -> Record | None:
        """See `DataAcquisition`. Raises InstrumentError for a wrong record, or one that does not
        follow the one before."""
        record = self._daq.read()
        if record is not None and self._wanted is not None:
            self._require("read", _wrong_record(record, self._wanted, self._next))
            self._next += len(record.counts)
        return cast("Record | None", record)

    def _require(self, command: str, wrong: str | None) -> None:
        if wrong is not None:
            hint = f"check the unit and its cable, and the driver {self._driver}"
            raise InstrumentError("daq", command, f"its driver returned {wrong}", hint)


class CheckedGenerator:
    """A generator of another package, which is asked whether its output is off once it has been
    made safe; all else is the driver's own."""

    def __init__(self, generator: Any, driver: str):
        self._generator, self._driver = generator, driver

    def __getattr__(self, name: str) -> Any:
        return getattr(self._generator, name)

    def make_safe(self) -> None:
        """See `Instrument`. Raises InstrumentError where the output is still on, or where that
        cannot be known."""
        self._generator.make_safe()  # first, and whatever the answer is
        on = self._generator.output_is_on()
        if type(on).__name__ not in ("bool", "bool_") or on:  # NumPy's False is one, too
            raise InstrumentError(
                "generator",
                "make_safe",
                f"its output is still on (output_is_on() returned {_shown(on)})",
                f"switch the generator off by hand; check the driver {self._driver}",
            )


def _wrong_record(record: Any, wanted: Acquisition, first: int) -> str | None:
    """Return what is wrong with a record of an acquisition whose next row is `first`; None for a
    record."""
    if not isinstance(record, Record):
        return f"{_shown(record)}, not a Record"
    counts: Any = record.counts
    if (kind := getattr(counts, "dtype", type(counts).__name__)) != "int16":
        return f"counts of the type {kind}, not int16 (.astype('int16') converts them)"
    if counts.ndim != 2 or counts.shape[1] != len(wanted.channels):
        return f"counts of the shape {counts.shape}, not (n, {len(wanted.channels)})"
    if record.first_index != first:
        return f"samples from {_shown(record.first_index)} on, where {first} comes next: a gap"
    return _wrong_scaling(record.scaling, wanted)


def _wrong_scaling(scaling: Any, wanted: Acquisition) -> str | None:
    """Return what is wrong with the scaling of an acquisition; None if it gives volts."""
    if not isinstance(scaling, Scaling):
        return f"{_shown(scaling)}, not a Scaling"
    try:
        return _wrong_numbers(scaling, wanted)
    except (TypeError, ValueError):  # None, a text or one number where several belong
        return f"a scaling that is not of numbers, one a channel: {_shown(scaling)}"


def _wrong_numbers(scaling: Scaling, wanted: Acquisition) -> str | None:
    """Return what is wrong with the numbers of a scaling; None if they give volts. Raises TypeError
    or ValueError where they are not numbers."""
    names = tuple(channel.name for channel in wanted.channels)
    if tuple(scaling.channels) != names:
        return f"a scaling of the channels {scaling.channels}, not {names}"
    if not math.isclose(scaling.rate_S_s, wanted.rate_S_s, rel_tol=ROUNDED):
        return f"a rate of {scaling.rate_S_s:g} 1/s, where {wanted.rate_S_s:g} 1/s was asked for"
    for name in ("volts_per_count", "offset_V", "range_V", "delay_s"):
        values = getattr(scaling, name)
        if len(values) != len(names) or not all(map(math.isfinite, values)):
            return f"a scaling with {name} = {values}, not {len(names)} finite numbers"
    if not scaling.lowest_count < scaling.highest_count:
        return f"counts from {scaling.lowest_count} to {scaling.highest_count}"
    if not all(scaling.volts_per_count):
        return f"a scaling with volts_per_count = {scaling.volts_per_count}"
    return None


def _wrong_in(frames: Any, axes: str) -> str | None:
    """Return what is wrong with frames of a force sensor that has these axes; None for frames with
    forces."""
    import numpy as np  # the driver has imported it; at the top it would slow every command

    if not isinstance(frames, ForceFrames):
        return f"{_shown(frames)}, not ForceFrames"
    if np.shape(frames.force_N) != (shape := (len(frames), 3)):
        return f"force_N of the shape {np.shape(frames.force_N)}, not {shape}"
    finite = np.isfinite(frames.force_N)
    if finite.all():
        return None
    along = [axis for axis in "xyz" if not finite[:, "xyz".index(axis)].all()]
    axis = next((axis for axis in along if axis in axes), along[0])
    column = frames.force_N[:, "xyz".index(axis)]
    return f"a force of {column[~np.isfinite(column)][0]} N along {axis}"


def checked_stage(role: str, stage: Any, driver: str) -> Any:
    """Return a stage with its positions checked."""
    return _with_members_of(stage, CheckedStage, "_stage")(role, stage, driver)


def checked_force_sensor(sensor: Any, driver: str) -> Any:
    """Return a force sensor with its frames checked."""
    return _with_members_of(sensor, CheckedForceSensor, "_sensor")(sensor, driver)


def _wrong_ranges(ranges: Any) -> str | None:
    """Return what is wrong with the ranges of a DAQ, in words; None if nothing is."""
    if not isinstance(ranges, (tuple, list)):
        return f"{_shown(ranges)}, not a tuple of full scales in V"
    if not ranges:
        return "no range"
    for one in ranges:
        if not isinstance(one, Real) or isinstance(one, bool) or not 0 < float(one) < math.inf:
            return f"the range {_shown(one)}, not a full scale in V"
    return None if list(ranges) == sorted(ranges) else "ranges that do not ascend"


def checked_daq(daq: Any, driver: str) -> Any:
    """Return a DAQ with its records checked."""
    return _with_members_of(daq, CheckedDaq, "_daq")(daq, driver)


def checked_generator(generator: Any, driver: str) -> Any:
    """Return a generator that is asked whether it is off once it was made safe."""
    return _with_members_of(generator, CheckedGenerator, "_generator")(generator, driver)


def _with_members_of(instrument: Any, checked: type, kept_as: str) -> type:
    """Return a class derived from `checked` that has the members that the instrument has, so that
    the optional interfaces (`ReportsFault` and others) are found at it, however they are looked
    for. `kept_as` is the attribute of the instrument."""
    own = vars(checked)
    passed_on = [name for name in dir(instrument) if not name.startswith("_") and name not in own]
    members = {name: property(_passed_on(kept_as, name)) for name in passed_on}
    return type(checked.__name__, (checked,), members)


def _passed_on(kept_as: str, name: str) -> Callable[[Any], Any]:
    return lambda checked: getattr(getattr(checked, kept_as), name)
