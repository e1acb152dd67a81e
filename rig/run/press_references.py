"""What a bench's earlier runs have shown of a press, to compare a run with.

A force sensor with a wrong scale does not show it: it reads a plausible force, and z presses with
another one. But the same object on the same bench then seems softer or stiffer than before. The
first press of a kind is the reference for the following ones, in one file in the folder of results;
a run that is begun with ``--accept REASON`` makes its own press the reference.
"""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, ValidationError

from rig.core.atomic import write_text
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan

FILE = "press-references.json"
ADDRESS = ("resource", "host", "port", "unit_id")


class PressReference(BaseModel):
    """What one press has shown."""

    model_config = ConfigDict(frozen=True)

    time: str
    """When it was made the reference, local time."""
    way_mm: float
    """Way of z from contact to the force."""
    stiffness_N_mm: float
    zero_N: tuple[float, float, float]
    """The force sensor's zero along x, y, z, relative to the amplifier's own."""
    reason: str = ""
    """Why it has replaced an earlier one; empty for the first."""


class _References(BaseModel):
    references: dict[str, PressReference] = {}


class PressReferences:
    """The references of one bench with what is mounted on it."""

    def __init__(self, folder: Path | None, plan: BenchPlan, sample: str, accept: str = ""):
        """`folder` is that of the results, None where nothing is to be compared. `accept` is the
        reason for which this run's presses become the references, if any."""
        self._path = None if folder is None else folder / FILE
        self._bench = _bench_key(plan, sample)
        self.accept = accept
        self._accepted: set[str] = set()

    @property
    def compares(self) -> bool:
        """Whether there is a place for references."""
        return self._path is not None

    def of(self, kind: str) -> PressReference | None:
        """Return the reference for a kind of press; None where there is none, or where this run has
        yet to replace it. Raises ConfigurationError for a file that cannot be understood."""
        key = self._key(kind)
        if self.accept and key not in self._accepted:
            return None
        return self._read().references.get(key)

    def remember(
        self, kind: str, way_mm: float, stiffness_N_mm: float, zero_N: tuple[float, float, float]
    ) -> None:
        """Make this press the reference of its kind. Raises OSError if it cannot be written."""
        if self._path is None:
            return
        key = self._key(kind)
        reference = PressReference(
            time=time.strftime("%Y-%m-%d %H:%M:%S"),
            way_mm=way_mm,
            stiffness_N_mm=stiffness_N_mm,
            zero_N=zero_N,
            reason=self.accept,
        )
        known = self._read().references | {key: reference}
        text = _References(references=known).model_dump_json(indent=1) + "\n"
        write_text(self._path, text, durable=False)
        self._accepted.add(key)

    def _read(self) -> _References:
        if self._path is None:
            return _References()
        try:
            return _References.model_validate_json(self._path.read_text("utf-8"))
        except FileNotFoundError:
            return _References()
        except (OSError, ValueError, ValidationError) as error:
            raise ConfigurationError(
                f"{self._path} cannot be read: it holds what earlier runs have shown of a press",
                "restore it, or remove it: then the next run is the reference",
            ) from error

    def _key(self, kind: str) -> str:
        return hashlib.sha256(f"{self._bench}\n{kind}".encode()).hexdigest()[:16]


def _bench_key(plan: BenchPlan, sample: str) -> str:
    """Name the bench by its instruments, its fixture and its specimen. A simulated bench, whose
    addresses are new each time, is named by what it simulates."""
    own = plan.settings
    instruments: object = own.simulation
    if own.simulation is None:
        instruments = [
            {name: value for name, value in part.settings.model_dump().items() if name in ADDRESS}
            for part in plan.instruments
        ]
    parts = (own.film, own.skin)
    names = [None if part is None else part.name for part in parts]
    described = [instruments, own.fixture.model_dump(mode="json"), names, sample]
    return json.dumps(described, sort_keys=True, default=str)
