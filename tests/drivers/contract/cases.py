"""The registry: for every installed driver, how its simulator is put on its real transport.

To bring a driver under the contract, write a subclass of `Case` that starts its simulator and tells
the truth about it, and add it to `CASES`. Everything in ``test_every_driver.py`` then applies.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from typing import Any

from simulated.ideal import IdealBench, serving

from drivers.simulated.faults import FaultKind, FaultPlan, WireFaults
from drivers.simulated.keysight_33500b import Keysight33500B
from drivers.simulated.keysight_u2300a import KeysightU2300A
from drivers.simulated.scpi import ScpiInstrument
from drivers.simulated.servers import HislipServer, ScpiSocketServer
from rig.clock import Clock

from .roles import carried

TIMEOUT_S = 0.1
STRANGER = ("ACME", "T-1000", "77", "0.1")


class BenchClock(Clock):
    """The clock of an ideal bench: time passes when somebody sleeps, and only then."""

    def __init__(self, bench: IdealBench):
        super().__init__()
        self._bench = bench

    def now(self) -> float:
        """Bench time in seconds."""
        return self._bench.now_us * 1e-6

    def _pass(self, seconds: float) -> None:
        self._bench.now_us += max(1, round(seconds * 1e6))


class CountedFaults(WireFaults):
    """Faults that remember how many requests there were."""

    requests = 0

    def kind_for(self, request: bytes) -> FaultKind | None:
        """Count a request; the fault that befalls it."""
        self.requests += 1
        return super().kind_for(request)


class Service(ABC):
    """A simulator that is running on its transport."""

    def __init__(self, faults: CountedFaults):
        self.bench = IdealBench(wave=carried)
        self.clock = BenchClock(self.bench)
        self.faults = faults
        self.settings: dict[str, Any] = {}
        """A bench file's table for the driver."""

    def now_s(self) -> float:
        """Bench time in seconds."""
        return self.clock.now()

    def sleep(self, seconds: float) -> None:
        """Let bench time pass."""
        self.clock.sleep(seconds)

    @abstractmethod
    def truth(self, what: str) -> Any:
        """What the simulated instrument really does, by the role's quantity."""

    @abstractmethod
    def at_rest(self) -> bool:
        """Whether the instrument does nothing that has to be stopped."""

    @abstractmethod
    def connections(self) -> int:
        """How many connections clients hold open."""


class Case(ABC):
    """One driver on one transport."""

    name: str
    driver: str
    """Entry point of group ``rig.drivers``."""
    every_fault = True
    """False where another case has the same driver on the same transport: the walk of all faults
    over all requests takes seconds."""

    def __repr__(self) -> str:
        return self.name

    def module(self) -> Any:
        """The driver, found as the program finds it."""
        (entry,) = entry_points(group="rig.drivers", name=self.driver)
        return entry.load()

    def serve(
        self, *fault: dict[str, Any], identity: tuple[str, str, str, str] | None = None
    ) -> Any:
        """A context manager that gives a running `Service`; `identity` makes it a stranger."""
        plan = FaultPlan.model_validate({"fault": [{"device": "it", **one} for one in fault]})
        return self._serve(CountedFaults(plan, "it"), identity)

    @abstractmethod
    def _serve(self, faults: CountedFaults, identity: tuple[str, str, str, str] | None) -> Any: ...


class ScpiService(Service):
    """A SCPI core behind one of the TCP servers."""

    core: ScpiInstrument
    server: Any

    def connections(self) -> int:
        """Open TCP connections."""
        return len(self.server.transports)


class GeneratorService(ScpiService):
    """Channel 1 of a simulated 33500B."""

    core: Keysight33500B

    def truth(self, what: str) -> Any:
        """The channel's state."""
        state = self.core.state(1)
        return {
            "frequency": state.frequency_Hz,
            "amplitude": state.amplitude_Vpp / 2,
            "on": state.on,
        }[what]

    def at_rest(self) -> bool:
        """Output off."""
        return not self.core.state(1).on


class DaqService(ScpiService):
    """A simulated U2300A."""

    def truth(self, what: str) -> Any:
        """Its records are checked by what the terminals carried."""
        raise KeyError(what)

    def at_rest(self) -> bool:
        """Nothing is sampled."""
        happened = [value for _, what, value, _ in self.bench.entries if what == "acquisition"]
        return not happened or happened[-1] != "run"


class ScpiCase(Case):
    """A SCPI instrument on a raw socket or HiSLIP."""

    def __init__(self, name: str, driver: str, link: str, settings: dict[str, Any]):
        self.name = name
        self.driver = driver
        self._link = link
        self._settings = settings

    @abstractmethod
    def _service(self, faults: CountedFaults) -> ScpiService: ...

    @contextmanager
    def _serve(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[Service]:
        service = self._service(faults)
        if identity is not None:
            service.core.identity = identity
        kind = HislipServer if self._link == "hislip" else ScpiSocketServer
        service.server = kind(service.core, faults=faults)
        with serving(service.server):
            port = service.server.port
            where = f"hislip0,{port}::INSTR" if self._link == "hislip" else f"{port}::SOCKET"
            service.settings = {
                "driver": self.driver,
                "resource": f"TCPIP::127.0.0.1::{where}",
                "timeout_s": TIMEOUT_S,
                **self._settings,
            }
            yield service


class GeneratorCase(ScpiCase):
    """The 33500B."""

    def _service(self, faults: CountedFaults) -> ScpiService:
        service = GeneratorService(faults)
        service.core = Keysight33500B(service.bench, service.bench)
        return service


class DaqCase(ScpiCase):
    """One model of the U2300A family; HiSLIP stands for USBTMC, whose messages it has."""

    def __init__(self, model: str):
        wiring = {"channels": {"load_cell": 101, "film": 102}}
        super().__init__(f"{model}-hislip", "keysight-u2300a", "hislip", wiring)
        self._model = model
        self.every_fault = model == "U2331A"

    def _service(self, faults: CountedFaults) -> ScpiService:
        service = DaqService(faults)
        service.core = KeysightU2300A(self._model, service.bench, service.bench)
        return service


CASES: tuple[Case, ...] = (
    GeneratorCase("33500b-socket", "keysight-33500b", "socket", {"max_amplitude_V": 3.0}),
    GeneratorCase("33500b-hislip", "keysight-33500b", "hislip", {"max_amplitude_V": 3.0}),
    DaqCase("U2331A"),
    DaqCase("U2542A"),
)
