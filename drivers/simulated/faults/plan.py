"""Fault plans: the faults of a simulated bench, as a TOML file that is checked completely when it
is read.

    [[fault]]
    device = "daq"
    kind = "silence"        # at the wire: keyed to the device's requests
    at = 3                  # the third request that matches
    count = 1               # 0: from then on, for ever
    command = "WAV:DATA"    # only requests with a command that begins so
    acquisition = 2         # only requests from a moment on, given as in the World

    [[fault]]
    device = "stage_z"
    kind = "stuck"          # in the World: keyed to a move, an acquisition, or bench time
    move = 3
    of = "stage_x"          # whose move it is, where it is another axis's
    after_s = 0.5

    [[fault]]
    device = "disk"
    kind = "disk-full"      # under the recording's file calls: keyed to bytes written
    after_bytes = 50000

This module defines which faults a plan may contain for which device. It applies none itself:
`faults.wire` acts at the wire, `world.schedule` in the World, `faults.disk` under the file calls.
Nothing is random: in virtual time the same plan has the same effect at the same instant. All kinds
are described in docs/fault-plans.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args

from pydantic import Field, ValidationError

from drivers.simulated.task_log import TaskStart
from rig.core.errors import ConfigurationError, shortened
from rig.core.settings import Settings
from rig.core.toml_files import read_toml

GENERATOR, DAQ, STAGE_Z, STAGE_X = "generator", "daq", "stage_z", "stage_x"
ROTARY = "rotary"
FORCE_SENSOR, FORCE_STREAM = "force_sensor", "force_sensor.stream"
"""The amplifier's answers, and the frames that it sends without being asked."""
CLOCK, DISK = "clock", "disk"
INTERLOCK = "interlock"
"""The contacts of the bench; a fault says which one by its name."""
STAGES = (STAGE_Z, STAGE_X)
ON_TCP = (GENERATOR, DAQ, *STAGES)
ANSWERING = (*ON_TCP, ROTARY, FORCE_SENSOR)
ON_A_WIRE = (*ANSWERING, FORCE_STREAM)
DEVICES = (*ON_A_WIRE, INTERLOCK, CLOCK, DISK)
LONGEST_AFTER_s = 36_000.0

SensorAxis = Literal["x", "y", "z"]


class Placed(Settings):
    """A fault that begins at a moment that repeats exactly."""

    device: str
    """The device's name in the simulated bench."""
    move: int | None = Field(default=None, ge=1)
    """Number of the drive's task, or turn of the rotary stage, during which the fault begins: 1 is
    the first of the World. Homing and changes under way are not counted."""
    of: str | None = None
    """Name of the device whose task it is; None means the device's own."""
    acquisition: int | None = Field(default=None, ge=1)
    """Number of the DAQ's acquisition during which the fault begins: 1 is the first of the World.
    If neither this nor `move` is given, `after_s` is measured from the World's beginning."""
    after_s: float = Field(default=0.0, ge=0, le=LONGEST_AFTER_s)
    """Delay in s after that began."""

    @property
    def task(self) -> TaskStart | None:
        """The task from whose beginning `after_s` is measured; None means the World's beginning."""
        if self.acquisition is not None:
            return DAQ, self.acquisition
        return None if self.move is None else (self.of or self.device, self.move)


# --- at the wire ------------------------------------------------------------------------------


class ReplyFault(Placed):
    """A fault of a device's replies, from its moment on."""

    at: int = Field(default=1, ge=1)
    """The first matching request that is disturbed, from 1 over all connections. Only requests from
    its moment on are counted whose reply can be disturbed in this way: it has a checksum, or can
    carry an error."""
    count: int = Field(default=1, ge=0)
    """Number of matching requests that are disturbed; 0 means all later ones."""
    every: int = Field(default=1, ge=1)
    """Interval of the disturbed requests: 3 disturbs the first and then every third matching
    request. With ``silence`` and ``count = 0`` the link then loses every third reply."""
    for_s: float | None = Field(default=None, gt=0, le=LONGEST_AFTER_s)
    """Time in s for which requests are disturbed instead, from the first one on."""
    command: str = ""
    """Beginning of a command in the request (upper or lower case, without its leading colon)."""

    def matches(self, request: bytes) -> bool:
        """Return whether a command of the request begins as asked."""
        prefix = self.command.encode().upper()
        units = request.upper().split(b";")
        return any(unit.strip().lstrip(b":").startswith(prefix) for unit in units)

    def disturbs(self, occurrence: int, since_us: int) -> bool:
        """Return whether the n-th matching request is disturbed, given the time since the first
        disturbed one."""
        turn, between = divmod(occurrence - self.at, self.every)
        if turn < 0 or between:
            return False
        if self.for_s is not None:
            return since_us < round(self.for_s * 1e6)
        return self.count == 0 or turn < self.count


class WireFault(ReplyFault):
    """A reply that is lost, corrupted, late or doubled, or that ends its connection."""

    kind: Literal[
        "silence",
        "garbage",
        "truncate",
        "double",
        "stale",
        "before-last",
        "checksum",
        "close",
        "reset",
        "half-open",
    ]
    """``silence`` loses the reply; ``garbage`` makes it unreadable; ``truncate`` sends its first
    half; ``double`` sends it twice; ``stale`` holds it back until the connection's next reply, in
    front of which it arrives late; ``before-last`` sends the connection's reply before the last one
    once more instead, if there is one; ``checksum`` spoils its check; ``close`` ends the connection
    in its place, ``reset`` breaks it; ``half-open`` leaves it open while nothing answers any
    more. A serial port has no connections: ``close`` unplugs it and plugs it in again, ``reset``
    takes it away for a while, and behind ``half-open`` the line stays cut."""


class LateReply(ReplyFault):
    """A reply that is on its way for longer, in wall time: the device obeys at once."""

    kind: Literal["late"]
    by_s: float = Field(gt=0, le=60)
    jitter_s: float = Field(default=0.0, ge=0, le=60)
    """Up to so much more, another part of it for each reply; the same parts in every run."""


class FlippedBit(ReplyFault):
    """A reply in which one bit is turned over, and nothing else."""

    kind: Literal["flip"]
    byte: int = Field(default=-1, ge=-260, le=260)
    """Which byte of the reply, from 0; from -1 backwards from its end. A reply without that byte is
    left as it is."""
    bit: int = Field(default=0, ge=0, le=7)
    """Which bit of it; 7 is the highest."""


class ErrorReply(ReplyFault):
    """The device answers with an error of its protocol although it has obeyed: an exception code of
    Modbus, an error code of the amplifier, an entry of a SCPI error queue."""

    kind: Literal["error"]
    code: int = Field(ge=-32768, le=32767)
    """Error code; 1 to 255 except for SCPI instruments."""


class Rejection(ReplyFault):
    """The rotary stage rejects a command although it has obeyed."""

    kind: Literal["rejected"]
    reason: str = Field(default="BADDATA", pattern="^[A-Z]{1,20}$")
    """Reason that the instrument gives."""


class RefusedConnections(Settings):
    """The device refuses new connections; existing ones are not disturbed."""

    device: str
    kind: Literal["refused"]
    at: int = Field(default=1, ge=1)
    """The first TCP connection that is refused, from 1; a HiSLIP session consists of two."""


# --- in the World -----------------------------------------------------------------------------


class AxisFault(Placed):
    """A fault of an axis that needs no further settings."""

    kind: Literal["stuck", "idle", "runaway", "limit-switch", "reference-lost"]
    """No force moves the carriage any more; the drive acknowledges motions and moves nothing; it
    runs past its target until it is stopped; the limit switch that it moves towards closes; the
    drive forgets where it is."""


class StaleStatus(Placed):
    """The drive obeys, and what it shows of its state and position stays what it was."""

    kind: Literal["stale-status"]


class WrongPosition(Placed):
    """The drive shows a position that is off, from then on; where it moves to is not affected."""

    kind: Literal["wrong-position"]
    by_mm: float = Field(default=2.0, ge=-1000, le=1000)


class WrongTorque(Placed):
    """The drive shows a torque that does not belong to the force, from then on; what limits its
    torque is not affected."""

    kind: Literal["wrong-torque"]
    shows: Literal["zero", "frozen", "scaled"] = "zero"
    """None at all, the value of the moment at which it begins, or a multiple."""
    factor: float = Field(default=0.1, ge=0.001, le=1000)
    """The multiple that ``scaled`` shows."""


class DriveFault(Placed):
    """The drive reports a fault and brakes."""

    kind: Literal["drive-fault"]
    code: int | None = Field(default=None, ge=1, le=0xFFFF)
    """The fault's number; None: the drive's own for an axis that did not follow."""


class SlowAxis(Placed):
    """The axis does not reach the commanded speed, from then on."""

    kind: Literal["slow"]
    share: float = Field(default=0.1, gt=0, lt=1)
    """Share of the commanded speed that it reaches."""


class RaisedFlag(Placed):
    """The rotary stage raises a warning flag; with a fault it brakes."""

    kind: Literal["warning-flag"]
    flag: str = Field(default="FS", pattern="^[A-Z]{2}$")


class TurnedKnob(Placed):
    """A person turns the rotary stage by its knob."""

    kind: Literal["knob"]
    by_deg: float = Field(default=1.0, ge=-360, le=360)


class Spike(Placed):
    """A force that pushes on the probe for a while."""

    kind: Literal["spike"]
    for_s: float = Field(default=0.05, gt=0)
    force_N: float = 30.0
    """Along z, on top of everything else."""


class SensorFault(Placed):
    """The amplifier's converter stands at its end, or gives the same values again and again."""

    kind: Literal["saturated", "frozen"]
    for_s: float = Field(default=0.5, gt=0)


class DeadSensor(Placed):
    """No force reaches the bridges any more, from then on; the amplifier sends its noise."""

    kind: Literal["dead-noisy"]
    noise_N: float = Field(default=0.0, ge=0, le=10)
    """Standard deviation of further noise, in each millisecond and along each axis."""
    shows_N: float = Field(default=0.0, ge=-100, le=100)
    """Force along z about which the noise lies: a sensor that sticks, and not to the last bit."""


class StuckSensorAxis(Placed):
    """One axis keeps its value, to the last bit, from then on; the others measure."""

    kind: Literal["one-axis-stuck"]
    axis: SensorAxis = "z"


class SensorDrift(Placed):
    """A drift of the sensor's zero at a constant rate, from then on."""

    kind: Literal["drift"]
    axis: SensorAxis = "z"
    rate_N_s: float = Field(default=2.0, ge=-1000, le=1000)


class WrongScale(Placed):
    """The sensor reads a multiple of the force, from then on; its zero is not changed."""

    kind: Literal["wrong-scale"]
    factor: float = Field(default=0.1, ge=0.001, le=1000)


class WrongValue(Placed):
    """One frame has a plausible value that is wrong."""

    kind: Literal["wrong-value"]
    axis: SensorAxis = "z"
    force_N: float = Field(default=30.0, ge=-200, le=200)
    """Difference of the frame from the force that acts."""


class EarlierFrames(Placed):
    """Each frame has the values of the frame before last."""

    kind: Literal["previous"]
    for_s: float = Field(default=0.5, gt=0)


class Clipped(Placed):
    """A limit of the vibrator drive's amplitude, from then on."""

    kind: Literal["clipped"]
    amplitude_V: float = Field(gt=0)
    """Largest amplitude, peak."""


class Overrun(Placed):
    """The DAQ's buffer overruns where an acquisition is running."""

    kind: Literal["overrun"]


class ContactFault(Placed):
    """A person opens or closes what an interlock contact is on, or the contact itself fails."""

    kind: Literal["opened", "closed", "stuck-closed", "stuck-open", "bouncing"]
    """A door is opened or closed; the contact stays closed or open from then on, whatever the door
    does; it bounces for a while."""
    name: str
    """The contact's name in the bench file."""
    for_s: float = Field(default=0.1, gt=0)
    """Time in s for which it bounces."""


class ClockJump(Placed):
    """Time passes without the run, as it does while a computer is suspended."""

    kind: Literal["clock-jump"]
    by_s: float = Field(gt=0, le=60)


# --- under the file calls ---------------------------------------------------------------------


class DiskFault(Settings):
    """A file system that takes no more: it is full or can only be read."""

    device: str
    kind: Literal["disk-full", "read-only"]
    after_bytes: int = Field(default=0, ge=0)
    """Written below the folder of results since the command began."""


class SlowSync(Settings):
    """Every synchronisation with the disk takes this much longer, in wall time."""

    device: str
    kind: Literal["slow-sync"]
    delay_s: float = Field(gt=0, le=10)


# --- the plan ---------------------------------------------------------------------------------

MoveFault = AxisFault | DriveFault | SlowAxis | StaleStatus | WrongPosition | WrongTorque
RotaryFault = AxisFault | SlowAxis | RaisedFlag | TurnedKnob
ConverterFault = SensorFault | StuckSensorAxis | WrongValue | EarlierFrames
"""A fault in the force sensor's amplifier, which its simulator carries out."""
SensedFault = DeadSensor | SensorDrift | WrongScale
"""A fault that changes the force that reaches the amplifier."""
TimedFault = Spike | ConverterFault | SensedFault | Clipped | Overrun | ContactFault | ClockJump
FileFault = DiskFault | SlowSync
WireKind = WireFault | LateReply | FlippedBit | ErrorReply | Rejection | RefusedConnections
Fault = WireKind | MoveFault | RotaryFault | TimedFault | FileFault

DEVICES_BY_FAULT: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("silence", "garbage", "truncate", "stale", "close"), ON_A_WIRE),
    "double": (DAQ, *STAGES, ROTARY, FORCE_SENSOR),
    "before-last": (DAQ, *STAGES, ROTARY, FORCE_SENSOR),
    "late": ANSWERING,
    "flip": ON_A_WIRE,
    "checksum": (ROTARY, FORCE_SENSOR, FORCE_STREAM),
    "error": (*ON_TCP, FORCE_SENSOR),
    "rejected": (ROTARY,),
    **dict.fromkeys(("reset", "half-open"), ANSWERING),
    "refused": ON_TCP,
    **dict.fromkeys(
        ("slow", *get_args(AxisFault.model_fields["kind"].annotation)), (*STAGES, ROTARY)
    ),
    **dict.fromkeys(("drive-fault", "stale-status", "wrong-position", "wrong-torque"), STAGES),
    **dict.fromkeys(("warning-flag", "knob"), (ROTARY,)),
    **dict.fromkeys(("spike", "saturated", "frozen"), (FORCE_SENSOR,)),
    **dict.fromkeys(("dead-noisy", "one-axis-stuck", "drift"), (FORCE_SENSOR,)),
    **dict.fromkeys(("wrong-scale", "wrong-value", "previous"), (FORCE_SENSOR,)),
    "clipped": (GENERATOR,),
    "overrun": (DAQ,),
    **dict.fromkeys(get_args(ContactFault.model_fields["kind"].annotation), (INTERLOCK,)),
    "clock-jump": (CLOCK,),
    **dict.fromkeys(("disk-full", "read-only", "slow-sync"), (DISK,)),
}
"""The devices to which each kind of fault can happen, where the stages are on Modbus TCP."""


def devices_by_fault(on_a_line: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return `DEVICES_BY_FAULT` for a bench whose stages `on_a_line` are on a serial line."""
    return {
        **DEVICES_BY_FAULT,
        "checksum": (*DEVICES_BY_FAULT["checksum"], *on_a_line),
        "refused": tuple(name for name in ON_TCP if name not in on_a_line),
    }


_WHY_NOT = {
    "double": "its protocol cannot distinguish a doubled message from the next one",
    "checksum": "its protocol has no checksum of its own",
    "error": "its answers carry no error numbers",
    "late": "it is sent without being asked",
    "before-last": "its protocol cannot distinguish an earlier reply from the one that is due",
    **dict.fromkeys(("reset", "half-open"), "it is sent without being asked"),
    "refused": "it is not on a TCP connection",
}
F = TypeVar("F")


class FaultPlan(Settings):
    """All faults of a simulated bench; empty by default."""

    fault: tuple[Annotated[Fault, Field(discriminator="kind")], ...] = ()

    @classmethod
    def read(
        cls,
        path: Path,
        devices: Iterable[str] = DEVICES,
        devices_by_kind: Mapping[str, tuple[str, ...]] = DEVICES_BY_FAULT,
    ) -> FaultPlan:
        """Return the plan in a TOML file; `devices` are the names that exist on this bench,
        `devices_by_kind` says to which of them each kind can happen there.

        Raises ConfigurationError for an unreadable file, unknown keys, kinds or devices, and for a
        kind that cannot happen to its device.
        """
        tables = read_toml(path, "fault plan")
        try:
            plan = cls.model_validate(tables)
        except ValidationError as error:
            kinds = ", ".join(DEVICES_BY_FAULT)
            hint = f"a fault has a device, a kind ({kinds}), and what its kind needs"
            raise ConfigurationError.from_validation(error, str(path), hint) from error
        known = tuple(devices)
        for index, fault in enumerate(plan.fault):
            _require_device(f"{path}: fault.{index}", fault, known, devices_by_kind)
        return plan

    def of(self, kind: type[F] | object, device: str | None = None) -> tuple[F, ...]:
        """Return the plan's faults of a class or union of classes, in order; only those of `device`
        if it is given."""
        return tuple(
            fault
            for fault in self.fault
            if isinstance(fault, kind) and device in (None, fault.device)  # type: ignore[arg-type]
        )


def _require_device(
    where: str, fault: Fault, known: tuple[str, ...], devices_by_kind: Mapping[str, tuple[str, ...]]
) -> None:
    device, able = fault.device, devices_by_kind[fault.kind]
    if device not in known:
        raise ConfigurationError(
            f"{where}: device = {shortened(device)!r}: no such device on this bench",
            f"it has {', '.join(known)}",
        )
    if device not in able:
        why = f": {_WHY_NOT[fault.kind]}" if fault.kind in _WHY_NOT else ""
        raise ConfigurationError(
            f"{where}: kind = {fault.kind!r} cannot happen to {device}{why}",
            f"it can happen to {', '.join(able)}",
        )
    if isinstance(fault, Placed):
        _require_moment(where, fault, known)
    if isinstance(fault, ErrorReply):
        low, high = (-32768, 32767) if device in (GENERATOR, DAQ) else (1, 255)
        if not low <= fault.code <= high or fault.code == 0:
            raise ConfigurationError(
                f"{where}: code = {fault.code} is not an error of the {device}'s protocol, "
                f"which has {low} to {high} without 0",
                "give a number of its manual",
            )


def _require_moment(where: str, fault: Placed, known: tuple[str, ...]) -> None:
    if fault.move is not None and fault.acquisition is not None:
        raise ConfigurationError(
            f"{where}: move = {fault.move} and acquisition = {fault.acquisition}",
            "a fault has one moment: give one of them",
        )
    if fault.of is not None and fault.move is None:
        raise ConfigurationError(
            f"{where}: of = {shortened(fault.of)!r}, and no move", "say which: move = 1"
        )
    mover = fault.of or fault.device
    movers = [name for name in (*STAGES, ROTARY) if name in known]
    if fault.move is not None and mover not in movers:
        raise ConfigurationError(
            f"{where}: move = {fault.move}: {shortened(mover)!r} does not move on this bench",
            f"say whose move: of = one of {', '.join(movers)}",
        )
