"""The force sensor is zeroed in free air: a drift is refused, a push is waited for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from procedures.pressed.approach.tare import tare_in_free_air
from rig.core.errors import InstrumentError

RATE_S_s = 1000.0
ZERO_N = (0.98, -0.54, 1.77)
Force = Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]
"""The force along z at times in s, on top of the zero and the noise."""


class FreeAir:
    """A run whose force sensor hangs in free air, 10 s of it; nothing else is asked of it."""

    rate_S_s = RATE_S_s

    def __init__(self, force: Force, noise_N: float = 0.005, axis: int = 2):
        t = np.arange(10_000) / RATE_S_s
        self._all_N = np.random.default_rng(1).normal(ZERO_N, noise_N, (len(t), 3))
        self._all_N[:, axis] += force(t)
        self._now_s = 0.0
        self.clock: Any = self
        self.force: Any = self

    def sleep(self, seconds: float) -> None:
        self._now_s += seconds

    def latest_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> npt.NDArray[np.float64]:
        now = round(self._now_s * RATE_S_s)
        return self._all_N[max(0, now - round(seconds * RATE_S_s)) : now]

    def tare(self, seconds: float) -> tuple[float, ...]:
        return tuple(self.latest_N(seconds).mean(axis=0))


def push(at_s: float, for_s: float = 0.05, force_N: float = 30.0) -> Force:
    return lambda t: force_N * ((t >= at_s) & (t < at_s + for_s))


def drift(rate_N_s: float) -> Force:
    return lambda t: rate_N_s * t


@pytest.mark.parametrize("at_s", np.arange(0.0, 1.7, 0.05).round(2).tolist())
@pytest.mark.parametrize("force_N", [30.0, -2.0])
def test_a_push_is_no_drift_and_does_not_shift_the_zero(at_s: float, force_N: float) -> None:
    zero = tare_in_free_air(FreeAir(push(at_s, force_N=force_N)))  # type: ignore[arg-type]
    assert zero == pytest.approx(ZERO_N, abs=0.005)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("rate_N_s", "noise_N"), [(0.25, 0.005), (-2.0, 0.005), (20.0, 0.005), (-2.0, 0.1)]
)
def test_a_drift_is_refused_along_every_axis(axis: int, rate_N_s: float, noise_N: float) -> None:
    run: Any = FreeAir(drift(rate_N_s), noise_N, axis)
    with pytest.raises(InstrumentError, match=f"its zero drifts by .* along {'xyz'[axis]}"):
        tare_in_free_air(run)


@pytest.mark.parametrize("at_s", [0.2, 0.4, 0.9, 1.3])
def test_a_push_does_not_hide_a_drift(at_s: float) -> None:
    run: Any = FreeAir(lambda t: push(at_s)(t) + drift(0.5)(t))
    with pytest.raises(InstrumentError, match="its zero drifts by"):
        tare_in_free_air(run)


def test_a_force_that_is_pushed_again_and_again_is_refused() -> None:
    run: Any = FreeAir(lambda t: 3.0 * (t % 0.15 < 0.03))
    with pytest.raises(InstrumentError, match="was not steady in free air"):
        tare_in_free_air(run)


def test_much_noise_alone_is_neither() -> None:
    zero = tare_in_free_air(FreeAir(drift(0.0), noise_N=2.0))  # type: ignore[arg-type]
    assert zero == pytest.approx(ZERO_N, abs=0.6)
