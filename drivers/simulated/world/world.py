"""The World: one simulated physics behind all simulated instruments of a bench.

It holds time, the log, what is mounted, and what the force sensor and the DAQ's input terminals
carry: the film in its clamp with the stage and the vibrator that press on it, or the skin that two
stages press and slide on a plate. Instruments see it through the narrow
ports of `ports.py`; only here do they meet. Random numbers are keyed, never continued: the noise of
a point depends on the seed, the run, the point and the stream, and not on what came before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from drivers.simulated.faults.plan import (
    DAQ,
    INTERLOCK,
    STAGE_X,
    STAGE_Z,
    Clipped,
    ClockJump,
    ContactFault,
    SensedFault,
    Spike,
    TimedFault,
)
from drivers.simulated.ports import Excitation
from drivers.simulated.task_log import TaskLog
from drivers.simulated.world.contacts import Contacts, ContactsSettings
from drivers.simulated.world.driven_line import DrivenLine
from drivers.simulated.world.film_clamp import ClampedFilm
from drivers.simulated.world.log import WorldLog
from drivers.simulated.world.monitor import WatchSettings
from drivers.simulated.world.schedule import Schedule
from drivers.simulated.world.sensed_force import SensedForce
from drivers.simulated.world.timeline import WorldTimeline
from rig.core.errors import ConfigurationError
from rig.core.toml_files import read_toml
from rig.physics import film_clamp, front_end, pvdf, vibrator
from rig.physics.film_clamp import FilmClampSettings
from rig.physics.front_end import FrontEndSettings

if TYPE_CHECKING:
    from drivers.simulated.world.contact_geometry import Where
    from drivers.simulated.world.skin_contact import SkinContact

LOAD_CELL_TERMINAL = 101
FILM_TERMINAL = 102
STRIP_TERMINALS = {101: 1, 102: 2}
"""Terminals of the strips' amplifiers while the skin is mounted."""
VIBRATOR_CHANNEL = 1
AMPLIFIER_CLIP_V = 10.0
NOISE_CHUNK = 4096
TERMINALS_SAMPLED = 4
"""Largest number of terminals that are sampled together."""
FORCE_NOISE = 900
"""Stream number that keys the force sensor's noise; terminals are the DAQ's streams."""
FORCE_SENSOR_FOLLOWS_Hz = 1000.0
"""Vibration beyond does not reach the force sensor's bridges: its probe is too heavy (assumed)."""


class WorldSettings(ContactsSettings):
    """The physical parameters of the simulated bench, which cannot be chosen on a real one."""

    film: Literal["drawn", "nominal", "open-circuit"] = "drawn"
    """A film drawn from the seed, the default film of the model, or none connected."""
    film_gain: float = 1.0
    """Gain of the film's amplifier: a large one saturates the input."""
    film_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of the film's channel."""
    load_cell_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of the load cell's channel."""
    clamp: FilmClampSettings = FilmClampSettings()
    """Position of the film, its stiffness and its creep."""
    load_cell_sensitivity_V_N: float = Field(default=0.1, gt=0)
    """True sensitivity of the load cell."""
    load_cell_zero_V: float = 0.0
    """Output of the load cell without load."""
    force_sensor_zero_mV_V: tuple[float, float, float] = (0.012, -0.007, 0.021)
    """Bridge outputs of the force sensor under no load."""
    daq_model: Literal["U2331A", "U2542A"] = "U2331A"
    """Model of the DAQ."""
    daq_buffer_samples: int = Field(default=8_000_000, ge=1)
    """Size of the DAQ's buffer, all channels together."""
    generator_link: Literal["socket", "hislip"] = "socket"
    """Kind of the generator's connection."""
    stiffest_contact_N_mm: float | None = Field(default=None, gt=0)
    """Stiffest contact in N/mm that the bench file declares of its fixture; None: it declares none,
    since its text is an example that people copy for stiffer benches. The contacts simulated here
    have 88 N/mm (film in its clamp) and 145 N/mm (skin)."""
    watch: WatchSettings | None = None
    """Checks of the World's own monitor; None for none."""


W = TypeVar("W", bound=WorldSettings)


def read_world(path: str | None, kind: type[W] = WorldSettings) -> W:  # type: ignore[assignment]
    """Return the World settings in a TOML file; the defaults if there is none.

    Raises ConfigurationError for a file that cannot be used.
    """
    if path is None:
        return kind()
    tables = read_toml(Path(path), "file of World settings")
    try:
        return kind.model_validate(tables)
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, path) from error


def mounted_film(
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


class World:
    """One bench's physics; implements the instruments' ports."""

    def __init__(
        self,
        settings: WorldSettings,
        seed: int,
        slaved: bool,
        log: Path | None = None,
        faults: Iterable[TimedFault] = (),
    ):
        self.settings = settings
        self.timeline = WorldTimeline(slaved)
        self._log = WorldLog(log, self.timeline)
        self._seed = seed
        self._point_key = (0, 0)
        self._acquisitions_of_point = 0
        self._acquisition_keys: dict[int, tuple[int, int, int]] = {}
        self._mechanics, self._circuit = mounted_film(settings, seed)
        self._line = DrivenLine(vibrator.vibrator_line(self._mechanics, self._circuit))
        self._clamp: ClampedFilm | None = None
        self._skin: SkinContact | None = None
        self._strip_input = FrontEndSettings()
        self._object: dict[str, Any] = {}
        self._weight_N = np.zeros(3)
        self._pushes: list[tuple[float, float, float]] = []
        """Begin and end in s, force in N."""
        self._sensed = SensedForce()
        faults = tuple(faults)
        self.contacts = Contacts(settings.interlock, self._log_contact)
        self.contacts.require([one for one in faults if isinstance(one, ContactFault)])
        self._schedule = Schedule(faults)
        self.tasks = TaskLog()
        """The bench's log of tasks and acquisitions."""
        self.tasks.listen(self._schedule.hear)
        self._elsewhere: dict[str, Callable[[TimedFault, int], None]] = {}
        self._excitation: Excitation | None = None
        self._clip_V = math.inf

    @property
    def now_us(self) -> int:
        """World time in microseconds."""
        return self.timeline.now_us

    @property
    def noise_key(self) -> tuple[int, ...]:
        """Seeds of the force sensor's noise: those of the World and of the present point."""
        return (self._seed, *self._point_key, FORCE_NOISE)

    def mount(self, stage_z_mm: Where) -> None:
        """Mount the vibrator on the z stage, whose carriage has these positions."""
        self._clamp = ClampedFilm(self.settings.clamp, stage_z_mm)

    def mount_skin(
        self, skin: SkinContact, strips: FrontEndSettings, below: dict[str, Any]
    ) -> None:
        """Mount a skin above an object on the stages; `strips` are its channels' noise and hum,
        `below` is the shape of the object."""
        self._skin, self._strip_input, self._object = skin, strips, below

    @property
    def failure(self) -> str | None:
        """Reason why this World is no longer valid, if there is one; it continues only to be
        brought to rest."""
        return None if self._skin is None else self._skin.failure

    def on_fault(self, device: str, act: Callable[[TimedFault, int], None]) -> None:
        """Call `act` with each fault of a device and its World time in us, when it is due."""
        self._elsewhere[device] = act

    def settle(self) -> None:
        """Bring what is mounted up to the present, faults included."""
        self._apply_due_faults()
        if self._skin is not None:
            self._skin.catch_up(self.now_us)

    def truth(self) -> dict[str, Any]:
        """Return the film, or what really happened to the skin since the point was announced, as
        JSON; nothing where the film is not connected."""
        if self._skin is not None:
            self.settle()
            return {**self._skin.truth(), "object": self._object}
        return {} if self.settings.film == "open-circuit" else {"film": self._film_truth()}

    def _film_truth(self) -> dict[str, Any]:
        """Return the numbers of the film that a sweep should find."""
        return {
            "level_dB": pvdf.level_at_one_hertz(self._circuit),
            "corner_Hz": pvdf.corner_frequency(self._circuit),
            "drops_Hz": [drop.frequency_Hz for drop in self._mechanics.drops],
            "gain_per_newton_dB": self.settings.clamp.gain_per_newton_dB,
            "gain_per_load_decade_dB": self.settings.clamp.gain_per_load_decade_dB,
        }

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force in N along an axis on its carriage, on which the film or the plate
        pushes back."""
        if self._skin is not None:  # the carriage stands where the skin will ask for it
            tangential_N, normal_N = self._skin.push_N(t_us)
            return {STAGE_Z: -normal_N, STAGE_X: -tangential_N}.get(axis, 0.0)
        if axis != STAGE_Z or self._clamp is None:
            return 0.0
        return -self._clamp.push_N(position_mm, t_us)

    def force_N(  # noqa: N802
        self, times_s: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return the force in N that the sensor under film or plate senses, (n, 3), at World times
        in s, (n,): weights, pushes and contact, as far as its faults let them through."""
        self._apply_due_faults()  # in real time frames come more often than `settle`
        weight_N = self._weight_N if np.count_nonzero(self._weight_N) else 0.0
        force = self.pressed_N(times_s) + weight_N
        for begin_s, end_s, push_N in self._pushes:
            force[:, 2] += push_N * ((times_s >= begin_s) & (times_s < end_s))
        return self._sensed.of(times_s, force)

    def pressed_N(  # noqa: N802
        self, times_s: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return the force in N, (n, 3), by which the stages press and the vibrator shakes."""
        if self._skin is not None:
            return self._skin.force_N(times_s)
        force = np.zeros((len(times_s), 3))
        force[:, 2] = self._film_N(times_s)
        return force

    def _film_N(  # noqa: N802
        self, times_s: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return the preload and vibration."""
        along_z = self._preload(times_s)
        if self._line.frequency_Hz <= FORCE_SENSOR_FOLLOWS_Hz and along_z.any():
            shaken = self._line.output(vibrator.VibratorOutput.LOAD, times_s)
            along_z = np.maximum(along_z + shaken, 0.0) * (along_z > 0)
        return along_z

    def weigh(self, force_N: tuple[float, float, float]) -> None:
        """Put weights on the sensors, along x, y and z."""
        self._weight_N = np.array(force_N, float)
        self.log("world", "weights", list(force_N), "world")

    def announce(self, run: int, point: int) -> None:
        """Announce the next point of the run, which keys the noise."""
        self._point_key = (run, point)
        self._acquisitions_of_point = 0
        if self._skin is not None:
            self.settle()
            self._skin.record.begin(self.now_us)

    def log(self, device: str, what: str, value: object, by: str) -> None:
        """Write to the World's log."""
        self._log.log(device, what, value, by)

    @property
    def driven(self) -> bool:
        """True if the vibrator's terminals carry anything."""
        return self._excitation is not None and self._excitation.on

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        """Change the signal of a generator channel from now on."""
        if channel == VIBRATOR_CHANNEL:
            self._excitation = excitation
            self._drive()

    def _drive(self) -> None:
        if self._excitation is not None:
            given_V = min(self._excitation.amplitude_V, self._clip_V)
            self._line.excite(self.now_us, replace(self._excitation, amplitude_V=given_V))

    def input_high(self, device: str, line: str) -> bool:
        """Return the present level of a digital input of an instrument."""
        self._apply_due_faults()
        return self.contacts.high(device, line, self.now_us)

    def _log_contact(self, value: object) -> None:
        self.log(INTERLOCK, "contact", value, "world")

    def _apply_due_faults(self) -> None:
        """Begin the faults that are due by now, in their order."""
        while (t_us := self._schedule.due(self.now_us)) is not None:
            self._apply_fault(self._schedule.take(), t_us)

    def _apply_fault(self, fault: TimedFault, t_us: int) -> None:
        """Apply a fault."""
        self.log(fault.device, "injected", fault.kind, "plan")
        if isinstance(fault, Spike):
            begin_s = t_us * 1e-6
            self._pushes.append((begin_s, begin_s + fault.for_s, fault.force_N))
        elif isinstance(fault, SensedFault):
            self._sensed.begin(fault, t_us)
        elif isinstance(fault, Clipped):
            self._clip_V = fault.amplitude_V
            self._drive()
        elif isinstance(fault, ContactFault):
            self.contacts.disturb(fault, t_us)
        elif isinstance(fault, ClockJump):
            self.timeline.jump(round(fault.by_s * 1e6))
        else:
            self._elsewhere[fault.device](fault, t_us)

    def begin_acquisition(self) -> int:
        """Return a fresh acquisition number; its noise is keyed by the point and its place in
        it."""
        number = len(self._acquisition_keys)
        self._acquisition_keys[number] = (*self._point_key, self._acquisitions_of_point)
        self._acquisitions_of_point += 1
        self.tasks.begin(DAQ, self.now_us)
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
        """Return the voltages of the terminals at the samples' instants: (count, len(terminals))
        volts."""
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
        if self._skin is not None:
            strip = STRIP_TERMINALS.get(terminal)
            return hum if strip is None else self._skin.strip_V(strip, times) + hum
        preload = self._preload(times)
        if terminal == LOAD_CELL_TERMINAL:
            own = self.settings
            still = own.load_cell_zero_V + own.load_cell_sensitivity_V_N * self._weight_N[2]
            # Zeroed under the preload: only what vibrates is seen, and only if there is contact.
            seen: npt.NDArray[np.float64] = self._line.output(vibrator.VibratorOutput.CELL, times)
            seen = seen * (preload > 0) + still
        elif terminal == FILM_TERMINAL and self.settings.film != "open-circuit":
            film: npt.NDArray[np.float64] = self._line.output(vibrator.VibratorOutput.FILM, times)
            film = film * film_clamp.preload_gain(self.settings.clamp, preload)
            load_N = self._line.amplitude(vibrator.VibratorOutput.LOAD, times)
            film = film * film_clamp.load_gain(self.settings.clamp, load_N)
            seen = np.clip(film, -AMPLIFIER_CLIP_V, AMPLIFIER_CLIP_V)
        else:
            seen = np.zeros(times.shape)
        result: npt.NDArray[np.float64] = seen + hum
        return result

    def _preload(self, times: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the static force on the film; the nominal one where no stage is mounted."""
        if self._clamp is None:
            return np.full(times.shape, self.settings.clamp.nominal_preload_N)
        return self._clamp.preload_N(times)

    def _front_end(self, terminal: int) -> FrontEndSettings:
        if self._skin is not None:
            return self._strip_input
        if terminal == LOAD_CELL_TERMINAL:
            return self.settings.load_cell_input
        return self.settings.film_input

    def _noise(
        self, acquisition: int, terminal: int, rate_S_s: float, first: int, count: int
    ) -> npt.NDArray[np.float64]:
        """Return the white noise by sample index, made in whole chunks so that blocks do not
        matter."""
        key = (self._seed, *self._acquisition_keys[acquisition], terminal)
        chunks = range(first // NOISE_CHUNK, (first + count - 1) // NOISE_CHUNK + 1)
        drawn = [_noise_chunk((*key, chunk)) for chunk in chunks]
        begin = first - chunks[0] * NOISE_CHUNK
        rms = front_end.noise_rms(self._front_end(terminal), rate_S_s)
        return rms * np.concatenate(drawn)[begin : begin + count]


@lru_cache(maxsize=2 * TERMINALS_SAMPLED)
def _noise_chunk(key: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Return the standard normal, (NOISE_CHUNK,): a block often wants the same as the one
    before."""
    drawn = np.random.default_rng(key).standard_normal(NOISE_CHUNK)
    drawn.flags.writeable = False
    return drawn
