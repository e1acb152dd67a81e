"""Slide of the artificial skin on a plate at constant normal force: paper 4.1.

The skin hangs on the x-z stage above the plate, the plate lies on the force sensor. A trial goes
down until the plate is felt, brings the normal force up and holds it by a servo on z, rests, slides
along x, and lifts off. The strips are sampled all the while, gap by gap the same: what was lost
ends the trial.

Every tick takes what the force sensor and the DAQ have sent, records it, and moves z by what the
force asks for. Whatever ends a trial, x stops first, then z goes up.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from procedures import slip_layout
from procedures.contact import contact_range_mm, park, unload
from rig.bench import STRIPS, Fixture
from rig.errors import RigError
from rig.instruments import Acquisition, InputChannel
from rig.runner.points import Move, Point, Reading
from rig.settings import Settings as BaseSettings

if TYPE_CHECKING:
    from rig.runner.run import Run

NAME = "slip-trial"
FIXTURES: tuple[Fixture, ...] = ("plate",)
FIGURE = "slip_trial"
LAYOUT = slip_layout.LAYOUT
STREAMS = slip_layout.STREAMS

FORCE_RATE_S_S = 1000.0
"""Frames of the force sensor (paper 4.1)."""
DELAY_S = 0.004
"""From a command to the first force that shows it: link 1 ms, half a frame, half a look, the
rubber's relaxation. Two milliseconds too much ring at 500 Hz (decision 0038)."""
LINK_S = 0.001
"""Of a look at an axis and a new target, that much is in `DELAY_S`; of what it takes longer, half
comes between look and command (decision 0042)."""
TICK_Hz = 100.0
"""Of the servo, where stages can be told so often."""
UNREHEARSED_mm = 0.0175
"""Travel within delay and tick up to which the servo holds the force through a slide that it has
not seen, whatever the friction (decision 0035)."""
WAY_S, SEARCHED_mm = 3.5, 0.6
"""Expected of the way to the held force and back where the place of the contact is known, and of
the slow search where it is not."""


class Settings(BaseSettings):
    """What a slip trial may be asked for."""

    normal_force_N: float = Field(default=4.0, gt=0)
    """Normal force, held by the servo (paper 2.2: all nine ridges touch at 4 N)."""
    loading: Literal["slide", "ramp"] = "slide"
    """What drags the skin: a slide at constant speed, or a tangential force that rises evenly."""
    speed_mm_s: float = Field(default=0.5, gt=0)
    """Speed of the slide; of a ramp, its limit and the speed after gross slip."""
    distance_mm: float = Field(default=1.0, gt=0)
    """Length of the slide; of a ramp, the longest."""
    ramp_N_s: float = Field(default=2.0, gt=0)
    """Rate at which a ramp has the tangential force rise."""
    ramp_to_N: float = Field(default=10.0, gt=0)
    """Tangential force at which a ramp ends where nothing has slipped."""
    direction: Literal["+x", "-x"] = "+x"
    """Direction of the slide."""
    start_mm: float = 10.0
    """Position of the x stage at which a trial begins."""
    acceleration_mm_s2: float = Field(default=200.0, gt=0)
    """Of the stages, as their drives are set."""
    rest_s: float = Field(default=0.3, ge=0, le=60)
    """Rest under the held force, before the slide."""
    trials: int = Field(default=1, ge=1, le=10_000, json_schema_extra={"short": "-n"})
    """How many trials are made."""
    retry_invalid: int = Field(default=0, ge=0, le=100)
    """How often a trial that does not count is made again."""
    force_error_rms_percent: float = Field(default=2.0, gt=0)
    """Error of the normal force during the slide, rms, beyond which a trial does not count."""
    force_error_peak_percent: float = Field(default=5.0, gt=0)
    """Its largest error beyond which a trial does not count."""
    late_ticks_percent: float = Field(default=1.0, ge=0, le=100)
    """Share of late ticks beyond which a trial does not count."""
    largest_force_N: float = Field(default=15.0, gt=0)
    """Force along any axis at which everything stops."""
    tick_Hz: float | None = Field(default=None, ge=20, le=500)
    """Ticks of the servo; left out, 100 a second, or as many as the stages' links have time for."""
    rehearsal: Literal["auto", "always", "never"] = "auto"
    """A first slide without a record, from which the servo learns; auto: where it is needed."""
    rate_S_s: float = Field(default=10e3, ge=10e3, le=50e3)
    """Sampling rate of the strips; a whole multiple of 1000."""
    block_s: float = Field(default=0.02, ge=0.002, le=0.2)
    """Of the strips' samples: as long as they may be old when they are seen during the trial."""
    range_V: float = Field(default=1.25, gt=0)
    """Input range of the strips' channels, bipolar."""
    object: str = ""
    """What lies in the place of the plate."""

    @model_validator(mode="after")
    def _fits(self) -> Settings:
        if self.normal_force_N >= self.largest_force_N:
            raise ValueError(
                f"normal_force_N {self.normal_force_N:g} is not below largest_force_N "
                f"{self.largest_force_N:g}"
            )
        if self.loading == "ramp" and self.ramp_to_N >= self.largest_force_N:
            raise ValueError(
                f"ramp_to_N {self.ramp_to_N:g} is not below largest_force_N "
                f"{self.largest_force_N:g}"
            )
        if self.rate_S_s % 1000:
            raise ValueError(f"rate_S_s {self.rate_S_s:g} is not a whole multiple of 1000")
        return self

    @property
    def block_samples(self) -> int:
        """Of the DAQ."""
        return round(self.rate_S_s * self.block_s)

    @property
    def longest_slide_s(self) -> float:
        """What a slide or a ramp may take at most."""
        ramps_s = 2 * self.speed_mm_s / self.acceleration_mm_s2
        rise_s = self.ramp_to_N / self.ramp_N_s if self.loading == "ramp" else 0.0
        return rise_s + self.distance_mm / self.speed_mm_s + ramps_s + 1.0

    @property
    def updates_a_tick(self) -> int:
        """How many stages are looked at and told a new target in every tick."""
        return 2 if self.loading == "ramp" else 1

    def rehearsed(self, tick_s: float, delay_s: float = DELAY_S) -> bool:
        """Whether a series begins with a slide that only teaches the servo."""
        if self.rehearsal != "auto":
            return self.rehearsal == "always"
        return self.speed_mm_s * (delay_s + tick_s) > UNREHEARSED_mm

    @property
    def along(self) -> int:
        """Sign of the slide."""
        return 1 if self.direction == "+x" else -1

    @property
    def end_mm(self) -> float:
        """Where the slide ends."""
        return self.start_mm + self.along * self.distance_mm


# --- what will be done ------------------------------------------------------------------------


def points(settings: Settings) -> tuple[Point, ...]:
    """One point a trial."""
    from rig.runner.approach import TOUCH, search_speed_mm_s

    tick_s, trial_s = (
        1 / (settings.tick_Hz or TICK_Hz),
        settings.longest_slide_s + settings.rest_s + WAY_S,
    )
    search_mm_s = search_speed_mm_s(
        TOUCH * settings.normal_force_N, DELAY_S + tick_s, settings.acceleration_mm_s2
    )
    first_s = SEARCHED_mm / search_mm_s + settings.rehearsed(tick_s) * trial_s
    channels = tuple(InputChannel(name, settings.range_V) for name in STRIPS)
    updates_Hz = (settings.tick_Hz or 0.0) * settings.updates_a_tick
    return tuple(
        Point(
            id=f"trial-{number:03d}",
            condition=number,
            moves=(
                Move("force_sensor.force", settings.largest_force_N),
                Move("stage_x.position", settings.start_mm),
                Move("stage_x.position", settings.end_mm),
                Move("stage_x.speed", settings.speed_mm_s),
                Move("stage_z.update_rate", updates_Hz),
            ),
            acquisitions=(Acquisition(channels, settings.rate_S_s, settings.block_samples),),
            duration_s=trial_s + (first_s if number == 1 else 0.0),
        )
        for number in range(1, settings.trials + 1)
    )


def invalid(settings: Settings, reading: Reading) -> str:
    """Why a trial does not count; empty where it does."""
    return str(reading.get("invalid") or "")


def summarise(settings: Settings, readings: Sequence[Reading]) -> Mapping[str, Any]:
    """Friction and servo, means of the trials that count and their standard deviations, how many
    count, and why trials have no friction coefficients."""
    counting = [r for r in readings if not r["invalid"]]
    found: dict[str, Any] = {"trials": len(readings), "valid_trials": len(counting)}
    if readings and "tick_Hz" in readings[-1]:  # not in files of before
        found["tick_Hz"] = readings[-1]["tick_Hz"]
    for name in (
        "static_friction",
        "kinetic_friction",
        "force_error_rms_percent",
        "force_error_peak_percent",
        "overshoot_percent",
    ):
        values = [float(value) for r in counting if (value := r[name]) is not None]
        if values:
            found[f"mean_{name}"] = statistics.fmean(values)
        if len(values) > 1:
            found[f"standard_deviation_{name}"] = statistics.stdev(values)
    reasons = [str(why) for r in readings if (why := r.get("no_friction"))]
    if reasons:
        found["no_friction"] = [
            f"{len(reasons)} of {len(readings)} trials give no friction coefficients: {reasons[0]}"
        ]
    return found


# --- doing it ---------------------------------------------------------------------------------


def import_ahead() -> None:
    """What a trial needs and takes seconds to import: never while something is switched on."""
    import scipy.interpolate
    import scipy.ndimage
    import scipy.optimize
    import scipy.signal
    import scipy.special  # noqa: F401

    import procedures.slip_taking  # noqa: F401


def arm(run: Run) -> None:
    """Watch the force; have the end of everything known before it begins; park."""
    bench, settings = run.bench, run.settings
    x, daq = bench.stage_x, bench.daq
    contact_range_mm(bench)  # a fixture that does not say it is refused before anything happens
    from procedures.slip_taking import series_on

    run.state = run.state or series_on(run)
    run.stream_force(FORCE_RATE_S_S)
    run.force.watch(settings.largest_force_N)
    run.arm("acquisition", daq.stop)  # the last to be ended: a DAQ that hangs keeps no skin pressed
    run.arm("slide", x.stop, at_once=x.make_safe)
    x.stop()
    park(run, "normal force", lambda: _lift(run))
    if not x.homed():  # only now: the skin is clear of everything
        x.home()


def take(run: Run, point: Point) -> Reading:
    """One trial: down, hold, rest, slide, up; then what it shows."""
    from procedures.slip_taking import Series, Trial

    series: Series = run.state
    if run.settings.rehearsed(series.tick_s, series.delay_s) and series.shift is None:
        Trial(run, int(point.condition), series).rehearse()
    trial = Trial(run, int(point.condition), series)
    trial.make_ready()
    trial.record()
    trial.press()
    trial.slide()
    trial.end_record()
    trial.lift()
    return trial.reading()


def _lift(run: Run) -> None:
    """Stop, x first; then away from the plate, if the drive still can."""
    try:
        run.bench.stage_x.stop()
    except RigError as error:  # its own off says so, too: up is what matters here
        run.event("warning", "slide-not-stopped", error.one_line())
    unload(run, "skin")
