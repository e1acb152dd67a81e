"""The contract for a driver whose simulator is one core, such as a laboratory brings for its own
instrument.

The servers, faults and bench come from the installed simulated bench, found by its entry point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from rig.core.entry_points import BENCHES, load
from rig.core.errors import ConfigurationError
from rig.testing.case import TIMEOUT_S, BenchClock, Case, Service
from rig.testing.signals import ForceLaw, USUAL_RATE_S_s, carried

TERMINALS = {"load_cell": 101, "film": 102}
"""Wiring of the terminals of a simulated bench."""


class _LineClock(BenchClock):
    """Bench time passes in the server's thread, which sends what falls due."""

    def __init__(self, lone: Any):
        super().__init__(lone.bench)
        self._lone = lone

    def _pass(self, seconds: float) -> None:
        self._lone.in_loop(lambda: super(_LineClock, self)._pass(seconds))


class CoreService(Service):
    """A core behind the server of its link, on a bench of its own."""

    def __init__(self, lone: Any, settings: dict[str, Any], force_law: ForceLaw):
        self.core = lone.core
        self.faults = lone.faults
        self.clock = _LineClock(lone)
        # A driver may name its TCP port in whatever notation; the number is in all of them.
        self.place = lone.place.rpartition(":")[2]
        self.settings = settings
        self._lone, self._force_law = lone, force_law

    def in_real_time(self) -> AbstractContextManager[None]:
        """Let time pass by itself meanwhile."""
        free: AbstractContextManager[None] = self._lone.bench.free()
        return free

    def truth(self, what: str) -> Any:
        """Return what the instrument does, by the role's quantity, or a property of its core."""
        own: dict[str, Callable[[], Any]] = {
            "bytes": lambda: self._lone.server.bytes_sent,
            "force law": lambda: self._force_law,
            "terminals": lambda: TERMINALS,
            "angle": lambda: self.core.position,
        }
        if what in own:
            return own[what]()
        if what in ("frequency", "amplitude", "on"):
            return self._generated(what)
        return getattr(self.core, what)

    def _generated(self, what: str) -> Any:
        """Return what the terminals of the generator's channel 1 carry."""
        excitation = self._lone.bench.excitations.get(1)
        assert excitation is not None or what == "on", (
            "the simulator has not said what its output carries: port.excite(1, ...) is missing"
        )
        if what == "on":
            return excitation is not None and excitation.on
        return excitation.frequency_Hz if what == "frequency" else excitation.amplitude_V

    def at_rest(self) -> bool:
        """Return whether the instrument does nothing that has to be stopped: no stream, no output,
        no acquisition, no motion."""
        role = self.core.roles[0]
        if role == "generator":
            return not self._generated("on")
        if role in ("daq", "force_sensor"):
            return not (self.core.acquiring if role == "daq" else self.core.streaming)
        return not self.core.moving and self.core.speed == 0

    def connections(self) -> int:
        """Return how many clients have the link open."""
        count: int = self._lone.connections()
        return count


class CoreCase(Case):
    """A driver with its simulator core, on the link that the core names."""

    stranger_says = "T-1000"

    def __init__(
        self,
        driver: str,
        core: Any,
        settings: Mapping[str, Any] | None = None,
        silent_first_request: str = "",
        force_scale: float = 1.0,
        travel: tuple[float, float] | None = None,
        no_identity: str = "",
    ):
        self.name = f"{driver}-{core.link}"
        self.driver = driver
        self.deaf_greeting = silent_first_request
        self.no_identity = no_identity
        self.alike = tuple(core.alike)
        if core.link == "serial":
            self.exclusive_link = "a serial port belongs to the one who has opened it"
        if "force_sensor" in core.roles:
            self.drives_nothing = (
                "a sensor drives nothing, and its stream guards the rest of the bench"
            )
        if not core.serial_number.startswith("SIM"):
            self.anonymous = "its serial number does not begin with SIM, or it has none"
        slow = [rate for rate in getattr(core, "rates", ()) if rate <= USUAL_RATE_S_s]
        self._force_law = ForceLaw(max(slow, default=USUAL_RATE_S_s), force_scale)
        self._core, self._settings, self._travel = core, settings or {}, travel

    def module(self) -> Any:
        """Return the driver's module; raises ConfigurationError where its simulator has another
        role."""
        module = super().module()
        if module.ROLES[0] not in self._core.roles:
            raise ConfigurationError(
                f"driver {self.driver!r} is for the role {module.ROLES[0]}, its simulator "
                f"{self._core.__name__} for {' and '.join(self._core.roles) or 'none'}",
                "derive the simulator from the core of that role",
            )
        return module

    def disguise(self, core: Any, identity: tuple[str, str, str, str]) -> None:
        """Make the core say that it is another instrument."""
        core.vendor, core.model, core.serial_number, core.firmware = identity

    @contextmanager
    def _serve(
        self, faults: Sequence[Mapping[str, Any]], identity: tuple[str, str, str, str] | None
    ) -> Iterator[CoreService]:
        with load(BENCHES, "simulated").alone(
            self._core,
            self.module().ROLES[0],
            faults=list(faults),
            force_law=self._force_law,
            wave=carried,
            limits=self._travel,
        ) as lone:
            if identity is not None:
                self.disguise(lone.core, identity)
            table = {
                "driver": self.driver,
                **lone.core.bench_settings(lone.place),
                "timeout_s": TIMEOUT_S,
            }
            if "daq" in self._core.roles:
                wired = {name: lone.core.channel(one) for name, one in TERMINALS.items()}
                table["channels"] = wired
            yield CoreService(lone, {**table, **self._settings}, self._force_law)
