"""The axes of a trial: where each was commanded to be, and where it was when it was last polled."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from procedures.pressed.approach.contact import contact_range_mm, refuse_deeper
from rig.bench.limits import require

if TYPE_CHECKING:
    from procedures.pressed.approach.torque_watch import TorqueWatch
    from procedures.pressed.links import TrialLinks
    from rig.control.tick_loop import Tick
    from rig.instruments.roles import LinearStage, RotaryStage
    from rig.run.context import Run

SLOWEST_mm_s = 0.01
"""Slowest speed that z is commanded to move at."""
ARRIVED_EVERY_S = 0.05
"""Interval in s at which x is polled for its arrival."""


@dataclass(frozen=True)
class Look:
    """An axis's answer to where it is; its times on the run's clock."""

    asked_s: float = -math.inf
    """Time of the question. The axis has not been seen where it was any later."""
    answered_s: float = -math.inf

    @property
    def at_s(self) -> float:
        """Time for which the answer is recorded: the middle between question and answer."""
        return (self.asked_s + self.answered_s) / 2


@dataclass(frozen=True)
class StagePoll(Look):
    """A stage's answer to where it is, with the position in mm that was commanded then."""

    position_mm: float = math.nan
    commanded_mm: float = 0.0


class PolledAxis(Protocol):
    """An axis whose position a trial records."""

    role: str
    """Role of its stage."""
    in_motion: bool
    """True if the axis is polled; one at rest stays where it was polled last."""

    @property
    def looked(self) -> Look:
        """The latest look at the axis."""
        ...

    @property
    def stage(self) -> LinearStage | RotaryStage:
        """Stage that is polled."""
        ...

    def ask_poll(self) -> None:
        """Ask its link for the position; the answer is there for a later tick."""
        ...


class PolledStage:
    """A linear stage of a trial, moved and polled through its link."""

    def __init__(self, run: Run, role: str, stage: LinearStage, links: TrialLinks):
        self.role, self.stage, self.links, self.clock = role, stage, links, run.clock
        self.commanded_mm = 0.0
        self.in_motion = False
        self.latest = StagePoll()
        self.on_command: Callable[[float, float], None] = lambda to_mm, speed_mm_s: None
        """Called with target and speed of every move that is asked for; with 0 mm/s for a stop."""

    @property
    def looked(self) -> Look:
        """See `PolledAxis`."""
        return self.latest

    def poll(self) -> None:
        """Ask the stage where it is, in the calling thread."""
        commanded_mm, asked_s = self.commanded_mm, self.clock.now()
        position_mm = self.stage.position_mm()
        self.latest = StagePoll(asked_s, self.clock.now(), position_mm, commanded_mm)

    def ask_poll(self) -> None:
        """See `PolledAxis`."""
        self.links.ask(self.role, "poll", self.poll)

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        """Ask the stage's link to begin a move, or to change the target of the one under way."""
        self.commanded_mm = position_mm
        self.on_command(position_mm, speed_mm_s)
        self.links.ask(self.role, "target", lambda: self.stage.start_move(position_mm, speed_mm_s))

    def stop(self) -> None:
        """Stop the stage, in the calling thread."""
        self.stage.stop()
        self.on_command(self.commanded_mm, 0.0)


@dataclass
class SentMove:
    """Times in s on the run's clock at which a move was sent and acknowledged; None before."""

    sent_s: float | None = None
    acknowledged_s: float | None = None


class PressingStage(PolledStage):
    """The z stage of a trial, whose position decides the force; it is always polled."""

    def __init__(self, run: Run, stage: LinearStage, links: TrialLinks, link_s: float):
        super().__init__(run, "stage_z", stage, links)
        self.in_motion = True
        self._deepest_mm = contact_range_mm(run.bench)[1]
        self.target_late_s = 0.0
        """Delay of the latest target to the stage beyond the usual delay."""
        self._link_s = link_s

    def start_move(
        self, position_mm: float, speed_mm_s: float, sent: SentMove | None = None
    ) -> None:
        """Ask for a move to a position; the speed is brought within the stage's limits. What
        becomes of the move is noted in `sent`. Raises TripError for a position below the latest
        contact, and LimitError for one outside the stage's limits."""
        refuse_deeper(position_mm, self._deepest_mm)
        limits = self.stage.limits()
        require("position under the force", position_mm, limits["position"])
        self.commanded_mm = position_mm
        speed_mm_s = limits["speed"].nearest(max(speed_mm_s, SLOWEST_mm_s))
        asked_s = self.clock.now()

        def move() -> None:
            begun_s = self.clock.now()
            if sent is not None:
                sent.sent_s = begun_s
            self.stage.start_move(position_mm, speed_mm_s)
            if sent is not None:
                sent.acknowledged_s = self.clock.now()
            # The target came in the middle of the time beyond the usual, which is in the delay.
            beyond_s = max(0.0, self.clock.now() - begun_s - self._link_s)
            self.target_late_s = begun_s - asked_s + beyond_s / 2

        self.links.ask(self.role, "target", move)

    def ask_torque(self, torque: TorqueWatch) -> None:
        """Ask the stage's link for the torque, if it is time to."""
        if torque.is_due():
            self.links.ask(self.role, "torque", torque.read)


class ArrivalWatch:
    """Asks a stage under way, now and then, whether it has arrived."""

    def __init__(self, stage: PolledStage, tick_Hz: float):
        self._stage = stage
        self._every = max(1, round(tick_Hz * ARRIVED_EVERY_S))
        """Ticks from one question to the next."""
        self._asked = 0
        """Number of the latest question."""
        self.arrived = False
        """True if the stage has answered that it stands."""

    def under_way(self, tick: Tick) -> bool:
        """Return whether the stage has not arrived, as far as is known; ask if it is time to."""
        number = (tick.number + 1) // self._every
        due, self._asked = number != self._asked, number
        if due:
            self._stage.links.ask(self._stage.role, "arrived", self._ask)
        return not self.arrived

    def _ask(self) -> None:
        self.arrived = not self._stage.stage.moving()
