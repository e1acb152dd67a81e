"""The roles that instruments play, as protocols, and the values that pass between them and others.

A procedure knows roles, a driver knows one instrument's protocol; neither knows the other. Roles
speak SI-like units named in their arguments; amplitudes are peak values. Every method either does
what its docstring states and verifies it as far as the instrument allows, or raises an
`InstrumentError` that names device, command and cause.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from rig.core.errors import LimitError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rig.core.clock import Clock
    from rig.core.settings import Settings


MEASURING_ROLES = ("daq", "force_sensor")
"""Roles that move nothing and put nothing out."""


@dataclass(frozen=True)
class Identity:
    """Identity of an instrument as it reports it."""

    vendor: str
    model: str
    serial_number: str
    firmware: str

    @property
    def simulated(self) -> bool:
        """True if this is one of our simulators: their serial numbers begin with SIM."""
        return self.serial_number.startswith("SIM")


@dataclass(frozen=True)
class Limits:
    """Limits of a value: an interval in a unit, and the device that sets it."""

    low: float
    high: float
    unit: str
    limited_by: str

    def holds(self, value: float) -> bool:
        """Return whether `value` lies inside the limits; NaN does not."""
        return self.low <= value <= self.high

    def nearest(self, value: float) -> float:
        """Return `value`, or the limit that is nearest to it if it lies outside."""
        return min(max(value, self.low), self.high)

    def require(self, device: str, what: str, value: float) -> None:
        """Raise LimitError, which names device, quantity, value, unit and limit, unless `value`
        lies inside. A driver calls it before it sends anything."""
        if not self.holds(value):
            raise LimitError(
                f"{device}: {what} {value:g} {self.unit} is outside {self.low:g} to {self.high:g} "
                f"{self.unit} of the {self.limited_by}",
                "choose a value inside, or correct the bench file if the limit is wrong",
            )


class Instrument(Protocol):
    """The interface of every instrument."""

    @property
    def identity(self) -> Identity:
        """Vendor, model, serial number, firmware, as read at connect."""
        ...

    def limits(self) -> Mapping[str, Limits]:
        """Return the instrument's own limits by quantity name, for the check before the first
        motion."""
        ...

    def make_safe(self) -> None:
        """Bring the instrument to rest and verify it; may be called at any time, any number of
        times."""
        ...

    def close(self) -> None:
        """Close the link; the instrument stays in its state."""
        ...


@runtime_checkable
class ReadsInputs(Protocol):
    """The interface of an instrument with digital inputs, of which some carry interlock contacts.

    The driver's module lists the names of the inputs as ``INPUTS``.
    """

    def inputs_high(self, names: Sequence[str]) -> Mapping[str, bool]:
        """Return the present level of each named input: True for high.

        Any thread may call it at any time, also while another one uses the instrument. It does not
        wait on the bench clock. Raises InstrumentError if the levels cannot be read now.
        """
        ...


@runtime_checkable
class CountsMisreadings(Protocol):
    """The interface of a stage whose driver asks again for a position where the axis cannot be."""

    @property
    def misreadings(self) -> int:
        """Number of positions since connecting that the next answer did not confirm; they are not
        used."""
        ...


class LastSeen(NamedTuple):
    """What a drive has answered last, with bench times in s."""

    position_mm: float
    """The latest position that it has answered."""
    seen_s: float
    """Time of that answer."""
    answered_s: float
    """Time of its latest answer of any kind."""


@runtime_checkable
class RemembersPosition(Protocol):
    """The interface of a stage whose driver knows where its axis was last seen.

    Optional: without it a run that cannot reach the drive any more says only what is pressed.
    """

    def last_seen(self) -> LastSeen | None:
        """Return what the drive has answered last; None if it has answered no position. Asks
        nothing, so it returns at once."""
        ...


@runtime_checkable
class ReadsTorque(Protocol):
    """The interface of a stage whose drive reports the torque of its motor.

    Optional: a stage without it presses all the same, and then only the force sensor and the
    drive's torque limit show how hard.
    """

    def torque_percent(self) -> float | None:
        """Return the motor's present torque in percent of what `torque_limit_percent` of the bench
        file is a percentage of; None where the drive does not report it.

        The sign and the friction in it are the drive's own: compare two readings of one motion.
        Raises InstrumentError for an exchange that fails.
        """
        ...


@runtime_checkable
class ReportsFault(Protocol):
    """The interface of a stage whose driver can say whether its drive has a fault.

    Optional: without it the guard of a run that has died does not lift what is pressed.
    """

    def fault(self) -> str | None:
        """Return the drive's present fault, its own communication time-out included, by number and
        meaning; None if it has none. Raises InstrumentError if it does not answer."""
        ...


class SignalGenerator(Instrument, Protocol):
    """One channel that drives the vibrator's amplifier (high impedance)."""

    def sine(self, frequency_Hz: float, amplitude_V: float) -> None:
        """Make the waveform a sine of this peak amplitude, read back; the output stays as it is."""
        ...

    def output(self, on: bool) -> None:
        """Switch the output and verify its state by query."""
        ...

    def output_is_on(self) -> bool:
        """Return whether the output is on, as queried from the instrument."""
        ...


@dataclass(frozen=True)
class InputChannel:
    """One analogue input of an acquisition."""

    name: str
    range_V: float
    """Bipolar full scale."""


@dataclass(frozen=True)
class Acquisition:
    """Plan of an acquisition: channels in scan order, one rate for all, samples per channel."""

    channels: tuple[InputChannel, ...]
    rate_S_s: float
    samples: int


@dataclass(frozen=True)
class Scaling:
    """Conversion of raw counts to volts, and sampling delays; per channel, in the order of the
    acquisition."""

    channels: tuple[str, ...]
    rate_S_s: float
    volts_per_count: tuple[float, ...]
    offset_V: tuple[float, ...]
    range_V: tuple[float, ...]
    delay_s: tuple[float, ...]
    """Delay of each channel's sample after the scan's nominal instant (multiplexer skew)."""
    lowest_count: int
    highest_count: int


@dataclass(frozen=True)
class Record:
    """Samples of a converter: counts (n, channels) int16, with their scaling.

    The channels are in the order of the acquisition, whatever order the instrument sends them in.
    """

    counts: npt.NDArray[np.int16]
    scaling: Scaling
    first_index: int
    """Index of the first row since the acquisition started."""

    def volts(self, channel: str) -> npt.NDArray[np.float64]:
        """Return one channel in volts, shape (n,)."""
        k = self.scaling.channels.index(channel)
        counts = self.counts[:, k].astype("f8")
        return counts * self.scaling.volts_per_count[k] + self.scaling.offset_V[k]

    def delay_s(self, channel: str) -> float:
        """Return one channel's sampling delay in seconds."""
        return self.scaling.delay_s[self.scaling.channels.index(channel)]

    def clipped(self, channel: str) -> int:
        """Return how many samples of a channel are at either end of the converter's range."""
        return int(self.at_end_of_range(channel).sum())

    def at_end_of_range(self, channel: str) -> npt.NDArray[np.bool_]:
        """Return which samples of a channel are at either end of the converter's range, (n,)."""
        column = self.counts[:, self.scaling.channels.index(channel)]
        low, high = self.scaling.lowest_count, self.scaling.highest_count
        ends: npt.NDArray[np.bool_] = (column <= low) | (column >= high)
        return ends


class DataAcquisition(Instrument, Protocol):
    """Analogue inputs, sampled together or one after the other (the scaling says which)."""

    def check(self, acquisition: Acquisition) -> None:
        """Raise LimitError for a rate, range, channel or count that this instrument cannot
        provide."""
        ...

    def ranges_V(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        """Return the bipolar full scales of an input in ascending order."""
        ...

    def acquire(self, acquisition: Acquisition) -> Record:
        """Sample once, wait for the end on the bench clock, and return everything."""
        ...

    def start(self, acquisition: Acquisition) -> Scaling:
        """Begin sampling without end; `acquisition.samples` is the block size asked for."""
        ...

    def read(self) -> Record | None:
        """Return the next block of a running acquisition, or None if none is ready yet.

        Lost data raise InstrumentError: a gap is never patched.
        """
        ...

    def stop(self) -> None:
        """End a running acquisition, after a `read` under way in another thread; does nothing if
        none runs."""
        ...


class LinearStage(Instrument, Protocol):
    """One linear axis. Waiting happens on the bench clock; positions in mm, speeds in mm/s.

    `limits` holds ``position``, ``speed`` and ``update_rate``: how often, in Hz, the link has time
    to poll the axis and send a new target during a motion. An axis that has not been homed refuses
    to move.
    """

    def homed(self) -> bool:
        """Return whether the axis has found its reference since it was switched on."""
        ...

    def home(self) -> None:
        """Find the reference, and wait until it is found."""
        ...

    def position_mm(self) -> float:
        """Return the measured position, queried from the drive."""
        ...

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        """Begin to move there, or change the target of the motion under way.

        Raises InstrumentError if another thread calls `stop` meanwhile; nothing is sent after that.
        """
        ...

    def moving(self) -> bool:
        """Return whether a motion is under way. Raises InstrumentError for a fault of the drive."""
        ...

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Move there, wait, and verify the measured position."""
        ...

    def stop(self) -> None:
        """Stop the axis and wait until it is at rest."""
        ...

    def acknowledge_timeout(self) -> bool:
        """Let an axis move again whose drive has stopped by its own communication time-out.

        Returns whether the drive has that fault: the next motion then acknowledges it. Returns
        False for a drive without a fault and for every other fault, which is left standing. Meant
        for lifting what is pressed once a run has failed; it starts no motion.
        """
        ...

    def keep_alive(self) -> None:
        """Exchange one message, which resets the drive's communication time-out, and check for
        faults."""
        ...


class RotaryStage(Instrument, Protocol):
    """One rotary axis. Waiting happens on the bench clock; angles in deg, speeds in deg/s.

    `limits` holds ``angle``, ``speed`` and ``acceleration``. A stage that has not been homed, or
    that was turned by hand since, refuses to turn until it has been.
    """

    def homed(self) -> bool:
        """Return whether the stage has found its reference and has not been turned by hand
        since."""
        ...

    def home(self) -> None:
        """Acknowledge the warnings that the stage has reported, find the reference and wait
        for it."""
        ...

    def angle_deg(self) -> float:
        """Return the measured angle, queried from the stage."""
        ...

    def start_turn(self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """Begin to turn there along a trapezoid of speed, or change the turn under way.

        The stage makes the profile itself: it speeds up and brakes with the acceleration and stands
        at the angle in the end. A turn under way goes over into the new one from the speed that it
        has, without a stop between; where the new angle lies behind, or too near to brake for, the
        stage passes it, stops and comes back. So a profile that is given as data can be streamed as
        set points, up to 100 a second; one or two steps ahead and at the profile's own speed, they
        keep the stage from braking between. Should they cease, it stands at the last one. Repeating
        a call changes nothing. Raises InstrumentError if another thread calls `stop` meanwhile;
        nothing is sent after that.
        """
        ...

    def moving(self) -> bool:
        """Return whether a turn is under way. Raises InstrumentError for a fault, or a turn that
        ended at another angle."""
        ...

    def turn_to(self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """Turn there, wait, and verify the measured angle."""
        ...

    def stop(self) -> None:
        """Stop the stage and wait until it is at rest; a stage made safe may turn afterwards."""
        ...

    def keep_alive(self) -> None:
        """Poll status and warnings. Raises InstrumentError, once, for a fault, a stall, a lost
        reference or a turn of the knob."""
        ...


@dataclass(frozen=True)
class StageStatus:
    """What a stage reports of itself at one instant."""

    position: float
    """Measured position in mm; of a rotary stage its angle in deg."""
    moving: bool
    """True if the stage moves, whoever has set it going."""
    servo: str
    """State of the motor's power in a word or two: "on", "off", or what the drive calls it."""
    homed: bool
    """False if the position has no reference: it then says nothing about where the stage is."""
    fault: str
    """Number and meaning of the fault or alarm that stands; empty if there is none."""


class StageReader(Protocol):
    """A connection to a stage that only reads. `rig monitor` shows a bench without a run by it."""

    @property
    def identity(self) -> Identity:
        """Identity of the stage; what can only be asked with a write is "unknown"."""
        ...

    @property
    def timeout_s(self) -> float:
        """The stage's own communication time-out in s, as it is set now; 0 where it has none.

        A reading may restart it. Whoever reads leaves an axis in motion alone for longer than
        that, now and then, so that the time-out can stop an axis whose program has died."""
        ...

    def read(self) -> StageStatus:
        """Return what the stage reports now. Raises InstrumentError for an exchange that fails."""
        ...

    def close(self) -> None:
        """Close the link; the stage stays in its state."""
        ...


@runtime_checkable
class OffersReader(Protocol):
    """The interface of a driver's module whose stage can be read without being changed.

    Optional: without it `rig monitor` shows no position of the stage.
    """

    def open_reader(self, settings: Any, clock: Clock) -> StageReader:
        """Connect, identify the stage and return a reader of it.

        Nothing is sent that changes the stage: no limit, mode, control word, acknowledgement or
        time-out, neither here nor later. A stage in motion continues, one with a fault keeps it.
        Never called while a run has the bench. Raises InstrumentError if the stage does not
        answer or is a different one.
        """
        ...


ALL_AXES = "xyz"
"""Axes of a force sensor."""


@dataclass(frozen=True)
class ForceFrames:
    """Consecutive frames of a force sensor."""

    first_index: int
    """Index of the first frame since the stream was started."""
    raw: npt.NDArray[np.float32]
    """Values as the sensor sent them: (n, 3), in `raw_unit`; 0 on axes that the sensor lacks."""
    force_N: npt.NDArray[np.float64]
    """Forces in N along the sensor's x, y, z after matrix and tare, (n, 3); 0 on axes it lacks.
    A force that presses on the sensor is positive along z."""
    saturated: npt.NDArray[np.bool_]
    """True for each frame in which the amplifier's converter was saturated: (n,)."""
    raw_unit: str = "mV/V"
    """Unit of `raw`, which the run file states: mV/V of a bridge amplifier, or N."""

    def __len__(self) -> int:
        return len(self.raw)


class ForceSensor(Instrument, Protocol):
    """A force sensor with up to three axes that streams. One reader thread calls `read`; other
    threads may call the other methods at the same time.

    `limits` holds ``rate`` in frames/s, with twice the same value where it is fixed, and ``force``
    in N. The class of a sensor that lacks axes states those that it has, ``axes = "z"``; one that
    states none has all three (`axes_of`).
    """

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the link since it was opened."""
        ...

    @property
    def frames_behind(self) -> float:
        """Number of frames that are due since `start` by bench time and that `read` has not
        returned."""
        ...

    def start(self, rate_S_s: float) -> float:
        """Begin to stream at the nearest rate that the sensor has; return that rate in frames/s."""
        ...

    def read(self) -> ForceFrames | None:
        """Return the frames that have arrived, or None; waits a few milliseconds at most.

        Raises InstrumentError for bytes that are not a frame: a gap is never patched.
        """
        ...

    def stop(self) -> None:
        """End the stream."""
        ...

    def calibrate(self, matrix_N_mV_V: Sequence[Sequence[float]]) -> None:
        """Use this matrix, force in N by `raw` (mV/V, or N), from the next `read` on."""
        ...

    def tare(self, zero_mV_V: tuple[float, float, float]) -> tuple[float, float, float]:
        """Define this reading as zero force; the amplifier's own zero stays as it is. Returns the
        force along x, y, z in N that the reading means relative to the amplifier's zero."""
        ...


def axes_of(sensor: ForceSensor) -> str:
    """Return the axes that a force sensor measures, as a text of ``x``, ``y`` and ``z``."""
    return str(getattr(sensor, "axes", ALL_AXES))


class DriverModule(Protocol):
    """The members of a module that an entry point of the group ``rig.drivers`` names.

    The module of an instrument with digital inputs (`ReadsInputs`) has their names as well, as a
    tuple ``INPUTS``; where a reading takes time that the link needs for something else, also the
    shortest interval between two readings in s, ``INPUTS_EVERY_S``.
    """

    ROLES: tuple[str, ...]
    """Roles that its instrument can play, such as ``generator`` or ``stage_z``."""
    Settings: type[Settings]

    def connect(self, settings: Any, clock: Clock) -> Instrument:
        """Connect, identify, set the instrument's own limits and read them back."""
        ...

    def make_safe(self, settings: Any) -> None:
        """Bring the instrument to rest over a separate connection; may be called any number of
        times."""
        ...
