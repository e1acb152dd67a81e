"""The head on the rotary stage in the World: it rolls as the model's trial does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from drivers.simulated.world.contact_geometry import Where
from drivers.simulated.world.plate_world import HeadWorldSettings, mount_skin
from drivers.simulated.world.world import World
from rig.core.cache import DiskCache
from rig.physics.contact.settings import Sphere
from rig.physics.contact.slices import SlicedStepper, hertz_force
from rig.physics.skin.condensed import CondensedSkin

QUIET = {"noise_density_V_sqrtHz": 0.0, "mains_amplitude_mV": 0.0}
CONTACT_mm, CENTRE_mm, UPRIGHT_deg = 12.4, 10.0, 15.0
ROLLER = {"body": {"shape": "cylinder", "radius_mm": 30.0}}


@pytest.fixture(autouse=True)
def cached(monkeypatch: pytest.MonkeyPatch, skin_cache: DiskCache, skin6: CondensedSkin) -> None:
    """The World finds its skin where these tests keep it."""
    monkeypatch.setenv("RIG_CACHE", str(skin_cache.folder))


class Curve:
    """A stage that follows a function of World times in us."""

    def __init__(self, positions_mm: Where):
        self.positions_mm = positions_mm

    def highest_mm(self, begin_us: int, end_us: int) -> float:
        return float(self.positions_mm(np.arange(begin_us, end_us + 1, 100)).max())


class Rolled:
    """A skin above a head; the stages follow given curves of World time in s."""

    def __init__(self, head: dict[str, Any], approach, x_mm, angle_deg):
        given = {"skin": {"elements_per_ridge": 6}, "strip_input": QUIET, "head": head}
        settings = HeadWorldSettings.model_validate(given)
        self.world = World(settings, 0, slaved=True)
        mount_skin(
            self.world,
            settings,
            Curve(lambda t: CONTACT_mm + approach(t * 1e-6)),
            Curve(lambda t: CENTRE_mm + x_mm(t * 1e-6)),
            lambda t: UPRIGHT_deg + angle_deg(t * 1e-6),
        )

    def run(self, seconds: float, step_us: int = 10_000) -> Rolled:
        for _ in range(round(seconds * 1e6) // step_us):
            self.world.timeline.advance(step_us)
            self.world.settle()
        return self

    def force(self, *times_s: float) -> np.ndarray:
        return self.world.force_N(np.array(times_s))


def pressed(depth_mm: float):
    """Down within 0.2 s, along a line."""
    return lambda t: np.clip(t / 0.2, 0, 1) * (depth_mm + 0.05) - 0.05


def rolled(angle_deg: float):
    """Upright until 0.3 s, turned at 0.7 s."""
    return lambda t: angle_deg * (1 - np.cos(np.pi * np.clip((t - 0.3) / 0.4, 0, 1))) / 2


def still(value: float):
    return lambda t: np.full(t.shape, value)


def giving_way(depth_mm: float, turn, offset_mm: float = 0.0):
    """z takes back what the turn lifts the head by."""
    press = pressed(depth_mm)
    return lambda t: press(t) - (30.0 + offset_mm) * (1 - np.cos(np.radians(turn(t))))


@pytest.mark.parametrize("x0", [-6.5, -5.0])
def test_pure_rolling_drags_the_skin_little(x0):
    turn = rolled(3.5)
    world = Rolled({**ROLLER, "axis_offset_mm": 0.0}, giving_way(0.13, turn), still(x0), turn)
    force = world.run(0.8).force(0.3, 0.5, 0.75)
    assert (force[:, 2] > 2.0).all()
    assert np.abs(force[:, 0]).max() < 0.06 * force[:, 2].max()


@pytest.mark.thorough
def test_an_offset_axis_shears_and_x_can_take_it_back():
    turn, head = rolled(3.5), {**ROLLER, "axis_offset_mm": 2.0}
    sheared = Rolled(head, pressed(0.1), still(-5.0), turn).run(0.8).force(0.75)[0]

    def back(t):
        return -5.0 - 2.0 * np.sin(np.radians(turn(t)))

    taken_back = Rolled(head, pressed(0.1), back, turn).run(0.8).force(0.75)[0]
    assert sheared[0] > 5 * abs(taken_back[0])


def test_a_turn_presses_the_head_up():
    turned = Rolled({**ROLLER, "axis_offset_mm": 0.0}, pressed(0.05), still(-5.0), rolled(3.5))
    before, after = turned.run(0.8).force(0.3, 0.75)[:, 2]
    assert after > 2 * before


def test_blocks_of_time_do_not_matter():
    def one(step_us):
        made = Rolled({**ROLLER}, pressed(0.1), still(-6.0), rolled(3.5)).run(0.8, step_us)
        return made.force(*np.arange(0.1, 0.8, 0.05))

    np.testing.assert_allclose(one(10_000), one(1000), atol=1e-9)


def test_a_ridge_that_the_head_leaves_is_reported():
    """From the third ridge on to the last but one: it is left on the way."""
    turn = rolled(12.0)
    world = Rolled({**ROLLER, "axis_offset_mm": 0.0}, giving_way(0.03, turn), still(-4.0), turn)
    world.world.announce(0, 0)
    truth = world.run(0.8).world.truth()
    assert truth["lift_off_us"] == []
    (left,) = truth["ridge_lift_off_us"]
    assert 0.3e6 < left < 0.7e6


def test_a_sphere_carries_more_than_its_slices_were_laid_out_for(skin6):
    stepper = SlicedStepper(skin6, settings := HeadWorldSettings().contact, Sphere(), beyond=True)
    depth = 1.5
    block = stepper.advance([depth], [0.0], normal_control="position")
    assert block.normal_force_N[0] == pytest.approx(
        float(hertz_force(skin6.settings, 30.0, depth)), rel=1e-6
    )
    with pytest.raises(ValueError, match="must be at most"):
        SlicedStepper(skin6, settings, Sphere()).advance([depth], [0.0], normal_control="position")


def test_a_plate_as_head_is_refused():
    with pytest.raises(ValueError, match="cannot roll"):
        HeadWorldSettings.model_validate({"head": {"body": {"shape": "plate"}}})
