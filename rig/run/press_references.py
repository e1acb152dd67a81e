"""What a bench's earlier runs have shown of a press, to compare a run with.

A force sensor with a wrong scale does not show it: it reads a plausible force, and z presses with
another one. But the same object on the same bench then seems softer or stiffer than before. The
first press of a kind is the reference for the following ones; a run that is begun with ``--accept
REASON`` makes its own press the reference.

The references belong to the bench, named by the addresses of its z stage and force sensor, so they
lie where all its users find them whatever their folder of results: in the shared folder, beside
locks and marks. Those of a simulated bench lie in the folder of results: no one else relies on
them.
"""

from __future__ import annotations

import hashlib
import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, ValidationError

from rig.bench.addresses import addresses_of
from rig.core.atomic import write_text
from rig.core.errors import ConfigurationError, RigError
from rig.run.locks.shared_folder import SharedFolder

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan

FILE = "press-references.json"
"""Name of the file in a folder of results; in the shared folder it begins with the bench's."""
PRESSING = ("stage_z", "force_sensor")
"""Roles whose addresses name a bench."""
TIME_FORMAT = "%Y-%m-%d %H:%M:%S"
MOST_BYTES = 1 << 22
"""Largest size of the file: some ten thousand kinds of press."""


class TouchGain(BaseModel):
    """The gain of a strip during a touch-down, with its standard error."""

    model_config = ConfigDict(frozen=True)

    value_V_s_N: float
    error_V_s_N: float


class PressReference(BaseModel):
    """What one press has shown of the contact, to compare later runs with."""

    model_config = ConfigDict(frozen=True)

    time: str
    """When it was made the reference, local time."""
    way_mm: float
    """Way of z from contact to the force."""
    stiffness_N_mm: float
    zero_N: tuple[float, float, float]
    """The force sensor's zero along x, y, z, relative to the amplifier's own."""
    touch_gains: dict[str, TouchGain] = {}
    """Touch gains by strip; only those that could be distinguished from zero."""
    bench: str = ""
    """Name of the bench, for who reads the file."""
    kind: str = ""
    reason: str = ""
    """Why it has replaced an earlier one; empty for the first."""


class _References(BaseModel):
    references: dict[str, PressReference] = {}


class _InResults:
    """The file in a folder of results."""

    def __init__(self, folder: Path):
        self._path = folder / FILE

    def __str__(self) -> str:
        return str(self._path)

    def read(self) -> str | None:
        """Return the text; None where there is none. Raises OSError or ValueError."""
        try:
            return self._path.read_text("utf-8")
        except FileNotFoundError:
            return None

    def write(self, text: str) -> None:
        """Write the text in place of an earlier one. Raises OSError."""
        write_text(self._path, text, durable=False)


class _InSharedFolder:
    """The file of a bench in the folder that all its users share."""

    def __init__(self, addresses: object):
        named = hashlib.sha256(json.dumps(addresses, sort_keys=True).encode()).hexdigest()[:16]
        self._name = f"{named}-{FILE}"

    def __str__(self) -> str:
        with SharedFolder() as folder:
            return str(folder.path / self._name)

    def read(self) -> str | None:
        """Return the text; None where there is none. Raises OSError or ValueError."""
        with SharedFolder() as folder:
            return folder.read(self._name, MOST_BYTES)

    def write(self, text: str) -> None:
        """Write the text in place of an earlier one. Raises OSError."""
        with SharedFolder() as folder:
            folder.write(self._name, text)


class PressReferences:
    """The references of one bench with what is mounted on it."""

    def __init__(
        self,
        results: Path | None,
        plan: BenchPlan,
        sample: str,
        accept: str = "",
        begun: str | None = None,
    ):
        """`results` is the folder of results, None where nothing is to be compared. `accept` is the
        reason for which this run's presses become the references, if any. `begun`, in ISO 8601
        with its zone, is when the run began that is resumed; None for a new one."""
        self._file = None if results is None else _file_of(plan, results)
        self._bench = _bench_key(plan, sample)
        self._bench_name = plan.settings.name
        self.accept = accept
        self._begun = datetime.now() if begun is None else _local(begun)
        self._own: dict[str, PressReference] = {}
        """References that this run has set, by their keys; not written yet."""

    @property
    def compares(self) -> bool:
        """Whether there is a place for references."""
        return self._file is not None

    def of(self, kind: str) -> PressReference | None:
        """Return the reference for a kind of press; None where there is none, or where this run has
        yet to replace it. Raises ConfigurationError for a file that cannot be understood."""
        key = self._key(kind)
        if (own := self._own.get(key)) is not None:
            return own
        found = self._read().references.get(key)
        if found is None or not self.accept:
            return found
        # One that is newer than the run has been set by the run itself, before it was interrupted.
        return None if datetime.strptime(found.time, TIME_FORMAT) < self._begun else found

    def remember(
        self, kind: str, way_mm: float, stiffness_N_mm: float, zero_N: tuple[float, float, float]
    ) -> None:
        """Compare the further presses of this kind with this one; `keep` makes it the reference of
        later runs."""
        self._own[self._key(kind)] = PressReference(
            time=datetime.now().strftime(TIME_FORMAT),
            way_mm=way_mm,
            stiffness_N_mm=stiffness_N_mm,
            zero_N=zero_N,
            bench=self._bench_name,
            kind=kind,
            reason=self.accept,
        )

    def remember_gain(self, kind: str, strip: str, gain: TouchGain) -> None:
        """Add the touch gain of a strip to the reference of a kind, if there is one."""
        if (reference := self.of(kind)) is not None:
            gains = reference.touch_gains | {strip: gain}
            self._own[self._key(kind)] = reference.model_copy(update={"touch_gains": gains})

    def keep(self) -> None:
        """Write what this run has set, for later runs: once the bench is safe, since a slow disk
        must not hold up what presses, and only where nothing spoke against the run's presses.
        Raises RigError if it cannot be written."""
        if self._file is None or not self._own:
            return
        known = self._read().references | self._own
        try:
            self._file.write(_References(references=known).model_dump_json(indent=1) + "\n")
        except OSError as error:
            raise RigError(
                f"no reference for later presses was saved to {self._file}: {error.strerror}",
                "free some disk space, or have the folder's owner correct it",
            ) from error

    def _read(self) -> _References:
        if self._file is None:
            return _References()
        try:
            text = self._file.read()
            return _References() if text is None else _References.model_validate_json(text)
        except (OSError, ValueError, ValidationError) as error:
            raise ConfigurationError(
                f"{self._file} cannot be read: it holds what earlier runs have shown of a press",
                "restore it, or remove it: then the next run is the reference",
            ) from error

    def _key(self, kind: str) -> str:
        return hashlib.sha256(f"{self._bench}\n{kind}".encode()).hexdigest()[:16]


def _local(time: str) -> datetime:
    """Return a time in ISO 8601 with its zone as local time without one."""
    return datetime.fromisoformat(time).astimezone().replace(tzinfo=None)


def _file_of(plan: BenchPlan, results: Path) -> _InResults | _InSharedFolder:
    # A simulated bench, also one that `rig simulate` has started or that stands in for a real one
    # in a dry run, must not set what a real bench is compared with.
    if plan.settings.simulation is not None:
        return _InResults(results)
    return _InSharedFolder(_addresses(plan))


def _addresses(plan: BenchPlan) -> list[tuple[str, str]]:
    # Only of what presses and what measures it: with another DAQ or a further stage it is the same
    # bench.
    return [
        (part.role, address)
        for part in plan.instruments
        if part.role in PRESSING
        for address in addresses_of(part.settings)[:1]
    ]


def _bench_key(plan: BenchPlan, sample: str) -> str:
    """Name the bench by its addresses, its fixture and its specimen. A simulated bench, whose
    addresses are new each time, is named by what it simulates.

    The places of the fixture are left out: to state another contact range must not lose what is
    known of the force sensor.
    """
    own = plan.settings
    # Without the World's defaults, of which a later version may have more.
    simulated = {key: value for key, value in (own.simulation or {}).items() if key != "world"}
    instruments = _addresses(plan) if own.simulation is None else simulated
    parts = (own.film, own.skin)
    names = [None if part is None else part.name for part in parts]
    described = [instruments, own.fixture.mounted, names, sample]
    return json.dumps(described, sort_keys=True, default=str)
