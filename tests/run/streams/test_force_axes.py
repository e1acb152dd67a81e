"""One axis of a force sensor that stops measuring while the others go on."""

from __future__ import annotations

import numpy as np
import pytest

from rig.run.streams.force_axes import STUCK_FRAMES, AxisWatch

BATCH = 20
RNG = np.random.default_rng(3)


def frames(count: int, axes: str = "xyz", step: float = 0.0) -> np.ndarray:
    """Noise about a zero on these axes, 0 on the others; in steps of a coarse converter, if any."""
    raw = 0.02 + 2e-5 * RNG.standard_normal((count, 3))
    if step:
        raw = step * np.round(raw / step)
    raw[:, [axis not in axes for axis in "xyz"]] = 0.0
    return raw.astype(np.float32)


def feed(watch: AxisWatch, raw: np.ndarray) -> tuple[int, str] | None:
    """The first fault, and how many frames it took."""
    for first in range(0, len(raw), BATCH):
        if (fault := watch.fault(raw[first : first + BATCH])) is not None:
            return first + BATCH, fault
    return None


@pytest.mark.parametrize("axes", ["xyz", "z", "xz"])
def test_axes_that_measure_are_left_alone_and_axes_that_are_not_there(axes: str) -> None:
    assert feed(AxisWatch(), frames(20_000, axes)) is None


@pytest.mark.parametrize(("axes", "stuck"), [("xyz", "y"), ("xyz", "z"), ("z", "z")])
def test_an_axis_that_repeats_its_value_is_named(axes: str, stuck: str) -> None:
    watch = AxisWatch()
    assert feed(watch, frames(2000, axes)) is None
    raw = frames(2000, axes)
    raw[:, "xyz".index(stuck)] = 0.02
    found = feed(watch, raw)
    assert found is not None
    after, fault = found
    assert after <= STUCK_FRAMES + BATCH
    assert f"axis {stuck} has had the same value" in fault


def test_an_axis_that_has_been_stuck_since_the_beginning_is_named_where_it_is_known() -> None:
    raw = frames(2000, "xz")
    assert feed(AxisWatch(), raw) is None
    found = feed(AxisWatch("xyz"), raw)
    assert found is not None
    assert "axis y" in found[1]


def test_a_coarse_converter_repeats_values_and_measures_all_the_same() -> None:
    assert feed(AxisWatch(), frames(20_000, step=4e-5)) is None


def test_an_axis_without_its_noise_is_named_while_the_others_have_theirs() -> None:
    watch = AxisWatch()
    rest = frames(200)
    watch.learn(rest)
    raw = frames(1000)
    raw[:, 0] = 0.02 + 1e-9 * np.arange(1000)
    raw[:, 0] += 2e-8 * (np.arange(1000) % 2)
    found = feed(watch, raw)
    assert found is not None
    assert "axis x has" in found[1]


def test_noise_that_becomes_less_on_all_axes_is_no_fault() -> None:
    watch = AxisWatch()
    watch.learn(100 * (frames(200) - np.float32(0.02)))
    assert feed(watch, frames(2000)) is None
