"""The common part of all simulated drives: one axis, its faults, and its history for the World.

No protocol: a drive of a model adds its registers or commands. Everything is evaluated lazily at
exact World times: what was due before a request or a question happens first, in its order and at
its own time, as if it had been watched all along.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import (
    MoveFault,
    RotaryFault,
    SlowAxis,
    StaleStatus,
    WrongPosition,
    WrongTorque,
)
from drivers.simulated.ports import DrivePort
from drivers.simulated.world.axis import AxisCommand, Load, Mechanics, SimulatedAxis
from drivers.simulated.world.schedule import Schedule

FARTHER_THAN_ANY_SWITCH_mm = 1e5
"""Target of an axis without a target, beyond everything that may end its motion."""

F = TypeVar("F", bound=MoveFault | RotaryFault)
Due = tuple[int, Callable[[int], None]]
"""World time in us of an event that needs no command, and the function for the event, which takes
that time."""


@dataclass
class MotionFaults:
    """What faults of the mechanics make of the motions that are commanded."""

    speed_share: float = 1.0
    """The share of a commanded speed that the axis reaches."""
    runs_to_mm: float | None = None
    """Position to which a runaway moves instead of its target, until it is stopped."""

    def command(
        self,
        target_mm: float,
        speed_mm_s: float,
        acceleration_mm_s2: float,
        deceleration_mm_s2: float,
    ) -> AxisCommand:
        """Return what the axis does where it is to do this."""
        if self.runs_to_mm is not None:
            target_mm = self.runs_to_mm
        speed_mm_s *= self.speed_share
        return AxisCommand(target_mm, speed_mm_s, acceleration_mm_s2, deceleration_mm_s2)


class SimulatedDrive(ABC, Generic[F]):
    """One drive and its axis; of a rotary stage the millimetres are degrees.

    A subclass says what happens by itself (`_own_due`, `_catch_up`) and what its own kinds of fault
    do (`_apply_own_fault`). Faults of the mechanics are applied here.
    """

    def __init__(
        self, name: str, mechanics: Mechanics, load: Load, faults: Iterable[F], port: DrivePort
    ):
        self.axis = SimulatedAxis(mechanics, load)
        self._drive_name = name
        self._port = port
        self._motion_faults = MotionFaults()
        self.shows_off_mm = 0.0
        """Error of the position that it shows."""
        self._shown_torque: WrongTorque | None = None
        """How the torque that it shows is wrong."""
        self._frozen_N = 0.0
        self._schedule = Schedule(faults)
        port.tasks.listen(self._schedule.hear)

    # --- the World's side ---------------------------------------------------------------------

    def position_mm(self, t_us: int) -> float:
        """Return the position of the carriage at a World time."""
        self.settle(t_us)
        return self.axis.position(t_us)

    def positions_mm(self, times_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Return the position of the carriage at ascending World times, in the shape of
        `times_us`."""
        if times_us.size:
            self.settle(int(times_us[-1]))
        return self.axis.positions(times_us)

    def highest_mm(self, begin_us: int, end_us: int) -> float:
        """Return the largest position between two World times."""
        self.settle(end_us)
        return self.axis.highest_mm(begin_us, end_us)

    def velocity_mm_s(self, t_us: int) -> float:
        """Return the speed of the carriage at a World time."""
        self.settle(t_us)
        return self.axis.velocity(t_us)

    def settle(self, now_us: int) -> None:
        """Let everything happen that was due by now, in its order and at its time.

        A load that asks for the position meanwhile gets the history as it is.
        """
        if self.axis.settling:
            return
        while (due := self._next_due(now_us)) is not None:
            t_us, happen = due
            self._catch_up(t_us)
            happen(t_us)
        self._catch_up(now_us)

    # --- what a model of drive adds -----------------------------------------------------------

    @abstractmethod
    def _catch_up(self, t_us: int) -> None:
        """React to the events of the axis up to a World time."""

    @abstractmethod
    def _apply_own_fault(self, fault: F, t_us: int, velocity_mm_s: float) -> None:
        """Apply a fault of the drive itself: its number, a limit switch, a lost reference."""

    def _shown_force_N(self, t_us: int) -> float:  # noqa: N802 - the unit keeps its capital
        """Return the force of the drive at a World time, as the torque that it shows has it."""
        force_N = self.axis.drive_force_N(t_us)
        if self._shown_torque is None:
            return force_N
        shown = {"zero": 0.0, "frozen": self._frozen_N}
        return shown.get(self._shown_torque.shows, self._shown_torque.factor * force_N)

    def _freeze_status(self) -> None:
        """From now on the drive shows the state and the position that it has now."""
        raise NotImplementedError(f"{self._drive_name} shows no status of its own")

    def _own_due(self, now_us: int) -> Due | None:
        """Return further events that are due by now, such as a communication time-out."""
        return None

    # --- faults -------------------------------------------------------------------------------

    def _next_due(self, now_us: int) -> Due | None:
        """Return the earliest of what is due by now."""
        due = [one for one in (self._own_due(now_us),) if one is not None]
        if (fault_us := self._schedule.due(now_us)) is not None:
            due.append((fault_us, self._apply_fault))
        return min(due, key=lambda one: one[0], default=None)

    def _apply_fault(self, t_us: int) -> None:
        """Apply the next fault of the plan."""
        fault = self._schedule.take()
        self._log("injected", fault.kind, "plan")
        command = None if self.axis.finished(t_us) else self.axis.command
        velocity = self.axis.velocity(t_us)
        if isinstance(fault, SlowAxis):
            self._motion_faults.speed_share = fault.share
            if command is not None:
                slower = replace(command, speed_mm_s=command.speed_mm_s * fault.share)
                self.axis.move(t_us, slower)
        elif isinstance(fault, WrongPosition):
            self.shows_off_mm = fault.by_mm
        elif isinstance(fault, WrongTorque):
            self._frozen_N = self._shown_force_N(t_us)
            self._shown_torque = fault
        elif isinstance(fault, StaleStatus):
            self._freeze_status()
        elif fault.kind == "stuck":
            self.axis.jammed = True
        elif fault.kind == "idle":
            if command is not None:
                self.axis.stop(t_us, command.deceleration_mm_s2)
            self.axis.idle = True
        elif fault.kind == "runaway":
            if command is not None:
                runs_to_mm = math.copysign(FARTHER_THAN_ANY_SWITCH_mm, velocity)
                self._motion_faults.runs_to_mm = runs_to_mm
                self.axis.move(t_us, replace(command, target_mm=runs_to_mm))
        else:
            self._apply_own_fault(fault, t_us, velocity)

    def _log(self, what: str, value: object, by: str) -> None:
        self._port.log(self._drive_name, what, value, by)
