"""The simulated bench as its users start it.

Entry point ``simulated`` of group ``rig.benches``. `serve` runs the bench here until it is stopped
(``rig simulate``); `start` runs it as a process of its own with its time slaved to the caller,
which is what a run without a bench file does. Both end up in the same few lines of
`drivers.simulated.bench.process`, which whoever starts a bench does not import.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from drivers.simulated.bench.options import (
    Options,
    Stages,
    driver_names,
    fault_plan,
    options_for,
    variant_for,
)
from rig.core.errors import ConfigurationError, InstrumentError

if TYPE_CHECKING:
    from drivers.simulated.faults.disk import FaultyDisk

__all__ = ["StartedBench", "alone", "options_for", "serve", "start", "variant_for", "variants"]

ABANDONED_S = 0.5
"""Time in s after which a bench ends by itself if no run has connected to it."""


class StartedBench:
    """A bench that was started as a process of its own, and how to drive it."""

    def __init__(self, options: Options):
        """Start the process of a bench with these options. Raises ConfigurationError for a fault
        plan that is wrong; no process is started then."""
        self._disk = _faulty_disk(options)
        self.drivers = driver_names(options)
        """Names of the drivers in its bench file."""
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "drivers.simulated.bench.process"],
            stdin=subprocess.PIPE,  # its end informs the bench that this process has died
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # a terminal's Ctrl-C is the run's business, not the bench's
        )
        if self._disk is not None:
            self._disk.install()
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # `ready` reports one that has died
            self._process.stdin.write(json.dumps(asdict(options)).encode() + b"\n")
            self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def ready(self) -> dict[str, Any]:
        """Wait until the bench listens: ``control_port``, ``bench_toml``, ``recorded_toml``.

        Raises ConfigurationError for options that the bench refuses, InstrumentError if its process
        ends.
        """
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        answer: dict[str, Any] = json.loads(line) if line else {}
        if "error" in answer:
            raise ConfigurationError(answer["error"], answer["hint"])
        if "control_port" not in answer:
            assert self._process.stderr is not None
            words = self._process.stderr.read().decode(errors="replace").strip().splitlines()
            raise InstrumentError(
                "simulated bench", "start", words[-1] if words else "the process ended at once"
            )
        return answer

    def wait(self, timeout_s: float = 5.0) -> None:
        """Wait for the process to end; one that does not is ended. With it end the faults of the
        disk. What it had to say meanwhile is shown."""
        if self._disk is not None:
            self._disk.remove()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None and not self._process.stdout.closed:
            for line in self._process.stdout:
                with contextlib.suppress(ValueError, KeyError):  # the end of one that was killed
                    sys.stderr.write(f"{json.loads(line)['line']}\n")
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()

    def abandon(self) -> None:
        """End the process, to which nothing has been connected: it may still be making its skin."""
        self._process.terminate()
        self.wait(ABANDONED_S)


def variants() -> tuple[str, ...]:
    """Return the stages that the bench can have, by the names that `Options.stages` takes; the
    first is the usual one."""
    return get_args(Stages)


def start(options: dict[str, Any]) -> StartedBench:
    """Start a slaved bench; `options` are fields of `Options`.

    A fault plan's disk is this process's, until the bench has been waited for. Raises
    ConfigurationError for a fault plan that is wrong.
    """
    return StartedBench(Options(**{**options, "slaved": True}))


def serve(
    options: dict[str, Any],
    ready: Callable[[str], None],
    show_line: Callable[[str], None] = lambda text: None,
) -> None:
    """Run a bench here in real time until SIGINT, SIGQUIT or SIGTERM.

    `ready` gets the bench file's text; `show_line` shows a line to who runs it.
    """
    import asyncio

    from drivers.simulated.bench import process

    asyncio.run(
        process.serve(Options(**options), lambda said: ready(said["bench_toml"]), show_line)
    )


def alone(core: Any, role: str, **options: Any) -> AbstractContextManager[Any]:
    """Serve one simulated instrument without a bench, for the contract of its driver: see
    `drivers.simulated.bench.alone`."""
    from drivers.simulated.bench import alone as lone

    return lone.alone(core, role, **options)


def _faulty_disk(options: Options) -> FaultyDisk | None:
    """Return the disk of the owner's results, where the fault plan has something for it."""
    if options.fault is None or options.results is None:
        return None
    from drivers.simulated.faults.disk import FaultyDisk
    from drivers.simulated.faults.plan import FileFault

    faults: tuple[FileFault, ...] = fault_plan(options).of(FileFault)
    return FaultyDisk(faults, Path(options.results)) if faults else None
