"""A film in its clamp on a simulated bench, with the vibrator that shakes it and the load cell."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import STAGE_Z
from drivers.simulated.ports import Excitation
from drivers.simulated.world.driven_line import DrivenLine
from drivers.simulated.world.film_clamp import ClampedFilm
from drivers.simulated.world.settings import WorldSettings
from rig.physics import film_clamp, pvdf, vibrator
from rig.physics.front_end import FrontEndSettings

if TYPE_CHECKING:
    from drivers.simulated.world.contact_geometry import Where

LOAD_CELL_TERMINAL = 101
FILM_TERMINAL = 102
AMPLIFIER_CLIP_V = 10.0
FORCE_SENSOR_FOLLOWS_Hz = 1000.0
"""Vibration beyond does not reach the force sensor's bridges: its probe is too heavy (assumed)."""

Reals = npt.NDArray[np.float64]


def drawn_film(
    settings: WorldSettings, seed: int
) -> tuple[vibrator.VibratorSettings, pvdf.CircuitSettings]:
    """Return the vibrator with its load cell and drops, and the film with its amplifier, as the
    World has them: drawn by the seed, or the nominal ones."""
    mechanics, circuit = (
        vibrator.drawn_film(seed)
        if settings.film == "drawn"
        else (vibrator.VibratorSettings(), pvdf.SWEEP_FILM)
    )
    sensitivity = {"cell_sensitivity_V_N": settings.load_cell_sensitivity_V_N}
    return (
        mechanics.model_copy(update=sensitivity),
        circuit.model_copy(update={"gain": settings.film_gain}),
    )


class MountedFilm:
    """A film under the vibrator: pressed with its nominal preload, until a stage carries it."""

    failure = None

    def __init__(self, settings: WorldSettings, seed: int):
        """Mount the film that `seed` draws, or the nominal one."""
        self._settings = settings
        self._mechanics, self._circuit = drawn_film(settings, seed)
        self._line = DrivenLine(vibrator.vibrator_line(self._mechanics, self._circuit))
        self._clamp: ClampedFilm | None = None
        self._excitation: Excitation | None = None
        self._clip_V = math.inf

    def carry(self, stage_z_mm: Where) -> None:
        """Have the z stage, whose carriage has these positions, carry the vibrator."""
        self._clamp = ClampedFilm(self._settings.clamp, stage_z_mm)

    # --- the vibrator -------------------------------------------------------------------------

    @property
    def driven(self) -> bool:
        """True if the vibrator's terminals carry anything."""
        return self._excitation is not None and self._excitation.on

    def excite(self, excitation: Excitation, now_us: int) -> None:
        """Change the signal at the vibrator's terminals from now on."""
        self._excitation = excitation
        self._drive(now_us)

    def clip(self, amplitude_V: float, now_us: int) -> None:
        """Let no more than this amplitude in V reach the vibrator from now on."""
        self._clip_V = amplitude_V
        self._drive(now_us)

    def _drive(self, now_us: int) -> None:
        if self._excitation is not None:
            given_V = min(self._excitation.amplitude_V, self._clip_V)
            self._line.excite(now_us, replace(self._excitation, amplitude_V=given_V))

    # --- what the World asks ------------------------------------------------------------------

    def settle(self, now_us: int) -> None:
        """Do nothing: what happened is computed when it is asked for."""

    def begin_point(self, now_us: int) -> None:
        """Do nothing: a film is the same in every point."""

    def truth(self) -> dict[str, Any]:
        """Return the numbers of the film that a sweep should find; nothing where it is not
        connected."""
        if self._settings.film == "open-circuit":
            return {}
        film = {
            "level_dB": pvdf.level_at_one_hertz(self._circuit),
            "corner_Hz": pvdf.corner_frequency(self._circuit),
            "drops_Hz": [drop.frequency_Hz for drop in self._mechanics.drops],
            "gain_per_newton_dB": self._settings.clamp.gain_per_newton_dB,
            "gain_per_load_decade_dB": self._settings.clamp.gain_per_load_decade_dB,
        }
        return {"film": film}

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force in N on z's carriage, on which the film pushes back; 0 on another."""
        if axis != STAGE_Z or self._clamp is None:
            return 0.0
        return -self._clamp.push_N(position_mm, t_us)

    def force_N(self, times_s: Reals) -> Reals:  # noqa: N802
        """Return the preload and vibration in N, (n, 3)."""
        along_z = self._preload_N(times_s)
        if self._line.frequency_Hz <= FORCE_SENSOR_FOLLOWS_Hz and along_z.any():
            shaken = self._line.output(vibrator.VibratorOutput.LOAD, times_s)
            along_z = np.maximum(along_z + shaken, 0.0) * (along_z > 0)
        force = np.zeros((len(times_s), 3))
        force[:, 2] = along_z
        return force

    def terminal_V(  # noqa: N802
        self, terminal: int, times_s: Reals, weight_N: float
    ) -> Reals:
        """Return the volts of the load cell or of the film's amplifier; 0 at other terminals."""
        own, preload = self._settings, self._preload_N(times_s)
        if terminal == LOAD_CELL_TERMINAL:
            still = own.load_cell_zero_V + own.load_cell_sensitivity_V_N * weight_N
            # Zeroed under the preload: only what vibrates is seen, and only if there is contact.
            seen: Reals = self._line.output(vibrator.VibratorOutput.CELL, times_s)
            return seen * (preload > 0) + still
        if terminal == FILM_TERMINAL and own.film != "open-circuit":
            film: Reals = self._line.output(vibrator.VibratorOutput.FILM, times_s)
            film = film * film_clamp.preload_gain(own.clamp, preload)
            load_N = self._line.amplitude(vibrator.VibratorOutput.LOAD, times_s)
            film = film * film_clamp.load_gain(own.clamp, load_N)
            return np.clip(film, -AMPLIFIER_CLIP_V, AMPLIFIER_CLIP_V)
        return np.zeros(times_s.shape)

    def front_end(self, terminal: int) -> FrontEndSettings:
        """Return the noise and hum of the load cell's channel or of the film's."""
        if terminal == LOAD_CELL_TERMINAL:
            return self._settings.load_cell_input
        return self._settings.film_input

    def _preload_N(self, times_s: Reals) -> Reals:  # noqa: N802
        """Return the static force on the film; the nominal one where no stage carries it."""
        if self._clamp is None:
            return np.full(times_s.shape, self._settings.clamp.nominal_preload_N)
        return self._clamp.preload_N(times_s)
