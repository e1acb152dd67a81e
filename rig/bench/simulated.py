"""What a simulated bench has to offer: the interface of the entry-point group ``rig.benches``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol


class BenchFactory(Protocol):
    """What an entry point of group ``rig.benches`` names: a module that can be a bench."""

    def variants(self) -> tuple[str, ...]:
        """The names of the benches that it can be, for the option ``stages``; the usual one is the
        first."""
        ...

    def variant_for(self, drivers: Mapping[str, str]) -> str | None:
        """The variant that stands in for a bench with these drivers (names by role): its stages
        have their limits. None where it has none for them."""
        ...

    def options_for(self, drivers: Mapping[str, str]) -> dict[str, Any]:
        """Options for `start` that give the bench the simulators of these drivers (names by role),
        as far as they are installed."""
        ...

    def start(self, options: dict[str, Any]) -> RunningBench:
        """Start the bench as a process of its own, its time slaved to the caller."""
        ...

    def serve(self, options: dict[str, Any], ready: Callable[[str], None]) -> None:
        """Be the bench in real time until stopped; `ready` gets the text of its bench file."""
        ...


class RunningBench(Protocol):
    """A simulated bench that was started for one run."""

    def ready(self) -> dict[str, Any]:
        """Wait until it listens: ``control_port``, ``bench_toml``, ``recorded_toml``, the same text
        without the process's port numbers, and ``models``, the instruments' by role."""
        ...

    def wait(self, timeout_s: float = 5.0) -> None:
        """Wait for the process to end."""
        ...

    def abandon(self) -> None:
        """End the process, to which nothing has been connected."""
        ...
