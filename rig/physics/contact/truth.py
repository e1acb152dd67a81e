"""Ground truth of a trial: which ridge slipped first, which slipped whole, when all slipped.

Works on node statuses alone, block by block, so that a running bench and a finished trial are
judged by the same code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.physics.contact.stepper import OPEN, STICK, Statuses

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SlipTruth:
    """Times in s from the trial's start; NaN where it did not happen."""

    first_slip_s: Floats
    """First slipping node of each ridge, (ridges,)."""
    whole_slip_s: Floats
    """First time every node of the ridge that touches slips, (ridges,)."""
    lift_off_s: Floats
    """First time a ridge that touched no longer does, (ridges,)."""
    gross_slip_s: float
    """First time every node of the skin that touches slips."""

    def slip_order(self) -> list[int]:
        """Ridges (1 is the leftmost) that slipped whole, earliest first."""
        order = np.argsort(self.whole_slip_s, kind="stable")
        return [int(r) + 1 for r in order if np.isfinite(self.whole_slip_s[r])]


class SlipWatch:
    """Collects the truth from blocks of statuses; nothing before `since_s` counts.

    While the normal force grows, nodes at the contact's edge slip in any trial; a slide or roll is
    therefore judged from the start of its motion on.
    """

    def __init__(self, ridge_of_node: NDArray[np.int64], step_s: float, since_s: float = 0.0):
        ridges = int(ridge_of_node.max()) + 1
        self._on_ridge = (ridge_of_node[:, None] == np.arange(ridges)).astype(np.float32)
        """Of each node and ridge whether it lies on it: 1 or 0."""
        self._step_s = step_s
        self._since_s = since_s
        self._steps = 0
        self._first = np.full(ridges, np.nan)
        self._whole = np.full(ridges, np.nan)
        self._lifted = np.full(ridges, np.nan)
        self._touched = np.zeros(ridges, bool)
        self._gross = np.full(1, np.nan)

    def add(self, status: Statuses) -> None:
        """Take the statuses (k, m) of the next k steps."""
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
        """Whether it is so anywhere on a ridge: (k, nodes) to (k, ridges)."""
        anywhere: NDArray[np.bool_] = seen.astype(np.float32) @ self._on_ridge > 0
        return anywhere

    def truth(self) -> SlipTruth:
        """What was seen so far."""
        return SlipTruth(
            self._first.copy(), self._whole.copy(), self._lifted.copy(), float(self._gross[0])
        )


def _note(kept: Floats, time: Floats, seen: NDArray[np.bool_]) -> None:
    """Keep, in (n,), when each of n things was seen first: times (k,), seen (k, n)."""
    fresh = np.isnan(kept) & seen.any(axis=0)
    kept[fresh] = time[seen.argmax(axis=0)[fresh]]
