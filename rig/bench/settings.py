"""The settings of the bench itself in a bench file: fixture, film, skin, load cell."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from rig.bench.interlocks import Interlocks
from rig.core.name_patterns import NAME
from rig.core.settings import Settings
from rig.instruments.calibration import (
    CalibrationFiles,
)

ROLES = ("generator", "daq", "stage_z", "stage_x", "rotary", "force_sensor")


Fixture = Literal["film-clamp", "plate", "semi-spherical-object"]


STIFFEST_CONTACT_N_mm: dict[Fixture, float] = {
    "film-clamp": 1000.0,
    "plate": 250.0,
    "semi-spherical-object": 250.0,
}
"""Stiffest contact expected on each kind of fixture. A film in its clamp: stiffer than any film.
Skin: above the 206 N/mm that a plate on the reference skin has at 12 N."""

Strip = Literal["strip_1", "strip_2"]


STRIPS: tuple[Strip, ...] = ("strip_1", "strip_2")
"""The skin's two channels as the DAQ's wiring names them: S1 and S2 of the paper."""


class FilmSettings(Settings):
    """Settings of the film under test and its amplifier."""

    amplifier_gain: float = Field(default=1.0, gt=0)
    """Gain between film and DAQ."""
    area_mm2: float = Field(default=8.0, gt=0)
    """Contact area of the indentor."""
    name: str = ""
    """Label or batch of the film."""


class LoadCellSettings(Settings):
    """Settings of the load cell, the dynamic force sensor that carries the film."""

    name: str = ""
    """Label or serial number of the load cell."""
    sensitivity_V_N: float = Field(gt=0)
    """Output per newton."""
    max_load_N: float = Field(default=20.0, gt=0)
    """Largest peak load allowed on film and load cell; a larger one trips the run."""


class MountedSkinSettings(Settings):
    """Settings of the artificial finger skin and the amplifiers of its two strips."""

    name: str = ""
    """Label or batch of the skin."""
    amplifier_gain: float = Field(default=1000.0, gt=0)
    """Gain between a strip and the DAQ."""
    ridge: int = Field(default=3, ge=1)
    """Number of the ridge that holds the strips; 1 is the leftmost."""
    ridges_extent_mm: float = Field(default=17.4, gt=0)
    """Extent of all ridges along x, from the outer side of the first to that of the last: nine
    ridges 1.4 mm wide, 2 mm apart. A roll begins on them."""
    b_dB: dict[Strip, float] = Field(default_factory=dict)
    """Calibrated b (paper eq. 2) by strip, without the amplifier's gain; none until calibrated. A
    calibration record in use replaces it."""
    b_error_dB: dict[Strip, float] = Field(default_factory=dict)
    """Standard error of each b."""
    films: dict[Strip, str] = Field(default_factory=dict)
    """Label of the film in each strip; a calibration record must be of that film."""

    @model_validator(mode="after")
    def _every_level_has_its_error(self) -> Self:
        if self.b_dB.keys() != self.b_error_dB.keys():
            raise ValueError("b_dB and b_error_dB must name the same strips")
        if any(error < 0 for error in self.b_error_dB.values()):
            raise ValueError("b_error_dB is below 0")
        return self


class HoldLimits(Settings):
    """Largest numbers of holds of a run, beyond which it ends: after each hold the object is
    pressed again, so a loose contact in the sensor's cable would press it time after time. Pauses
    by the operator are not included."""

    per_point: int = Field(default=5, ge=0)
    """Holds that may disturb one point, or the arming before it."""
    per_run: int = Field(default=20, ge=0)
    """Holds of a run as a whole, counted from its start or from where it was resumed."""


class FixtureSettings(Settings):
    """Settings of a fixture that is mounted on the bench."""

    mounted: Fixture
    """Kind of fixture; a procedure refuses to run on one that it is not made for."""
    contact_from_mm: float | None = None
    """Earliest position of the z stage at which the probe can meet the object: contact felt before
    it means that something is in the way."""
    contact_to_mm: float | None = None
    """Position by which the probe must have met the object: no contact by then means that the
    object is missing."""
    parked_mm: float = 5.0
    """Position at which the z stage waits, clear of everything. With one that is not clear of
    contact every run that presses is refused, but the file is accepted, so that the bench can still
    be made safe with it."""
    stiffest_contact_N_mm: float | None = Field(default=None, gt=0)
    """Stiffest contact that z can make here. The largest speed of z towards a contact follows from
    it. Default: 1000 N/mm for a film in its clamp, 250 N/mm for skin."""
    centre_mm: float | None = None
    """For an object that rolls: position of x at which the middle of the skin is above the
    object."""
    upright_deg: float | None = None
    """For an object that rolls: angle of the rotary stage at which the object stands upright."""

    @property
    def stiffest_N_mm(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Stiffest contact in N/mm: the one that is stated, or that of this kind of fixture."""
        return self.stiffest_contact_N_mm or STIFFEST_CONTACT_N_mm[self.mounted]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        first_mm, last_mm = self.contact_from_mm, self.contact_to_mm
        if first_mm is not None and last_mm is not None and first_mm > last_mm:
            raise ValueError(
                f"contact_from_mm ({first_mm:g}) is above contact_to_mm ({last_mm:g}); "
                "contact is felt from the former to the latter"
            )
        return self


class BenchSettings(Interlocks):
    """Settings of the bench itself; the instruments' tables belong to their drivers."""

    name: str = Field(min_length=1, pattern=NAME)
    """Name of the bench, used in messages and file names."""
    simulation: dict[str, Any] | None = None
    """Seed and World of a simulated bench; None on a real one. A run with any simulated instrument
    is marked as simulated in either case."""
    heartbeat_timeout_s: float = Field(default=5.0, ge=1, le=600)
    """Time without a heartbeat after which the guard ends the run and makes the bench safe."""
    holds: HoldLimits = HoldLimits()
    fixture: FixtureSettings
    also_mounted: tuple[FixtureSettings, ...] = ()
    """Further fixtures mounted at the same time, each with its own positions, so that runs on any
    of them need no change of the bench in between."""
    film: FilmSettings | None = None
    load_cell: LoadCellSettings | None = None
    skin: MountedSkinSettings | None = None
    calibrations: CalibrationFiles = CalibrationFiles()
    """Calibration records in use; their values replace those of the bench file."""

    @model_validator(mode="after")
    def _each_fixture_once(self) -> Self:
        mounted = [fixture.mounted for fixture in self.fixtures]
        for name in mounted:
            if mounted.count(name) > 1:
                raise ValueError(f"[fixture] and [[also_mounted]] name the {name} twice")
        return self

    @property
    def fixtures(self) -> tuple[FixtureSettings, ...]:
        """All mounted fixtures, the one of [fixture] first."""
        return (self.fixture, *self.also_mounted)
