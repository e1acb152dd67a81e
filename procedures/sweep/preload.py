"""The static preload: approach until contact is felt, bring the force up under control, hold,
release.

As a person would by hand while watching the force: park, zero the sensor, go down quickly to just
before the contact range, slowly until contact is felt, then raise the force at a limited rate to
the preload. The film creeps under it, so the force is followed for as long as the run lasts.
Whatever ends the run, the stage is stopped, and moved away if it still can be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from procedures.pressed.approach.approach_watch import ApproachWatch, naming_the_sensor
from procedures.pressed.approach.contact import (
    HOMING_S,
    arm_from_where_it_stands,
    come_close,
    contact_range_mm,
    expected_contact_mm,
    felt_N,
    first_ways_s,
    not_there,
    nothing_felt,
    park,
    refuse_deeper,
    refuse_early_contact,
    stream_force,
    travel_s,
)
from procedures.pressed.approach.earlier_runs import EarlierPress
from procedures.pressed.approach.tare import TARE_S, ForceZero, tare_in_free_air
from procedures.pressed.approach.torque_watch import TorqueWatch
from procedures.pressed.approach.unload import SETTLED_S, unload
from procedures.pressed.approach.way_down import BOTTOM_mm
from rig.bench.limits import require
from rig.bench.settings import FixtureSettings
from rig.core.errors import InstrumentError, LimitError
from rig.run.trip import TripError

if TYPE_CHECKING:
    from procedures.sweep.settings import SweepSettings
    from rig.instruments.roles import LinearStage
    from rig.run.context import Run

TICK_S = 0.01
"""Interval between two steps of the force control."""
MIN_FORCE_RATE_S_S = 1 / TICK_S
"""Lowest frame rate of a force sensor: one frame for every step of the control."""
CHECKED_EVERY_S = 0.02
"""Interval between two checks of the force in an approach; the limit is watched all the time."""
FORCE_WINDOW_S = 0.005
"""Time over which a step averages the force: one frame at least."""
CONTACT_N = 0.4
"""Force that means contact: far above the sensor's noise, far below the preload."""
APPROACH_mm_s = 0.5
"""Speed of the slow search for contact."""
USUAL_LIMIT_N = 40.0
"""Force limit from which the time of the first way down is estimated."""
LATE_S = 1.0
"""Time beyond that needed for the approach at its speed after which it is ended."""
RISE_N_s = 25.0
"""Largest rate of the force."""
FIRST_STIFFNESS_N_mm = 1000.0
"""Stiffness assumed until the film's own is known: stiffer than any film, for a small first
step."""
KNOWN_AFTER_mm = 0.02
"""Compression from which the measured stiffness of the film is used."""
AHEAD_S = 0.1
"""Largest distance of the target ahead of the stage, as time of motion at the wanted speed. It
bounds the motion of a late or hanging program until the drive's time-out, and the effect of a wrong
stiffness."""
CLOSE = 0.002
"""Relative error of the force that is not corrected."""
CHANGED = 0.1
"""Relative change of the force that has to come with a change of the torque while it is held."""
HELD = 0.01
"""Relative error within which the force is held."""
HOLD_S = 0.3
PATIENCE_S = 15.0
"""Longest time from contact to a held force."""
GONE_S = 0.1
"""Time without force after which a contact is rejected: something has shaken the sensor."""
MOST_REJECTED = 5
"""Number of rejected contacts that end a press. A shake costs one; a stage that shows a place where
it does not stand touches and lets go for as long as it is commanded from there."""
CREEP_PATIENCE_S = 60.0
"""Longest time until a held film creeps slowly enough to begin."""
WORTH_mm = 0.002
"""Smallest move from which the film's stiffness is estimated."""


@dataclass
class Preload:
    """A preloaded film: position of contact, stiffness, and quality of the preload."""

    target_N: float
    contact_mm: float
    stiffness_N_mm: float
    reached_N: float
    overshoot: float
    """Largest relative excess of the force on the way up."""
    settling_s: float
    """Time from contact until the force was held."""
    position_mm: float
    """Commanded position of the stage."""
    torque: TorqueWatch
    """Torque of the stage, compared with the force before each move."""
    zero: ForceZero = field(default_factory=ForceZero)
    """Zero of the force sensor, from before the contact."""
    _moved: tuple[float, float] | None = None
    """Length of the latest move in mm, and the force before it."""

    def hold(self, run: Run, stretch_s: float, pause_s: float) -> None:
        """Follow the film until it creeps slowly. Raises InstrumentError if it never does.

        A move has its effect within `pause_s`.
        """
        give_up_s = run.clock.now() + CREEP_PATIENCE_S
        while self.follow(run, stretch_s):
            run.clock.sleep(stretch_s + pause_s)
            if run.clock.now() > give_up_s:
                raise InstrumentError(
                    "stage_z",
                    "preload",
                    f"{felt_N(run, stretch_s):.4g} N, followed for {CREEP_PATIENCE_S:g} s and not "
                    f"within {100 * CLOSE:g} % of {self.target_N:g} N",
                    "check the film and its clamp: something gives way, or the stage hunts",
                )

    def follow(self, run: Run, stretch_s: float) -> bool:
        """Correct the mean force of the latest `stretch_s` for the film's creep by one small move
        at most; return whether there was one. `stretch_s` has to contain whole periods of the
        vibration.

        Raises TripError if the force differs from the preload by more than a fifth.
        """
        missing_N = self.target_N - felt_N(run, stretch_s)
        self._learn_stiffness(self.target_N - missing_N)
        if abs(missing_N) <= CLOSE * self.target_N:
            return False
        if abs(missing_N) > 0.2 * self.target_N:
            raise TripError(
                f"force_sensor reads a preload of {self.target_N - missing_N:.3g} N where stage_z "
                f"had pressed with {self.target_N:g} N",
                "check the film and its clamp: something has given way",
            )
        self.torque.read()
        self.torque.refuse_rise_in_hold(felt_N(run, stretch_s), CHANGED * self.target_N)
        # Aims beyond the target, because the film continues to creep.
        creep_N = CLOSE * self.target_N if missing_N > 0 else 0.0
        step_mm = (missing_N + creep_N) / self.stiffness_N_mm
        refuse_deeper(self.position_mm + step_mm, contact_range_mm(run.bench)[1])
        self.position_mm += step_mm
        self._moved = step_mm, self.target_N - missing_N
        stage = run.bench.stage_z
        speed_mm_s = min(RISE_N_s / self.stiffness_N_mm, APPROACH_mm_s)
        stage.start_move(self.position_mm, _possible_mm_s(stage, speed_mm_s))
        return True

    def _learn_stiffness(self, force_N: float) -> None:
        """Raise the assumed stiffness if the latest move had more effect than expected: the force
        rises faster the further the film is pressed, or contact was felt too early. Without this,
        moves would stay too long and the control would never settle."""
        if self._moved is None:
            return
        (step_mm, before_N), self._moved = self._moved, None
        if abs(step_mm) >= WORTH_mm:
            shown_N_mm = (force_N - before_N) / step_mm
            self.stiffness_N_mm = max(self.stiffness_N_mm, min(shown_N_mm, FIRST_STIFFNESS_N_mm))


def refuse_impossible(settings: SweepSettings, share: float) -> None:
    """Raise LimitError if the largest load could lift the indentor off the film."""
    preload_N, load_N = settings.preload_N, max(settings.levels_N)
    if load_N >= share * preload_N:
        option = "--loads" if settings.loads_N else "--load"
        raise LimitError(
            f"{option} {load_N:g} N (peak) is not below {share:g} of --preload {preload_N:g} N: "
            "the indentor could lift off the film",
            f"ask for less than {share * preload_N:g} N, or for more preload",
        )


def press(run: Run, target_N: float) -> Preload:
    """Press the film with `target_N` and hold it; the shutdown action is registered before
    contact."""
    bench = run.bench

    def lift(came_from_mm: float) -> None:
        unload(run, "film", came_from_mm)

    arm_from_where_it_stands(run, "preload", lift)
    stream_force(run, MIN_FORCE_RATE_S_S, "the control of the preload")
    run.force.watch(bench.force_sensor.limits()["force"].high)
    park(run, "preload", lift)
    zero = tare_in_free_air(run)
    torque = TorqueWatch(run)
    torque.rest()
    come_close(run, CONTACT_N, FORCE_WINDOW_S, CHECKED_EVERY_S)
    with naming_the_sensor(run, CONTACT_N):
        earlier = EarlierPress(run, target_N)
        pressed = _press_until_confirmed(run, target_N, earlier, torque)
        earlier.judge(pressed.position_mm - pressed.contact_mm, pressed.stiffness_N_mm, zero)
    pressed.zero = zero
    torque.hold_begins(pressed.reached_N)
    torque.settle_in_hold()
    return pressed


def _press_until_confirmed(
    run: Run, target_N: float, earlier: EarlierPress, torque: TorqueWatch
) -> Preload:
    """Approach and press; again where the contact was not confirmed, `MOST_REJECTED` times."""
    first_mm, last_mm = contact_range_mm(run.bench)
    contact_mm = first_mm
    for number in range(MOST_REJECTED):
        if number:
            run.event("warning", "preload", "the contact was not confirmed: the approach continues")
        run.count_press()
        contact_mm = _approach(run, first_mm, last_mm, target_N, torque)
        pressed = _press_from(run, contact_mm, target_N, earlier.refuse_way, torque)
        if pressed is not None:
            return pressed
    # The shutdown action stops z. A stop here could fail and hide the first cause.
    raise InstrumentError(
        "stage_z",
        "approach",
        f"contact was felt {MOST_REJECTED} times, the last time at {contact_mm:.3f} mm, and each "
        f"time it was lost within {GONE_S:g} s",
        "check that nothing shakes the bench, that the object is held, and that the drive of "
        "stage_z shows its true position",
    )


def duration_s(fixture: FixtureSettings, target_N: float, homed: bool) -> float:
    """Return the expected bench time of `press` and the retreat; a stage that is `homed` is parked
    already."""
    slow_from_mm, contact_mm, parked_mm = expected_contact_mm(fixture)
    return (
        (0.0 if homed else HOMING_S + travel_s(parked_mm))
        + 2 * TARE_S
        + travel_s(slow_from_mm - parked_mm)
        + first_ways_s(fixture, USUAL_LIMIT_N, homed)
        + (contact_mm - slow_from_mm) / APPROACH_mm_s
        + KNOWN_AFTER_mm * FIRST_STIFFNESS_N_mm / RISE_N_s
        + target_N / RISE_N_s
        + HOLD_S
        + travel_s(contact_mm - parked_mm)
        + 2 * SETTLED_S
    )


def _approach(
    run: Run, first_mm: float, last_mm: float, target_N: float, torque: TorqueWatch
) -> float:
    """Move slowly until contact is felt, with small targets ahead of the stage; return its
    position."""
    stage, clock = run.bench.stage_z, run.clock
    speed_mm_s = _possible_mm_s(stage, APPROACH_mm_s)
    patience_s = (last_mm - stage.position_mm()) / speed_mm_s + LATE_S
    begin_s = clock.now()
    watch = ApproachWatch(run, CONTACT_N, target_N, torque)
    targets = 0
    while (here_mm := stage.position_mm()) < last_mm - BOTTOM_mm:
        if clock.now() - begin_s > patience_s:
            stage.stop()
            raise not_there(run, patience_s, patience_s / max(1, targets), AHEAD_S)
        targets += 1
        target_mm = min(here_mm + AHEAD_S * speed_mm_s, last_mm)
        watch.commanded(target_mm - here_mm, speed_mm_s)
        stage.start_move(target_mm, speed_mm_s)
        clock.sleep(CHECKED_EVERY_S)
        if torque.is_due():
            torque.read()
        force_N = felt_N(run, FORCE_WINDOW_S)
        watch.step(here_mm, force_N, touched=False)
        if force_N > CONTACT_N:
            touched_mm = stage.position_mm()
            if touched_mm < first_mm:
                refuse_early_contact(run, force_N, CONTACT_N)
            return touched_mm
    stage.stop()
    check = "the film is clamped and the force sensor connected"
    raise nothing_felt(run, felt_N(run, FORCE_WINDOW_S), CONTACT_N, check)


def _press_from(
    run: Run,
    contact_mm: float,
    target_N: float,
    refuse_way: Callable[[float, float], None],
    torque: TorqueWatch,
) -> Preload | None:
    """Go from contact to the held preload in small targets ahead of the stage that depend on the
    measured stiffness; None if the contact was not confirmed. `refuse_way` raises for a way beyond
    contact, in mm, that is too long for the force in N there."""
    stage, clock = run.bench.stage_z, run.clock
    start_s = clock.now()
    felt, held = _FeltContact(start_s), _HoldTimer(target_N)
    stiffness, largest_N = FIRST_STIFFNESS_N_mm, 0.0
    target_mm = contact_mm
    watch = ApproachWatch(run, CONTACT_N, target_N, torque)
    while clock.now() - start_s < PATIENCE_S:
        if torque.is_due():
            torque.read()
        force_N = felt_N(run, FORCE_WINDOW_S)
        largest_N = max(largest_N, force_N)
        here_mm = stage.position_mm()
        pressed_mm = here_mm - contact_mm
        watch.step(here_mm, force_N, touched=True)
        if force_N < target_N / 2:
            refuse_way(pressed_mm, force_N)
        if felt.is_gone(clock.now(), force_N, pressed_mm):
            return None
        if pressed_mm > KNOWN_AFTER_mm:
            stiffness = max((force_N - CONTACT_N) / pressed_mm, 1e-3)
        if (held_since_s := held.held_since_s(clock.now(), force_N)) is not None:
            return Preload(
                target_N,
                contact_mm,
                stiffness,
                felt_N(run, HOLD_S),
                max(0.0, largest_N / target_N - 1),
                held_since_s - start_s,
                target_mm,
                torque,
            )
        missing_N = target_N - force_N
        if abs(missing_N) > CLOSE * target_N:
            speed_mm_s = _possible_mm_s(stage, _speed(stiffness, missing_N))
            ahead_mm = AHEAD_S * speed_mm_s
            target_mm = here_mm + min(max(missing_N / stiffness, -ahead_mm), ahead_mm)
            _start_move(run, target_mm, speed_mm_s)
            watch.commanded(target_mm - here_mm, speed_mm_s)
        clock.sleep(TICK_S)
    raise InstrumentError(
        "stage_z",
        "preload",
        f"{felt_N(run, FORCE_WINDOW_S):.3g} N after {PATIENCE_S:g} s, {target_N:g} N wanted; the "
        f"stage is at {stage.position_mm():.3f} mm",
        "check the film and its clamp; for a small preload or a stiff film the steps of the stage "
        f"may be too coarse to hold it within {100 * HELD:g} %: choose a larger preload",
    )


class _FeltContact:
    """A contact that was felt, until it is certain to be one: a sensor that was shaken shows a
    force for a moment only."""

    def __init__(self, felt_s: float):
        self._felt_s = felt_s
        """Time at which it was felt last."""

    def is_gone(self, now_s: float, force_N: float, pressed_mm: float) -> bool:
        """Return whether nothing has been felt for `GONE_S`."""
        # Once pressed so far it is a real contact: a film does not disappear.
        if force_N > CONTACT_N / 2 or pressed_mm > KNOWN_AFTER_mm:
            self._felt_s = now_s
        return now_s - self._felt_s >= GONE_S


class _HoldTimer:
    """A force that has to stay within `HELD` of its target for `HOLD_S`."""

    def __init__(self, target_N: float):
        self._target_N = target_N
        self._since_s: float | None = None
        """Time since which the force has been near its target; None while it is not."""

    def held_since_s(self, now_s: float, force_N: float) -> float | None:
        """Return since when the force is held; None if it is not, or not for long enough."""
        if abs(self._target_N - force_N) > HELD * self._target_N:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = now_s
        elif now_s - self._since_s >= HOLD_S:
            return self._since_s
        return None


def _start_move(run: Run, target_mm: float, speed_mm_s: float) -> None:
    """Begin a move under the force. Raises TripError for a target below the latest contact, and
    LimitError for one outside the stage's limits."""
    stage = run.bench.stage_z
    refuse_deeper(target_mm, contact_range_mm(run.bench)[1])
    require("position for the preload", target_mm, stage.limits()["position"])
    stage.start_move(target_mm, speed_mm_s)


def _possible_mm_s(stage: LinearStage, wanted_mm_s: float) -> float:
    """Return the speed nearest to the wanted one that the stage has, but none above the speed of
    the approach, for which the bound on z's speed was checked."""
    return min(stage.limits()["speed"].nearest(wanted_mm_s), APPROACH_mm_s)


def _speed(stiffness_N_mm: float, missing_N: float) -> float:
    """Return the speed of full rise far from the target, and near it the one that needs a few
    ticks."""
    rise_N_s = min(RISE_N_s, max(abs(missing_N) / (5 * TICK_S), 1.0))
    return min(APPROACH_mm_s, rise_N_s / stiffness_N_mm)
