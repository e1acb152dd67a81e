"""The way from contact to the preload, on a film that is a spring and a force that comes late."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from procedures import preload
from rig.instruments import Reach

CONTACT_mm, TARGET_N = 12.6, 25.0
REACH = Reach(0.0, 14.0, "mm", "stage_z")


class Bench:
    """Stage, film, sensor and clock: time passes in ms, the force is known `late_ms` afterwards."""

    def __init__(self, stiffness_N_mm: float, late_ms: int):
        self.stiffness_N_mm = stiffness_N_mm
        self.now_ms = 0
        self.position, self.target, self.speed = CONTACT_mm, 13.0, preload.APPROACH_mm_s
        self.known = deque([preload.CONTACT_N] * (late_ms + 1), maxlen=late_ms + 1)
        self.farthest_ahead_mm = 0.0

    def now(self) -> float:
        return 1e-3 * self.now_ms

    def sleep(self, seconds: float) -> None:
        for _ in range(round(1e3 * seconds)):
            self.now_ms += 1
            step = 1e-3 * self.speed
            self.position += min(max(self.target - self.position, -step), step)
            self.known.append(
                preload.CONTACT_N + self.stiffness_N_mm * (self.position - CONTACT_mm)
            )

    def mean_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> np.ndarray:
        return np.array([0.0, 0.0, self.known[0]])

    def position_mm(self) -> float:
        return self.position

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        self.target, self.speed = position_mm, speed_mm_s
        self.farthest_ahead_mm = max(self.farthest_ahead_mm, position_mm - self.position)

    def reach(self) -> dict[str, Reach]:
        return {"position": REACH}


@pytest.mark.parametrize("late_ms", [5, 60])
@pytest.mark.parametrize("stiffness_N_mm", [30.0, 250.0])
def test_a_late_force_neither_ends_the_way_to_the_preload_nor_sends_the_stage_far_ahead(
    stiffness_N_mm: float, late_ms: int
) -> None:
    bench = Bench(stiffness_N_mm, late_ms)
    run = SimpleNamespace(bench=SimpleNamespace(stage_z=bench), clock=bench, force=bench)
    pressed = preload._press_from(run, CONTACT_mm, TARGET_N)  # type: ignore[arg-type]
    assert pressed.reached_N == pytest.approx(TARGET_N, rel=0.02)
    assert bench.farthest_ahead_mm <= 0.051
    assert max(bench.known) < 1.1 * TARGET_N
