"""The contract for a driver whose simulator is one core, such as a laboratory brings for its own
force sensor.

The servers, faults and bench come from the installed simulated bench, found by its entry point.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rig.core.entry_points import BENCHES, load
from rig.core.errors import ConfigurationError
from rig.testing.case import TIMEOUT_S, BenchClock, Case, Service
from rig.testing.signals import ForceLaw, USUAL_RATE_S_s

SERVED_ROLES = ("force_sensor",)


class _LineClock(BenchClock):
    """Bench time passes in the server's thread, which sends what falls due."""

    def __init__(self, lone: Any):
        super().__init__(lone.bench)
        self._lone = lone

    def _pass(self, seconds: float) -> None:
        self._lone.in_loop(lambda: super(_LineClock, self)._pass(seconds))


class CoreService(Service):
    """A core behind the server of its link, on a bench that presses by a known law."""

    def __init__(self, lone: Any, settings: dict[str, Any], force_law: ForceLaw):
        self.core = lone.core
        self.faults = lone.faults
        self.clock = _LineClock(lone)
        self.place = lone.place
        self.settings = settings
        self._lone, self._force_law = lone, force_law

    def truth(self, what: str) -> Any:
        """Return the stream's state, or a property of the sensor."""
        if what == "bytes":
            return self._lone.server.bytes_sent
        return self._force_law if what == "force law" else getattr(self.core, what)

    def at_rest(self) -> bool:
        """Return whether the sensor is silent."""
        return not self.core.streaming

    def connections(self) -> int:
        """Return how many clients have the link open."""
        count: int = self._lone.connections()
        return count


class CoreCase(Case):
    """A driver of a force sensor with its simulator core, on the link that the core names."""

    drives_nothing = "a sensor drives nothing, and its stream guards the rest of the bench"
    stranger_told = "T-1000"

    def __init__(
        self,
        driver: str,
        core: Any,
        settings: Mapping[str, Any],
        silent_first_request: str = "",
        force_scale: float = 1.0,
    ):
        self.name = f"{driver}-{core.link}"
        self.driver = driver
        self.deaf_greeting = silent_first_request
        self.alike = tuple(core.alike)
        if core.link == "serial":
            self.exclusive_link = "a serial port belongs to the one who has opened it"
        if not core.serial_number.startswith("SIM"):
            self.anonymous = "its serial number does not begin with SIM, or it has none"
        slow = [rate for rate in core.rates if rate <= USUAL_RATE_S_s]
        self._force_law = ForceLaw(max(slow, default=USUAL_RATE_S_s), force_scale)
        self._core, self._settings = core, settings

    def module(self) -> Any:
        """Return the driver's module; ConfigurationError where its role is not served here."""
        module = super().module()
        if module.ROLES[0] not in SERVED_ROLES:
            raise ConfigurationError(
                f"driver_contract serves {', '.join(SERVED_ROLES)}; driver {self.driver!r} is for "
                f"the role {module.ROLES[0]}",
                "write a subclass of rig.testing.Case for it and use rig.testing.contract_of",
            )
        return module

    def disguise(self, core: Any, identity: tuple[str, str, str, str]) -> None:
        """Make the core say that it is another instrument."""
        core.vendor, core.model, core.serial_number, core.firmware = identity

    @contextmanager
    def _serve(
        self, faults: Sequence[Mapping[str, Any]], identity: tuple[str, str, str, str] | None
    ) -> Iterator[CoreService]:
        with load(BENCHES, "simulated").alone(self._core, self._force_law, list(faults)) as lone:
            if identity is not None:
                self.disguise(lone.core, identity)
            table = {
                "driver": self.driver,
                **lone.core.bench_settings(lone.place),
                "timeout_s": TIMEOUT_S,
                **self._settings,
            }
            yield CoreService(lone, table, self._force_law)
