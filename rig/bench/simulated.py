"""The interface of a simulated bench, for the entry-point group ``rig.benches``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol


class BenchFactory(Protocol):
    """The members of a module that an entry point of the group ``rig.benches`` names."""

    def variants(self) -> tuple[str, ...]:
        """Return the names of the benches that the module can simulate, for the option ``stages``;
        the default comes first."""
        ...

    def variant_for(self, drivers: Mapping[str, str]) -> str | None:
        """Return the variant whose stages have the limits of a bench with these drivers (names by
        role), or None if there is no such variant."""
        ...

    def options_for(self, drivers: Mapping[str, str]) -> dict[str, Any]:
        """Return options for `start` that give the bench the simulators of these drivers (names by
        role), as far as they are installed."""
        ...

    def start(self, options: dict[str, Any]) -> RunningBench:
        """Start the bench as a separate process whose time the caller advances."""
        ...

    def serve(
        self,
        options: dict[str, Any],
        ready: Callable[[str], None],
        show_line: Callable[[str], None] = ...,
    ) -> None:
        """Run the bench in real time until stopped; `ready` is called with the text of its bench
        file, `show_line` with each line that who runs it should see."""
        ...


class RunningBench(Protocol):
    """The process of a simulated bench that was started for one run."""

    drivers: tuple[str, ...]
    """Names of the drivers in its bench file: they can be imported while it boots."""

    def ready(self) -> dict[str, Any]:
        """Wait until it listens: ``control_port``, ``bench_toml``, ``recorded_toml``, the same text
        without the process's port numbers, and ``models``, the instruments' by role."""
        ...

    def wait(self, timeout_s: float = 5.0) -> None:
        """Wait for the process to end."""
        ...

    def abandon(self) -> None:
        """End a process to which nothing has been connected."""
        ...
