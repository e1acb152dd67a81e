"""The clamped film as stage and force sensor meet it: stiffness, creep, one-sided contact."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.physics.film_clamp import FilmClampSettings, creep_step, preload_gain, push_after

FILM = FilmClampSettings()


def pressed(path_mm, step_s=1e-3):
    return creep_step(FILM, 0.0, np.asarray(path_mm, float), step_s)[0]


def test_a_slow_compression_feels_the_static_stiffness_only():
    path = FILM.contact_mm + np.linspace(0.0, 0.3, 100_001)
    force = pressed(path, step_s=1e-3)  # 100 s, 33 time constants
    assert force[-1] == pytest.approx(0.3 * FILM.stiffness_N_mm, rel=0.005)


def test_a_sudden_compression_relaxes_with_its_time_constant():
    path = FILM.contact_mm + np.array([0.0, *([0.3] * 6001)])
    force = pressed(path)
    relaxing = force[1:] - 0.3 * FILM.stiffness_N_mm
    assert relaxing[0] == pytest.approx(0.3 * FILM.creep_stiffness_N_mm, rel=1e-3)
    assert relaxing[3000] / relaxing[0] == pytest.approx(math.exp(-1), rel=1e-3)


def test_the_film_never_pulls_and_nothing_is_felt_before_contact():
    path = FILM.contact_mm + np.concatenate([np.linspace(-1, 0.3, 1000), np.linspace(0.3, -1, 500)])
    force = pressed(path)
    assert force.min() == 0.0
    assert not force[path < FILM.contact_mm].any()


@given(
    st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=20), st.integers(1, 50), st.integers(1, 19)
)
def test_one_step_without_arrays_is_the_same_step(offsets, step_ms, at):
    path = FILM.contact_mm + np.array(offsets)
    at = min(at, len(path) - 1)
    _, fading = creep_step(FILM, 0.0, path[:at], step_ms * 1e-3)
    force = creep_step(FILM, fading, path[at - 1 : at + 1], step_ms * 1e-3)[0][-1]
    single = push_after(FILM, fading, path[at - 1], path[at], step_ms * 1e-3)
    assert single == pytest.approx(force, abs=1e-12)


def test_the_gain_is_nominal_at_the_nominal_preload_and_none_without_contact():
    gain = preload_gain(FILM, np.array([0.0, FILM.nominal_preload_N, FILM.nominal_preload_N + 10]))
    assert gain[:2].tolist() == [0.0, 1.0]
    assert 20 * math.log10(gain[2]) == pytest.approx(10 * FILM.gain_per_newton_dB)
