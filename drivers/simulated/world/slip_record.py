"""Ground truth of the skin on its plate: times of touch-down, of each ridge's slip and of gross
slip.

Works on the nodes' statuses and the plate's position, block by block. A touch is judged from the
moment on at which the plate moves after the touch-down, or after the point was announced: while the
force grows, nodes at the contact's edge slip in any trial. World times in us.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from rig.physics.contact.stepper import OPEN
from rig.physics.contact.truth import SlipWatch, WholeSlips, slips_whole

Statuses = npt.NDArray[np.int8]
Reals = npt.NDArray[np.float64]


@dataclass
class _Slide:
    """The motion of a touching plate, from its first step on."""

    from_us: int
    watch: SlipWatch
    reported: set[int] = field(default_factory=set)
    """Ridges whose slip was logged, from 1; 0 stands for all of the skin."""
    slips: WholeSlips = field(default_factory=WholeSlips)
    """Slips of the watched ridge."""

    def us(self, seconds: float) -> int | None:
        """World time of an instant of the watch, None for never."""
        return self.from_us + round(seconds * 1e6) if np.isfinite(seconds) else None


class SlipRecord:
    """Slips since the last announced point; after several touches, those of the last one."""

    def __init__(
        self,
        ridge_of_node: npt.NDArray[np.int64],
        watched_ridge: int,
        step_us: int,
        report: Callable[[str, object], None],
    ):
        """Record the contact of the skin. `watched_ridge` is a number from 0; `report` logs each
        event by name, with its value."""
        self._ridge_of_node = ridge_of_node
        self._watched = watched_ridge
        self._step_us = step_us
        self._report = report
        self._touching = False
        self._since_us = 0
        self._touch_downs: list[int] = []
        self._lift_offs: list[int] = []
        self._ridge_touching = False
        self._ridge_lifts: list[int] = []
        self._rest_mm: float | None = None
        """Position of the plate when the present touch, or the point, began."""
        self._slide: _Slide | None = None
        self._done = 0
        """Steps before those that wait."""
        self._waiting: list[tuple[Statuses, Reals]] = []

    def begin(self, t_us: int) -> None:
        """Begin a new point: earlier slips are forgotten."""
        self.judge()
        self._since_us = t_us
        self._touch_downs, self._lift_offs, self._ridge_lifts = [], [], []
        self._rest_mm = self._slide = None

    def add(self, done: int, status: Statuses, plate_mm: Reals) -> None:
        """Take the statuses (k, nodes) and the plate's positions (k,), as the stage means them, of
        the steps that follow the first `done`; `judge` evaluates them."""
        if not self._waiting:
            self._done = done
        self._waiting.append((status, plate_mm))

    def judge(self) -> None:
        """Look for touch-downs, lift-offs and slips in what was added since the last call, and log
        what is found."""
        if not self._waiting:
            return
        status, plate_mm = (np.concatenate(part) for part in zip(*self._waiting, strict=True))
        self._waiting, done = [], self._done
        self._follow_ridge(done, status)
        touching = (status != OPEN).any(axis=1)
        before = np.concatenate([[self._touching], touching[:-1]])
        changes = np.flatnonzero(touching != before)
        for begin, end in pairwise([0, *changes.tolist(), touching.size]):
            if begin == end:
                continue
            if touching[begin] != self._touching:
                self._turn(done + begin)
            if self._touching:
                self._follow(done + begin, status[begin:end], plate_mm[begin:end])

    def _follow_ridge(self, done: int, status: Statuses) -> None:
        """Record when the watched ridge loses contact, whatever the other ridges do."""
        touching = (status[:, self._ridge_of_node == self._watched] != OPEN).any(axis=1)
        before = np.concatenate([[self._ridge_touching], touching[:-1]])
        for step in np.flatnonzero(before & ~touching).tolist():
            self._ridge_lifts.append((done + step + 1) * self._step_us)
        self._ridge_touching = bool(touching[-1])

    def truth(self) -> dict[str, Any]:
        """Return everything known since the point was announced, as JSON: times in us of World
        time, null where it did not happen; lists by ridge, the first ridge first."""
        self.judge()
        slide, never = self._slide, [None] * (int(self._ridge_of_node.max()) + 1)
        seen = None if slide is None else slide.watch.truth()
        return {
            "since_us": self._since_us,
            "touch_down_us": self._touch_downs,
            "lift_off_us": self._lift_offs,
            "slide_us": None if slide is None else slide.from_us,
            "ridge": self._watched + 1,
            "ridge_lift_off_us": self._ridge_lifts,
            "first_slip_us": [*map(slide.us, seen.first_slip_s)] if slide and seen else never,
            "whole_slip_us": [*map(slide.us, seen.whole_slip_s)] if slide and seen else never,
            "gross_slip_us": slide.us(seen.gross_slip_s) if slide and seen else None,
            "ridge_slip_begins_us": [] if slide is None else list(slide.slips.begins_us),
            "ridge_slip_ends_us": [] if slide is None else list(slide.slips.ends_us),
        }

    def _turn(self, step: int) -> None:
        """Take note that the skin touches the plate in the step after `step`, or no longer does."""
        at_us = (step + 1) * self._step_us
        self._touching = not self._touching
        if self._touching:
            self._rest_mm = self._slide = None
        (self._touch_downs if self._touching else self._lift_offs).append(at_us)
        self._report("touch-down" if self._touching else "lift-off", {"at_us": at_us})

    def _follow(self, step: int, status: Statuses, plate_mm: Reals) -> None:
        """Statuses of steps in touch; those from the first motion on are judged."""
        if self._slide is None:
            if self._rest_mm is None:
                self._rest_mm = float(plate_mm[0])
            moved = np.flatnonzero(plate_mm != self._rest_mm)
            if not moved.size:
                return
            first = int(moved[0])
            watch = SlipWatch(self._ridge_of_node, self._step_us * 1e-6)
            self._slide = _Slide((step + first) * self._step_us, watch)
            status, step = status[first:], step + first
        slips = slips_whole(status, self._ridge_of_node, self._watched)
        self._slide.slips.add((step + 1) * self._step_us, self._step_us, slips)
        if len(self._slide.reported) > int(self._ridge_of_node.max()) + 1:
            return  # every ridge has slipped once, and all of them together
        self._slide.watch.add(status)
        self._log_slips(self._slide)

    def _log_slips(self, slide: _Slide) -> None:
        truth = slide.watch.truth()
        found = {ridge + 1: at for ridge, at in enumerate(truth.whole_slip_s) if np.isfinite(at)}
        for ridge in sorted(found.keys() - slide.reported, key=lambda one: (found[one], one)):
            slide.reported.add(ridge)
            self._report("slip", {"ridge": ridge, "at_us": slide.us(found[ridge])})
        if np.isfinite(truth.gross_slip_s) and 0 not in slide.reported:
            slide.reported.add(0)
            self._report("gross-slip", {"at_us": slide.us(truth.gross_slip_s)})
