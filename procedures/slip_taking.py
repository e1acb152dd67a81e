"""One slip trial: its phases, what every tick records, and what it shows in the end."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal  # noqa: F401 - the decimator's, imported before anything moves

from procedures.contact import (
    CLEAR_mm,
    TRAVEL_mm_s,
    come_close,
    contact_range_mm,
    felt_N,
    nothing_felt,
    refuse_early_contact,
    tare_in_free_air,
)
from procedures.slip_trial import FORCE_RATE_S_S, STRIPS
from rig.analysis.clock_offset import ClockOffsetError, Series, clock_offset
from rig.analysis.decimation import Decimator
from rig.analysis.friction import FrictionError, friction
from rig.bench import require
from rig.errors import InstrumentError
from rig.instruments import Acquisition, InputChannel
from rig.runner.approach import Approach
from rig.runner.loop import tick_loop
from rig.runner.servo import ForceServo, settings_from

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.slip_trial import Settings
    from rig.runner.loop import LoopStatistics, Tick
    from rig.runner.points import Reading
    from rig.runner.run import Run

LOOK_S = 0.004
"""Stretch of force that a tick looks at: shorter is noisier, longer is later."""
CONTACT_N = 0.1
"""Force that means contact: ten times the sensor's noise over a look."""
SLOWEST_mm_s = 0.01
SLOWEST_SEARCH_mm_s = 0.05
"""Slowest search for contact that is waited for."""
BOTTOM_mm = 0.002
"""So near to contact_to_mm is there."""
DELAY_S = 0.005
"""From a command to the first force that shows it: link 1 ms, half a frame, half a look, the age of
the newest frame, the rubber's relaxation."""
FORCE_AGE_S = 0.003
"""How much older the force of a look is than the position read with it."""
MOVING_EVERY = 5
"""Ticks between two looks whether x has arrived."""
MISSING_S = 0.05
"""Samples or frames of so long may be under way when a record ends."""
SERVO_SEEN = 5
"""Frames over which the error of the force is averaged."""
DECIMATED_Hz = 1000.0
TOUCH_SEEN_S, TOUCH_FELT_S = (0.2, 0.5), (0.5, 0.8)
"""Before and after the touch-down: what the two clocks are compared by."""
FRICTION_COLUMNS = (
    "static_friction",
    "static_friction_error",
    "kinetic_friction",
    "kinetic_friction_error",
)
PATIENCE_S = 10.0
"""From contact to a held force, at most."""
AFTER_S = 0.1
"""What is still recorded after the slide."""


@dataclass
class _Taken:
    """What a trial has recorded so far, for what is computed from it."""

    volts: list[npt.NDArray[np.float64]] = field(default_factory=list)
    """Strips at 1 kHz, (n, 2) each."""
    force: list[npt.NDArray[np.float64]] = field(default_factory=list)
    """F_n, F_t, F_y, (n, 3) each."""
    position: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    """Time, z, x, z commanded, x commanded."""
    rows: int = 0
    """Of the strips."""
    signal_rows: int = 0
    frames: int = 0


class Trial:
    """One trial under way."""

    def __init__(self, run: Run, number: int):
        self.run, self.number = run, number
        self.settings: Settings = run.settings
        self.bench = run.bench
        self.z, self.x = run.bench.stage_z, run.bench.stage_x
        self.fixture = run.bench.settings.fixture
        self.taken = _Taken()
        self.begun_s = self.contact_mm = self.stiffness_N_mm = 0.0
        self.largest_N = 0.0
        self.slide_from_s = self.slide_to_s = 0.0
        self._z_commanded = self._x_commanded = 0.0
        self._first_frame = 0
        self._statistics: list[LoopStatistics] = []

    # --- the phases -----------------------------------------------------------------------------

    def make_ready(self) -> None:
        """Up, to the place where the slide begins, and zero the force in free air."""
        self.z.move_to(self.fixture.parked_mm, TRAVEL_mm_s)
        self.x.move_to(self.settings.start_mm, TRAVEL_mm_s)
        tare_in_free_air(self.run)
        self._z_commanded = self.fixture.parked_mm
        self._x_commanded = self.settings.start_mm
        come_close(self.run, CONTACT_N, LOOK_S, 1 / self.settings.tick_Hz)

    def record(self) -> None:
        """Begin to record: strips, forces and positions."""
        settings = self.settings
        self._decimator = Decimator(settings.rate_S_s, len(STRIPS))
        block = round(settings.rate_S_s / settings.tick_Hz)
        channels = tuple(InputChannel(name, settings.range_V) for name in STRIPS)
        self.bench.daq.start(Acquisition(channels, settings.rate_S_s, block))
        self.begun_s = self.run.clock.now()
        self._begun_us = round(1e6 * self.begun_s)
        self._first_frame = self.run.force.frames_seen

    def end_record(self) -> None:
        """Take what has still come, and end the acquisition."""
        self._collect_streams()
        self.bench.daq.stop()

    def press(self) -> None:
        """Down until the plate is felt, on until the force is there, no faster than it allows; the
        contact's stiffness is learnt on the way. Then rest under the servo."""
        settings = self.settings
        first_mm, last_mm = contact_range_mm(self.bench)
        tick_s = 1 / settings.tick_Hz
        down = Approach(
            settings.normal_force_N, tick_s, DELAY_S, FORCE_AGE_S, self._acceleration_mm_s2()
        )
        touched = arrived = False

        def look(tick: Tick) -> bool:
            nonlocal touched, arrived
            force_N = self._collect()
            here_mm = self.taken.position[-1][1]
            step = down.step(tick.began_s, here_mm, force_N)
            if step.touched and not touched:
                touched = True
                self.contact_mm = here_mm
                if here_mm < first_mm:
                    refuse_early_contact(self.run, force_N, CONTACT_N)
            arrived = step.touched and step.speed_mm_s == 0
            braking_mm = step.speed_mm_s**2 / (2 * self._acceleration_mm_s2())
            target_mm = here_mm + 3 * step.speed_mm_s * tick_s + braking_mm
            self._move_z(min(target_mm, last_mm), max(step.speed_mm_s, SLOWEST_mm_s))
            return not arrived and (touched or here_mm < last_mm - BOTTOM_mm)

        search_s = (last_mm - first_mm + CLEAR_mm) / SLOWEST_SEARCH_mm_s
        self._loop(search_s + PATIENCE_S, look)
        if not arrived:
            self.z.stop()
            self._refuse_no_force(touched)
        self.stiffness_N_mm = down.stiffness_N_mm
        self._servo = ForceServo(
            settings_from(
                settings.normal_force_N,
                self.stiffness_N_mm,
                tick_s,
                DELAY_S,
                self._acceleration_mm_s2(),
            )
        )
        self._loop(settings.rest_s, self._hold)

    def slide(self) -> None:
        """Slide under the held force to the end, and a moment longer."""
        settings = self.settings
        self.slide_from_s = self.run.clock.now() - self.begun_s
        self._x_commanded = settings.end_mm
        self.x.start_move(settings.end_mm, settings.speed_mm_s)
        self._sliding = True
        ramp_s = 2 * settings.speed_mm_s / self._acceleration_mm_s2()
        longest_s = settings.distance_mm / settings.speed_mm_s + ramp_s + 1.0

        def hold(tick: Tick) -> bool:
            self._hold(tick)
            return tick.number % MOVING_EVERY != 0 or self.x.moving()

        self._loop(longest_s, hold)
        self.slide_to_s = self.run.clock.now() - self.begun_s
        self._sliding = False
        self.x.stop()
        self._loop(AFTER_S, self._hold)

    def lift(self) -> None:
        """Off the plate."""
        self.z.stop()
        self.z.move_to(self.fixture.parked_mm, TRAVEL_mm_s)

    # --- a tick ---------------------------------------------------------------------------------

    def _loop(self, longest_s: float, on_tick: Callable[[Tick], bool]) -> None:
        self._statistics.append(tick_loop(self.run, self.settings.tick_Hz, longest_s, on_tick))

    def _hold(self, tick: Tick) -> bool:
        """Move z by what the force asks for."""
        step = self._servo.step(self._collect())
        self._move_z(self._z_commanded + step.increment_mm, step.speed_mm_s)
        return True

    def _collect(self) -> float:
        """Take and record what DAQ, force sensor and stages say; the latest force along z."""
        self._collect_streams()
        here = (self.z.position_mm(), self.x.position_mm(), self._z_commanded, self._x_commanded)
        row, taken = np.array([here]), self.taken
        self.run.put("position", len(taken.position), row, self.settings.tick_Hz, units="mm")
        taken.position.append((self.run.clock.now() - self.begun_s, *here))
        force_N = self._force_N()
        self.largest_N = max(self.largest_N, force_N)
        return force_N

    def _collect_streams(self) -> None:
        run, taken = self.run, self.taken
        while (record := self.bench.daq.read()) is not None:
            run.emit("strips", record)
            taken.rows += len(record.counts)
            volts = np.stack([record.volts(name) for name in STRIPS], axis=1)
            self._signals(self._decimator.add(volts))
        frames = run.force.frames_since(self._first_frame + taken.frames)
        if frames is not None:
            first, taken.frames = taken.frames, taken.frames + len(frames)
            run.put("bridges", first, frames.raw, FORCE_RATE_S_S, units="mV/V")
            # The sensor's z points up out of the plate: what presses on it is F_n.
            newton = np.ascontiguousarray(frames.force_N[:, [2, 0, 1]])
            run.put("force", first, newton, FORCE_RATE_S_S, units="N")
            taken.force.append(newton)

    def _signals(self, volts: npt.NDArray[np.float64]) -> None:
        if not len(volts):
            return
        rows = np.column_stack([volts[:, 0] - volts[:, 1], volts])
        self.run.put("signals", self.taken.signal_rows, rows, DECIMATED_Hz, units="V")
        self.taken.signal_rows += len(rows)
        self.taken.volts.append(volts)

    def _force_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        return felt_N(self.run, LOOK_S)

    def _move_z(self, position_mm: float, speed_mm_s: float) -> None:
        reach = self.z.reach()
        require("position under the force", position_mm, reach["position"])
        self._z_commanded = position_mm
        self.z.start_move(position_mm, min(max(speed_mm_s, SLOWEST_mm_s), reach["speed"].high))

    # --- what can be wrong ----------------------------------------------------------------------

    def _acceleration_mm_s2(self) -> float:
        return self.settings.acceleration_mm_s2

    def _refuse_no_force(self, touched: bool) -> None:
        here_mm, force_N = self.z.position_mm(), self._force_N()
        if touched:
            raise InstrumentError(
                "stage_z",
                "press",
                f"{force_N:.3g} N at {here_mm:.3f} mm, {self.settings.normal_force_N:g} N wanted",
                "look at the skin and the plate; correct contact_to_mm if it may go further",
            )
        check = "the plate lies on the force sensor and that the sensor is connected"
        raise nothing_felt(self.run, force_N, CONTACT_N, check)

    # --- what it shows --------------------------------------------------------------------------

    def reading(self) -> Reading:
        """Figures of the trial, and why it does not count if it does not."""
        settings, taken = self.settings, self.taken
        force = np.concatenate(taken.force)
        t = np.arange(len(force)) / FORCE_RATE_S_S
        held = (t >= self.slide_from_s) & (t <= self.slide_to_s)
        error = 100 * (_smoothed(force[:, 0])[held] / settings.normal_force_N - 1)
        ticks = sum(loop.ticks for loop in self._statistics)
        late = sum(loop.late for loop in self._statistics)
        reading: Reading = {
            "trial": self.number,
            "normal_force_set_N": settings.normal_force_N,
            "speed_mm_s": settings.speed_mm_s,
            "direction": float(settings.along),
            "contact_mm": self.contact_mm,
            "stiffness_N_mm": self.stiffness_N_mm,
            "overshoot_percent": 100 * max(0.0, self._overshoot(force, t)),
            "normal_force_N": float(force[held, 0].mean()),
            "force_error_rms_percent": float(np.sqrt(np.mean(error**2))),
            "force_error_peak_percent": float(np.abs(error).max()),
            "slide_from_s": self.slide_from_s,
            "slide_to_s": self.slide_to_s,
            "samples": taken.rows,
            "frames": taken.frames,
            "ticks": ticks,
            "late_ticks": late,
            "largest_lateness_s": max(loop.largest_lateness_s for loop in self._statistics),
            "filter_delay_s": self._decimator.delay_s,
        }
        self.run.check_stop()  # computing takes a while: still alive
        reading |= self._friction(force[held])
        self.run.check_stop()
        reading |= self._clock_offset(force)
        self.run.check_stop()
        if truth := self.run.clock.truth():
            reading["simulated_truth"] = json.dumps({**truth, "record_begun_us": self._begun_us})
        reading["invalid"] = "; ".join(self._doubts(reading, late / max(ticks, 1)))
        return reading

    def _overshoot(self, force: npt.NDArray[np.float64], t: npt.NDArray[np.float64]) -> float:
        before = t < self.slide_from_s
        return float(_smoothed(force[:, 0])[before].max()) / self.settings.normal_force_N - 1

    def _friction(self, force: npt.NDArray[np.float64]) -> Reading:
        times = np.array([row[0] for row in self.taken.position])
        x = np.array([row[2] for row in self.taken.position])
        t = self.slide_from_s + np.arange(len(force)) / FORCE_RATE_S_S
        travel = np.abs(np.interp(t, times, x) - self.settings.start_mm)
        try:
            found = friction(force[:, 0], np.abs(force[:, 1]), travel)
        except FrictionError as error:
            self.run.event("warning", "friction", f"trial {self.number}: {error.one_line()}")
            return dict.fromkeys(FRICTION_COLUMNS)
        return {
            "static_friction": found.static.value,
            "static_friction_error": found.static.standard_error,
            "kinetic_friction": found.kinetic.value,
            "kinetic_friction_error": found.kinetic.standard_error,
        }

    def _clock_offset(self, force: npt.NDArray[np.float64]) -> Reading:
        """Of the force sensor's clock against the DAQ's, from the touch-down that both saw."""
        volts = np.concatenate(self.taken.volts).sum(axis=1)
        touch_s = float(np.argmax(force[:, 0] > CONTACT_N)) / FORCE_RATE_S_S
        seen = _stretch(volts, DECIMATED_Hz, touch_s, TOUCH_SEEN_S)
        felt = _stretch(force[:, 0], FORCE_RATE_S_S, touch_s, TOUCH_FELT_S)
        half_frame_s = 0.5 / FORCE_RATE_S_S
        try:
            found = clock_offset(
                Series(*felt, delay_s=half_frame_s), Series(*seen, self._decimator.delay_s)
            )
        except ClockOffsetError as error:
            self.run.event("warning", "clock-offset", f"trial {self.number}: {error.one_line()}")
            return {"clock_offset_s": None, "clock_offset_error_s": None}
        offset = found.offset
        return {"clock_offset_s": offset.value, "clock_offset_error_s": offset.standard_error}

    def _doubts(self, reading: Reading, late: float) -> list[str]:
        settings = self.settings
        doubts = []
        for name, limit in (
            ("force_error_rms_percent", settings.force_error_rms_percent),
            ("force_error_peak_percent", settings.force_error_peak_percent),
        ):
            value = float(reading[name] or 0)
            if value > limit:
                words = name.removesuffix("_percent").replace("_", " ")
                doubts.append(f"{words} {value:.2g} % is above {limit:g} %")
        if 100 * late > settings.late_ticks_percent:
            doubts.append(f"{100 * late:.2g} % of the ticks were late")
        span_s = self.slide_to_s + AFTER_S
        for name, rate in (("samples", settings.rate_S_s), ("frames", FORCE_RATE_S_S)):
            missing = span_s * rate - float(reading[name] or 0)
            if missing > MISSING_S * rate:
                doubts.append(f"{missing:.0f} {name} are missing")
        return doubts


def _stretch(
    values: npt.NDArray[np.float64], rate_Hz: float, at_s: float, around_s: tuple[float, float]
) -> tuple[npt.NDArray[np.float64], float, float]:
    """Values from so long before an instant to so long after; their rate; when they begin."""
    first = max(0, round((at_s - around_s[0]) * rate_Hz))
    last = round((at_s + around_s[1]) * rate_Hz)
    return values[first:last], rate_Hz, first / rate_Hz


def _smoothed(force_N: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Mean of `SERVO_SEEN` frames: the error of a servo is not the sensor's noise."""
    kernel = np.full(SERVO_SEEN, 1 / SERVO_SEEN)
    return np.convolve(np.pad(force_N, SERVO_SEEN // 2, mode="edge"), kernel, "valid")
