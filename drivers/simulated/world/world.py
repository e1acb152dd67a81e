"""The World: one simulated physics behind all simulated instruments of a bench.

It holds time, the log, what is mounted, and what the force sensor and the DAQ's input terminals
carry: the film in its clamp with the stage and the vibrator that press on it (`mounted_film`), or
the skin that two stages press and slide on a plate (`mounted_skin`). Instruments see it through the
narrow ports of `ports.py`; only here do they meet. Random numbers are keyed, never continued
(`sampled_noise`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import (
    DAQ,
    INTERLOCK,
    Clipped,
    ClockJump,
    ContactFault,
    SensedFault,
    Spike,
    TimedFault,
)
from drivers.simulated.ports import Excitation
from drivers.simulated.task_log import TaskLog
from drivers.simulated.world.contacts import Contacts
from drivers.simulated.world.log import WorldLog
from drivers.simulated.world.mounted import Mounted
from drivers.simulated.world.mounted_film import MountedFilm
from drivers.simulated.world.sampled_noise import SampledNoise
from drivers.simulated.world.schedule import Schedule
from drivers.simulated.world.sensed_force import SensedForce
from drivers.simulated.world.settings import WorldSettings
from drivers.simulated.world.timeline import WorldTimeline
from rig.physics import front_end

if TYPE_CHECKING:
    from drivers.simulated.world.contact_geometry import Where

VIBRATOR_CHANNEL = 1


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
        self._noise = SampledNoise(seed)
        self._film = MountedFilm(settings, seed)
        self._mounted: Mounted = self._film
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

    @property
    def now_us(self) -> int:
        """World time in microseconds."""
        return self.timeline.now_us

    @property
    def noise_key(self) -> tuple[int, ...]:
        """Seeds of the force sensor's noise: those of the World and of the present point."""
        return self._noise.force_key

    def mount(self, stage_z_mm: Where) -> None:
        """Mount the vibrator on the z stage, whose carriage has these positions."""
        self._film.carry(stage_z_mm)

    def mount_instead(self, mounted: Mounted) -> None:
        """Mount something else in the place of the film."""
        self._mounted = mounted

    @property
    def failure(self) -> str | None:
        """Reason why this World is no longer valid, if there is one; it continues only to be
        brought to rest."""
        return self._mounted.failure

    def on_fault(self, device: str, act: Callable[[TimedFault, int], None]) -> None:
        """Call `act` with each fault of a device and its World time in us, when it is due."""
        self._elsewhere[device] = act

    def settle(self) -> None:
        """Bring what is mounted up to the present, faults included."""
        self._apply_due_faults()
        self._mounted.settle(self.now_us)

    def truth(self) -> dict[str, Any]:
        """Return the film, or what really happened to the skin since the point was announced, as
        JSON; nothing where the film is not connected."""
        self.settle()
        return self._mounted.truth()

    def load_N(self, axis: str, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force in N along an axis on its carriage, on which the film or the plate
        pushes back."""
        return self._mounted.load_N(axis, position_mm, t_us)

    def force_N(  # noqa: N802
        self, times_s: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return the force in N that the sensor under film or plate senses, (n, 3), at World times
        in s, (n,): weights, pushes and contact, as far as its faults let them through."""
        self._apply_due_faults()  # in real time frames come more often than `settle`
        weight_N = self._weight_N if np.count_nonzero(self._weight_N) else 0.0
        force = self._mounted.force_N(times_s) + weight_N
        for begin_s, end_s, push_N in self._pushes:
            force[:, 2] += push_N * ((times_s >= begin_s) & (times_s < end_s))
        return self._sensed.of(times_s, force)

    def pressed_N(  # noqa: N802
        self, times_s: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return the force in N, (n, 3), by which the stages press and the vibrator shakes."""
        return self._mounted.force_N(times_s)

    def weigh(self, force_N: tuple[float, float, float]) -> None:
        """Put weights on the sensors, along x, y and z."""
        self._weight_N = np.array(force_N, float)
        self.log("world", "weights", list(force_N), "world")

    def announce(self, run: int, point: int) -> None:
        """Announce the next point of the run, which keys the noise."""
        self._noise.begin_point(run, point)
        self.settle()
        self._mounted.begin_point(self.now_us)

    def log(self, device: str, what: str, value: object, by: str) -> None:
        """Write to the World's log."""
        self._log.log(device, what, value, by)

    @property
    def driven(self) -> bool:
        """True if the vibrator's terminals carry anything."""
        return self._film.driven

    def excite(self, channel: int, excitation: Excitation, by: str) -> None:
        """Change the signal of a generator channel from now on."""
        if channel == VIBRATOR_CHANNEL:
            self._film.excite(excitation, self.now_us)

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
            self._film.clip(fault.amplitude_V, self.now_us)
        elif isinstance(fault, ContactFault):
            self.contacts.disturb(fault, t_us)
        elif isinstance(fault, ClockJump):
            self.timeline.jump(round(fault.by_s * 1e6))
        else:
            self._elsewhere[fault.device](fault, t_us)

    def begin_acquisition(self) -> int:
        """Return a fresh acquisition number; its noise is keyed by the point and its place in
        it."""
        self.tasks.begin(DAQ, self.now_us)
        return self._noise.begin_acquisition()

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
            channel = self._mounted.front_end(terminal)
            result[:, k] = (
                self._mounted.terminal_V(terminal, times, self._weight_N[2])
                + front_end.mains_hum(channel, times)
                + front_end.noise_rms(channel, rate_S_s)
                * self._noise.of(acquisition, terminal, first, count)
            )
        return result

    def close(self) -> None:
        """End the World; its log says so."""
        self.log("world", "end", None, "world")
        self._log.close()
