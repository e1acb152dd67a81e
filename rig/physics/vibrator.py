"""The line from the volts of the generator to the volts of the film: shaker, indentor, load cell,
film, amplifier.

    generator V -> coil and armature -> load (N) -> load cell (V)
                                          |
                                          +-> three drops -> film force (N) -> circuit -> film (V)

The paper holds the load, as the load cell measures it, constant from 2 to 20000 Hz. It finds drops
(notches) at 500, 2400 and 9000 Hz and traces them to the mechanics between indentor and film (3.2).
They are therefore in the force that reaches the film and not in what the load cell measures.
Everything here is linear about the preload: forces and volts are deviations from it. The paper
describes neither the shaker nor the depth and width of the drops: every default marked so is
assumed.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from rig.core.settings import Settings
from rig.physics import pvdf
from rig.physics.modal import Complexes, ModalSystem, ZeroPoleGain, lag, resonance
from rig.physics.pvdf import SWEEP_FILM, CircuitSettings


class VibratorOutput(IntEnum):
    """Columns of the outputs of the vibrator line."""

    LOAD = 0
    """Load on the cell, in N."""
    CELL = 1
    """Output of the load cell, in V."""
    FILM_FORCE = 2
    """Force that reaches the film, in N."""
    FILM = 3
    """Output of the film's amplifier, in V."""


class DropSettings(Settings):
    """A mechanical resonance between indentor and film: a notch in the transmitted force."""

    frequency_Hz: float = Field(gt=0)
    """Frequency at which the notch is deepest."""
    pole_Q: float = Field(default=10.0, gt=0.5)
    """Quality factor of its poles (assumed 5 to 20)."""
    depth_dB: float = Field(default=13.0, ge=0)
    """Depth at its frequency (assumed 8 to 18; 0 removes the notch)."""


PAPER_DROPS = tuple(DropSettings(frequency_Hz=frequency) for frequency in (500.0, 2400.0, 9000.0))
"""The drops that the paper reports, with Q and depth in the middle of their assumed ranges."""


class VibratorSettings(Settings):
    """Shaker, mechanics of the indentor, and load cell. All values except the drops' frequencies
    are assumed."""

    force_constant_N_V: float = Field(default=1.5, gt=0)
    """Load per generator volt at mid band (assumed): the generator's 10 V peak then give 10 N peak
    at 20 kHz too."""
    armature_resonance_Hz: float = Field(default=95.0, gt=0)
    """Resonance of the armature on its suspension (assumed)."""
    armature_Q: float = Field(default=1.3, gt=0)
    """Quality factor of that resonance (assumed)."""
    armature_rise_dB: float = Field(default=6.0, ge=0, le=20)
    """Height of the load at that resonance above mid band (assumed)."""
    coil_corner_Hz: float = Field(default=25e3, ge=15e3)
    """Corner frequency of the coil's inductance (assumed)."""
    drops: tuple[DropSettings, ...] = PAPER_DROPS
    """Notches in the force transmitted to the film (paper 3.2 (iii))."""
    cell_sensitivity_V_N: float = Field(default=0.1, gt=0)
    """Sensitivity of the load cell with its amplifier (assumed), DC-coupled."""
    cell_bandwidth_Hz: float | None = Field(default=None, gt=0)
    """First-order corner of the load cell; None (assumed) for none within the sweep. A finite
    corner appears in every measured gain as an error, because the load is known only through the
    cell."""


def vibrator_line(settings: VibratorSettings, circuit: CircuitSettings) -> ModalSystem:
    """Return the line from generator volts to the four columns of :class:`VibratorOutput`."""
    load = (
        ZeroPoleGain(gain=settings.force_constant_N_V)
        * resonance(settings.armature_resonance_Hz, settings.armature_Q, settings.armature_rise_dB)
        * lag(settings.coil_corner_Hz)
    )
    cell = load * ZeroPoleGain(gain=settings.cell_sensitivity_V_N)
    if settings.cell_bandwidth_Hz is not None:
        cell = cell * lag(settings.cell_bandwidth_Hz)
    film_force = load * _transmission(settings)
    film = film_force * pvdf.zeros_poles_gain(circuit)
    return ModalSystem.from_chains([load, cell, film_force, film])


def true_response(
    frequency: ArrayLike, settings: VibratorSettings, circuit: CircuitSettings
) -> Complexes:
    """Return film output over load on the cell, complex V/N at ``frequency`` in Hz: what a sweep
    measures.

    It is the drops times the circuit. Shaker and load cell do not appear in it.
    """
    return _transmission(settings).response(frequency) * pvdf.circuit(frequency, circuit)


def drawn_film(
    seed: int, film: CircuitSettings = SWEEP_FILM
) -> tuple[VibratorSettings, CircuitSettings]:
    """Return one mounting of one film, with random properties drawn from ``seed``.

    Level ±3 dB, uniform in dB, as a change of d33; corner 1 to 4 kHz, log-uniform, as a change of
    C_PV; frequency of each drop ±20 %, pole Q 5 to 20 and depth 8 to 18 dB, uniform and independent
    (all ranges assumed). ``film`` provides the level and the other components.

    Raises ValueError if ``film`` has a series resistance, because level and corner would then
    depend on each other.
    """
    if film.series_resistance_ohm:
        raise ValueError("a film is drawn without series resistance: level and corner would mix")
    random = np.random.default_rng([seed, 0])
    level_dB = random.uniform(-3.0, 3.0)
    corner_Hz = 1e3 * 4.0 ** random.uniform(0.0, 1.0)
    drops = tuple(
        DropSettings(
            frequency_Hz=drop.frequency_Hz * random.uniform(0.8, 1.2),
            pole_Q=random.uniform(5.0, 20.0),
            depth_dB=random.uniform(8.0, 18.0),
        )
        for drop in PAPER_DROPS
    )
    resistance_ohm = 1 / (1 / film.film_resistance_ohm + 1 / film.input_resistance_ohm)
    capacitance_pF = 1e12 / (2 * np.pi * corner_Hz * resistance_ohm)
    drawn = CircuitSettings.model_validate(
        film.model_dump()
        | {
            "d33_C_N": film.d33_C_N * 10 ** (level_dB / 20),
            "film_capacitance_pF": capacitance_pF - film.input_capacitance_pF,
        }
    )
    return VibratorSettings(drops=drops), drawn


def _transmission(settings: VibratorSettings) -> ZeroPoleGain:
    """Return film force over load: all drops in series."""
    line = ZeroPoleGain()
    for drop in settings.drops:
        line = line * resonance(drop.frequency_Hz, drop.pole_Q, -drop.depth_dB)
    return line
