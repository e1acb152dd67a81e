"""The World: one simulated physics behind all simulated instruments of a bench.

It holds time, the log, the film in its clamp with the vibrator that presses on it, and what the
DAQ's input terminals carry. Instruments see it through the narrow ports of `ports.py`; only here
do they meet. Random numbers are keyed, never continued: the noise of a point depends on the seed,
the run, the point and the stream, and not on what came before it.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from drivers.simulated.driven_line import DrivenLine
from drivers.simulated.ports import Excitation
from drivers.simulated.timeline import Timeline
from drivers.simulated.world_log import WorldLog
from rig.errors import ConfigurationError
from rig.model import front_end, pvdf, vibrator
from rig.model.front_end import FrontEndSettings
from rig.settings import Settings

LOAD_CELL_TERMINAL = 101
FILM_TERMINAL = 102
VIBRATOR_CHANNEL = 1
AMPLIFIER_CLIP_V = 10.0
NOISE_CHUNK = 4096


class WorldSettings(Settings):
    """What the simulated bench is like; everything a real one would not let you choose."""

    film: Literal["drawn", "nominal", "open-circuit"] = "drawn"
    """A film drawn from the seed, the default film of the model, or none connected."""
    film_gain: float = 1.0
    """Gain of the film's amplifier: a large one saturates the input."""
    film_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of the film's channel."""
    load_cell_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of the load cell's channel."""
    daq_model: Literal["U2331A", "U2542A"] = "U2331A"
    """Which DAQ the bench has."""
    generator_link: Literal["socket", "hislip"] = "socket"
    """How the generator is reached."""


def read_world(path: str | None) -> WorldSettings:
    """World settings from a TOML file; defaults where there is none."""
    if path is None:
        return WorldSettings()
    try:
        return WorldSettings.model_validate(tomllib.loads(Path(path).read_text("utf-8")))
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, path) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigurationError(f"cannot read the World settings {path}: {error}") from error


class World:
    """One bench's physics; implements the instruments' ports."""

    def __init__(self, settings: WorldSettings, seed: int, slaved: bool, log: Path | None = None):
        self.settings = settings
        self.timeline = Timeline(slaved)
        self._log = WorldLog(log, self.timeline)
        self._seed = seed
        self._point_key = (0, 0)
        self._acquisitions_of_point = 0
        self._acquisition_keys: dict[int, tuple[int, int, int]] = {}
        mechanics, circuit = (
            vibrator.drawn_film(seed)
            if settings.film == "drawn"
            else (vibrator.VibratorSettings(), pvdf.SWEEP_FILM)
        )
        circuit = circuit.model_copy(update={"gain": settings.film_gain})
        self._line = DrivenLine(vibrator.vibrator_line(mechanics, circuit))

    @property
    def now_us(self) -> int:
        """World time in microseconds."""
        return self.timeline.now_us

    def announce(self, run: int, point: int) -> None:
        """The run says which point comes next: it keys the noise."""
        self._point_key = (run, point)
        self._acquisitions_of_point = 0

    def log(self, device: str, what: str, value: object, by: str) -> None:
        """Write to the World's log."""
        self._log.log(device, what, value, by)

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        """A generator channel's terminals change from now on."""
        if channel == VIBRATOR_CHANNEL:
            self._line.excite(self.now_us, excitation)

    def begin_acquisition(self) -> int:
        """A fresh acquisition number; its noise is keyed by the point and its place in it."""
        number = len(self._acquisition_keys)
        self._acquisition_keys[number] = (*self._point_key, self._acquisitions_of_point)
        self._acquisitions_of_point += 1
        return number

    def volts(
        self,
        acquisition: int,
        terminals: tuple[int, ...],
        start_us: int,
        rate_S_s: float,
        first: int,
        count: int,
        skew_s: tuple[float, ...],
    ) -> npt.NDArray[np.float64]:
        """What the terminals carry at the samples' instants: (count, len(terminals)) volts."""
        nominal = start_us * 1e-6 + (first + np.arange(count)) / rate_S_s
        result = np.empty((count, len(terminals)))
        for k, terminal in enumerate(terminals):
            times = nominal + skew_s[k]
            noise = self._noise(acquisition, terminal, rate_S_s, first, count)
            result[:, k] = self._signal(terminal, times) + noise
        return result

    def close(self) -> None:
        """End the World; its log says so."""
        self.log("world", "end", None, "world")
        self._log.close()

    def _signal(self, terminal: int, times: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        hum = front_end.mains_hum(self._front_end(terminal), times)
        if terminal == LOAD_CELL_TERMINAL:
            return self._line.output(vibrator.Output.CELL, times) + hum
        if terminal == FILM_TERMINAL and self.settings.film != "open-circuit":
            film = self._line.output(vibrator.Output.FILM, times)
            return np.clip(film, -AMPLIFIER_CLIP_V, AMPLIFIER_CLIP_V) + hum
        return hum

    def _front_end(self, terminal: int) -> FrontEndSettings:
        if terminal == LOAD_CELL_TERMINAL:
            return self.settings.load_cell_input
        return self.settings.film_input

    def _noise(
        self, acquisition: int, terminal: int, rate_S_s: float, first: int, count: int
    ) -> npt.NDArray[np.float64]:
        """White noise by sample index, made in whole chunks so that blocks do not matter."""
        key = (self._seed, *self._acquisition_keys[acquisition], terminal)
        chunks = range(first // NOISE_CHUNK, (first + count - 1) // NOISE_CHUNK + 1)
        drawn = [
            np.random.default_rng([*key, chunk]).standard_normal(NOISE_CHUNK) for chunk in chunks
        ]
        begin = first - chunks[0] * NOISE_CHUNK
        rms = front_end.noise_rms(self._front_end(terminal), rate_S_s)
        return rms * np.concatenate(drawn)[begin : begin + count]
