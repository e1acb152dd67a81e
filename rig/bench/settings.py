"""What a bench file says of the bench itself: fixture, film, skin, load cell. Values only."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from rig.core.settings import Settings
from rig.instruments.calibration import (
    CalibrationFiles,
)

ROLES = ("generator", "daq", "stage_z", "stage_x", "rotary", "force_sensor")


Fixture = Literal["film-clamp", "plate", "semi-spherical-object"]


Strip = Literal["strip_1", "strip_2"]


STRIPS: tuple[Strip, ...] = ("strip_1", "strip_2")
"""The skin's two channels as the DAQ's wiring names them: S1 and S2 of the paper."""


class FilmSettings(Settings):
    """The film under test and its amplifier."""

    amplifier_gain: float = Field(default=1.0, gt=0)
    """Gain between film and DAQ."""
    area_mm2: float = Field(default=8.0, gt=0)
    """Contact area of the indentor."""
    name: str = ""
    """Which film: its label or batch."""


class LoadCellSettings(Settings):
    """The dynamic force sensor that carries the film."""

    name: str = ""
    """Which cell: its label or serial number."""
    sensitivity_V_N: float = Field(gt=0)
    """Output per newton."""
    max_load_N: float = Field(default=20.0, gt=0)
    """Largest peak load that film and cell may see; beyond it the run trips."""


class MountedSkinSettings(Settings):
    """The artificial finger skin and the amplifiers of its two strips."""

    name: str = ""
    """Which skin: its label or batch."""
    amplifier_gain: float = Field(default=1000.0, gt=0)
    """Gain between a strip and the DAQ."""
    ridge: int = Field(default=3, ge=1)
    """The ridge that holds the strips, 1 is the leftmost."""
    b_dB: dict[Strip, float] = Field(default_factory=dict)
    """Calibrated b (paper eq. 2) by strip, without the amplifier's gain; none until calibrated. A
    calibration record in use replaces it."""
    b_error_dB: dict[Strip, float] = Field(default_factory=dict)
    """Standard error of each b."""
    films: dict[Strip, str] = Field(default_factory=dict)
    """Label of the film in each strip: a calibration record has to be of it."""

    @model_validator(mode="after")
    def _every_level_has_its_error(self) -> Self:
        if self.b_dB.keys() != self.b_error_dB.keys():
            raise ValueError("b_dB and b_error_dB have to name the same strips")
        if any(error < 0 for error in self.b_error_dB.values()):
            raise ValueError("b_error_dB is below 0")
        return self


class FixtureSettings(Settings):
    """What is mounted on the bench."""

    mounted: Fixture
    """A procedure refuses to run on the wrong fixture."""
    contact_from_mm: float | None = None
    """Position of the z stage at which the probe meets the object at the earliest: contact felt
    before means that something is in the way."""
    contact_to_mm: float | None = None
    """Position at which it has met the object: no contact by then means that there is none."""
    parked_mm: float = 5.0
    """Position at which the z stage waits, clear of everything. One that is not clear of contact
    refuses each run that presses, not this file: the bench can still be made safe with it."""
    centre_mm: float | None = None
    """Of an object that rolls: position of x at which the middle of the skin is above it."""
    upright_deg: float | None = None
    """Of an object that rolls: angle of the rotary stage at which it stands upright."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        first_mm, last_mm = self.contact_from_mm, self.contact_to_mm
        if first_mm is not None and last_mm is not None and first_mm > last_mm:
            raise ValueError(
                f"contact_from_mm ({first_mm:g}) is above contact_to_mm ({last_mm:g}); "
                "contact is felt from the former to the latter"
            )
        return self


class BenchSettings(Settings):
    """A bench file without its instruments, whose tables belong to their drivers."""

    name: str = Field(min_length=1, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    """Name of the bench, used in messages and file names."""
    simulation: dict[str, Any] | None = None
    """Present on a simulated bench: its seed and World. A simulated instrument marks a run as
    simulated all the same."""
    heartbeat_timeout_s: float = Field(default=5.0, ge=1, le=600)
    """A run silent for longer is taken for hung: the guard ends it and makes the bench safe."""
    fixture: FixtureSettings
    also_mounted: tuple[FixtureSettings, ...] = ()
    """Fixtures that are mounted beside it, each with its own places: runs on any of them need
    nobody to change the bench between them."""
    film: FilmSettings | None = None
    load_cell: LoadCellSettings | None = None
    skin: MountedSkinSettings | None = None
    calibrations: CalibrationFiles = CalibrationFiles()
    """Calibration records in use; their values replace those of this file."""

    @model_validator(mode="after")
    def _each_fixture_once(self) -> Self:
        mounted = [fixture.mounted for fixture in self.fixtures]
        for name in mounted:
            if mounted.count(name) > 1:
                raise ValueError(f"[fixture] and [[also_mounted]] name the {name} twice")
        return self

    @property
    def fixtures(self) -> tuple[FixtureSettings, ...]:
        """All that is mounted."""
        return (self.fixture, *self.also_mounted)
