"""One slip trial: its phases, what every tick records, and what it shows in the end."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal  # noqa: F401 - the decimator's, imported before anything moves

from procedures.slip_trial import DELAY_S, FORCE_RATE_S_S, STRIPS, TRAVEL_mm_s
from rig.analysis import clock_offset as clocks
from rig.analysis.decimation import Decimator
from rig.analysis.friction import FrictionError, friction
from rig.bench import require
from rig.errors import InstrumentError
from rig.instruments import Acquisition, InputChannel
from rig.runner.approach import Approach, search_speed_mm_s
from rig.runner.loop import tick_loop
from rig.runner.servo import ContactShift, ForceServo, settings_from

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.slip_trial import Settings
    from rig.runner.loop import LoopStatistics, Tick
    from rig.runner.points import Reading
    from rig.runner.run import Run

TARE_S = 0.2
LOOK_S = 0.004
"""Stretch of force that a tick looks at: shorter is noisier, longer is later."""
CONTACT_N = 0.1
"""Force that means contact: ten times the sensor's noise over a look."""
CLEAR_mm = 0.3
"""Where the slow approach begins, before the earliest contact."""
SLOWEST_mm_s = 0.01
SLOWEST_SEARCH_mm_s = 0.05
"""Slowest search for contact that is waited for."""
BOTTOM_mm = 0.002
"""So near to contact_to_mm is there."""
NEAR_mm = 0.06
"""Where the slow search begins, before the place at which contact has been felt already."""
TAP = 0.15
"""Of the normal force: what the tap lets go. The clocks need a twentieth (`clock_offset`)."""
TAP_mm_s = 1.0
TAP_S = 0.04
"""From the way back to the way on, and until the servo takes over."""
FORCE_AGE_S = 0.003
"""How much older the force of a look is than the position read with it."""
MOVING_EVERY = 5
"""Ticks between two looks whether x has arrived."""
MISSING_S = 0.05
"""Samples or frames of so long may be under way when a record ends."""
SERVO_SEEN = 5
"""Frames over which the error of the force is averaged."""
DECIMATED_Hz = 1000.0
CLOCKS_SEEN_S, CLOCKS_SEARCHED_S = 0.1, 0.2
"""What the two clocks are compared by reaches so far beyond touch-down and tap; and how far apart
they are taken to be at most."""
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


@dataclass
class Series:
    """What the trials of a series have taught the ones that follow."""

    contact_mm: float | None = None
    """Position of z at which the plate was felt last."""
    shift: ContactShift | None = None
    """What the first slide, which had none to go by, has shown."""


class Trial:
    """One trial under way."""

    def __init__(self, run: Run, number: int, series: Series):
        self.run, self.number, self.series = run, number, series
        self.settings: Settings = run.settings
        self.bench = run.bench
        self.z, self.x = run.bench.stage_z, run.bench.stage_x
        self.fixture = run.bench.settings.fixture
        self.taken = _Taken()
        self.begun_s = self.contact_mm = self.stiffness_N_mm = 0.0
        self.tapped_s = self.slide_from_s = self.slide_to_s = 0.0
        self._recording = False
        self._z_mm = self._z_commanded = self._x_commanded = 0.0
        self._first_frame = 0
        self._statistics: list[LoopStatistics] = []

    # --- the phases -----------------------------------------------------------------------------

    def rehearse(self) -> None:
        """The same without a record: the servo learns what the slide does to the normal force."""
        self.make_ready()
        self.press()
        self.slide()
        self.lift()

    def make_ready(self) -> None:
        """Up, to the place where the slide begins, and zero the force in free air."""
        self.z.move_to(self.fixture.parked_mm, TRAVEL_mm_s)
        self.x.move_to(self.settings.start_mm, TRAVEL_mm_s)
        self.run.clock.sleep(2 * TARE_S)
        self.run.force.tare(TARE_S)
        self._z_commanded = self.fixture.parked_mm
        self._x_commanded = self.settings.start_mm
        first_mm = self._contact_from_mm()
        self.z.start_move(first_mm - CLEAR_mm, TRAVEL_mm_s)
        while self.z.moving():
            self.run.clock.sleep(1 / self.settings.tick_Hz)
            self._refuse_contact(self._force_N(), first_mm)
        self.z.stop()

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
        self._recording = True

    def end_record(self) -> None:
        """Take what has still come, and end the acquisition."""
        self._collect_streams()
        self._recording = False
        self.bench.daq.stop()

    def press(self) -> None:
        """Down until the plate is felt, on until the force is there, no faster than it allows; the
        contact's stiffness is learnt on the way. A tap, then rest under the servo."""
        settings, tick_s = self.settings, 1 / self.settings.tick_Hz
        down = Approach(
            settings.normal_force_N, tick_s, DELAY_S, FORCE_AGE_S, settings.acceleration_mm_s2
        )
        self._go_near()
        self._go_down(down)
        self.stiffness_N_mm = down.stiffness_N_mm
        self._servo = ForceServo(
            settings_from(
                settings.normal_force_N,
                self.stiffness_N_mm,
                tick_s,
                DELAY_S,
                settings.acceleration_mm_s2,
            )
        )
        self._tap()
        self._loop(settings.rest_s, self._hold)

    def _go_near(self) -> None:
        """To shortly before the place where a trial of this series has felt the plate. A plate that
        is met on the way is pressed with the normal force at most."""
        if self.series.contact_mm is None:
            return
        near_mm, settings = self.series.contact_mm - NEAR_mm, self.settings
        speed_mm_s = search_speed_mm_s(
            settings.normal_force_N, DELAY_S + 1 / settings.tick_Hz, settings.acceleration_mm_s2
        )
        self._move_z(near_mm, speed_mm_s)

        def look(tick: Tick) -> bool:
            felt = self._collect() > CONTACT_N
            if felt:
                self._move_z(self._z_mm, speed_mm_s)
            return not felt and self._z_mm < near_mm - BOTTOM_mm

        self._loop(abs(near_mm - self._z_mm) / speed_mm_s + PATIENCE_S, look)

    def _go_down(self, down: Approach) -> None:
        """Slowly until the plate is felt, and on until the force is there."""
        first_mm, last_mm = self._contact_from_mm(), self._contact_to_mm()
        touched = arrived = False

        def look(tick: Tick) -> bool:
            nonlocal touched, arrived
            force_N = self._collect()
            here_mm = self._z_mm
            step = down.step(tick.began_s, here_mm, force_N)
            if step.touched and not touched:
                touched = True
                self.contact_mm = self.series.contact_mm = here_mm
                if here_mm < first_mm:
                    self._refuse_contact(force_N, first_mm)
            arrived = step.arrived
            self._move_z(min(here_mm + step.ahead_mm, last_mm), step.speed_mm_s)
            return not arrived and (touched or here_mm < last_mm - BOTTOM_mm)

        search_s = (last_mm - first_mm + CLEAR_mm) / SLOWEST_SEARCH_mm_s
        self._loop(search_s + PATIENCE_S, look)
        if not arrived:
            self.z.stop()
            self._refuse_no_force(touched)

    def _tap(self) -> None:
        """Let go a little and press on again: a force that only rises would not tell how far the
        clocks of force sensor and DAQ are apart."""
        here_mm = self._z_commanded
        back_mm = TAP * self.settings.normal_force_N / self.stiffness_N_mm
        for position_mm in (here_mm - back_mm, here_mm):
            self._move_z(position_mm, TAP_mm_s)
            self._loop(TAP_S, self._look_on)
        self.tapped_s = self.run.clock.now() - self.begun_s

    def slide(self) -> None:
        """Slide under the held force to the end, and a moment longer."""
        settings = self.settings
        self.slide_from_s = self.run.clock.now() - self.begun_s
        self._x_commanded = settings.end_mm
        self.x.start_move(settings.end_mm, settings.speed_mm_s)
        self._servo.slide_begins(self.series.shift)
        ramp_s = 2 * settings.speed_mm_s / settings.acceleration_mm_s2
        longest_s = settings.distance_mm / settings.speed_mm_s + ramp_s + 1.0

        def hold(tick: Tick) -> bool:
            self._hold(tick)
            return tick.number % MOVING_EVERY != 0 or self.x.moving()

        self._loop(longest_s, hold)
        self.slide_to_s = self.run.clock.now() - self.begun_s
        if self.series.shift is None:
            self.series.shift = self._servo.shift
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

    def _look_on(self, tick: Tick) -> bool:
        """Leave z to itself."""
        self._collect()
        return True

    def _collect(self) -> float:
        """Look where z is, and record what DAQ, force sensor and stages say, if there is a record;
        the latest force along z."""
        self._z_mm = self.z.position_mm()
        if self._recording:
            self._collect_streams()
            self._record_position()
        return self._force_N()

    def _record_position(self) -> None:
        here = (self._z_mm, self.x.position_mm(), self._z_commanded, self._x_commanded)
        row, taken = np.array([here]), self.taken
        self.run.put("position", len(taken.position), row, self.settings.tick_Hz, units="mm")
        taken.position.append((self.run.clock.now() - self.begun_s, *here))

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
        return float(self.run.force.mean_N(LOOK_S)[2])

    def _move_z(self, position_mm: float, speed_mm_s: float) -> None:
        reach = self.z.reach()
        require("position under the force", position_mm, reach["position"])
        self._z_commanded = position_mm
        self.z.start_move(position_mm, min(max(speed_mm_s, SLOWEST_mm_s), reach["speed"].high))

    # --- what can be wrong ----------------------------------------------------------------------

    def _contact_from_mm(self) -> float:
        assert self.fixture.contact_from_mm is not None, "arm() has looked"
        return self.fixture.contact_from_mm

    def _contact_to_mm(self) -> float:
        assert self.fixture.contact_to_mm is not None, "arm() has looked"
        return self.fixture.contact_to_mm

    def _refuse_contact(self, force_N: float, first_mm: float) -> None:
        if abs(force_N) <= CONTACT_N:
            return
        self.z.stop()
        raise InstrumentError(
            "stage_z",
            "approach",
            f"{force_N:.2g} N are felt at {self.z.position_mm():.2f} mm, before any contact can be "
            f"(contact_from_mm = {first_mm:g} mm)",
            "look what is in the way; correct [fixture] if contact belongs there",
        )

    def _refuse_no_force(self, touched: bool) -> None:
        here_mm, force_N = self.z.position_mm(), self._force_N()
        if touched:
            raise InstrumentError(
                "stage_z",
                "press",
                f"{force_N:.3g} N at {here_mm:.3f} mm, {self.settings.normal_force_N:g} N wanted",
                "look at the skin and the plate; correct contact_to_mm if it may go further",
            )
        raise InstrumentError(
            "stage_z",
            "approach",
            f"no contact is felt down to {self._contact_to_mm():g} mm (contact_to_mm): "
            f"{force_N:.2g} N",
            "check that the plate lies on the force sensor and that the sensor is connected; "
            "correct [fixture]",
        )

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
        begin_s = touch_s - CLOCKS_SEEN_S
        end_s = min(self.tapped_s + CLOCKS_SEEN_S, self.slide_from_s)
        wider_s = CLOCKS_SEARCHED_S + CLOCKS_SEEN_S
        seen = _stretch(volts, DECIMATED_Hz, begin_s, end_s)
        felt = _stretch(force[:, 0], FORCE_RATE_S_S, begin_s - wider_s, end_s + wider_s)
        half_frame_s = 0.5 / FORCE_RATE_S_S
        try:
            found = clocks.clock_offset(
                clocks.Series(*felt, delay_s=half_frame_s),
                clocks.Series(*seen, self._decimator.delay_s),
                CLOCKS_SEARCHED_S,
            )
        except clocks.ClockOffsetError as error:
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
    values: npt.NDArray[np.float64], rate_Hz: float, begin_s: float, end_s: float
) -> tuple[npt.NDArray[np.float64], float, float]:
    """Values from one instant to another; their rate; when they begin."""
    first = max(0, round(begin_s * rate_Hz))
    return values[first : round(end_s * rate_Hz)], rate_Hz, first / rate_Hz


def _smoothed(force_N: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Mean of `SERVO_SEEN` frames: the error of a servo is not the sensor's noise."""
    kernel = np.full(SERVO_SEEN, 1 / SERVO_SEEN)
    return np.convolve(np.pad(force_N, SERVO_SEEN // 2, mode="edge"), kernel, "valid")
