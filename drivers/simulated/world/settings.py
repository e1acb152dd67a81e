"""The physical parameters of a simulated bench."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypeVar

from pydantic import Field, ValidationError

from drivers.simulated.world.contacts import ContactsSettings
from drivers.simulated.world.monitor import WatchSettings
from rig.core.errors import ConfigurationError
from rig.core.toml_files import read_toml
from rig.physics.film_clamp import FilmClampSettings
from rig.physics.front_end import FrontEndSettings


class WorldSettings(ContactsSettings):
    """The physical parameters of the simulated bench, which cannot be chosen on a real one."""

    film: Literal["drawn", "nominal", "open-circuit"] = "drawn"
    """A film drawn from the seed, the default film of the model, or none connected."""
    film_gain: float = 1.0
    """Gain of the film's amplifier: a large one saturates the input."""
    film_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of the film's channel."""
    load_cell_input: FrontEndSettings = FrontEndSettings()
    """Noise and hum of the load cell's channel."""
    clamp: FilmClampSettings = FilmClampSettings()
    """Position of the film, its stiffness and its creep."""
    load_cell_sensitivity_V_N: float = Field(default=0.1, gt=0)
    """True sensitivity of the load cell."""
    load_cell_zero_V: float = 0.0
    """Output of the load cell without load."""
    force_sensor_zero_mV_V: tuple[float, float, float] = (0.012, -0.007, 0.021)
    """Bridge outputs of the force sensor under no load."""
    daq_model: Literal["U2331A", "U2542A"] = "U2331A"
    """Model of the DAQ."""
    daq_buffer_samples: int = Field(default=8_000_000, ge=1)
    """Size of the DAQ's buffer, all channels together."""
    generator_link: Literal["socket", "hislip"] = "socket"
    """Kind of the generator's connection."""
    stiffest_contact_N_mm: float | None = Field(default=None, gt=0)
    """Stiffest contact in N/mm that the bench file declares of its fixture; None: it declares none,
    since its text is an example that people copy for stiffer benches. The contacts simulated here
    have 88 N/mm (film in its clamp) and 145 N/mm (skin)."""
    watch: WatchSettings | None = None
    """Checks of the World's own monitor; None for none."""


W = TypeVar("W", bound=WorldSettings)


def read_world(path: str | None, kind: type[W] = WorldSettings) -> W:  # type: ignore[assignment]
    """Return the World settings in a TOML file; the defaults if there is none.

    Raises ConfigurationError for a file that cannot be used.
    """
    if path is None:
        return kind()
    tables = read_toml(Path(path), "file of World settings")
    try:
        return kind.model_validate(tables)
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, path) from error
