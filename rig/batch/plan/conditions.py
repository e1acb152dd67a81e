"""The conditions that a batch file expands to and the runs of each, in their order, as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class BatchCondition:
    """One set of settings of one procedure, run once or several times."""

    id: str
    """Stable and readable: ``slip-trial-002``, after experiment and place in its matrix."""
    experiment: int
    """Index of its ``[[experiment]]``, from 0."""
    procedure: str
    settings: Mapping[str, Any]
    """The whole of the procedure's settings, validated, as plain values of JSON."""
    varied: Mapping[str, Any]
    """Settings that the matrix or the sample varies."""
    reference: bool = False
    rest_s: float = 0.0
    """Rest before each of its runs."""


@dataclass(frozen=True)
class PlannedRun:
    """A run of the queue: which condition it executes, and as which of its repeats."""

    number: int
    """Place in the queue, from 1; keys its file, and the noise of a simulated bench."""
    condition: str
    repeat: int
    """Number of the run among its condition's runs, from 1."""


@dataclass(frozen=True)
class BatchPlan:
    """The batch file, expanded: its conditions by their ids, and its runs in the order of the
    queue."""

    conditions: Mapping[str, BatchCondition]
    runs: tuple[PlannedRun, ...]
