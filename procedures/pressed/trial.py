"""A trial with the skin pressed on an object: its phases, and what every tick records and does."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.contact import (
    BOTTOM_mm,
    CLEAR_mm,
    TRAVEL_mm_s,
    come_close,
    contact_range_mm,
    felt_N,
    not_there,
    nothing_felt,
    refuse_early_contact,
    tare_in_free_air,
)
from procedures.pressed.reading import CONTACT_N, DECIMATED_Hz, Taken
from procedures.pressed.settings import FORCE_RATE_S_S, TAP_S, NEAR_mm, PressedSettings
from procedures.pressed.strips import StripRecord
from rig.analysis.trial.load_rate import LoadScale, amplifier_dB, load_scale, load_scale_of_record
from rig.bench.bench import STRIPS, require
from rig.control.approach import Approach, search_speed_mm_s
from rig.control.force_servo import ForceServo, settings_from
from rig.control.tick_loop import tick_loop
from rig.core.errors import InstrumentError, RigError

if TYPE_CHECKING:
    from procedures.pressed.rates import Pace
    from rig.control.tick_loop import Tick
    from rig.instruments.roles import LinearStage
    from rig.run.context import Run
    from rig.run.points import Reading

LOOK_S = 0.004
"""Stretch of force that a tick looks at: shorter is noisier, longer is later."""
SLOWEST_mm_s = 0.01
TAP = 0.15
"""Of the normal force: what the tap lets go. The clocks need a twentieth (`clock_offset`)."""
TAP_mm_s = 1.0
FORCE_AGE_S = 0.003
"""How old the force of a look is: half of its stretch, half a frame, and the rubber."""
SILENT_S = 0.5
"""Where z does not answer for longer, nothing holds the force: what moves has to stop. A stalled
computer is silent for less."""
PATIENCE_S = 10.0
"""From contact to a held force, at most."""
BLOCK_S = 0.05
"""Forces and places are recorded in blocks of so long: each block has a checksum of its own, and
its place in the run file."""
BLOCK_FRAMES = round(BLOCK_S * FORCE_RATE_S_S)


@dataclass(frozen=True)
class Seen:
    """A look at a stage."""

    at_s: float = 0.0
    """When it was, on the run's clock."""
    is_mm: float = 0.0
    commanded_mm: float = 0.0


@dataclass
class PressedSeries:
    """What the stages allow, and what the trials of a series have taught the ones that follow."""

    pace: Pace
    scales: dict[str, LoadScale] = field(default_factory=dict)
    """Of the strips that are calibrated."""
    contact_mm: float | None = None
    """Position of z at which the object was felt last."""


def scales_on(run: Run) -> dict[str, LoadScale]:
    """Load rate by volt of the strips that are calibrated; those missing are told."""
    skin, scales = run.bench.skin, dict[str, LoadScale]()
    for strip in STRIPS:
        record = run.bench.strip_calibrations.get(strip)
        if record is not None:
            scales[strip] = load_scale_of_record(record, skin.amplifier_gain)
        elif strip in skin.b_dB:
            level_dB = skin.b_dB[strip] + amplifier_dB(skin.amplifier_gain)
            scales[strip] = load_scale(level_dB, skin.b_error_dB[strip])
    if missing := [strip for strip in STRIPS if strip not in scales]:
        run.event(
            "warning",
            "calibration",
            f"{' and '.join(missing)} of the skin: not calibrated, so volts are not told as load "
            "rate; name the records in [calibrations] of the bench file",
        )
    return scales


class PressedTrial:
    """One trial under way; what moves under the held force is a procedure's own."""

    EVENLY = False
    """Whether the servo's moves fill their ticks (`rig.control.force_servo`)."""

    def __init__(self, run: Run, number: int, series: PressedSeries, taken: Taken):
        self.run, self.number, self.series, self.taken = run, number, series, taken
        self.settings: PressedSettings = run.settings
        self.bench = run.bench
        self.z, self.x = run.bench.stage_z, run.bench.stage_x
        self.fixture = run.bench.settings.fixture
        self._strips = StripRecord(run, taken)
        links = run.bench.links
        self._link_z, self._link_x = links["stage_z"], links["stage_x"]
        self._links = {"stage_z": self._link_z, "stage_x": self._link_x, "daq": self._strips.link}
        """By role."""
        self._recording = self._in_motion = False
        self._pace = series.pace
        self._looks_Hz = self._pace.looks_Hz
        """How often the stages are looked at, at most, where only the force is needed."""
        self._look_every = 1
        """Ticks of the loop under way from one look to the next, and how long that is."""
        self._look_s = self._pace.tick_s
        self._look_due = False
        self._ticks_since_step = 0
        """Of the servo."""
        self._target_late_s = 0.0
        """By how much later than usual z was told its latest target."""
        self._looks = -1
        """Number of the look before, in the loop under way."""
        self._left: list[Callable[[], None]] = []
        """What is still to be collected of it, the next at the end."""
        self._z_seen = self._x_seen = Seen()
        self._recorded_rows = 0
        """Of the stages' places."""
        self._recorded_s = -math.inf
        """When the stages were seen where the record has them last."""
        self._z_commanded = self._x_commanded = 0.0
        self._felt_s = self._older_s = 0.0
        """When the latest force was, and by how much older than usual that is."""
        self._at_rest_s = 0.0
        """From when on z stands where the servo begins."""
        self._tangential_N = self._next_tick_s = 0.0
        self._first_frame = self._frames_sent = 0
        """Number of the record's first frame, and how many have come since, in the tick."""

    # --- the phases -----------------------------------------------------------------------------

    def make_ready(self, start_mm: float) -> None:
        """Up, x to where the trial begins, and zero the force in free air."""
        self.z.move_to(self.fixture.parked_mm, TRAVEL_mm_s)
        self.x.move_to(start_mm, TRAVEL_mm_s)
        self.taken.zero = tare_in_free_air(self.run)
        self._z_commanded = self.fixture.parked_mm
        self._x_commanded = start_mm
        self._look_at_x()
        come_close(self.run, CONTACT_N, LOOK_S, self._pace.approach_s)

    def record(self) -> None:
        """Begin to record: strips, forces and positions."""
        self._strips.start()
        self._first_frame = self.run.force.frames_seen
        self._recording = True

    def end_record(self) -> None:
        """Take what has still come, and end the acquisition."""
        self._record_position()
        self._record_places()
        self._strips.collect_rest()
        self._count_frames()
        self._collect_frames()
        self._recording = False
        self._strips.stop()

    def press(self) -> None:
        """Down until the object is felt, on until the force is there, no faster than it allows; the
        contact's stiffness is learnt on the way. A tap, then rest under the servo."""
        settings, tick_s, delay_s = self.settings, self._pace.tick_s, self._pace.delay_s
        down = Approach(
            settings.normal_force_N,
            self._pace.approach_s,
            delay_s,
            settings.acceleration_mm_s2,
        )
        self._go_near()
        self._go_down(down)
        self.taken.stiffness_N_mm = down.stiffness_N_mm
        self._servo = ForceServo(
            settings_from(
                settings.normal_force_N,
                down.stiffness_N_mm,
                tick_s,
                delay_s,
                settings.acceleration_mm_s2,
                self.EVENLY,
            )
        )
        self._tap()
        self._ticks_since_step = 0
        self._loop(settings.rest_s, self._hold)

    def _go_near(self) -> None:
        """To shortly before the place where a trial of this series has felt the object. One that is
        met on the way is pressed with the normal force at most."""
        if self.series.contact_mm is None:
            return
        near_mm, settings = self.series.contact_mm - NEAR_mm, self.settings
        speed_mm_s = search_speed_mm_s(
            settings.normal_force_N,
            self._pace.delay_s + self._pace.approach_s,
            settings.acceleration_mm_s2,
        )
        self._move_z(near_mm, speed_mm_s)

        def look(tick: Tick) -> bool:
            felt = self._collect(tick, look=True) > CONTACT_N
            here_mm = self._z_seen.is_mm
            if felt:
                self._move_z(here_mm, speed_mm_s)
            return not felt and here_mm < near_mm - BOTTOM_mm

        way_mm = near_mm - contact_range_mm(self.bench)[0] + CLEAR_mm
        self._loop(way_mm / speed_mm_s + PATIENCE_S, look, self._pace.approach_s)

    def _go_down(self, down: Approach) -> None:
        """Slowly until the object is felt, and on until the force is there."""
        first_mm, last_mm = contact_range_mm(self.bench)
        touched = arrived = False

        def look(tick: Tick) -> bool:
            nonlocal touched, arrived
            force_N = self._collect(tick, look=True)
            seen, behind_s = self._z_seen, self._older_s + self._target_late_s
            here_mm = seen.is_mm
            step = down.step(seen.at_s, here_mm, self._felt_s, force_N, behind_s)
            if step.touched and not touched:
                touched = True
                self.taken.contact_mm = self.series.contact_mm = here_mm
                if here_mm < first_mm:
                    refuse_early_contact(self.run, force_N, CONTACT_N)
            arrived = step.arrived
            self._move_z(min(here_mm + step.ahead_mm, last_mm), step.speed_mm_s)
            return not arrived and (touched or here_mm < last_mm - BOTTOM_mm)

        search_s = (last_mm - first_mm + CLEAR_mm) / down.search_mm_s
        self._loop(search_s + PATIENCE_S, look, self._pace.approach_s)
        if not arrived:
            self.z.stop()
            self._refuse_no_force(touched, search_s + PATIENCE_S)

    def _tap(self) -> None:
        """Let go a little and press on again: a force that only rises would not tell how far the
        clocks of force sensor and DAQ are apart."""
        here_mm = self._z_commanded
        back_mm = TAP * self.settings.normal_force_N / self.taken.stiffness_N_mm
        for position_mm in (here_mm - back_mm, here_mm):
            self._move_z(position_mm, TAP_mm_s)
            self._at_rest_s = self.run.clock.now() + TAP_S / 2
            self._loop(TAP_S, self._look_on)
        self.taken.tapped_s = self._since_s()

    def lift(self) -> None:
        """Off the object."""
        self.z.stop()
        self.z.move_to(self.fixture.parked_mm, TRAVEL_mm_s)

    # --- a tick ---------------------------------------------------------------------------------

    def _loop(
        self, longest_s: float, on_tick: Callable[[Tick], bool], tick_s: float | None = None
    ) -> None:
        """Ticks of the servo, or every `tick_s`."""

        def whole(tick: Tick) -> bool:
            self._ticks_since_step += 1 + tick.missed
            going_on = on_tick(tick)
            self._ask_what_is_due()
            return going_on

        self._await_tick()
        begin_s, tick_Hz = self.run.clock.now(), 1 / (tick_s or self._pace.tick_s)
        self._look_every = max(1, round(tick_Hz / self._looks_Hz))
        self._look_s, self._looks = self._look_every / tick_Hz, -1
        with contextlib.ExitStack() as links:
            for link in self._links.values():
                links.enter_context(link)
            links.push(self._end_blocks)
            done = tick_loop(self.run, tick_Hz, longest_s, whole)
        self._next_tick_s = begin_s + done.ticks / tick_Hz
        self.taken.loops.append(done)

    def _end_blocks(self, kind: object, raised: BaseException | None, _: object) -> None:
        """Record what had come when a loop's last tick began, whatever has ended it."""
        if self._recording:
            try:
                self._record_places()
                self._collect_frames()
            except RigError:
                if raised is None:  # else that is told
                    raise

    def _await_tick(self) -> None:
        """Until the next tick is due: one loop follows another as one tick the other."""
        self.run.clock.sleep(max(0.0, self._next_tick_s - self.run.clock.now()))

    def _since_s(self) -> float:
        """Since the record began."""
        return self.run.clock.now() - self.taken.begun_s

    def _hold(self, tick: Tick) -> bool:
        """Move z by what the force asks for.

        Nothing is asked of a link that is not done with what it was asked before: a target that
        waits there would come later than the servo takes for granted, and ring. And a force that is
        older than the end of the tap is not what the servo begins with.
        """
        force_N = self._collect(tick)
        if (silent_s := self._link_z.silent_s) > SILENT_S:
            raise self._not_held(silent_s)
        if not self._link_z.idle or self._felt_s < self._at_rest_s:
            self.taken.held_back += 1
            return True
        step = self._servo.step(force_N, self._ticks_since_step, self._target_late_s, self._older_s)
        self._ticks_since_step = 0
        self._move_z(self._z_commanded + step.increment_mm, step.speed_mm_s)
        return True

    def _look_on(self, tick: Tick) -> bool:
        """Leave z to itself."""
        self._collect(tick)
        return True

    def _collect(self, tick: Tick, look: bool = False) -> float:
        """The latest force along z. Every so many ticks the stages are asked where they are, x
        while it may move; a `look` waits for the answers. If there is a record, it goes on with
        that and with what DAQ and force sensor have said since, each in a tick of its own where
        ticks are many.
        """
        looks = tick.number // self._look_every
        due, self._looks = looks != self._looks, looks
        for link in self._links.values():
            link.check()
        self._look_due = look or due
        if look or self.run.clock.is_virtual:
            self._ask_what_is_due()
        if look:
            self._link_z.settle()
            self._link_x.settle()
        if self._recording:
            self._count_frames()
            if due:
                self._record_position()
            self._collect_in_turn(due, last=(tick.number + 1) % self._look_every == 0)
        self._older_s = self.run.force.older_s
        self._felt_s = self.run.clock.now() - FORCE_AGE_S - self._older_s
        force_N = self.run.force.mean_N(LOOK_S)
        self._tangential_N = float(force_N[0])
        return float(force_N[2])

    def _ask_what_is_due(self) -> None:
        """A look at the stages, where the tick has not had it: behind its new target."""
        due, self._look_due = self._look_due, False
        if due:
            self._ask_where()

    def _ask_where(self) -> None:
        """Ask the stages where they are, x while it may move."""
        self._link_z.ask("look", self._look_at_z)
        if self._in_motion:
            self._link_x.ask("look", self._look_at_x)

    def _look_at_z(self) -> None:
        self._z_seen = self._seen(self.z, self._z_commanded)

    def _look_at_x(self) -> None:
        self._x_seen = self._seen(self.x, self._x_commanded)

    def _seen(self, stage: LinearStage, commanded_mm: float) -> Seen:
        asked_s = self.run.clock.now()
        is_mm = stage.position_mm()
        return Seen((asked_s + self.run.clock.now()) / 2, is_mm, commanded_mm)

    def _collect_in_turn(self, due: bool, last: bool) -> None:
        """What is left of the look before, one of it in a tick; all of it by the next look."""
        if due:
            self._collect_left()
            self._left = [
                lambda: self._collect_frames(BLOCK_FRAMES),
                lambda: self._strips.collect(self._look_s),
            ]
        elif self._left:
            self._left.pop()()
        if last:
            self._collect_left()

    def _collect_left(self) -> None:
        while self._left:
            self._left.pop()()

    def _record_position(self) -> None:
        """Where the stages were seen last, unless it is recorded already."""
        seen_s = self._seen_last_s()
        if seen_s > self._recorded_s:
            self._recorded_s = seen_s
            self._record_seen(seen_s - self.taken.begun_s)

    def _seen_last_s(self) -> float:
        """When the latest look at a stage was."""
        return max(self._z_seen.at_s, self._x_seen.at_s)

    def _record_seen(self, since_s: float) -> None:
        """A row of the stages' places."""
        z, x, taken = self._z_seen, self._x_seen, self.taken
        taken.position.append((since_s, z.is_mm, x.is_mm, z.commanded_mm, x.commanded_mm))
        if since_s - taken.position[self._recorded_rows][0] >= BLOCK_S:
            self._record_places()

    def _record_places(self) -> None:
        """The rows that are not recorded yet."""
        first, rows = self._recorded_rows, np.array(self.taken.position[self._recorded_rows :])
        if len(rows):
            self._recorded_rows += len(rows)
            self.run.put("ticks", first, rows[:, :1], None, units="s")
            self.run.put("position", first, rows[:, 1:], None, units="mm")

    def _collect_frames(self, least: int = 1) -> None:
        """What the force sensor had sent when the tick began, where that is `least` frames."""
        run, taken = self.run, self.taken
        fresh = self._frames_sent - taken.frames
        if fresh < least:
            return
        frames = run.force.frames_since(self._first_frame + taken.frames)
        assert frames is not None, "they have been seen"
        first, taken.frames = taken.frames, taken.frames + fresh
        run.put("bridges", first, frames.raw[:fresh], FORCE_RATE_S_S, units="mV/V")
        # The sensor's z points up out of the object: what presses on it is F_n.
        newton = np.ascontiguousarray(frames.force_N[:fresh, [2, 0, 1]])
        run.put("force", first, newton, FORCE_RATE_S_S, units="N")
        taken.force.append(newton)

    def _count_frames(self) -> None:
        self._frames_sent = self.run.force.frames_seen - self._first_frame

    def _force_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        return felt_N(self.run, LOOK_S)

    def _move_z(self, position_mm: float, speed_mm_s: float) -> None:
        reach = self.z.reach()
        require("position under the force", position_mm, reach["position"])
        self._z_commanded = position_mm
        speed_mm_s = min(max(speed_mm_s, SLOWEST_mm_s), reach["speed"].high)
        asked_s = self.run.clock.now()

        def tell() -> None:
            begun_s = self.run.clock.now()
            self.z.start_move(position_mm, speed_mm_s)
            # It came in the middle of what is beyond the usual; the usual is in the delay.
            beyond_s = max(0.0, self.run.clock.now() - begun_s - self._pace.link_s)
            self._target_late_s = begun_s - asked_s + beyond_s / 2

        self._link_z.ask("target", tell)

    # --- what can be wrong ----------------------------------------------------------------------

    def _not_held(self, silent_s: float) -> InstrumentError:
        return InstrumentError(
            "stage_z",
            "hold the force",
            f"no answer for {silent_s:.2g} s: nothing holds {self.settings.normal_force_N:g} N",
            "check the connection to the stage, and what else the computer is busy with",
        )

    def _refuse_no_force(self, touched: bool, within_s: float) -> None:
        here_mm, force_N = self.z.position_mm(), self._force_N()
        if touched:
            raise InstrumentError(
                "stage_z",
                "press",
                f"{force_N:.3g} N at {here_mm:.3f} mm, {self.settings.normal_force_N:g} N wanted",
                "look at the skin and the object; correct contact_to_mm if it may go further",
            )
        if here_mm < contact_range_mm(self.bench)[1] - BOTTOM_mm:
            raise not_there(self.run, within_s)
        check = "the object stands on the force sensor and that the sensor is connected"
        raise nothing_felt(self.run, force_N, CONTACT_N, check)

    # --- what it shows --------------------------------------------------------------------------

    def _load_rates(self) -> Reading:
        """Record the strips' load rates, where they are calibrated; their scales."""
        taken, scales = self.taken, self.series.scales
        if scales:
            rates = taken.load_rates(scales)
            self.run.put("load_rate", 0, rates, DECIMATED_Hz, units="N/s")
        return taken.load_scales(scales)
