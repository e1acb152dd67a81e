"""The common settings, expectations and arming of trials with the skin pressed on an object.

The skin hangs on the x-z stage above the object, which stands on the force sensor. A trial goes
down until the object is felt, brings the normal force up and holds it by a servo on z while
something moves, and lifts off. Whatever ends it, what moves stops first, then z goes up.
"""

from __future__ import annotations

import json
import math
import statistics
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationInfo, field_validator, model_validator

from procedures.pressed.approach.contact import (
    HOMING_S,
    arm_from_where_it_stands,
    expected_contact_mm,
    first_ways_s,
    park,
    stream_force,
    travel_s,
)
from procedures.pressed.approach.tare import TARE_S, ZERO_LABEL, force_zero_of
from procedures.pressed.approach.unload import SETTLED_S, say_if_lost, unload
from rig.bench.settings import STRIPS, FixtureSettings
from rig.core.errors import RigError
from rig.core.settings import Settings as BaseSettings
from rig.core.settings import name_without_unit
from rig.core.validated import STORED
from rig.detector import DEFAULT_DETECTOR
from rig.files.journal.detections import NO_DETECTOR, SLIP, from_text
from rig.instruments.roles import Acquisition, InputChannel
from rig.run.points import Move, Point, Reading
from rig.run.procedure import DriftFigure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rig.run.context import Run

MIN_FORCE_RATE_S_S = 100.0
"""Minimum number of frames a second of a force sensor: below, a frame is longer than the tap's way
back, so that the clocks could not be compared, and some ticks bring the servo no new force."""
DELAY_S = 0.004
"""Time in s from a command to the first force that shows it, with a force sensor at 1000 frames/s:
link 1 ms, half a frame, half of the window that a tick takes the mean of, the rubber's relaxation.
Two milliseconds too much ring at 500 Hz (decision 0038)."""
LINK_S = 0.001
"""Share in s of `DELAY_S` for a poll of an axis and a new target together. If they take longer,
half of the additional time is between poll and command (decision 0042)."""
TICK_Hz = 100.0
"""Ticks of the servo, where the links of the stages have time for them."""
POLL_RATE_Hz = 100.0
"""Highest rate at which stages and DAQ are polled and recorded, also if ticks are more frequent. An
approach, which needs the position of z in every tick, has no higher tick rate."""
NEAR_mm = 0.06
"""Distance before the place of an earlier contact at which the slow search begins."""
TAP_S = 0.04
"""Time in s from the way back to the way on, and from there until the servo takes over."""
AFTER_S = 0.1
"""Time in s that is still recorded after the motion."""
RISE_S = 0.22
"""Expected time in s from touch to the normal force (measured on the skin, 2 to 8 N)."""

TOUCH_DRIFT = {
    f"mean_touch_gain_{number}_dB": DriftFigure("gain by touch-down and tap", strip, 0.5)
    for number, strip in enumerate(STRIPS, 1)
}
"""Five times the largest difference that was seen on the simulated bench (decision 0051)."""
SUMMARY_LABELS = {
    "tick_Hz": "servo tick rate; Hz",
    "mean_touch_gain_1_dB": "strip 1, touch-down gain; dB re 1 V s/N",
    "mean_touch_gain_2_dB": "strip 2, touch-down gain; dB re 1 V s/N",
    "mean_force_error_rms_percent": "error of the normal force, rms",
    "mean_force_error_peak_percent": "error of the normal force, peak",
    "force_zero_N": ZERO_LABEL,
}
"""Labels of values that are shown after a run, see `Procedure.summary_labels`."""


class PressedSettings(BaseSettings):
    """Settings that all trials with the skin pressed on an object share."""

    normal_force_N: float = Field(default=4.0, gt=0)
    """Set point of the normal force (paper 2.2: all nine ridges touch at 4 N)."""
    acceleration_mm_s2: float = Field(default=200.0, ge=1, le=50_000)
    """Acceleration that is configured in the stage drives, for the force servo and the expected
    times. It is only stated here: nothing is set in the drives."""
    rest_s: float = Field(default=0.3, ge=0, le=60)
    """Rest under the held force, before the motion."""
    trials: int = Field(default=1, ge=1, le=10_000, json_schema_extra={"short": "-n"})
    """Number of trials."""
    retry_invalid: int = Field(default=0, ge=0, le=100)
    """How many times an invalid trial is repeated."""
    force_error_rms_percent: float = Field(default=2.0, gt=0)
    """Maximum rms error of the normal force in the motion; a trial above it is marked invalid."""
    force_error_peak_percent: float = Field(default=5.0, gt=0)
    """Maximum error of the normal force in the motion; a trial above it is marked invalid."""
    overshoot_percent: float = Field(default=10.0, gt=0)
    """Maximum overshoot of the normal force before the motion; a trial above it is marked
    invalid."""
    late_ticks_percent: float = Field(default=1.0, ge=0, le=100)
    """Maximum share of late servo ticks; a trial above it is marked invalid."""
    largest_force_N: float = Field(default=15.0, gt=0)
    """Safety limit on each force axis; exceeding it stops the bench."""
    tick_Hz: float | None = Field(default=None, ge=20, le=500)
    """Update rate of the force servo. Default: 100 Hz, or the fastest that the stage connection
    allows."""
    rate_S_s: float = Field(default=10e3, ge=10e3, le=50e3)
    """Sampling rate of the strips; a whole multiple of 1000."""
    block_s: float | None = Field(default=None, ge=0.001, le=0.2)
    """Length of a DAQ read block; upper bound on the delay of live data. Default: 20 ms, or 2 ms
    where a grip answers what is detected, and longer if the DAQ's link cannot keep up with that."""
    range_V: float = Field(default=1.25, gt=0)
    """Input range of the strips' channels, bipolar."""
    object: str = ""
    """Object that the skin is pressed on."""
    detector: str = DEFAULT_DETECTOR
    """Detector that looks for slips during the trial (`rig detectors` lists them), or none."""

    @field_validator("detector")
    @classmethod
    def _detector_is_known(cls, name: str, info: ValidationInfo) -> str:
        # A file can be read where the package of its detector is not installed.
        if name not in (DEFAULT_DETECTOR, NO_DETECTOR) and info.context != STORED:
            # Here and not at the top: numpy would slow `rig --help`.
            from rig.detector.registered import detector_names

            if name not in detector_names():
                known = ", ".join((*detector_names(), NO_DETECTOR))
                raise ValueError(f"{name!r} is not a detector; choose one of {known}")
        return name

    @model_validator(mode="after")
    def _can_be_held(self) -> PressedSettings:
        if self.normal_force_N >= self.largest_force_N:
            raise ValueError(
                f"normal_force_N {self.normal_force_N:g} N is not below largest_force_N "
                f"{self.largest_force_N:g} N"
            )
        if self.rate_S_s % 1000:
            raise ValueError(f"rate_S_s {self.rate_S_s:g} is not a whole multiple of 1000")
        return self

    @property
    def largest_held_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Largest set point of the normal force in a trial. A procedure that changes the set point
        (`PressedTrial.hold_at`) states it; the bench is checked for it before anything moves."""
        return self.normal_force_N

    @property
    def kind_of_press(self) -> str:
        """What decides, beside the normal force, what a press shows: a press is compared with
        earlier ones of its kind. A procedure that presses at several places names the place."""
        return self.object

    @property
    def usual_block_s(self) -> float:
        """Length of a DAQ read block in s where none is asked for."""
        return 0.02

    @property
    def alarms_answered(self) -> int:
        """Largest number of the detector's alarms upon which the normal force rises in a trial; 0
        where it answers none."""
        return 0

    @property
    def read_block_s(self) -> float:
        """Length of a DAQ read block, in s."""
        return self.usual_block_s if self.block_s is None else self.block_s

    @property
    def block_samples(self) -> int:
        """Number of samples in a block of the DAQ."""
        return round(self.rate_S_s * self.read_block_s)

    @property
    def acquisition(self) -> Acquisition:
        """Acquisition of the strips' signals."""
        channels = tuple(InputChannel(name, self.range_V) for name in STRIPS)
        return Acquisition(channels, self.rate_S_s, self.block_samples)

    @property
    def tick_s(self) -> float:
        """Time in s from one tick to the next, if the stages' links allow it."""
        return 1 / (self.tick_Hz or TICK_Hz)

    @property
    def updates_a_tick(self) -> int:
        """Number of stages that are polled and given a new target in every tick."""
        return 1

    @property
    def updates_Hz(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Rate of new targets for the stages; 0 if their links decide."""
        return (self.tick_Hz or 0.0) * self.updates_a_tick


def trial_points(
    settings: PressedSettings,
    moves: tuple[Move, ...],
    motion_s: float,
    first_s: float,
    places: int = 1,
) -> tuple[Point, ...]:
    """Return one point for each trial. `motion_s` is the expected time of the motion under the held
    force with its preparation, `first_s` an additional time of the first trial. There are
    `settings.trials` for each of `places` along x. The ways in z depend on the fixture:
    `pressed_overhead_s`."""
    asked = (
        Move("force_sensor.force", settings.largest_force_N, ("largest_force_N",)),
        Move("stage_z.update_rate", settings.updates_Hz, ("tick_Hz",)),
        *moves,
    )
    trial_s = pressing_s(settings) + motion_s + AFTER_S
    return tuple(
        Point(
            id=point_name(number),
            condition=number,
            moves=asked,
            acquisitions=(settings.acquisition,),
            acquisitions_given=("range_V", "rate_S_s"),
            duration_s=trial_s + (first_s if number == 1 else 0.0),
        )
        for number in range(1, settings.trials * places + 1)
    )


def point_name(number: int) -> str:
    """Return the name of a trial's point, from its number."""
    return f"trial-{number:03d}"


def pressing_s(settings: PressedSettings) -> float:
    """Return the expected time in s of zeroing the force, and from touch to the end of the rest."""
    return 2 * TARE_S + RISE_S + 2 * TAP_S + settings.rest_s


def pressed_overhead_s(
    settings: PressedSettings,
    fixture: FixtureSettings,
    homed: bool,
    presses: int,
    x_mm: float,
    slid_mm: float = 0.0,
) -> float:
    """Return the expected time in s of all travel to the object and back, and of making ready.

    The place of the contact is searched for once. x begins at `x_mm`, and is `slid_mm` from there
    after each press. Stages that are `homed` wait where they are parked, x where the last run has
    left it.
    """
    # Here and not at the top: numpy would slow `rig --help`.
    from rig.control.approach import TOUCH
    from rig.control.speed_bound import largest_speed_mm_s

    late_s, force_N = DELAY_S + max(settings.tick_s, 1 / POLL_RATE_Hz), settings.normal_force_N
    slow, quick = (
        largest_speed_mm_s(
            share * force_N, fixture.stiffest_N_mm, late_s, settings.acceleration_mm_s2
        )
        for share in (TOUCH, 1.0)
    )
    slow_from_mm, contact_mm, parked_mm = expected_contact_mm(fixture)
    searched_mm = contact_mm - slow_from_mm
    near_mm = min(NEAR_mm, searched_mm)
    ways_s = travel_s(slow_from_mm - parked_mm) + travel_s(contact_mm - parked_mm)
    again_s = (searched_mm - near_mm) / quick + near_mm / slow
    ready_s = 0.0 if homed else 2 * HOMING_S + travel_s(parked_mm) + travel_s(x_mm)
    back_s = (presses - 1 + homed) * travel_s(slid_mm)
    searches_s = searched_mm / slow + (presses - 1) * again_s
    ready_s += first_ways_s(fixture, settings.largest_force_N, homed)
    return ready_s + presses * (ways_s + 2 * SETTLED_S) + back_s + searches_s + 2 * SETTLED_S


def summary_of(readings: Sequence[Reading], names: Sequence[str]) -> dict[str, Any]:
    """Return the number of valid trials, and the means and standard deviations of the named values
    over them."""
    counting = [r for r in readings if not r["invalid"]]
    found: dict[str, Any] = {"trials": len(readings), "valid_trials": len(counting)}
    if readings and "tick_Hz" in readings[-1]:  # not in files of earlier versions
        found["tick_Hz"] = readings[-1]["tick_Hz"]
    errors: dict[str, float] = {}
    for name in names:
        values = [float(value) for r in counting if (value := r.get(name)) is not None]
        if values:
            found[f"mean_{name}"] = statistics.fmean(values)
        if len(values) > 1:
            found[f"standard_deviation_{name}"] = statistics.stdev(values)
            errors[f"mean_{name}"] = statistics.stdev(values) / math.sqrt(len(values))
        elif values and (own := _own_error(counting, name)) is not None:
            errors[f"mean_{name}"] = own
    if errors:
        found["standard_errors"] = errors
    if (slips := _slips_of(readings))["trial"]:
        found["slips"] = slips
    put_in = {"put_in": sentences} if (sentences := _put_in(readings)) else {}
    return found | _touch_gains_of(readings) | force_zero_of(readings) | put_in


def _slips_of(readings: Sequence[Reading]) -> dict[str, list[float | None]]:
    """Return every incipient slip that the detector found during the trials: the trial, the time in
    its record, the time at which the program knew it, the confidence, and the amplitudes by which
    the detector decided, where it states them: the predictive signal P_A and the impulse P_B of
    v_d."""
    found = [
        (reading, one)
        for reading in readings
        for one in from_text(str(reading.get("detections") or ""))
        if one.kind == SLIP
    ]
    return {
        "trial": [float(reading.get("trial") or 0) for reading, _ in found],
        "time_s": [one.time_s for _, one in found],
        "decided_s": [one.decided_s for _, one in found],
        "confidence": [one.confidence for _, one in found],
        **{
            name: amplitudes
            for name in ("predictive_mV", "impulse_mV")
            if any(amplitudes := [getattr(one, name) for _, one in found])
        },
    }


def _own_error(readings: Sequence[Reading], name: str) -> float | None:
    """Return the standard error that the one reading with this value states itself, if it does."""
    (reading,) = (r for r in readings if r.get(name) is not None)
    quantity = name_without_unit(name)
    error = reading.get(f"{quantity}_error{name.removeprefix(quantity)}")
    return None if error is None else float(error)


def truth_of(readings: Sequence[Reading]) -> dict[str, Any]:
    """Return the simulated bench's record of the latest trial that has one; empty on a real one."""
    accounts = [str(truth) for r in readings if (truth := r.get("simulated_truth"))]
    known: dict[str, Any] = json.loads(accounts[-1]) if accounts else {}
    return known


def _put_in(readings: Sequence[Reading]) -> list[str]:
    """Return what the simulated bench put into the trials, in words; nothing on a real one."""
    known = truth_of(readings)
    lines = []
    if (body := known.get("object", {})).get("shape") in ("cylinder", "sphere"):
        shape = f"a {body['shape']} of {body['radius_mm']:g} mm radius"
        other = ", not the paper's semi-spherical head" if body["shape"] == "cylinder" else ""
        lines.append(f"In the simulation the object is {shape}{other} (radius ASSUMED).")
    if "static_coefficient" in known:
        lines.append(
            f"True values in the simulation: friction {known['static_coefficient']:g} at rest, "
            f"{known['kinetic_coefficient']:g} in motion, over "
            f"{known['weakening_distance_um']:g} um (ASSUMED), and the skin: its finger radius is "
            "calibrated so that all nine ridges touch at 4 N, its other dimensions are ASSUMED "
            "where the paper gives none. When and where it slips follows from these."
        )
    return lines


def _touch_gains_of(readings: Sequence[Reading]) -> dict[str, float]:
    """Return each strip's mean gain in dB re 1 V s/N. An invalid trial was pressed all the same."""
    found = {}
    for number in (1, 2):
        name = f"touch_gain_{number}_V_s_N"
        gains = [float(gain) for r in readings if (gain := r.get(name)) is not None]
        if gains and (mean := statistics.fmean(gains)):
            found[f"mean_touch_gain_{number}_dB"] = 20 * math.log10(abs(mean))
    return found


def import_what_a_trial_needs() -> None:
    """Import what a trial needs. It takes seconds, so it must not happen while something is
    switched on."""
    import scipy.ndimage
    import scipy.special  # noqa: F401


def arm_pressed(
    run: Run,
    what: str,
    stop: Callable[[], None],
    emergency: Callable[[], None],
    done: str,
    tick_Hz: float,
) -> None:
    """Watch the force; register the end of everything before it begins; park.

    `what` moves under the held force; it is ended by `stop`, or by `emergency` where a watcher
    acts; `done` is what a person reads when it has ended. LimitError before any motion for a force
    sensor with less than `MIN_FORCE_RATE_S_S`, or less than a frame for each of `tick_Hz` ticks a
    second.
    """
    bench, settings = run.bench, run.settings
    least_S_s = max(MIN_FORCE_RATE_S_S, tick_Hz)

    def lift(came_from_mm: float) -> None:
        _lift(run, what, stop, came_from_mm)

    arm_from_where_it_stands(run, "normal force", lift)
    stream_force(run, least_S_s, f"a trial whose servo acts at {tick_Hz:g} Hz")
    run.force.watch(settings.largest_force_N)
    # Last, since a DAQ that hangs keeps no skin pressed.
    run.arm("acquisition", bench.daq.stop, drives=False)
    run.arm(what, stop, emergency=emergency, done=done)
    stop()
    park(run, "normal force", lift)
    if not bench.stage_x.homed():  # only now: the skin is clear of everything
        bench.stage_x.home()


def _lift(run: Run, what: str, stop: Callable[[], None], came_from_mm: float) -> None:
    """Stop, what moves first; then away from the object, if the drive still can. An instrument that
    does not answer its stop does not keep the skin pressed."""
    say_if_lost(run)
    try:
        run.arming.begin(what, stop)
    except RigError as error:  # its own off says so, too: up is what matters here
        run.event("warning", f"{what}-not-stopped", error.one_line())
    unload(run, "skin", came_from_mm)
