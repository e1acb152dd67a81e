"""Describes a driver for the contract: a `Case`, and the running simulator behind it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from typing import Any, Protocol

from rig.core.clock import Clock
from rig.core.entry_points import DRIVERS, load

TIMEOUT_S = 0.1
"""The time-out that a driver gets during the checks."""
STRANGER = ("ACME", "T-1000", "77", "0.1")
"""Vendor, model, serial number and firmware of an instrument that no driver expects."""


class SettableTime(Protocol):
    """A bench whose time is set by hand."""

    now_us: int


class BenchClock(Clock):
    """The clock of such a bench: time passes while something sleeps on it, and only then."""

    def __init__(self, bench: SettableTime):
        super().__init__()
        self._bench = bench

    def now(self) -> float:
        """Return the bench time in seconds."""
        return self._bench.now_us * 1e-6

    def _pass(self, seconds: float) -> None:
        self._bench.now_us += max(1, round(seconds * 1e6))


class HeardRequests(Protocol):
    """The requests that reached a simulated instrument, and whether each has an answer."""

    heard: list[bytes]
    answered: list[bool]

    @property
    def requests(self) -> int:
        """Number of requests so far."""
        ...


class Service(ABC):
    """A simulator that is running on its transport."""

    clock: Clock
    """The clock to connect the driver with."""
    faults: HeardRequests
    settings: dict[str, Any]
    """A bench file's table for the driver."""
    place: str
    """Name of the instrument's place in messages."""

    @cached_property
    def attending(self) -> dict[int, Callable[[], None] | None]:
        """Return what ends the runner's attention to each connected instrument, by its `id`."""
        return {}

    def now_s(self) -> float:
        """Return the bench time in seconds."""
        return self.clock.now()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of bench time pass."""
        self.clock.sleep(seconds)

    def in_real_time(self) -> AbstractContextManager[None]:
        """Let bench time follow the wall clock within the block, for a module's `make_safe` that
        waits on the wall clock; most do not."""
        return nullcontext()

    @abstractmethod
    def truth(self, what: str) -> Any:
        """Return what the simulated instrument really does, by the role's quantity."""

    @abstractmethod
    def at_rest(self) -> bool:
        """Return whether the instrument does nothing that has to be stopped."""

    @abstractmethod
    def connections(self) -> int:
        """Return how many connections clients hold open."""


class Case(ABC):
    """One driver on one transport."""

    name: str
    driver: str
    """Entry point of group ``rig.drivers``."""
    every_fault = True
    """False where another case has the same driver on the same transport: the walk of all faults
    over all requests takes seconds."""
    alike: tuple[bytes, ...] = ()
    """Beginnings of requests that a driver sends many times over, such as a poll or the reading of
    one parameter like another: the walk of faults visits the first of each in every step. All
    other requests are visited every one."""
    exclusive_link = ""
    """Reason why a second connection is impossible while one is open; empty if it is possible."""
    deaf_greeting = ""
    """Reason why a lost answer to the very first request is not noticed; empty if it is."""
    drives_nothing = ""
    """Reason why the module's `make_safe` has nothing to do; empty if it has something to do."""
    anonymous = ""
    """Reason why the instrument cannot report that it is simulated; empty if it can."""
    no_identity = ""
    """Reason why the instrument cannot be distinguished from another one; empty if it can."""
    stranger_says = "ACME T-1000"
    """Text that names an instrument other than the expected one in the refusal."""

    def __repr__(self) -> str:
        return self.name

    def module(self) -> Any:
        """Return the driver's module, found as the program finds it; raises ConfigurationError
        where it is not installed or lacks something."""
        return load(DRIVERS, self.driver)

    def serve(
        self, *fault: Mapping[str, Any], identity: tuple[str, str, str, str] | None = None
    ) -> AbstractContextManager[Any]:
        """Return a context manager that gives a running `Service`.

        `fault` are entries of a fault plan without their device; `identity` makes the instrument a
        stranger.
        """
        return self._serve([{"device": "it", **one} for one in fault], identity)

    @abstractmethod
    def _serve(
        self, faults: Sequence[Mapping[str, Any]], identity: tuple[str, str, str, str] | None
    ) -> AbstractContextManager[Any]:
        """Start the simulator on its transport, with these faults of a device named "it"."""
