"""The film's model: its derivatives, its shape, and what a fit of it states."""

from dataclasses import replace

import numpy as np
import pytest

from rig.analysis.film.fit import fit_film, minimised
from rig.analysis.film.model import FilmModel, Notch, without
from rig.analysis.response.curve import CurveError, ResponseCurve
from rig.physics import pvdf
from rig.physics.vibrator import DropSettings, VibratorSettings, true_response

F = np.geomspace(2, 20000, 120)
NOTCHES = (Notch(500.0, 8.0, 12.0), Notch(2400.0, 15.0, 9.0))
MODELS = [
    FilmModel(-78.0, 1 / 2000, NOTCHES, delay_s=2e-6),
    FilmModel(-78.0, 1 / 2000, NOTCHES, delay_s=-1e-6, polarity=-1.0, slope_dB_decade=19.7),
    FilmModel(-78.0, 1 / 4000, NOTCHES, break_Hz=1200.0),
]


def curve(model, seed=0, relative=0.003):
    random = np.random.default_rng(seed)
    truth = model.response(F)
    noise = random.standard_normal((2, F.size))
    return ResponseCurve.of(
        F,
        truth * (1 + relative * (noise[0] + 1j * noise[1])),
        np.square(relative * abs(truth))[:, None, None] * np.eye(2),
    )


@pytest.mark.parametrize("model", MODELS, ids=["circuit", "slope", "break"])
def test_derivatives_are_those_of_the_response(model):
    derivatives = model.log_jacobian(F)
    vector = model.vector
    for k, row in enumerate(derivatives):
        step = 1e-6 * max(abs(vector[k]), 1e-4)
        up, down = vector.copy(), vector.copy()
        up[k] += step
        down[k] -= step
        ratio = model.moved_to(up).response(F) / model.moved_to(down).response(F)
        assert np.log(ratio) / (2 * step) == pytest.approx(row, rel=1e-4, abs=1e-5 * abs(row).max())


@pytest.mark.parametrize("model", MODELS, ids=["circuit", "slope", "break"])
def test_a_vector_gives_its_model_back(model):
    assert model.moved_to(model.vector).vector == pytest.approx(model.vector, rel=1e-12)
    assert without(model, 0).notches == NOTCHES[1:]


def test_the_model_is_the_film_in_its_clamp():
    """Circuit and drops as the simulated bench has them, to rounding."""
    circuit = pvdf.SWEEP_FILM
    drops = tuple(
        DropSettings(frequency_Hz=n.frequency_Hz, pole_Q=n.pole_Q, depth_dB=n.depth_dB)
        for n in NOTCHES
    )
    model = FilmModel(pvdf.level_at_one_hertz(circuit), 1 / pvdf.corner_frequency(circuit), NOTCHES)
    truth = true_response(F, VibratorSettings(drops=drops), circuit)
    assert model.response(F) == pytest.approx(truth, rel=1e-9)


def test_a_notch_is_as_deep_and_wide_as_it_says():
    notch = Notch(1000.0, 10.0, 14.0)
    model = FilmModel(-78.0, 1 / 2000, (notch,))
    assert model.loss_dB(np.array([1000.0]))[0] == pytest.approx(14.0, abs=1e-9)
    assert model.loss_dB(np.array([2.0, 2e4])) == pytest.approx([0.0, 0.0], abs=0.02)


@pytest.mark.parametrize("model", MODELS, ids=["circuit", "slope", "break"])
def test_a_fit_comes_back_to_where_the_points_came_from(model):
    aside = [Notch(n.frequency_Hz * 1.01, n.pole_Q * 1.2, n.depth_dB - 2) for n in model.notches]
    start = replace(
        model, level_dB=-76.0, inverse_corner_s=1.2 * model.inverse_corner_s, notches=tuple(aside)
    )
    fit = fit_film(curve(model), start)
    errors = np.sqrt(np.diag(fit.covariance))
    assert np.abs(fit.model.vector - model.vector).max() > 0
    assert (np.abs(fit.model.vector - model.vector) < 4 * errors).all()
    assert fit.probability > 1e-3


@pytest.mark.thorough
def test_the_stated_covariance_is_the_scatter_of_the_fit():
    model = MODELS[0]
    found = [fit_film(curve(model, seed), model) for seed in range(150)]
    scatter = np.std([fit.model.vector for fit in found], axis=0)
    stated = np.mean([np.sqrt(np.diag(fit.covariance)) for fit in found], axis=0)
    assert scatter / stated == pytest.approx(np.ones(scatter.size), abs=0.2)


def test_fewer_numbers_than_parameters_are_refused():
    few = curve(MODELS[0]).at(F < 2.6)
    with pytest.raises(CurveError, match="cannot determine 9 parameters"):
        minimised(few, MODELS[0])
