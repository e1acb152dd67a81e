"""Friction coefficients of the simulated skin's slides, and what a correlated mean is worth.

Made with 240 random slides (decision 0035); the corners here are others, with noise of 5 mN, more
than twice that of the bench's force sensor.
"""

import numpy as np
import pytest

from rig.analysis.trial.friction import FrictionError, friction, mean_of_correlated
from rig.physics.contact.settings import ContactSettings, FrictionSettings
from rig.physics.skin.condensed import CondensedSkin
from rig.physics.trials import PressSettings, SkinTrial, SlideSettings, slide

NOISE_N = 5e-3


def slid(
    skin: CondensedSkin,
    static: float,
    ratio: float,
    force_N: float,
    speed_mm_s: float,
    steady_s: float = 0.3,
) -> SkinTrial:
    settings = SlideSettings(
        press=PressSettings(normal_force_N=force_N),
        contact=ContactSettings(
            friction=FrictionSettings(static_coefficient=static, kinetic_coefficient=static * ratio)
        ),
        speed_mm_s=speed_mm_s,
        slide_s=(0.09 * static * force_N + 0.07) / speed_mm_s + 0.05 + steady_s,
    )
    return slide(skin, settings)


def sampled(trial: SkinTrial, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F_n, F_t with noise and the travel at 1 kHz, from the motion's beginning on."""
    rng = np.random.default_rng([11, seed])
    rows = np.nonzero(trial.time_s > trial.motion_s)[0][9::10]
    block = trial.block
    noise = NOISE_N * rng.normal(size=(2, rows.size))
    return (
        block.normal_force_N[rows] + noise[0],
        block.tangential_force_N[rows] + noise[1],
        block.position_mm[rows],
    )


@pytest.mark.parametrize("static", [0.3, 0.7, 1.2])
@pytest.mark.parametrize(
    ("ratio", "force_N", "speed_mm_s"),
    [(0.7, 2.0, 1.0), (0.95, 2.0, 6.0), (0.7, 8.0, 6.0), (0.95, 4.0, 1.0)],
)
def test_the_contacts_coefficients_are_found(skin6, static, ratio, force_N, speed_mm_s) -> None:
    trial = slid(skin6, static, ratio, force_N, speed_mm_s)
    found = friction(*sampled(trial, 1))
    moved = trial.time_s > trial.motion_s
    shown = (trial.block.tangential_force_N / trial.block.normal_force_N)[moved].max()
    assert found.static.value == pytest.approx(shown, rel=0.03)
    assert found.kinetic.value == pytest.approx(static * ratio, rel=0.005)
    # what the contact shows is neither of its points' coefficients, and bounds the static one
    assert static * ratio < shown < static
    assert found.point_static.low < static < found.point_static.high


def test_creep_before_the_slide_and_its_direction_change_nothing(skin6: CondensedSkin) -> None:
    normal, tangential, travel = sampled(slid(skin6, 0.8, 0.8, 4.0, 1.0), 2)
    there = friction(normal, tangential, travel)
    back = friction(normal, -tangential, -travel)
    assert back.static == there.static
    assert back.kinetic == there.kinetic
    n = 100  # a tenth of a second in which the object is drawn slowly and F_t creeps up
    crept = friction(
        np.concatenate([np.full(n, normal[0]), normal]),
        np.concatenate([np.linspace(0.0, tangential[0], n), tangential]),
        np.concatenate([np.full(n, travel[0]), travel]),
    )
    assert crept.static.value == pytest.approx(there.static.value, rel=0.002)
    assert crept.kinetic.value == pytest.approx(there.kinetic.value, rel=1e-4)  # a sample apart


def test_uncertain_zeros_add_their_error(skin6: CondensedSkin) -> None:
    series = sampled(slid(skin6, 0.8, 0.8, 4.0, 1.0), 3)
    found = friction(*series, zero_error_N=(0.04, 0.03))
    expected = np.hypot(0.03, 0.64 * 0.04) / 4.0  # μ = F_t/F_n, differentiated
    assert found.kinetic.standard_error == pytest.approx(expected, rel=0.02)
    assert found.kinetic.covers(0.64)
    # a shift of F_t moves both coefficients alike: that of a point moves as much, not by the drop
    alone, shifted = friction(*series), friction(*series, zero_error_N=(0.0, 0.03))
    above = alone.point_static.high - alone.point_static.value
    expected = np.hypot(above, 1.96 * 0.03 / 4.0)
    assert shifted.point_static.high - shifted.point_static.value == pytest.approx(
        expected, rel=0.02
    )


def test_a_slide_without_gross_slip_has_no_coefficient(skin6: CondensedSkin) -> None:
    normal, tangential, travel = sampled(slid(skin6, 0.8, 0.8, 4.0, 1.0), 4)
    before = np.searchsorted(travel, 0.12)
    with pytest.raises(FrictionError, match="no gross slip"):
        friction(normal[:before], tangential[:before], travel[:before])
    soon = np.searchsorted(travel, 0.2)
    with pytest.raises(FrictionError, match="samples of steady sliding"):
        friction(normal[:soon], tangential[:soon], travel[:soon])


def test_lost_contact_and_rest_are_refused() -> None:
    line = np.linspace(0, 1, 500)
    with pytest.raises(FrictionError, match="contact is lost"):
        friction(4 - 5 * line, line, line)
    with pytest.raises(FrictionError, match="did not move"):
        friction(np.full(500, 4.0), line, np.zeros(500))
    with pytest.raises(ValueError, match="same shape"):
        friction(line, line, line[1:])


@pytest.mark.parametrize(
    ("memory", "samples", "at_least"),
    [
        (0.0, 50, 560), (0.0, 150, 560), (0.0, 770, 560), (0.5, 300, 555),
        (0.9, 50, 535), (0.9, 150, 560), (0.9, 770, 560),
        (0.98, 50, 460), (0.98, 150, 515), (0.98, 770, 555),
    ],
)  # fmt: skip
def test_the_interval_of_a_correlated_mean_holds_its_share(memory, samples, at_least) -> None:
    """First-order noise of zero mean; 95 % is 570 of 600, whose own scatter is 5.

    A memory of 0.98 lasts as long as 50 samples, which hardly show it: 82 %, and 90 % of 150. With
    as many degrees of freedom as independent samples it was 57 and 70 %, and 73 % with a memory of
    0.9 and 50 samples.
    """
    rng = np.random.default_rng([3, int(100 * memory), samples])
    kicks = rng.normal(size=(600, samples + 400))
    values = np.zeros_like(kicks)
    for k in range(1, samples + 400):
        values[:, k] = memory * values[:, k - 1] + kicks[:, k]
    found = [mean_of_correlated(row[400:])[0] for row in values]
    assert at_least <= sum(one.covers(0.0) for one in found) <= 598
    # the standard error alone says as much as the interval
    wide = [abs(one.value) < 1.96 * one.standard_error for one in found]
    assert sum(wide) == pytest.approx(sum(one.covers(0.0) for one in found), abs=1)


@pytest.mark.parametrize("rate_Hz", [100.0, 500.0, 1000.0])
def test_a_slower_force_sensor_gives_the_same_coefficients(skin6, rate_Hz) -> None:
    """Each of its frames is the mean of several of a fast one's."""
    trial = slid(skin6, 0.7, 0.8, 4.0, 1.0, steady_s=1.0)
    together = round(1000 / rate_Hz)
    series = [values[: values.size // together * together] for values in sampled(trial, 3)]
    slow = [values.reshape(-1, together).mean(axis=1) for values in series]
    found = friction(*slow, rate_Hz=rate_Hz)
    moved = trial.time_s > trial.motion_s
    shown = (trial.block.tangential_force_N / trial.block.normal_force_N)[moved].max()
    assert found.static.value == pytest.approx(shown, rel=0.03)
    assert found.kinetic.value == pytest.approx(0.56, rel=0.005)
