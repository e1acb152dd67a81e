"""The connected bench: its instruments by role, their limits and their links."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from rig.bench.link_worker import LinkWorkers
from rig.bench.plan import BenchPlan
from rig.bench.settings import (
    BenchSettings,
    FilmSettings,
    LoadCellSettings,
    MountedSkinSettings,
    Strip,
)
from rig.core.clock import Clock
from rig.core.errors import (
    ConfigurationError,
    RigError,
)
from rig.instruments.calibration import (
    FilmCalibration,
)
from rig.instruments.roles import (
    DataAcquisition,
    ForceSensor,
    Instrument,
    Limits,
    LinearStage,
    RotaryStage,
    SignalGenerator,
)

log = logging.getLogger("rig")
T = TypeVar("T")


@dataclass
class Bench:
    """The connected instruments of a bench, with its plan, limits and calibrations."""

    plan: BenchPlan
    clock: Clock
    instruments: dict[str, Instrument]
    links: LinkWorkers
    """A worker for each instrument's link."""
    strip_calibrations: dict[Strip, FilmCalibration] = field(default_factory=dict)
    """Calibration records in use, by strip of the skin."""

    @property
    def settings(self) -> BenchSettings:
        """The settings of the bench itself, without those of its instruments."""
        return self.plan.settings

    @property
    def generator(self) -> SignalGenerator:
        """The source of the sinusoidal drive. Raises ConfigurationError if the bench has none."""
        return self._role("generator")  # type: ignore[return-value]

    @property
    def daq(self) -> DataAcquisition:
        """The unit that samples film, load cell and strips.

        Raises ConfigurationError if the bench has none.
        """
        return self._role("daq")  # type: ignore[return-value]

    @property
    def stage_z(self) -> LinearStage:
        """The stage that presses. Raises ConfigurationError if the bench has none."""
        return self._role("stage_z")  # type: ignore[return-value]

    @property
    def stage_x(self) -> LinearStage:
        """The stage that slides the object. Raises ConfigurationError if the bench has none."""
        return self._role("stage_x")  # type: ignore[return-value]

    @property
    def rotary(self) -> RotaryStage:
        """The stage that rolls the object. Raises ConfigurationError if the bench has none."""
        return self._role("rotary")  # type: ignore[return-value]

    @property
    def force_sensor(self) -> ForceSensor:
        """The sensor of F_n and F_t. Raises ConfigurationError if the bench has none."""
        return self._role("force_sensor")  # type: ignore[return-value]

    @property
    def film(self) -> FilmSettings:
        """The film in the clamp, as the bench file describes it; ConfigurationError without one."""
        return self._part("film", self.settings.film)

    @property
    def load_cell(self) -> LoadCellSettings:
        """The cell that measures the sinusoidal load, as the bench file describes it.

        Raises ConfigurationError if the bench file describes none.
        """
        return self._part("load_cell", self.settings.load_cell)

    @property
    def skin(self) -> MountedSkinSettings:
        """The mounted skin, as the bench file describes it; ConfigurationError without one."""
        return self._part("skin", self.settings.skin)

    @property
    def simulated(self) -> bool:
        """True if any part of this bench is simulated, by its bench file or by an instrument's
        identity."""
        admitted = any(i.identity.simulated for i in self.instruments.values())
        return self.settings.simulation is not None or admitted

    def limits(self) -> dict[str, Limits]:
        """Return the limits of every instrument and of the load cell, by ``role.quantity``."""
        limits = {
            f"{role}.{quantity}": limits
            for role, instrument in self.instruments.items()
            for quantity, limits in instrument.limits().items()
        }
        if self.settings.load_cell is not None:
            largest = self.settings.load_cell.max_load_N
            limits["load_cell.load"] = Limits(0.0, largest, "N", "load cell")
        return limits

    def hand_over(self) -> None:
        """Close every instrument, so that another program can reach all of them: a serial port or a
        line answers one at a time. `close` has still to be called; nothing else may be."""
        self.links.close()
        close_all(self.instruments)
        with contextlib.suppress(RigError):
            self.clock.set_free()

    def close(self) -> None:
        """Close every instrument; a failure of one does not prevent closing the others."""
        self.links.close()
        close_all(self.instruments)
        self.clock.close()

    def _role(self, role: str) -> Instrument:
        if role not in self.instruments:
            raise ConfigurationError(
                f"{self.plan.source}: the bench has no {role}", f"add a [{role}] table"
            )
        return self.instruments[role]

    def _part(self, name: str, part: T | None) -> T:
        if part is None:
            raise ConfigurationError(
                f"{self.plan.source}: the bench file describes no {name}", f"add a [{name}] table"
            )
        return part


def close_all(instruments: Mapping[str, Instrument]) -> None:
    """Close every instrument; a failure of one does not prevent closing the others."""
    for role, instrument in instruments.items():
        try:
            with contextlib.suppress(RigError, OSError):
                instrument.close()
        except Exception:  # a defect of its driver
            log.exception("%s: close", role)
