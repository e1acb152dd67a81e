"""The settings that all trials with the skin pressed on an object share, and their constants."""

from __future__ import annotations

from pydantic import Field, ValidationInfo, field_validator, model_validator

from rig.bench.settings import STRIPS
from rig.core.settings import Settings as BaseSettings
from rig.core.validated import STORED
from rig.detector import DEFAULT_DETECTOR
from rig.files.journal.detections import NO_DETECTOR
from rig.instruments.roles import Acquisition, InputChannel

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
CONTACT_N = 0.1
"""Force that means contact: ten times the sensor's noise over a look."""
NEAR_mm = 0.06
"""Distance before the place of an earlier contact at which the slow search begins."""
TAP_S = 0.04
"""Time in s from the way back to the way on, and from there until the servo takes over."""
AFTER_S = 0.1
"""Time in s that is still recorded after the motion."""


class PressedSettings(BaseSettings):
    """Settings that all trials with the skin pressed on an object share."""

    normal_force_N: float = Field(default=4.0, gt=0)
    """Set point of the normal force, at least 0.1 N, which means contact (paper 2.2: all nine
    ridges touch at 4 N)."""
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
            # Here and not at the top: numpy would slow a command's `--help`.
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
        """What decides, apart from the normal force, what a press shows: a press is compared with
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
