"""Compares the torque of z's motor with the force that the sensor reads.

Every force limit trusts the force sensor. A drive that reports its torque is a second witness:
where the torque rises above what it was in free air and the force does not change, z presses on
something that the sensor does not show. The torque is known in percent only, with the friction of
guide and screw in it, so it is never converted into a force: a rise by `SHARE` of the torque limit
has to come with some change of force, whichever. A stage without `ReadsTorque` is not watched here.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

from procedures.pressed.approach.torque_limit import torque_limit_percent
from rig.core.errors import InstrumentError
from rig.instruments.roles import ReadsTorque

if TYPE_CHECKING:
    from rig.run.context import Run

EVERY_S = 0.02
"""Shortest interval between two readings."""
LINK_SHARE = 0.2
"""Largest share of a slow link's time that readings take."""
SHARE = 0.25
"""Share of the torque limit by which the torque may rise without a change of force: far above
ripple, and far enough below the limit that z stops before it."""
LEAST_percent = 3.0
"""The same where the torque limit is very low."""
SIGMAS = 5.0
"""Ratio to the scatter of the readings in free air above which a rise is more than scatter."""
FRICTION = 2.5
"""A drive that holds may show its friction in either direction: so many times the friction is the
least rise that is judged while the force is held."""
ENOUGH, KEPT = 3, 30
"""Minimum number of readings in a mean, and number of the latest readings that are used."""
FLAT, FLAT_N = 10, 2.0
"""Number of readings, all alike to the last bit, and least force in N that they would have shown:
an AZ reports its torque in steps of 0.1 %, about 0.1 N."""
HIDDEN_SHARE = 0.75
"""Share of the torque limit beyond which a margin leaves nothing to watch."""
SUSPECT = (
    "suspect the force sensor: check its cable, its supply and that the object rests on it; press "
    "on it by hand and look at its value (rig jog shows it) before anything is pressed again"
)


class TorqueWatch:
    """The torque of z in one run: what it was in free air and at rest, and how far it has risen.

    `read` may be called by the worker of z's link; everything else by the procedure's thread.
    """

    def __init__(self, run: Run):
        self._run = run
        stage = run.bench.stage_z
        self._stage = stage if isinstance(stage, ReadsTorque) else None
        self._limit_percent = torque_limit_percent(run.bench) if self._stage else 100.0
        self._every_s = EVERY_S
        if self._stage is not None:
            link_s = 1 / stage.limits()["update_rate"].high
            self._every_s = max(EVERY_S, link_s / LINK_SHARE)
        self._read_at_s = -math.inf
        self.latest_percent: float | None = None
        """Latest reading; None before the first, and where the drive does not report it."""
        self._fresh = False
        """True if the latest reading has not been learnt yet."""
        self._moving: deque[tuple[float, float]] = deque(maxlen=KEPT)
        """Times in s and readings in motion in free air."""
        self._resting: float | None = None
        self._held: list[float] = []
        """First readings under the held force."""
        self._held_N = 0.0
        self._reported = False
        self._shown: set[float | None] = set()
        """Different values that were read so far, until there are two."""
        self._readings = 0

    def is_due(self) -> bool:
        """Return whether the torque is to be read again."""
        if self._stage is None:
            return False
        return self._run.clock.now() - self._read_at_s >= self._every_s

    def read(self) -> None:
        """Read the torque. Raises InstrumentError for an exchange that fails."""
        if self._stage is None:
            return
        self._read_at_s = self._run.clock.now()
        self.latest_percent, self._fresh = self._stage.torque_percent(), True
        if len(self._shown) < 2:
            self._shown.add(self.latest_percent)
        self._readings += 1
        if self.latest_percent is None:
            self._stage = None
            self._report("stage_z reports no torque: only its torque limit backs the force")

    def rest(self) -> None:
        """Read the torque of a stage that stands in free air; the next approach begins from it."""
        self.read()
        self._resting, self._held, self._fresh = self.latest_percent, [], False
        # At rest the motor shows less than in motion, by the friction: no rise begins from there.
        self.latest_percent = None

    def learn(self) -> None:
        """Use the latest reading, once, as one in motion in free air."""
        if self._fresh and self.latest_percent is not None:
            self._moving.append((self._read_at_s, self.latest_percent))
        self._fresh = False

    @property
    def is_learnt(self) -> bool:
        """Whether the torque in motion in free air is known; else rises from rest, which have the
        friction in them, are all there is."""
        return len(self._moving) >= ENOUGH

    @property
    def margin_percent(self) -> float:
        """Rise that has to come with a change of force."""
        return self._margin_beyond(self._free_readings if self.is_learnt else [])

    def rise_percent(self) -> float:
        """Return by how much the latest reading differs from free air; 0 where either is not
        known."""
        free = self._free_percent()
        if free is None or self.latest_percent is None:
            return 0.0
        return abs(self.latest_percent - free)

    def idle_percent(self, stood_s: float) -> float | None:
        """Return the latest torque reading if it shows that z does not push, although z was
        commanded to move and has not moved for `stood_s`. Return None if z pushes, or if the torque
        does not show it: with few, old or unchanging readings, or if friction takes most of the
        limit."""
        latest, now_s = self.latest_percent, self._run.clock.now()
        # What was read since it stands may be the torque of a stage that is held, and it may have
        # been slow before.
        before = [one for at_s, one in self._moving if at_s < now_s - 2 * stood_s]
        if latest is None or now_s - self._read_at_s > stood_s / 2:
            return None
        if len(before) < ENOUGH or len(self._shown) < 2:
            return None
        free, margin = _mean(before), self._margin_beyond(before)
        if self._limit_percent - abs(free) <= margin:
            return None
        return latest if abs(latest - free) <= margin else None

    def hold_begins(self, force_N: float) -> None:
        """Compare with the readings from here on, in which the sensor reads `force_N`."""
        self._held, self._held_N = [], force_N
        if self._readings >= FLAT and len(self._shown) == 1 and abs(force_N) >= FLAT_N:
            self._report(
                f"stage_z shows the same torque, {self.latest_percent:.3g} %, in free air and "
                f"under {force_N:.2g} N: it does not follow the force, so that only the "
                "torque limit backs the force sensor; check the torque that the drive reports"
            )
        if self._stage is not None and self._hold_margin_percent() > self._hidden_percent:
            self._report(
                f"the friction of stage_z, {self._friction_percent():.2g} % of its torque, hides "
                "what a held force needs: its torque is not watched while the force is held"
            )

    def settle_in_hold(self) -> None:
        """Take the readings at once with which later ones are compared; z is at rest."""
        for _ in range(ENOUGH):
            self.read()
            if self.latest_percent is not None:
                self._held.append(self.latest_percent)

    def refuse_rise_in_hold(self, force_N: float, changed_N: float) -> None:
        """Stop z and raise InstrumentError where the torque has changed under the held force and
        the force along z, `force_N`, by less than `changed_N`. Call it once for each reading."""
        latest = self.latest_percent
        if latest is None:
            return
        if len(self._held) < ENOUGH:
            self._held.append(latest)
            return
        margin = self._hold_margin_percent()
        rise = abs(latest - _mean(self._held))
        if rise <= margin or margin > self._hidden_percent:
            return
        if abs(force_N - self._held_N) < changed_N:
            self._run.bench.stage_z.stop()
            raise self.suspect("hold the force", rise, force_N)

    def suspect(self, command: str, rise_percent: float, force_N: float) -> InstrumentError:
        """Return the error for a torque that has risen without a change of force."""
        return InstrumentError(
            "force_sensor",
            command,
            f"the torque of stage_z has changed by {rise_percent:.3g} % to "
            f"{self.latest_percent:.3g} % at {self._run.bench.stage_z.position_mm():.3f} mm, as if "
            f"it pressed, and the sensor's {force_N:.2g} N have not changed with it",
            SUSPECT,
        )

    def _margin_beyond(self, free: list[float]) -> float:
        """Return the rise that is more than ripple and the scatter of readings in free air."""
        import numpy as np  # as in _mean()

        scatter = float(np.std(free)) if free else 0.0
        return max(SHARE * self._limit_percent, LEAST_percent, SIGMAS * scatter)

    @property
    def _free_readings(self) -> list[float]:
        return [one for _, one in self._moving]

    @property
    def _hidden_percent(self) -> float:
        return HIDDEN_SHARE * self._limit_percent

    def _free_percent(self) -> float | None:
        if self.is_learnt:
            return _mean(self._free_readings)
        return self._resting

    def _friction_percent(self) -> float:
        free = self._free_percent()
        return 0.0 if free is None or self._resting is None else abs(free - self._resting)

    def _hold_margin_percent(self) -> float:
        return max(self.margin_percent, FRICTION * self._friction_percent())

    def _report(self, text: str) -> None:
        if not self._reported:
            self._reported = True
            self._run.event("warning", "torque", text)


class WayTorque:
    """The torque on a way through free air: its first stretch is what the rest is compared with."""

    LEARNT_S = 0.3
    """Stretch of the way that is learnt, from its beginning; longer where the link is slow."""
    STARTS_S = 0.1
    """Time for which a motion speeds up; its torque is not used."""

    def __init__(self, run: Run):
        self._run, self._torque = run, TorqueWatch(run)
        self._torque.rest()
        self._begun_s = run.clock.now()

    def refuse_rise(self, force_N: float) -> None:
        """Read the torque if it is time to. Stops z and raises InstrumentError where it has risen;
        call it where the force, of which `force_N` is along z, has not."""
        torque = self._torque
        if not torque.is_due():
            return
        torque.read()
        since_s = self._run.clock.now() - self._begun_s
        if since_s >= self.STARTS_S and (since_s < self.LEARNT_S or not torque.is_learnt):
            torque.learn()  # a slow link has brought too few readings by then
        if torque.is_learnt and (rise := torque.rise_percent()) > torque.margin_percent:
            self._run.bench.stage_z.stop()
            raise torque.suspect("way down", rise, force_N)


def _mean(readings: Sequence[float]) -> float:
    import numpy as np  # not at the top: a command's help does not need it

    return float(np.mean(readings))
