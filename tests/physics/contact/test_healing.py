"""Friction that heals at rest: static peaks, stick-slip and several slips, against closed forms.

The closed forms are those of a rigid block. The block here is one narrow ridge of a rubber a
thousand times stiffer than the skin's: it touches with one node and moves as a whole.
"""

import numpy as np
import pytest
from scipy.optimize import brentq
from tiers import mostly_thorough

from rig.physics.contact.settings import ContactSettings, FrictionSettings, Plate
from rig.physics.contact.stepper import OPEN, STICK, ContactStepper
from rig.physics.skin.condensed import CondensedSkin, build_skin
from rig.physics.skin.settings import SkinSettings

STATIC, KINETIC, NORMAL_N, STEP_S = 0.8, 0.65, 4.0, 1e-4


@pytest.fixture(scope="module")
def rigid(skin_cache) -> CondensedSkin:
    return build_skin(
        SkinSettings(ridges=1, elements_per_ridge=2, youngs_modulus_MPa=1700.0), skin_cache
    )


def block_on_a_plate(rigid: CondensedSkin, healing_time_ms: float) -> ContactStepper:
    contact = ContactSettings(friction=FrictionSettings(healing_time_ms=healing_time_ms))
    stepper = ContactStepper(rigid, contact, Plate(), watched_ridge=0)
    pressed = stepper.advance(np.full(400, NORMAL_N), 0.0, tangential_control="force")
    assert (pressed.status[-1] != OPEN).sum() == 1
    return stepper


def press(force_N: float, steps: int = 400) -> np.ndarray:
    return force_N * (1 - np.cos(np.pi * np.arange(1, steps + 1) / steps)) / 2


@pytest.mark.parametrize("slid_mm", [0.5, 20.0])
def test_the_static_peak_after_a_rest_grows_exponentially_with_the_rest(rigid, slid_mm):
    """μ_s - (μ_s - μ_k) exp(-t/t_h), however far the block slid before (Kato's law, m = 1)."""
    stepper = block_on_a_plate(rigid, healing_time_ms=50.0)
    way = 1e-2 * np.arange(1, round(slid_mm / 1e-2) + 1)
    slid = stepper.advance(np.full(way.size, NORMAL_N), way)
    assert slid.tangential_force_N[-1] == pytest.approx(KINETIC * NORMAL_N, rel=1e-9)
    stopped = stepper.state
    for rest_s in (0.0, 0.01, 0.02, 0.05, 0.1, 0.5):
        stepper.state = stopped
        stepper.advance(np.full(round(rest_s / STEP_S), NORMAL_N), slid_mm)
        again = stepper.advance(np.full(200, NORMAL_N), slid_mm + 1e-3 * np.arange(1, 201))
        expected = STATIC - (STATIC - KINETIC) * np.exp(-rest_s / 0.05)
        assert again.tangential_force_N.max() / NORMAL_N == pytest.approx(expected, abs=1e-6)
        assert again.tangential_force_N[-1] == pytest.approx(KINETIC * NORMAL_N, rel=1e-6)


@pytest.mark.parametrize("healing_time_ms", mostly_thorough([20.0, 300.0], default=[20.0]))
def test_a_block_on_a_spring_sticks_and_slips_with_the_period_of_the_closed_form(
    rigid, healing_time_ms
):
    """A block of mass m on a spring k that is pulled at constant speed V.

    The spring's force swings by ΔF = (μ_s(T) - μ_k) F_n about μ_k F_n. It rises for T = 2 ΔF/(k V),
    in which friction heals, and falls for 2 (π - atan(ΔF ω/(k V)))/ω, with ω² = k/m.
    """
    spring_N_mm, pull_mm_s, mass_t = 0.5, 2.0, 1e-4
    pace = spring_N_mm * pull_mm_s

    def swing(stuck_s: float) -> float:
        healed = 1 - np.exp(-stuck_s / (healing_time_ms * 1e-3))
        return float((STATIC - KINETIC) * NORMAL_N * healed)

    stuck_s = brentq(lambda t: 2 * swing(t) / pace - t, 0.1, 5.0)
    omega = np.sqrt(spring_N_mm / mass_t)
    slipping_s = 2 * (np.pi - np.arctan(swing(stuck_s) * omega / pace)) / omega

    stepper = block_on_a_plate(rigid, healing_time_ms)
    stretched_mm = 0.95 * KINETIC * NORMAL_N / spring_N_mm
    stepper.advance(
        np.full(400, NORMAL_N), press(spring_N_mm * stretched_mm), tangential_control="force"
    )
    origin, forces = stepper.position_mm + stretched_mm, []
    for k in range(1, round(3.5 / STEP_S) + 1):
        stretch = pull_mm_s * STEP_S * k - (stepper.position_mm - origin)
        stepper.advance(NORMAL_N, spring_N_mm * stretch, tangential_control="force")
        forces.append(spring_N_mm * stretch)
    force = np.array(forces)
    turns = np.flatnonzero((force[1:-1] >= force[:-2]) & (force[1:-1] > force[2:])) + 1
    peaks = [k for k in turns if force[k] > KINETIC * NORMAL_N]
    last, latest = peaks[-2], peaks[-1]
    middle = KINETIC * NORMAL_N
    assert (latest - last) * STEP_S == pytest.approx(stuck_s + slipping_s, rel=0.015)
    assert force[latest] - middle == pytest.approx(swing(stuck_s), rel=0.015)
    assert middle - force[last:latest].min() == pytest.approx(swing(stuck_s), rel=0.015)


def test_an_object_that_is_gripped_again_stops_and_then_bears_more_than_kinetic_friction(rigid):
    """A weight between the kinetic and the static limit: it runs away once it slips, and hangs
    again after a stronger grip that has been let go."""
    stepper = block_on_a_plate(rigid, healing_time_ms=20.0)
    weight_N = 0.72 * NORMAL_N
    stepper.advance(np.full(20, NORMAL_N), 0.81 * NORMAL_N, tangential_control="force")
    runs = stepper.advance(np.full(200, NORMAL_N), weight_N, tangential_control="force")
    assert (np.diff(runs.position_mm) > 0).all()
    stepper.advance(np.full(3000, 2 * NORMAL_N), weight_N, tangential_control="force")
    held = stepper.advance(np.full(2000, NORMAL_N), weight_N, tangential_control="force")
    assert np.ptp(held.position_mm) < 1e-3


def test_a_skin_that_is_stopped_sticks_and_slips_anew_ridge_by_ridge(skin6: CondensedSkin):
    """Slide, stop for 0.1 s under full shear, slide on: a second static peak and a second slip of
    every ridge."""
    stepper = ContactStepper(skin6, ContactSettings(), Plate())
    stepper.advance(press(4.0), 0.0)
    first = stepper.advance(np.full(4000, 4.0), 1e-4 * np.arange(1, 4001))
    assert (first.status[-1] != STICK).all()
    stopped = stepper.advance(np.full(1000, 4.0), 0.4)
    touching = stopped.status != OPEN
    assert (stopped.status[50:][touching[50:]] == STICK).all()
    assert stopped.tangential_force_N[-1] == pytest.approx(0.65 * 4.0, rel=1e-3)
    on = stepper.advance(np.full(4000, 4.0), 0.4 + 1e-4 * np.arange(1, 4001))
    assert on.tangential_force_N.max() > 1.08 * 0.65 * 4.0
    assert on.tangential_force_N[-1] == pytest.approx(0.65 * 4.0, rel=1e-6)
    whole = [
        int(np.argmax((on.status[:, skin6.ridge == r] != STICK).all(axis=1)))
        for r in range(skin6.settings.ridges)
    ]
    assert min(whole[1:8]) > 20
    assert len(set(whole)) > 4

    def impulse(block) -> float:
        difference = block.stress_MPa[:, 0, 1] - block.stress_MPa[:, 1, 1]
        return float(np.abs(np.diff(difference)).max())

    assert impulse(on) > 0.3 * impulse(first)


@pytest.mark.parametrize("speed_um_s", [0.3, 1.0, 3.0, 30.0])
def test_a_creep_about_the_healing_speed_has_an_answer_within_the_friction_limits(
    skin_cache, speed_um_s
):
    small = build_skin(SkinSettings(ridges=3, elements_per_ridge=4), skin_cache)
    stepper = ContactStepper(small, ContactSettings(), Plate(), watched_ridge=1)
    stepper.advance(press(1.0), 0.0)
    stepper.advance(np.full(2000, 1.0), 1e-4 * np.arange(1, 2001))
    creep = stepper.advance(
        np.full(20000, 1.0), 0.2 + speed_um_s * 1e-3 * STEP_S * np.arange(1, 20001)
    )
    assert creep.tangential_force_N.min() > 0.6
    assert creep.tangential_force_N.max() < 0.8 + 1e-9
    assert creep.dissipated_mJ.min() >= -1e-12
