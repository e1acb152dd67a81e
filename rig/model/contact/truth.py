"""Ground truth of a trial: which ridge slipped first, which slipped whole, when all slipped.

Works on node statuses alone, block by block, so that a running bench and a finished trial are
judged by the same code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.model.contact.stepper import OPEN, STICK, Statuses

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
        self._ridge = ridge_of_node
        self._step_s = step_s
        self._since_s = since_s
        self._steps = 0
        ridges = int(ridge_of_node.max()) + 1
        self._first = np.full(ridges, np.nan)
        self._whole = np.full(ridges, np.nan)
        self._lifted = np.full(ridges, np.nan)
        self._touched = np.zeros(ridges, bool)
        self._gross = np.nan

    def add(self, status: Statuses) -> None:
        """Take the statuses (k, m) of the next k steps."""
        time = np.arange(self._steps + 1.0, self._steps + status.shape[0] + 1.0) * self._step_s
        self._steps += status.shape[0]
        judged = time >= self._since_s - self._step_s / 2
        slips, touches = status > STICK, status != OPEN
        for ridge in range(self._first.size):
            nodes = self._ridge == ridge
            slipping = slips[:, nodes].any(axis=1)
            touching = touches[:, nodes].any(axis=1)
            sticking = (status[:, nodes] == STICK).any(axis=1)
            self._note(self._first, ridge, time, judged & slipping)
            self._note(self._whole, ridge, time, judged & touching & ~sticking)
            before = np.concatenate([[self._touched[ridge]], touching[:-1]])
            self._note(self._lifted, ridge, time, judged & before & ~touching)
            if touching.size:
                self._touched[ridge] = touching[-1]
        gross = judged & touches.any(axis=1) & ~(status == STICK).any(axis=1)
        if np.isnan(self._gross) and gross.any():
            self._gross = float(time[gross.argmax()])

    def truth(self) -> SlipTruth:
        """What was seen so far."""
        return SlipTruth(
            self._first.copy(), self._whole.copy(), self._lifted.copy(), float(self._gross)
        )

    @staticmethod
    def _note(kept: Floats, ridge: int, time: Floats, seen: NDArray[np.bool_]) -> None:
        if np.isnan(kept[ridge]) and seen.any():
            kept[ridge] = time[seen.argmax()]
