"""The skin on a plate while x follows a path and the normal force follows a course.

It makes the motions that a hand makes beside a plain slide: a hold close to slip, a motion to and
fro, tremor, a firmer grip, a grip that loosens, a knock. Path and course are straight between their
corners and begin together. z holds the force by its servo all the time, tick by tick; x is given a
new move in the tick after each corner of its path, with the acceleration of its drive.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from procedures.path_trial.path import moves_along
from procedures.path_trial.settings import PathTrialSettings
from procedures.pressed import PressedProcedure
from rig.files.journal.layout import Column
from rig.run.points import Move

if TYPE_CHECKING:
    from procedures.pressed.record.motion import MotionRecord
    from procedures.pressed.trial import PressedTrial
    from rig.bench.settings import FixtureSettings
    from rig.control.tick_loop import Tick


class PathTrial(PressedProcedure):
    """Move the skin along a path on a plate while the normal force follows a course."""

    name = "path-trial"
    fixtures = ("plate",)
    force_axes = "xz"
    Settings = PathTrialSettings
    columns = (
        Column("largest_tangential", "N", "Largest tangential force of the motion, in size"),
        Column("smallest_normal", "N", "Smallest normal force of the motion"),
        Column("largest_normal", "N", "Largest normal force of the motion"),
    )
    summary_labels = MappingProxyType(
        {
            **PressedProcedure.summary_labels,
            "mean_largest_tangential_N": "largest tangential force",
            "mean_smallest_normal_N": "smallest normal force",
            "mean_largest_normal_N": "largest normal force",
        }
    )

    settings: PathTrialSettings

    def motion_s(self) -> float:
        """Return the time of path, course and stay."""
        return self.settings.duration_s

    def start_mm(self, fixture: FixtureSettings) -> float:
        """Return where x begins: the setting, whatever the fixture."""
        return self.settings.start_mm

    def moves(self) -> tuple[Move, ...]:
        """Return the ends of the path and its speeds, to be checked before anything moves."""
        settings = self.settings
        names = ("start_mm", "path_positions_mm")
        ends = tuple(Move("stage_x.position", at_mm, names) for at_mm in settings.reach_mm)
        speeds = tuple(
            Move("stage_x.speed", speed_mm_s, ("path_positions_mm", "path_times_s"))
            for speed_mm_s in settings.speeds_mm_s
        )
        return (*ends, *speeds)

    def under_force(self, trial: PressedTrial) -> None:
        """Let x follow the path and the held force the course, from the same tick on."""
        settings, x = self.settings, trial.x
        course, waiting = settings.force, list(moves_along(settings.path))
        begun_s: float | None = None

        def follow(tick: Tick) -> bool:
            nonlocal begun_s
            if begun_s is None:
                begun_s = tick.began_s
            since_s = tick.began_s - begun_s
            trial.hold_at(settings.normal_force_N * course.at(since_s, 1.0))
            trial.hold_tick(tick)
            due = None
            # Corners that a late tick has missed are passed over: only the latest move is sent.
            while waiting and waiting[0].at_s <= since_s:
                due = waiting.pop(0)
            if due is not None:
                x.start_move(settings.start_mm + due.to_mm, due.speed_mm_s)
            return True

        x.in_motion = bool(waiting)
        trial.run_ticks(settings.duration_s, follow)

    def reading(self, record: MotionRecord) -> Mapping[str, Any]:
        """Return the extremes of the forces."""
        return {
            "largest_tangential_N": abs(record.tangential_N).max(),
            "smallest_normal_N": record.normal_N.min(),
            "largest_normal_N": record.normal_N.max(),
        }
