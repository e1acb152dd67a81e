"""The run of one slip trial: the slide or the ramp under the held force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from procedures.pressed.axes import ArrivalWatch
from procedures.pressed.series import PressedSeries
from procedures.pressed.settings import AFTER_S
from procedures.pressed.trial import PressedTrial
from procedures.slip_trial.reading import SlipTrialRecord, reading_of
from procedures.slip_trial.settings import SLID_ON_mm
from rig.control.force_ramp import ForceRamp, SLOWEST_mm_s
from rig.control.force_servo import ContactShift
from rig.control.weight import RestingWeight

if TYPE_CHECKING:
    from procedures.slip_trial.settings import SlipTrialSettings
    from rig.control.tick_loop import Tick
    from rig.run.context import Run
    from rig.run.points import Reading


@dataclass
class SlipSeries(PressedSeries):
    """State that the trials of a series pass on to later ones."""

    shift: ContactShift | None = None
    """Change of the contact that the first slide has shown; the servo knew none in that slide."""


class Loading(NamedTuple):
    """State of a ramp in a tick, since its first one."""

    since_s: float
    travel_mm: float
    force_N: float
    """Rise of the tangential force."""
    asked_mm_s: float
    """Speed of x that the ramp asks for."""


class SlipTrialRun(PressedTrial):
    """A slip trial, in which the x stage slides."""

    series: SlipSeries
    settings: SlipTrialSettings
    record: SlipTrialRecord

    def __init__(self, run: Run, number: int, series: SlipSeries):
        record = SlipTrialRecord(
            number, series.rates.tick_Hz, run.force.rate_S_s, run.settings.normal_force_N
        )
        super().__init__(run, series, record)

    @property
    def needs_rehearsal(self) -> bool:
        """Return whether a rehearsal has to come first."""
        asked = self.settings.rehearsed(self.series.rates.tick_s, self.delay_s)
        return asked and self.series.shift is None

    def rehearse(self) -> None:
        """Press, slide and lift without a record, from which the servo learns the effect of the
        slide on the normal force."""
        self.make_ready(self.settings.start_mm)
        self.press()
        self.slide()
        self.lift()

    def slide(self) -> None:
        """Drag the skin along x under the held normal force; then hold the force a moment
        longer."""
        settings, series, x = self.settings, self.series, self.x
        x.commanded_mm, x.in_motion = settings.end_mm, True
        arrival = ArrivalWatch(x, series.rates.tick_Hz)
        if settings.loading == "slide":
            pull = self._steadily(arrival)
        elif settings.hold_at_N is None:
            pull = self._ramp(arrival)
        else:
            pull = self._weight(settings.hold_at_N)
        self.begin_motion(series.shift)
        self.run_ticks(settings.longest_slide_s, pull)
        self.end_motion()
        if series.shift is None and not self.record.squeezes:
            series.shift = self.contact_shift
        x.stop()
        self.hold(AFTER_S)
        x.in_motion = False

    def _steadily(self, arrival: ArrivalWatch) -> Callable[[Tick], bool]:
        """Begin the slide of x at constant speed; the returned tick holds F_n until its end."""

        def pull(tick: Tick) -> bool:
            self.hold_tick(tick)
            if tick.number == 0:
                self.x.start_move(self.settings.end_mm, self.settings.speed_mm_s)
            return arrival.under_way(tick)

        return pull

    def _ramp(self, arrival: ArrivalWatch) -> Callable[[Tick], bool]:
        """Begin the ramp; the returned tick raises the tangential force until the skin slips as a
        whole and a little further, or until the end of the ramp, and holds F_n."""
        settings = self.settings
        ramp = ForceRamp(
            settings.ramp_N_s, settings.speed_mm_s, self.series.rates.tick_s, self.delay_s
        )
        ask, speeds = self._asking(ramp), self.x.stage.limits()["speed"]
        slipped_mm = speed_mm_s = 0.0

        def pull(tick: Tick) -> bool:
            nonlocal slipped_mm, speed_mm_s
            self.hold_tick(tick)
            since_s, travel_mm, _, asked_mm_s = ask(tick)
            if asked_mm_s != speed_mm_s:
                speed_mm_s = asked_mm_s
                self.x.start_move(settings.end_mm, speeds.nearest(speed_mm_s))
            if ramp.follows:
                self.record.ramp_to_s = self.since_s()
            if ramp.slipped:
                return travel_mm - slipped_mm <= SLID_ON_mm and arrival.under_way(tick)
            slipped_mm = travel_mm
            return ramp.wanted_N(since_s) < settings.ramp_to_N and arrival.under_way(tick)

        return pull

    def _asking(self, ramp: ForceRamp) -> Callable[[Tick], Loading]:
        """Begin to count way and force from here; the returned function of a tick asks the ramp."""
        along, force = self.settings.along, self.recorder.force
        first_mm, first_N, begin_s = self.x.latest.position_mm, force.tangential_N, 0.0

        def ask(tick: Tick) -> Loading:
            nonlocal begin_s
            if tick.number == 0:
                begin_s = tick.began_s
            polled, since_s = self.x.latest, tick.began_s - begin_s
            travel_mm = along * (polled.position_mm - first_mm)
            force_N = along * (force.tangential_N - first_N)
            polled_s, measured_s = polled.at_s - begin_s, force.measured_s - begin_s
            asked_mm_s = ramp.step(since_s, polled_s, travel_mm, measured_s, force_N)
            return Loading(since_s, travel_mm, force_N, asked_mm_s)

        return ask

    def _weight(self, load_N: float) -> Callable[[Tick], bool]:
        """Begin to lower a weight; the returned tick loads the contact with it and holds F_n, until
        the weight has rested for long enough or is lost."""
        settings, record, x = self.settings, self.record, self.x
        ramp = ForceRamp(
            settings.ramp_N_s,
            settings.speed_mm_s,
            self.series.rates.tick_s,
            self.delay_s,
            holds_N=load_N,
        )
        ask, speeds = self._asking(ramp), x.stage.limits()["speed"]
        weight = RestingWeight(load_N, settings.speed_mm_s)
        speed_mm_s = 0.0

        def pull(tick: Tick) -> bool:
            nonlocal speed_mm_s
            self.hold_tick(tick)
            since_s, travel_mm, force_N, asked_mm_s = ask(tick)
            if asked_mm_s != speed_mm_s:
                speed_mm_s = asked_mm_s
                to_mm = settings.end_mm if speed_mm_s > 0 else settings.start_mm
                if abs(speed_mm_s) < SLOWEST_mm_s:
                    to_mm = x.latest.position_mm
                x.start_move(to_mm, speeds.nearest(max(abs(speed_mm_s), SLOWEST_mm_s)))
            # The weight's way begins where the force last followed the ramp, whether or not there
            # was an alarm: a late alarm must not excuse what has slid before it, and the shear of
            # a contact that still sticks after an early one does not belong to the way. A fast ramp
            # passes as followed although much of the weight is missing: all travel from its end on
            # is part of it.
            if ramp.follows and ramp.wanted_N(since_s) < load_N:
                record.ramp_to_s, record.slid_from_mm = self.since_s(), travel_mm
            record.slid_mm = max(record.slid_mm, travel_mm - record.slid_from_mm)
            weight.add(since_s, force_N, travel_mm)
            record.weight_rested = weight.rested_s >= settings.hold_for_s
            record.lost = record.slid_mm > settings.lost_mm or travel_mm >= settings.distance_mm
            return not record.lost and not record.weight_rested

        return pull

    def reading(self) -> Reading:
        """Return the results of the trial, and why it is invalid if it is."""
        return reading_of(self.run, self.record) | self.record_load_rates()
