"""Settings of a path trial."""

from __future__ import annotations

from itertools import pairwise

from pydantic import Field, model_validator

from procedures.path_trial.path import Course, moves_along
from procedures.pressed.grip import GripSettings

LEAST_SHARE = 0.1
"""Smallest share of the normal force that a course may ask for: with less, the object is no longer
held, and the servo would search for it."""
LEAST_TIME_S = 0.001
"""Shortest time from one corner to the next; the servo's ticks are longer."""


class PathTrialSettings(GripSettings):
    """Settings of a path trial."""

    path_times_s: tuple[float, ...] = ()
    """Times of the path of x, ascending from 0. Without any, x rests."""
    path_positions_mm: tuple[float, ...] = ()
    """Positions of x at these times, from 0, the start; straight in between."""
    force_times_s: tuple[float, ...] = ()
    """Times of the course of the normal force, ascending from 0. Without any, it is constant."""
    force_shares: tuple[float, ...] = ()
    """Set points at these times as shares of --normal-force, from 1; straight in between."""
    stay_s: float = Field(default=0.3, ge=0, le=600)
    """Time under the held force after the end of path and course."""
    start_mm: float = 10.0
    """Position of the x stage at which a trial begins."""

    @model_validator(mode="after")
    def _can_be_followed(self) -> PathTrialSettings:
        for times, values, first, what in (
            (self.path_times_s, self.path_positions_mm, 0.0, ("path_times_s", "path_positions_mm")),
            (self.force_times_s, self.force_shares, 1.0, ("force_times_s", "force_shares")),
        ):
            if len(times) != len(values):
                raise ValueError(
                    f"{what[0]} has {len(times)} values, {what[1]} has {len(values)}: each time "
                    "needs its value"
                )
            if not times:
                continue
            gaps = [later - earlier for earlier, later in pairwise(times)]
            if len(times) < 2 or times[0] != 0 or min(gaps) < LEAST_TIME_S:
                raise ValueError(
                    f"{what[0]} must ascend from 0 in steps of at least {LEAST_TIME_S:g} s and "
                    "have at least 2 times"
                )
            if values[0] != first:
                raise ValueError(f"{what[1]} must begin with {first:g}, not {values[0]:g}")
        if self.force_shares and min(self.force_shares) < LEAST_SHARE:
            raise ValueError(
                f"force_shares has {min(self.force_shares):g}, less than {LEAST_SHARE:g}: the "
                "object would no longer be held"
            )
        if self.largest_held_N >= self.largest_force_N:
            raise ValueError(
                f"force_shares up to {self.largest_share:g} ask for {self.largest_held_N:g} N, "
                f"which is not below largest_force_N {self.largest_force_N:g} N"
            )
        return self

    @property
    def largest_held_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Largest set point of the course, in N, with every step of the grip."""
        return self.largest_share * self.normal_force_N + self.most_raised_N

    @property
    def path(self) -> Course:
        """Path of x: positions in mm from the start at times in s; empty where x rests."""
        return Course(self.path_times_s, self.path_positions_mm)

    @property
    def force(self) -> Course:
        """Course of the normal force, as shares of `normal_force_N`."""
        return Course(self.force_times_s, self.force_shares)

    @property
    def largest_share(self) -> float:
        """Largest share of the normal force that is asked for."""
        return max(self.force_shares, default=1.0)

    @property
    def duration_s(self) -> float:
        """Time of path and course, and of the stay after them."""
        return max(self.path.duration_s, self.force.duration_s) + self.stay_s

    @property
    def reach_mm(self) -> tuple[float, float]:
        """Positions of x between which the path lies."""
        positions = self.path_positions_mm or (0.0,)
        return self.start_mm + min(positions), self.start_mm + max(positions)

    @property
    def speeds_mm_s(self) -> tuple[float, ...]:
        """Slowest and fastest speed of x along the path; empty if it rests."""
        speeds = [move.speed_mm_s for move in moves_along(self.path)]
        return (min(speeds), max(speeds)) if speeds else ()

    @property
    def largest_speed_step_mm_s(self) -> float:
        """Largest change of the speed of x at a corner of its path, or where it begins or ends. A
        reversal changes it by both speeds, also over a rest in which the stage cannot stop."""
        stop_s = max(self.speeds_mm_s, default=0.0) / self.acceleration_mm_s2
        speeds_mm_s = [0.0]
        corners = zip(self.path_times_s, self.path_positions_mm, strict=True)
        for (from_s, from_mm), (to_s, to_mm) in pairwise(corners):
            if to_mm != from_mm or to_s - from_s >= stop_s:
                speeds_mm_s.append((to_mm - from_mm) / (to_s - from_s))
        return max(abs(after - before) for before, after in pairwise([*speeds_mm_s, 0.0]))
