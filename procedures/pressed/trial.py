"""A trial with the skin pressed on an object, as the phases that a procedure calls.

    trial.make_ready(start_mm)     # z up, x to the start, force zeroed, close to the object
    trial.start_recording()
    trial.press()                  # down, normal force, tap, rest under the servo
    trial.begin_motion()
    trial.hold(seconds)            # or hold_place(seconds), move_x(...), run_ticks(...)
    trial.end_motion()
    trial.stop_recording()
    trial.lift()

Whatever raises in between ends the trial; what was armed before makes the bench safe. What a motion
does in a tick of its own, it does in a function that it gives to `PressedTrial.run_ticks`, which
calls `PressedTrial.hold_tick` first. The links, axes, recorder and servo of a trial have modules
of their own.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from procedures.pressed.approach.contact import come_close
from procedures.pressed.approach.tare import tare_in_free_air
from procedures.pressed.approach.torque_watch import TorqueWatch
from procedures.pressed.approach.unload import SETTLED_S
from procedures.pressed.approach.way_down import held_speed_bound, travel_mm_s
from procedures.pressed.axes import ArrivalWatch, PolledStage, PressingStage, SentMove
from procedures.pressed.grip import Grip
from procedures.pressed.hold import ForceHold
from procedures.pressed.late_samples import LateSamples
from procedures.pressed.links import TrialLinks
from procedures.pressed.press import Press
from procedures.pressed.record.block_length import BEHIND_S, CATCH_UP_S, FAR_BEHIND_S
from procedures.pressed.record.commanded_x import CommandedX
from procedures.pressed.record.detection import slips_in_words, unjudged_motion_in_words
from procedures.pressed.record.reading import load_scale_columns
from procedures.pressed.record.recorder import TickRecorder
from procedures.pressed.settings import AFTER_S, CONTACT_N
from procedures.pressed.ticks import TrialTicks
from rig.analysis.trial.decimation import DECIMATED_Hz
from rig.bench.limits import require
from rig.control.force_servo import ForceServo, settings_from
from rig.core.errors import InstrumentError, RigError
from rig.detector.notices import HeldForce
from rig.run.points import RetakeError
from rig.run.streams.sample_stream import SlowStreamError

if TYPE_CHECKING:
    from procedures.pressed.record.trial_record import TrialRecord
    from procedures.pressed.series import PressedSeries
    from procedures.pressed.settings import PressedSettings
    from rig.control.force_servo import ContactShift
    from rig.control.tick_loop import Tick
    from rig.files.journal.detections import Detection
    from rig.run.context import Run
    from rig.run.points import Reading

LATE_ARRIVAL_S = 1.0
"""Time in s that x may arrive later than computed: it is polled every 0.05 s, on a link that may be
busy."""


class PressedTrial:
    """One trial under way; what moves under the held force is the procedure's own."""

    even_moves = False
    """True if the servo's moves fill their ticks (`rig.control.force_servo`)."""

    def __init__(
        self,
        run: Run,
        series: PressedSeries,
        record: TrialRecord,
        most_polls_Hz: float = math.inf,
    ):
        """Prepare a trial that presses with the record's `normal_force_N`.

        Its axes are polled `most_polls_Hz` times a second at most.
        """
        self.run, self.series, self.record = run, series, record
        self.settings: PressedSettings = run.settings
        rates, bench = series.rates, run.bench
        self.links = TrialLinks(run)
        self.links.add("stage_z")
        self.links.add("stage_x")
        self.z = PressingStage(run, bench.stage_z, self.links, rates.link_s)
        self.x = PolledStage(run, "stage_x", bench.stage_x, self.links)
        poll_rate_Hz = min(rates.poll_rate_Hz, most_polls_Hz)
        assert series.detection is not None, "the series is begun when the run is armed"
        stages = (self.z, self.x)
        block_s = series.block_s or self.settings.read_block_s
        self.recorder = TickRecorder(
            run, record, self.links, stages, poll_rate_Hz, series.detection, block_s
        )
        self._late_samples = LateSamples(run, series, record, self.recorder.strips)
        self._commanded_x = CommandedX(run.clock, record, series.detection)
        self.x.on_command = self._commanded_x.command
        self._ticks = TrialTicks(run, self.links, self.recorder, record.loops, rates.tick_s)
        self._hold: ForceHold | None = None
        self.grip = Grip(run, record, self._squeeze)
        self._ticks.on_detection = self._answer
        self._squeezed_N = 0.0
        """Amount by which the grip has raised the set point."""
        if series.torque is None:
            series.torque = TorqueWatch(run)
        self.torque = series.torque

    # --- the phases -----------------------------------------------------------------------------

    def make_ready(self, start_mm: float) -> None:
        """Move z up and x to `start_mm`, zero the force in free air, and come close to the
        object.

        Raises RigError, before anything moves, where the grip is to answer the alarms of a detector
        that was dropped.
        """
        assert self.series.detection is not None
        if self.settings.alarms_answered and self.series.detection.has_ended:
            raise RigError(
                f"detector {self.settings.detector} was dropped (see the warning about it), so the "
                "grip gets no alarms",
                "choose another --detector; the run can be resumed",
            )
        parked_mm = self.run.bench.settings.fixture.parked_mm
        self.z.stage.move_to(parked_mm, travel_mm_s(self.z.stage))
        self.x.stage.move_to(start_mm, travel_mm_s(self.x.stage))
        self.record.zero = tare_in_free_air(self.run)
        self.z.commanded_mm, self.x.commanded_mm = parked_mm, start_mm
        self.x.poll()
        self.torque.rest()
        window_s = self.recorder.force.timing.window_s
        series = self.series
        come_close(self.run, CONTACT_N, window_s, series.rates.approach_s, series.way_is_clear)
        series.way_is_clear = True

    def start_recording(self) -> None:
        """Begin to record strips, forces and positions."""
        self.recorder.start()
        self._commanded_x.begin(self.x.commanded_mm)

    def press(self) -> None:
        """Press the object with the normal force, no faster than the force allows; tap, and rest
        under the servo. The contact's stiffness is learnt on the way.

        Raises RetakeError as `begin_motion` does: in a long rest the samples may fall further
        behind than the DAQ's stream tolerates.
        """
        settings, record = self.settings, self.record
        press = Press(self.run, self.series, record, self.z, self.recorder, self._ticks)
        stiffness_N_mm = record.stiffness_N_mm = press.down()
        servo = ForceServo(
            settings_from(
                record.normal_force_N,
                stiffness_N_mm,
                self.series.rates.tick_s,
                self.delay_s,
                settings.acceleration_mm_s2,
                self.even_moves,
                press.fastest_mm_s,
            )
        )
        at_rest_s = press.tap(stiffness_N_mm)
        record.tapped_s = self.since_s()
        force, ticks = self.recorder.force, self._ticks
        self._commanded_force(record.tapped_s, record.normal_force_N)
        self.torque.hold_begins(record.normal_force_N)
        self._hold = ForceHold(
            servo, self.z, self.links, force, record, ticks, at_rest_s, self.torque,
            settings.largest_force_N,
        )  # fmt: skip
        self._rest()

    def _rest(self) -> None:
        """Hold the normal force for the rest before the motion."""
        late: str | None = None

        def rest(tick: Tick) -> bool:
            nonlocal late
            self.hold_tick(tick)
            late = self._late_samples.lengthen_blocks(FAR_BEHIND_S)
            return late is None

        self.run_ticks(self.settings.rest_s, rest)
        if late is not None:
            self._give_up(late)

    def hold(self, seconds: float) -> None:
        """Hold the normal force for some time."""
        self.run_ticks(seconds, self.hold_tick)

    def hold_place(self, seconds: float) -> None:
        """Leave z where it is for some time. The force is measured and not controlled: it may
        relax, and no error of the force is judged. What holds the force afterwards brings it back
        to the set point.

        Raises InstrumentError where the force falls below half of what was held, as in a hold: a
        sensor that has died cannot be distinguished from it, and z would press on afterwards.
        """

        def rest(tick: Tick) -> bool:
            self._held().rest(self.recorder.collect(tick))
            return True

        from_s = self.since_s()
        self.run_ticks(seconds, rest)
        self.record.rested.append((from_s, self.since_s()))

    def begin_motion(self, expected: ContactShift | None = None) -> None:
        """Wait for the next tick, and note that the motion begins with it: the reading is about
        the stretch from here to `end_motion`.

        `expected` is what an earlier motion of this kind has shown (`contact_shift`).

        Raises RetakeError, with the skin lifted, where the strips' samples are read so late that
        the grip could not answer an alarm, and longer blocks are possible: nothing is to be lost
        for that.
        """
        self._catch_up()
        self._ticks.wait()
        if (late := self._late_samples.lengthen_blocks(BEHIND_S)) is not None:
            self._give_up(late)
        self.record.motion_from_s = self.since_s()
        self._held().begin_motion(expected)
        self.grip.begin(self._held().set_force_N)

    def end_motion(self) -> None:
        """Note that the motion is over; alarms from now on raise no force."""
        self.grip.end()
        self.record.motion_to_s = self.since_s()
        assert self.series.detection is not None
        self.record.detection_ended = self.series.detection.has_ended
        self._late_samples.end_motion()

    def _catch_up(self) -> None:
        """Hold the force until the strips' samples are read in time, for `CATCH_UP_S` at most: the
        computer or the link may have stalled for a moment."""
        late = self._late_samples

        def hold(tick: Tick) -> bool:
            self.hold_tick(tick)
            return late.too_late_for_grip

        if late.too_late_for_grip:
            self.run_ticks(CATCH_UP_S, hold)

    def _give_up(self, late: str) -> None:
        """Lift the skin and raise RetakeError: the strips' samples come too late for the grip."""
        self.abandon()
        raise RetakeError(late)

    @contextlib.contextmanager
    def longer_blocks_if_too_slow(self) -> Iterator[None]:
        """Lift the skin and raise RetakeError if the DAQ's stream ends within the block because its
        link is too slow for short blocks, and longer ones are possible."""
        try:
            yield
        except SlowStreamError:
            if (late := self._late_samples.lengthen_blocks(FAR_BEHIND_S)) is None:
                raise
            self._give_up(late)

    def abandon(self) -> None:
        """Stop x, end the record, of which nothing will be made, and lift the skin."""
        self.x.stop()
        self.x.in_motion = False
        self._commanded_x.end()
        self.recorder.give_up()
        self._lift_off()

    def move_x(self, to_mm: float, speed_mm_s: float) -> None:
        """Move x to a position at a speed, under the held normal force, and wait until it is there.

        Raises LimitError, before x moves, for a position or a speed outside the stage's limits, and
        InstrumentError where x has not arrived when it should have been there for some time.
        """
        limits, x = self.x.stage.limits(), self.x
        require("stage_x position", to_mm, limits["position"])
        require("stage_x speed", speed_mm_s, limits["speed"])
        way_s = abs(to_mm - x.commanded_mm) / speed_mm_s
        longest_s = way_s + 2 * speed_mm_s / self.settings.acceleration_mm_s2 + LATE_ARRIVAL_S
        arrival = ArrivalWatch(x, self.series.rates.tick_Hz)
        x.in_motion = True

        def move(tick: Tick) -> bool:
            self.hold_tick(tick)
            if tick.number == 0:
                x.start_move(to_mm, speed_mm_s)
            return arrival.under_way(tick)

        self.run_ticks(longest_s, move)
        if not arrival.arrived:
            x.stop()
            raise InstrumentError(
                "stage_x",
                "move",
                f"it did not reach {to_mm:g} mm at {speed_mm_s:g} mm/s within {longest_s:.3g} s",
                "check what blocks the stage; then start again",
            )

    def complete_motion(self, least_s: float) -> None:
        """End the motion, no sooner than `least_s` after its beginning; stop x and hold the force a
        moment longer, for what is judged after it."""
        if (missing_s := self.record.motion_from_s + least_s - self.since_s()) > 0:
            self.hold(missing_s)
        self.end_motion()
        self.x.stop()
        self.hold(AFTER_S)
        self.x.in_motion = False

    def stop_recording(self) -> None:
        """Record what has still come, and end the acquisition."""
        self._commanded_x.end()
        self.recorder.stop()

    def lift(self) -> None:
        """Move z up, off the object; then see where the force sensor's zero is."""
        self._lift_off()
        self._report_slips()

    def _lift_off(self) -> None:
        self.z.stage.stop()
        parked_mm = self.run.bench.settings.fixture.parked_mm
        self.z.stage.move_to(parked_mm, travel_mm_s(self.z.stage))
        self.recorder.force.count_later_frames(2 * SETTLED_S)
        shift_N = self.run.force.mean_N(SETTLED_S)
        self.record.zero_shift_N = (float(shift_N[0]), float(shift_N[1]), float(shift_N[2]))

    def _report_slips(self) -> None:
        """Show the slips that were detected, and how much of the motion was not judged. Only now,
        since a terminal may make the run wait."""
        self.recorder.detected()  # what a detector in another process has found since
        for line in slips_in_words(self.record, self.settings.detector):
            self.run.inform(line)
        if unjudged := unjudged_motion_in_words(self.record, self.settings.detector):
            self.run.event("warning", "motion-not-judged", unjudged)

    def record_load_rates(self) -> Reading:
        """Record the load rates of the strips that are calibrated; return their scales."""
        record, scales = self.record, self.series.scales
        if scales:
            rates = record.load_rates(scales)
            self.run.streams.record_rows("load_rate", 0, rates, DECIMATED_Hz, units="N/s")
        return load_scale_columns(scales)

    @property
    def normal_force_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Set point of the normal force in N that the trial has pressed with."""
        return self.record.normal_force_N

    # --- ticks ----------------------------------------------------------------------------------

    def run_ticks(self, longest_s: float, on_tick: Callable[[Tick], bool]) -> None:
        """Call `on_tick` in every tick of the servo for `longest_s` or until it returns False. One
        loop follows another as one tick follows another."""
        self._ticks.run(longest_s, on_tick)

    def hold_tick(self, tick: Tick) -> bool:
        """Collect and record, and move z by what the force asks for; always True."""
        force_N = self.recorder.collect(tick)
        self._held().step(force_N, self.recorder.leaves_time)
        return True

    def hold_at(self, force_N: float) -> None:
        """Change the normal force that is held, from the next tick on; what the grip has added
        stays added.

        Raises ValueError for a force that is not above 0 N and below `largest_force_N`, and
        LimitError where z cannot go slowly enough to brake within what is left to that limit. The
        reading's errors of the force are those from the set point of their time.
        """
        force_N += self._squeezed_N
        if not 0 < force_N < self.settings.largest_force_N:
            raise ValueError(
                f"a held force of {force_N:g} N is not between 0 and largest_force_N "
                f"{self.settings.largest_force_N:g} N"
            )
        if force_N == self._held().set_force_N:
            return
        self._held().hold_at(force_N, self._fastest_mm_s(force_N))
        self._note_set_point(force_N)

    def _answer(self, one: Detection) -> None:
        if self._hold is not None:
            self.grip.answer(one, self._hold.set_force_N)

    def _squeeze(self, rise_N: float) -> SentMove:
        """Raise the held force by so many N and send z on its way at once."""
        force_N = self._held().set_force_N + rise_N
        sent = self._held().squeeze(force_N, self._fastest_mm_s(force_N))
        self._squeezed_N += rise_N
        self._note_set_point(force_N)
        return sent

    def _fastest_mm_s(self, force_N: float) -> float:
        """Return the largest speed in mm/s of z that holds this force. Raises LimitError where z
        cannot go so slowly that it would brake within what is left to the force limit."""
        bound = held_speed_bound(self.run.bench, self.settings.largest_force_N, force_N)
        speeds = self.z.stage.limits()["speed"]
        bound.require("stage_z", speeds.low)
        return min(bound.speed_mm_s, speeds.high)

    def _note_set_point(self, force_N: float) -> None:
        at_s = self.since_s()
        self.record.set_points.append((at_s, force_N))
        self._commanded_force(at_s, force_N)

    def _commanded_force(self, at_s: float, force_N: float) -> None:
        """Let the detector know that z is to hold a force from a time of the record on."""
        assert self.series.detection is not None
        self.series.detection.notice(HeldForce(math.ceil(at_s * DECIMATED_Hz), force_N))

    def since_s(self) -> float:
        """Return the time since the record began."""
        return self.run.clock.now() - self.record.begun_s

    @property
    def delay_s(self) -> float:
        """Time in s from a command to the first force that shows it."""
        return self.recorder.force.timing.delay_s(self.series.rates)

    @property
    def contact_shift(self) -> ContactShift:
        """Shift of the contact that the motion under way, or the latest one, has shown so far."""
        return self._held().shift

    def _held(self) -> ForceHold:
        assert self._hold is not None, "press() comes first"
        return self._hold
