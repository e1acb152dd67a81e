"""Ground truth of a trial: which ridge slipped first, which slipped as a whole, when everything
slipped.

It uses node statuses alone, block by block, so that a running bench and a finished trial are judged
by the same code.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rig.physics.contact.stepper import OPEN, STICK, Statuses

Floats = NDArray[np.float64]

STUCK_us = 5000
"""A ridge that has not slipped as a whole for this long slips again; a shorter stop is part of the
same slip."""


@dataclass
class WholeSlips:
    """Every slip of a ridge as a whole, in us."""

    begins_us: list[int] = field(default_factory=list)
    ends_us: list[int] = field(default_factory=list)
    """One fewer while the ridge slips."""

    def add(self, first_us: int, step_us: int, slips: NDArray[np.bool_]) -> None:
        """Add whether the ridge slipped in each of the next steps, the first of which ended at
        `first_us`."""
        slipping = len(self.begins_us) > len(self.ends_us)
        before = np.concatenate([[slipping], slips[:-1]])
        for step in np.flatnonzero(slips != before).tolist():
            at_us = first_us + step * step_us
            if not slips[step]:
                self.ends_us.append(at_us)
            elif self.ends_us and at_us - self.ends_us[-1] < STUCK_us:
                self.ends_us.pop()
            else:
                self.begins_us.append(at_us)


def slips_whole(
    status: Statuses, ridge_of_node: NDArray[np.int64], ridge: int
) -> NDArray[np.bool_]:
    """Return in which of k steps, by their statuses (k, nodes), a ridge (from 0) slips as a whole:
    every node of it that is in contact slips, and at least one is in contact, (k,)."""
    nodes = status[:, ridge_of_node == ridge]
    slips: NDArray[np.bool_] = (nodes != OPEN).any(axis=1) & (nodes != STICK).all(axis=1)
    return slips


@dataclass(frozen=True)
class SlipTruth:
    """Times of slip in s from the start of the trial; NaN where it did not happen."""

    first_slip_s: Floats
    """Slip of the first node of each ridge, (ridges,)."""
    whole_slip_s: Floats
    """First time at which every node of the ridge that is in contact slips, (ridges,)."""
    lift_off_s: Floats
    """First time at which a ridge loses contact, (ridges,)."""
    gross_slip_s: float
    """First time at which every node of the skin that is in contact slips."""

    def slip_order(self) -> list[int]:
        """Return the ridges (1 is the leftmost) that slipped as a whole, earliest first."""
        order = np.argsort(self.whole_slip_s, kind="stable")
        return [int(r) + 1 for r in order if np.isfinite(self.whole_slip_s[r])]


class SlipWatch:
    """Collects the truth from blocks of statuses. Slip before `since_s` is ignored.

    While the normal force rises, nodes at the edge of the contact slip in any trial. A slide or
    roll is therefore judged from the start of its motion.
    """

    def __init__(self, ridge_of_node: NDArray[np.int64], step_s: float, since_s: float = 0.0):
        ridges = int(ridge_of_node.max()) + 1
        self._on_ridge = (ridge_of_node[:, None] == np.arange(ridges)).astype(np.float32)
        """1 for each node and ridge if the node lies on the ridge, else 0, (nodes, ridges)."""
        self._step_s = step_s
        self._since_s = since_s
        self._steps = 0
        self._first = np.full(ridges, np.nan)
        self._whole = np.full(ridges, np.nan)
        self._lifted = np.full(ridges, np.nan)
        self._touched = np.zeros(ridges, bool)
        self._gross = np.full(1, np.nan)

    def add(self, status: Statuses) -> None:
        """Add the statuses (k, m) of the next k steps."""
        time = np.arange(self._steps + 1.0, self._steps + status.shape[0] + 1.0) * self._step_s
        self._steps += status.shape[0]
        if not time.size:
            return
        judged = (time >= self._since_s - self._step_s / 2)[:, None]
        sticks, touches = status == STICK, status != OPEN
        slipping, touching, sticking = map(self._by_ridge, (status > STICK, touches, sticks))
        before = np.concatenate([self._touched[None], touching[:-1]])
        self._touched = touching[-1]
        _note(self._first, time, judged & slipping)
        _note(self._whole, time, judged & touching & ~sticking)
        _note(self._lifted, time, judged & before & ~touching)
        gross = judged[:, 0] & touches.any(axis=1) & ~sticks.any(axis=1)
        _note(self._gross, time, gross[:, None])

    def _by_ridge(self, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return whether any node of a ridge has a property: (k, nodes) to (k, ridges)."""
        anywhere: NDArray[np.bool_] = seen.astype(np.float32) @ self._on_ridge > 0
        return anywhere

    def truth(self) -> SlipTruth:
        """Return the truth found so far."""
        return SlipTruth(
            self._first.copy(), self._whole.copy(), self._lifted.copy(), float(self._gross[0])
        )


def _note(kept: Floats, time: Floats, seen: NDArray[np.bool_]) -> None:
    """Store in `kept` (n,) when each of n things was first seen: times (k,), seen (k, n)."""
    fresh = np.isnan(kept) & seen.any(axis=0)
    kept[fresh] = time[seen.argmax(axis=0)[fresh]]
