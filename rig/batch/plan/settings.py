"""The settings of a batch file: what a batch does, and what ends or holds it.

    [batch]              the night: name, order, window, policies
    [defaults.PROCEDURE] settings that every experiment of a procedure begins with
    [[experiment]]       a procedure over a matrix of settings, or over points that fill a space
    [simulation]         the benches that a batch without a bench file starts for itself, and
                         their faults

Here are the values and what can be said of each by itself. What they expand to is in
`rig.batch.plan.expand`; what instruments make of them in `rig.batch.plan.validate`.
"""

from __future__ import annotations

from datetime import datetime, time
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
    model_validator,
)

from rig.core.name_patterns import NAME, OPTIONAL_NAME
from rig.core.settings import Settings, unit_of
from rig.core.units import quantity
from rig.files.journal.layout import Short

Order = Literal["as-written", "shuffled", "blocked"]
Occasion = Literal["start", "failure", "hold", "end"]
Value = bool | int | float | str
EXAMPLE_DATE, EXAMPLE_TIME = "2026-11-24", "07:00:00"
MOST_RUNS = 1_000_000
"""A queue of more is a mistake in a matrix."""


def _installed_variant(name: str) -> str:
    from rig.run.bench_selector import require_variant

    return require_variant(name)


Variant = Annotated[str, AfterValidator(_installed_variant)]
"""The name of a variant of the simulated bench, which alone knows what it can be."""


def _instant(value: Any, parse: ValidatorFunctionWrapHandler) -> Any:
    """Refuse a number, which pydantic would take for seconds since 1970."""
    wanted = f"a time of day ({EXAMPLE_TIME}) or a date and time ({EXAMPLE_DATE} {EXAMPLE_TIME})"
    if isinstance(value, str):  # also as the queue keeps it, in JSON
        try:
            float(value)
        except ValueError:
            try:
                return parse(value)
            except ValidationError:
                pass
        raise ValueError(f"write {wanted}, without quotes")
    if not isinstance(value, datetime | time):
        raise ValueError(f"must be {wanted}")
    return parse(value)


def _local(value: datetime | time) -> datetime | time:
    """Refuse a time of day with an offset: which day's offset that is cannot be known."""
    if isinstance(value, time) and value.tzinfo is not None:
        raise ValueError(
            f"a time of day is in this computer's time zone: write {EXAMPLE_TIME} without an "
            "offset, or a date, time and offset"
        )
    return value


Instant = Annotated[
    datetime | time,
    Field(union_mode="left_to_right"),
    WrapValidator(_instant),
    AfterValidator(_local),
]
"""A date with time, or a time of the day: the next one after the batch's start."""


class Retries(Settings):
    """Number of further attempts at a run, by the reason of its failure. After a limit there is
    none: it would be exceeded again, with the skin pressed once more."""

    timeout: int = Field(default=2, ge=0, le=100)
    """An instrument did not answer in time."""
    instrument: int = Field(default=1, ge=0, le=100)
    """An instrument failed in another way."""
    died: int = Field(default=2, ge=0, le=100)
    """The process that ran it died, or was killed because it hung."""
    rest_s: float = Field(default=5.0, ge=0, le=3600)
    """Rest before another try."""


class StopWhen(Settings):
    """Conditions that end a batch safely before its last run (exit 6)."""

    finished_runs: int | None = Field(default=None, ge=1)
    """This many runs have been finished."""
    failed_runs: int | None = Field(default=None, ge=1)
    """This many runs have failed for good."""
    bench_hours: float | None = Field(default=None, gt=0)
    """The bench has been in use for this long, rests and holds not included."""


class HoldWhen(Settings):
    """Conditions that hold a batch: the bench is safe and the batch waits for a person."""

    consecutive_failures: int = Field(default=3, ge=1)
    """This many runs in a row have failed for good."""
    free_disk_GB: float = Field(default=1.0, ge=0)
    """Less than this would be left on the results' disk."""
    zero_drift_N: float = Field(default=1.0, gt=0)
    """The force sensor's zero has moved by more since the batch's first run."""


class NotifySettings(Settings):
    """Addresses that are notified, and the occasions. Notifications cannot disturb a run."""

    urls: tuple[str, ...] = ()
    """Addresses as apprise understands them (optional extra ``notify``)."""
    command: tuple[str, ...] = ()
    """A program and its arguments; it gets title and text as two more, and the whole as JSON on
    its standard input."""
    on: tuple[Occasion, ...] = ("start", "failure", "hold", "end")


class BatchSettings(Settings):
    """Table ``[batch]``."""

    name: str = Field(min_length=1, max_length=60, pattern=NAME)
    """Names its folder and its files."""
    results: str = "results"
    """Folder in which the batch's folder is made; relative to where the command is given."""
    bench: str | None = None
    """Bench file, relative to the batch file; left out, --bench, ./bench.toml or simulated."""
    user: Short = ""
    sample: Short = ""
    notes: str = ""
    not_before: Instant | None = None
    """Time before which no instrument is connected."""
    stop_by: Instant | None = None
    """No run begins that would not have ended by then."""
    stop_when: StopWhen = StopWhen()
    hold_when: HoldWhen = HoldWhen()
    on_failure: Literal["continue", "hold", "stop"] = "continue"
    """Action of the batch when a run has failed for good."""
    on_hold: Literal["wait", "stop"] = "wait"
    """Action of a batch on hold: wait for a person, or end."""
    set_aside_after: int = Field(default=2, ge=1)
    """Number of failed runs of one condition after which its other runs are left out."""
    retries: Retries = Retries()
    order: Order = "as-written"
    seed: int = Field(default=0, ge=0)
    """Seed of every random order and sample."""
    allow_expired: bool = False
    """True if calibration records that have expired may be used."""
    figures: bool = True
    """True if figures are drawn of every run."""
    detect: bool = True
    """True if the detector analyses the strips of every trial."""
    notify: NotifySettings = NotifySettings()


def _bound(name: str, bound: Any) -> Any:
    if not isinstance(bound, str):
        return bound
    try:
        return quantity(bound, unit_of(name))
    except ValueError as error:
        raise ValueError(f"{name} = {bound!r}: {error}") from None


class SpaceSample(Settings):
    """Points that fill a space of settings more evenly than a grid of as many."""

    method: Literal["latin-hypercube", "sobol"] = "latin-hypercube"
    points: int = Field(ge=1, le=100_000)
    ranges: dict[str, tuple[float, float]] = Field(min_length=1)
    """Lowest and highest value by setting."""
    log: tuple[str, ...] = ()
    """Settings that are spread evenly over their logarithm."""

    @field_validator("ranges", mode="before")
    @classmethod
    def _in_units(cls, ranges: Any) -> Any:
        """Convert text with a unit to the unit of its setting, as in a matrix."""
        if not isinstance(ranges, dict):
            return ranges
        return {
            name: tuple(_bound(name, bound) for bound in bounds)
            if isinstance(bounds, list | tuple)
            else bounds
            for name, bounds in ranges.items()
        }

    @model_validator(mode="after")
    def _ranges_are_ranges(self) -> SpaceSample:
        for name, (low, high) in self.ranges.items():
            if not low < high:
                raise ValueError(f"ranges.{name}: {low:g} is not below {high:g}")
        for name in self.log:
            if name not in self.ranges:
                raise ValueError(f"log: {name} has no range")
            if self.ranges[name][0] <= 0:
                raise ValueError(f"log: {name} begins at {self.ranges[name][0]:g}, not above 0")
        return self


class Experiment(Settings):
    """One entry ``[[experiment]]``: a procedure over many conditions."""

    procedure: str
    name: str = Field(default="", pattern=OPTIONAL_NAME)
    """Names its conditions; left out, the procedure's name."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings that all its runs share."""
    matrix: dict[str, list[Value]] = Field(default_factory=dict)
    """Values by setting: every combination is a condition."""
    sample: SpaceSample | None = None
    """Random samples of settings, in place of a matrix or combined with it."""
    exclude: tuple[dict[str, Value], ...] = ()
    """Combinations to leave out: those that have all the values of one entry."""
    include: tuple[dict[str, Any], ...] = ()
    """Settings added to those combinations whose values of the matrix they do not contradict. If
    there is no such combination, they are a further one."""
    repeat: int = Field(default=1, ge=1, le=100_000)
    """Runs of each condition."""
    block_by: tuple[str, ...] = ()
    """For order "blocked": settings whose values stay together. If it is empty, each repeat is a
    block."""
    every: int | None = Field(default=None, ge=1)
    """Makes the experiment a reference: it is run before the others, after every so many of them,
    and after the last."""
    drift: dict[str, float] = Field(default_factory=dict)
    """For a reference: largest change from the first reference, by figure of the summary, in the
    figure's own unit. Default: the figures that the procedure names."""
    rest_s: float = Field(default=0.0, ge=0, le=86_400)
    """Rest before each of its runs: rubber recovers."""

    @model_validator(mode="after")
    def _reference_is_plain(self) -> Experiment:
        if self.every is None:
            if self.drift:
                raise ValueError("drift belongs to a reference: give every, too")
        elif self.matrix or self.sample or self.include or self.exclude or self.repeat != 1:
            raise ValueError(
                "a reference (every) is one condition: it has settings, no matrix, sample, include,"
                " exclude or repeat"
            )
        return self


class FaultSelection(Settings):
    """A fault plan in effect on some runs."""

    runs: tuple[int, ...]
    """Numbers of the runs in the queue, from 1."""
    plan: str
    """The plan's file, relative to the batch file."""
    attempts: int = Field(default=1, ge=1)
    """Number of attempts of a run, from the first on, in which the faults are in effect."""


class WorldChange(Settings):
    """Change of World settings, in effect from a run on."""

    from_run: int = Field(ge=1)
    settings: str
    """The World's settings (TOML), relative to the batch file."""


class Simulation(Settings):
    """Table ``[simulation]``: only where the batch starts a simulated bench for itself."""

    seed: int = Field(default=0, ge=0)
    stages: Variant | None = None
    """One of the simulated benches that are installed; left out, the usual one."""
    world: str | None = None
    """The World's settings (TOML), relative to the batch file, or "population": drawn by the
    seed."""
    fault: tuple[FaultSelection, ...] = ()
    change: tuple[WorldChange, ...] = ()
    world_log: bool = False
    """True if the log of every simulated bench is saved with its run."""


class BatchFile(Settings):
    """A whole batch file."""

    batch: BatchSettings
    defaults: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Settings by procedure."""
    experiment: tuple[Experiment, ...] = Field(min_length=1)
    simulation: Simulation | None = None
