"""Ends an approach in which z presses on something that the force sensor does not show.

A sensor that is dead does not always fall silent: its amplifier may send noise about the zero. Then
nothing but the stage itself shows that it presses. An approach ends

- where z stands although it is commanded to move: its torque limit holds it, or something else, or
  it does not obey; its torque shows which of these it is,
- where the torque of its motor rises and no force with it,
- where the sensor shows a pull, since its sign may be wrong: then contact is never felt, and z
  would press on until the force is over its limit, and
- where contact has been felt, z has gone on, and the mean force is no force by the sensor's own
  noise, which was measured before contact.

Each names the force sensor where that is the suspect.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.approach.contact import contact_range_mm, felt_N
from procedures.pressed.approach.tare import SIGMAS
from procedures.pressed.approach.torque_watch import SUSPECT, TorqueWatch
from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from rig.run.context import Run

HELD_S = 0.3
"""Time over which z is compared with its commands. A stage takes less to come up to speed."""
HELD_SHARE = 0.2
"""Share of the commanded way that a stage which is not held covers at least."""
NEARLY = 0.5
"""Share of the wanted force from which z is not taken for held."""
LEAST_WAY_mm = 0.03
"""Commanded way within `HELD_S` from which z is judged: far above the resolution of a stage and
what friction holds back."""
CONFIRMED_mm = 0.08
"""Distance from the place where contact was felt to the place where its force has to be there: a
skin or a film that is pressed so far pushes back with several times the force that means contact.
"""
CONFIRMED_S = 0.05
"""Stretch of force whose mean confirms a contact."""
PULLED_N = 0.5
"""Pull from which the sign of the force is in doubt: beyond the drift of a zero that was accepted
in free air, and what a film or a skin shows of a press of some 0.01 mm."""


class NotObeyedError(InstrumentError):
    """Raised for a z that stands although it is commanded to move, where its torque shows that
    nothing holds it: the force sensor is not suspected."""


class ApproachWatch:
    """Watches one approach, tick by tick."""

    def __init__(self, run: Run, contact_N: float, target_N: float, torque: TorqueWatch):
        """`contact_N` is the force that means contact, and `target_N` the one that is wanted.
        `torque` is that of z, at rest in free air before."""
        self._run, self._contact_N, self._target_N = run, contact_N, target_N
        self._first_mm, _ = contact_range_mm(run.bench)
        self._recent: deque[tuple[float, float, float]] = deque()
        """Time in s, position in mm, and commanded way since the approach began in mm."""
        self._way_mm = self._ahead_mm = self._speed_mm_s = 0.0
        self._touched_mm: float | None = None
        self._confirmed = False
        self._torque = torque
        self._matched_N = 0.0
        """Force that the latest rise of the torque has come with."""
        self._matched = 0
        """Rises of the torque, by its margin each, that a change of force has come with."""

    def commanded(self, ahead_mm: float, speed_mm_s: float) -> None:
        """Note the latest target: how far it is ahead of where z was seen, and the speed."""
        self._ahead_mm, self._speed_mm_s = max(ahead_mm, 0.0), speed_mm_s

    def step(self, position_mm: float, force_N: float, touched: bool) -> None:
        """Judge one tick: where z is, the force along z, and whether contact has been felt. Stops z
        and raises InstrumentError."""
        now_s = self._run.clock.now()
        if self._recent:
            passed_s = now_s - self._recent[-1][0]
            self._way_mm += min(self._speed_mm_s * passed_s, self._ahead_mm)
        self._recent.append((now_s, position_mm, self._way_mm))
        while len(self._recent) > 2 and self._recent[1][0] <= now_s - HELD_S:
            self._recent.popleft()
        self._refuse_pull(position_mm, force_N)
        self._refuse_held(position_mm, force_N)
        if touched and not self._confirmed:
            self._confirm(position_mm)
        self._compare_torque(position_mm)

    def _refuse_pull(self, position_mm: float, force_N: float) -> None:
        """Refuse a pull that lasts for half of `CONFIRMED_S`: before contact nothing pulls so."""
        if force_N > -PULLED_N:
            return
        usual_N = float(np.median(self._run.force.latest_N(CONFIRMED_S)[:, 2]))
        if usual_N > -PULLED_N:
            return
        self._run.bench.stage_z.stop()
        raise InstrumentError(
            "force_sensor",
            "approach",
            f"it reads {usual_N:.2g} N along z at {position_mm:.3f} mm, as if something pulled; "
            "what presses must read positive",
            "press on it by hand and look at its value (rig jog shows it): where that is negative, "
            "correct the sign of z in [force_sensor], or its cable; where it changes by itself, "
            "the sensor drifts",
        )

    def _refuse_held(self, position_mm: float, force_N: float) -> None:
        """Refuse a stage that does not do what it is commanded."""
        since_s, from_mm, way_mm = self._recent[0]
        commanded_mm = self._way_mm - way_mm
        if self._recent[-1][0] - since_s < HELD_S or commanded_mm < LEAST_WAY_mm:
            return
        moves = position_mm - from_mm >= HELD_SHARE * commanded_mm
        if moves or force_N > NEARLY * self._target_N:  # near the force its moves are small
            return
        self._run.bench.stage_z.stop()
        what = (
            f"at {position_mm:.3f} mm, although it was commanded to move a further "
            f"{commanded_mm:.2f} mm within {HELD_S:g} s"
        )
        idle_percent = self._torque.idle_percent(HELD_S)
        if idle_percent is not None:
            raise NotObeyedError(
                "stage_z",
                "approach",
                f"stage_z has not moved: it is {what}, and the torque of its motor is "
                f"{idle_percent:.3g} %, as in free air: nothing holds it, and it does not obey; "
                f"force_sensor reads {force_N:.2g} N of {self._target_N:g} N",
                "check whether its drive is enabled and obeys: move the stage up with rig jog",
            )
        what = f"stage_z is held {what}"
        if position_mm < self._first_mm or force_N > self._contact_N:
            raise InstrumentError(
                "stage_z",
                "approach",
                f"{what}; force_sensor reads {force_N:.2g} N of {self._target_N:g} N",
                "check what holds the stage, and whether the force sensor reads what is pressed; "
                "if the force needs it, raise torque_limit_percent",
            )
        raise InstrumentError(
            "force_sensor",
            "approach",
            f"{what}, as if it pressed with all its torque limit allows, and the sensor reads "
            f"{force_N:.2g} N",
            SUSPECT,
        )

    def _compare_torque(self, position_mm: float) -> None:
        """Refuse a torque that has risen by its margin, once or once more, without a change of
        force; learn it, with its friction, as long as z is above any contact."""
        torque = self._torque
        if position_mm < self._first_mm:
            if self._way_mm > LEAST_WAY_mm:
                torque.learn()
            if not torque.is_learnt:
                return
        rise_percent = torque.rise_percent()
        if rise_percent <= (self._matched + 1) * torque.margin_percent:
            return
        mean_N, least_N = self._mean_and_least_N()
        if abs(mean_N - self._matched_N) >= least_N:
            self._matched, self._matched_N = self._matched + 1, mean_N
            return
        self._run.bench.stage_z.stop()
        raise torque.suspect("approach", rise_percent, mean_N)

    def _mean_and_least_N(self) -> tuple[float, float]:  # noqa: N802 - the unit keeps its capital
        """Return the mean force along z, and the least one that is more than noise."""
        force = self._run.force
        latest_N = force.latest_N(CONFIRMED_S)[:, 2]
        error_N = float(force.noise_N[2]) / math.sqrt(len(latest_N))
        return float(latest_N.mean()), max(SIGMAS * error_N, self._contact_N / 2)

    def _confirm(self, position_mm: float) -> None:
        """Refuse a contact whose mean force is no more than noise."""
        if self._touched_mm is None:
            self._touched_mm = position_mm
        if position_mm - self._touched_mm < CONFIRMED_mm:
            return
        noise_N = float(self._run.force.noise_N[2])
        mean_N, least_N = self._mean_and_least_N()
        if mean_N >= least_N:
            self._confirmed = True
            return
        self._run.bench.stage_z.stop()
        raise InstrumentError(
            "force_sensor",
            "approach",
            f"contact was felt at {self._touched_mm:.3f} mm, but stage_z has moved on to "
            f"{position_mm:.3f} mm and the force has not changed: it is {mean_N:.2g} N on average, "
            f"with a noise of {noise_N:.2g} N before contact",
            SUSPECT,
        )


@contextlib.contextmanager
def naming_the_sensor(run: Run, contact_N: float) -> Iterator[None]:
    """Add what the force sensor reads to an InstrumentError that z raises in the block where it may
    press, for instance at its torque limit. Where the sensor reads no more than `contact_N`, the
    hint names it as the suspect."""
    try:
        yield
    except InstrumentError as error:
        # A time-out of its link, a refused motion and a z that does not obey are none of these.
        if error.device != "stage_z" or type(error) is not InstrumentError or not _may_press(run):
            raise
        force_N = felt_N(run, CONFIRMED_S)
        cause, hint = f"{error.cause}; force_sensor reads {force_N:.2g} N", error.hint
        if force_N <= contact_N:
            hint = f"{SUSPECT}; otherwise: {hint}" if hint else SUSPECT
        raise InstrumentError(error.device, error.command, cause, hint) from error


def _may_press(run: Run) -> bool:
    """Return whether z stands where contact may be; False where it does not answer."""
    with contextlib.suppress(InstrumentError):
        return run.bench.stage_z.position_mm() > contact_range_mm(run.bench)[0]
    return False
