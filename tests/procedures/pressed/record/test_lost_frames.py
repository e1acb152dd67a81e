"""Frames without a number: that some are lost is seen by the time of all that follow."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from procedures.pressed.record.lost_frames import COMPARED_LOOKS, lost_frames

RATE_S_S = 1000.0
TICK_s = 0.01


def looks(
    delay_s: npt.NDArray[np.float64], lost: int = 0, from_s: float = 1.0, clock_ppm: float = 0.0
) -> npt.NDArray[np.float64]:
    """A look every tick at a stream of which each frame comes `delay_s` late, (n,), and `lost`
    frames are missing from `from_s` on."""
    times_s = TICK_s * np.arange(len(delay_s))
    due = np.maximum(0, (times_s - delay_s) * RATE_S_S * (1 + 1e-6 * clock_ppm))
    return np.stack([times_s, np.floor(due) - lost * (times_s > from_s)], axis=1)


def usual(seed: int, ticks: int = 300) -> npt.NDArray[np.float64]:
    """Delays of frames that come in packets of up to 16 ms."""
    return np.random.default_rng(seed).uniform(0.0, 0.016, ticks)


@pytest.mark.parametrize("lost", [2, 10, 24, 60])
def test_frames_that_are_lost_are_counted(lost: int) -> None:
    assert lost_frames(looks(np.full(300, 0.001), lost), RATE_S_S) == lost
    for seed in range(5):
        assert lost_frames(looks(usual(seed), lost + 8), RATE_S_S) == pytest.approx(lost + 8, abs=1)


def test_packets_late_bursts_and_a_wrong_clock_are_no_loss() -> None:
    for seed in range(20):
        delay_s = usual(seed)
        assert lost_frames(looks(delay_s), RATE_S_S) == 0
        delay_s[100:130] += 0.3  # a computer that was busy; then all come at once
        assert lost_frames(looks(delay_s), RATE_S_S) == 0
    assert lost_frames(looks(usual(0, 20_000), clock_ppm=-200), RATE_S_S) == 0


def test_a_loss_in_the_last_tick_shows_in_the_looks_after_the_record() -> None:
    recorded = looks(np.full(300, 0.001), 10, from_s=2.975)
    assert lost_frames(recorded, RATE_S_S) == 0  # it may still be on its way
    later = np.stack([4 + 0.02 * np.arange(COMPARED_LOOKS)] * 2, axis=1) * [1, RATE_S_S] - [0, 11]
    assert lost_frames(np.concatenate([recorded, later]), RATE_S_S) == 10


def test_a_record_without_looks_has_lost_nothing() -> None:
    assert lost_frames([], RATE_S_S) == 0
