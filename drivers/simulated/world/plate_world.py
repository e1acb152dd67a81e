"""The World with the skin above a plate or a head: its further settings, and how it is mounted.

It is separate from `world`, so that a bench with the film clamp does not import what it does not
need.
"""

from __future__ import annotations

from typing import Literal, Self

from pydantic import model_validator

from drivers.simulated.world.contact_geometry import (
    Below,
    Carriage,
    HeadBelow,
    HeadSettings,
    PlateBelow,
    Where,
)
from drivers.simulated.world.mounted_skin import MountedSkin
from drivers.simulated.world.settings import WorldSettings
from drivers.simulated.world.skin_contact import SkinContact, SkinMountSettings
from drivers.simulated.world.world import World
from rig.core.cache import user_cache
from rig.core.errors import ConfigurationError
from rig.physics.contact.settings import ContactSettings, Object, Plate
from rig.physics.front_end import FrontEndSettings
from rig.physics.skin.condensed import build_skin
from rig.physics.skin.settings import SkinSettings
from rig.physics.transducer import TransducerSettings

VISCOUS = 3.0
"""Share by which rubber that is met at speed is stiffer than at rest: an ample bound."""


class PlateWorldSettings(WorldSettings):
    """The physical parameters of a simulated bench with the skin above a plate."""

    skin: SkinSettings = SkinSettings()
    """The skin."""
    skin_mount: SkinMountSettings = SkinMountSettings()
    """Mounting of the skin above the object."""
    contact: ContactSettings = ContactSettings()
    """Friction between skin and object, and the rubber's relaxation."""
    transducer: TransducerSettings = TransducerSettings()
    """The skin's strips and their amplifiers."""
    strip_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of each strip's channel."""
    daq_model: Literal["U2331A", "U2542A"] = "U2542A"
    """Model of the DAQ: strips need simultaneous samples."""


class HeadWorldSettings(PlateWorldSettings):
    """The physical parameters of a simulated bench with the skin above a head on the rotary
    stage."""

    head: HeadSettings = HeadSettings()
    """The object with its head."""

    @model_validator(mode="after")
    def _rolls(self) -> Self:
        if isinstance(self.head.body, Plate):
            raise ValueError("head.body plate cannot roll: give a sphere or a cylinder")
        return self


def mount_skin(
    world: World,
    settings: PlateWorldSettings,
    stage_z: Carriage,
    stage_x: Carriage,
    rotary_deg: Where | None = None,
) -> float:
    """Return the stages carry the skin above the plate, or above the head that the rotary stage
    turns: where they are or were. Takes the skin from the user's cache, or makes it. Raises
    ConfigurationError for settings that do not fit. Gives how steeply the force on a stage can rise
    at most, in N/mm."""
    touch_mm = settings.skin_mount.contact_mm
    below: Below = PlateBelow(touch_mm, stage_z, stage_x)
    if isinstance(settings, HeadWorldSettings):
        assert rotary_deg is not None
        below = HeadBelow(settings.head, touch_mm, stage_z, stage_x, rotary_deg)
    try:
        condensed = build_skin(settings.skin, user_cache())
        skin = SkinContact(
            condensed,
            settings.skin_mount,
            settings.contact,
            settings.transducer,
            below,
            lambda what, value: world.log("world", what, value, "world"),
        )
    except ValueError as error:
        raise ConfigurationError(f"World settings: {error}") from error
    body: Object = settings.head.body if isinstance(settings, HeadWorldSettings) else Plate()
    world.mount_instead(MountedSkin(skin, settings.strip_input, body.model_dump()))
    return VISCOUS * condensed.stiffest_N_mm
