"""The skin on a plate while x follows a path and the normal force follows a course.

It makes the motions that a hand makes apart from a plain slide: a hold close to slip, a motion back
and forth, tremor, a firmer grip, a grip that loosens, a knock. Path and course are straight
between their corners and begin together. z holds the force by its servo all the time, tick by tick;
x is given a new move in the tick after each corner of its path, with the acceleration of its drive.
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


LATE_S, BESIDE_mm = 0.02, 0.02
"""Delay of x in following, in addition to two ticks and the largest change of its speed, and
distance from its path, both of which have to be exceeded for a warning."""


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
        farthest_mm = 0.0

        def follow(tick: Tick) -> bool:
            nonlocal begun_s, farthest_mm
            if begun_s is None:
                begun_s = tick.began_s
            since_s = tick.began_s - begun_s
            look = x.latest  # taken once: the link's worker replaces it at any time
            if look.asked_s >= begun_s:
                wanted_mm = settings.path.at(look.at_s - begun_s, 0.0)
                beside_mm = look.position_mm - settings.start_mm - wanted_mm
                farthest_mm = max(farthest_mm, abs(beside_mm))
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
        self._warn_of_lag(trial, farthest_mm)

    def _warn_of_lag(self, trial: PressedTrial, farthest_mm: float) -> None:
        """Record a warning where x did not follow its path."""
        settings = self.settings
        if not settings.speeds_mm_s:
            return
        fastest_mm_s = settings.speeds_mm_s[-1]
        turn_s = settings.largest_speed_step_mm_s / settings.acceleration_mm_s2
        late_s = 2 * trial.series.rates.tick_s + turn_s + LATE_S
        if farthest_mm > max(late_s * fastest_mm_s, BESIDE_mm):
            trial.run.event(
                "warning",
                "path-lag",
                f"{trial.record.point}: x was up to {farthest_mm:.2g} mm away from its path, more "
                f"than {1e3 * late_s:.0f} ms at {fastest_mm_s:.3g} mm/s. It did not move as it was "
                "asked to; check what slows the stage, and whether its drive has the acceleration "
                f"of {settings.acceleration_mm_s2:g} mm/s^2 that --acceleration states, or ask for "
                "a slower path",
            )

    def reading(self, record: MotionRecord) -> Mapping[str, Any]:
        """Return the extremes of the forces."""
        return {
            "largest_tangential_N": abs(record.tangential_N).max(),
            "smallest_normal_N": record.normal_N.min(),
            "largest_normal_N": record.normal_N.max(),
        }
