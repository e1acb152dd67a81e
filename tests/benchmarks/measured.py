"""What the benchmarks share: the machine in a line, a spread in a line, a target met or missed, and
how often to repeat: `RIG_REPEATS` in the environment shortens or lengthens a benchmark."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def repeats(default: int) -> int:
    """Return how often a benchmark repeats its measurement: `RIG_REPEATS`, or else `default`."""
    return int(os.environ.get("RIG_REPEATS", default))


def machine() -> str:
    """Processor, cores this process may use, Python, and how busy the machine is already."""
    model = platform.machine()
    if (cpuinfo := Path("/proc/cpuinfo")).exists():
        named = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = named[0].partition(":")[2].strip() if named else model
    cores = len(os.sched_getaffinity(0))
    return (
        f"{model}, {cores} cores, Python {platform.python_version()}, "
        f"load before {os.getloadavg()[0]:.2f}"
    )


def heading(command: str) -> None:
    """Two lines above a table: where, and what."""
    print(f"\n\nmachine: {machine()}\ncommand: {command}")


def row(name: str, values: Sequence[float], unit: str, digits: int = 3) -> float:
    """Print median, quartiles and extremes of repeated measurements; gives the median."""
    v = np.asarray(values, float)
    low, median, high = np.quantile(v, [0.25, 0.5, 0.75])
    print(
        f"{name:44s} median {median:8.{digits}f} {unit}, quartiles {low:.{digits}f} to "
        f"{high:.{digits}f}, range {v.min():.{digits}f} to {v.max():.{digits}f} (n = {v.size})"
    )
    return float(median)


def target(name: str, value: float, bound: float, unit: str, at_least: bool = False) -> None:
    """Say whether a figure meets its target; a wall-clock figure is never asserted."""
    met = value >= bound if at_least else value <= bound
    words = "at least" if at_least else "at most"
    print(f"target {name}: {words} {bound:g} {unit}, is {value:.4g}: {'met' if met else 'MISSED'}")
