"""The World with the plate mounted: its further settings, and how the skin is hung into it.

Apart from `world`, so that a bench with the film clamp does not import what it has no use for.
"""

from __future__ import annotations

from typing import Literal

from drivers.simulated.skin_contact import SkinContact, SkinMountSettings, Where
from drivers.simulated.world import World, WorldSettings
from rig.cache import user_cache
from rig.errors import ConfigurationError
from rig.model.contact.settings import ContactSettings
from rig.model.front_end import FrontEndSettings
from rig.model.skin.condensed import build_skin
from rig.model.skin.settings import SkinSettings
from rig.model.transducer import TransducerSettings

VISCOUS = 3.0
"""Share by which rubber that is met at speed is stiffer than at rest: an ample bound."""


class PlateWorldSettings(WorldSettings):
    """What the simulated bench with the skin above its plate is like."""

    skin: SkinSettings = SkinSettings()
    """The skin."""
    skin_mount: SkinMountSettings = SkinMountSettings()
    """How it hangs above the plate."""
    contact: ContactSettings = ContactSettings()
    """Friction between skin and plate, and the rubber's relaxation."""
    transducer: TransducerSettings = TransducerSettings()
    """The skin's strips and their amplifiers."""
    strip_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of each strip's channel."""
    daq_model: Literal["U2331A", "U2542A"] = "U2542A"
    """Which DAQ the bench has: strips want simultaneous samples."""


def hang_skin(
    world: World, settings: PlateWorldSettings, stage_z_mm: Where, stage_x_mm: Where
) -> float:
    """The stages carry the skin above the plate: where their carriages are or were. Takes the skin
    from the user's cache, or makes it; ConfigurationError for settings that do not fit. Gives how
    steeply the force on a stage can rise at most, in N/mm."""
    try:
        condensed = build_skin(settings.skin, user_cache())
        skin = SkinContact(
            condensed,
            settings.skin_mount,
            settings.contact,
            settings.transducer,
            (stage_z_mm, stage_x_mm),
            lambda what, value: world.log("world", what, value, "world"),
        )
    except ValueError as error:
        raise ConfigurationError(f"World settings: {error}") from error
    world.hang(skin, settings.strip_input)
    return VISCOUS * condensed.stiffest_N_mm
