"""The way to the held force: down until the object is felt, on until the force is there, a tap."""

from __future__ import annotations

from typing import TYPE_CHECKING

from procedures.pressed.approach.approach_watch import ApproachWatch, naming_the_sensor
from procedures.pressed.approach.contact import (
    contact_range_mm,
    felt_N,
    not_there,
    nothing_felt,
    refuse_early_contact,
)
from procedures.pressed.approach.earlier_runs import EarlierPress
from procedures.pressed.approach.way_down import BOTTOM_mm, held_speed_bound
from procedures.pressed.settings import CONTACT_N, TAP_S, NEAR_mm
from rig.bench.clear_of_contact import CLEAR_mm
from rig.control.approach import Approach
from rig.control.speed_bound import largest_speed_mm_s
from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from procedures.pressed.axes import PressingStage
    from procedures.pressed.record.recorder import TickRecorder
    from procedures.pressed.record.trial_record import TrialRecord
    from procedures.pressed.series import PressedSeries
    from procedures.pressed.settings import PressedSettings
    from procedures.pressed.ticks import TrialTicks
    from rig.control.tick_loop import Tick
    from rig.run.context import Run

TAP = 0.15
"""Share of the normal force that the tap lets go. The clocks need a twentieth (`clock_offset`)."""
TAP_mm_s = 1.0
PATIENCE_S = 10.0
"""Longest time in s from contact to a held force."""


class Press:
    """The press of one trial, from near the object to rest under the normal force."""

    def __init__(
        self,
        run: Run,
        series: PressedSeries,
        record: TrialRecord,
        z: PressingStage,
        recorder: TickRecorder,
        ticks: TrialTicks,
    ):
        """Prepare the press with the record's `normal_force_N`."""
        self._run, self._series, self._record = run, series, record
        self._force_N = record.normal_force_N
        self._z, self._recorder, self._ticks = z, recorder, ticks
        self._settings: PressedSettings = run.settings
        self._earlier = EarlierPress(run, self._force_N, self._settings.kind_of_press)
        assert series.torque is not None, "a trial watches the torque from its beginning"
        self._torque = series.torque
        self._delay_s = recorder.force.timing.delay_s(series.rates)
        """Time in s from a command to the first force that shows it."""
        settings = self._settings
        bound = held_speed_bound(run.bench, settings.largest_force_N, self._force_N)
        self._stage_mm_s = z.stage.limits()["speed"].high
        """Largest speed of the stage."""
        self.fastest_mm_s = min(bound.speed_mm_s, self._stage_mm_s)
        """Largest speed of z from contact on."""

    def down(self) -> float:
        """Press the object with the normal force, and return the contact's stiffness in N/mm."""
        settings, rates = self._settings, self._series.rates
        way_down = Approach(
            self._force_N,
            rates.approach_s,
            self._delay_s,
            settings.acceleration_mm_s2,
            self._run.bench.settings.fixture.stiffest_N_mm,
            self.fastest_mm_s,
            self._stage_mm_s,
        )
        self._run.count_press()
        self._go_near()
        self._go_down(way_down)
        stiffness_N_mm = way_down.stiffness_N_mm
        way_mm = self._z.latest.position_mm - self._record.contact_mm
        self._earlier.judge(way_mm, stiffness_N_mm, self._record.zero)
        return stiffness_N_mm

    def tap(self, stiffness_N_mm: float) -> float:
        """Let go a little and press on again; return the time in s at which z is at rest after it,
        on the run's clock.

        A force that only rises would not show how far the clocks of force sensor and DAQ are apart.
        """
        z, clock = self._z, self._run.clock
        here_mm = z.commanded_mm
        back_mm = TAP * self._force_N / stiffness_N_mm
        at_rest_s = 0.0
        for position_mm in (here_mm - back_mm, here_mm):
            z.start_move(position_mm, min(TAP_mm_s, self.fastest_mm_s))
            at_rest_s = clock.now() + TAP_S / 2
            self._ticks.run(TAP_S, self._record_only)
        return at_rest_s

    def _record_only(self, tick: Tick) -> bool:
        self._recorder.collect(tick)
        return True

    def _go_near(self) -> None:
        """Go to shortly before the place where a trial of this series has felt the object. One that
        is met on the way is pressed with the normal force at most."""
        if self._series.contact_mm is None:
            return
        z, settings, rates = self._z, self._settings, self._series.rates
        near_mm = self._series.contact_mm - NEAR_mm
        bound_mm_s = largest_speed_mm_s(
            self._force_N,
            self._run.bench.settings.fixture.stiffest_N_mm,
            self._delay_s + rates.approach_s,
            settings.acceleration_mm_s2,
        )
        speed_mm_s = min(bound_mm_s, self._stage_mm_s)
        z.start_move(near_mm, speed_mm_s)

        def on_tick(tick: Tick) -> bool:
            felt = self._recorder.collect(tick, wait=True) > CONTACT_N
            here_mm = z.latest.position_mm
            if felt:
                z.start_move(here_mm, speed_mm_s)
            return not felt and here_mm < near_mm - BOTTOM_mm

        way_mm = near_mm - contact_range_mm(self._run.bench)[0] + CLEAR_mm
        self._ticks.run(way_mm / speed_mm_s + PATIENCE_S, on_tick, rates.approach_s)

    def _go_down(self, way_down: Approach) -> None:
        """Go slowly until the object is felt, and on until the force is there."""
        z, force = self._z, self._recorder.force
        first_mm, last_mm = contact_range_mm(self._run.bench)
        touched = arrived = False
        felt_mm = self._series.contact_mm  # by an earlier trial
        watch = ApproachWatch(self._run, CONTACT_N, self._force_N, self._torque)

        def on_tick(tick: Tick) -> bool:
            nonlocal touched, arrived
            force_N = self._recorder.collect(tick, wait=True)
            polled, behind_s = z.latest, force.older_s + z.target_late_s
            here_mm = polled.position_mm
            step = way_down.step(polled.at_s, here_mm, force.measured_s, force_N, behind_s)
            watch.step(here_mm, force_N, step.touched)
            if felt_mm is not None and not step.touched:
                self._earlier.refuse_missed(here_mm - felt_mm, force_N)
            if touched and not step.arrived:
                self._earlier.refuse_way(here_mm - self._record.contact_mm, force_N)
            if step.touched and not touched:
                touched = True
                self._record.contact_mm = self._series.contact_mm = here_mm
                if here_mm < first_mm:
                    refuse_early_contact(self._run, force_N, CONTACT_N)
            arrived = step.arrived
            target_mm = min(here_mm + step.ahead_mm, last_mm)
            watch.commanded(target_mm - here_mm, step.speed_mm_s)
            z.start_move(target_mm, step.speed_mm_s)
            z.ask_torque(self._torque)
            return not arrived and (touched or here_mm < last_mm - BOTTOM_mm)

        longest_s = (last_mm - first_mm + CLEAR_mm) / way_down.search_mm_s + PATIENCE_S
        with naming_the_sensor(self._run, CONTACT_N):
            self._ticks.run(longest_s, on_tick, self._series.rates.approach_s)
        if not arrived:
            z.stage.stop()
            raise self._no_force(touched, longest_s)

    def _no_force(self, touched: bool, within_s: float) -> InstrumentError:
        """Return why the normal force was not reached in this time."""
        run = self._run
        here_mm = self._z.stage.position_mm()
        force_N = felt_N(run, self._recorder.force.timing.window_s)
        if touched:
            return InstrumentError(
                "stage_z",
                "press",
                f"{force_N:.3g} N at {here_mm:.3f} mm, {self._force_N:g} N wanted",
                "check the skin and the object; correct contact_to_mm if it may go further",
            )
        if here_mm < contact_range_mm(run.bench)[1] - BOTTOM_mm:
            return not_there(run, within_s)
        check = "the object rests on the force sensor and that the sensor is connected"
        return nothing_felt(run, force_N, CONTACT_N, check)
