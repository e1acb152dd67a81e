"""Parameters of a detector from its name and a TOML file that overrides some of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.errors import ConfigurationError
from rig.core.toml_files import read_toml

if TYPE_CHECKING:
    from rig.detector.low_pass import LowPassSettings
    from rig.detector.settings import DetectorSettings

EITHER = {"lag_deg": "stop_Hz", "stop_Hz": "lag_deg"}
"""Fields of a low-pass filter that determine each other: a given one replaces the other."""


def low_pass_values(named: LowPassSettings, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of a low-pass filter with some of them changed."""
    replaced = {other: None for given, other in EITHER.items() if given in changes}
    return named.model_dump() | replaced | dict(changes)


def detector_settings(name: str, file: Path | None) -> DetectorSettings:
    """Returns the parameters of the named detector, overridden by those in a TOML file.

    Raises ConfigurationError for an unknown name, an unknown parameter or an invalid value.
    """
    from pydantic import ValidationError

    from rig.detector.settings import DetectorSettings, named_detectors

    known = named_detectors()
    if name not in known:
        raise ConfigurationError(f"--detector {name}: has to be one of {', '.join(known)}")
    named = known[name]
    if file is None:
        return named
    changes = read_toml(file, "file of settings")
    if "logic" in changes:
        raise ConfigurationError(f"{file}: logic: unknown key", "--detector names the logic")
    if isinstance(changes.get("low_pass"), dict):
        changes["low_pass"] = low_pass_values(named.low_pass, changes["low_pass"])
    if isinstance(changes.get("network"), dict) and named.network is not None:
        changes["network"] = named.network.model_dump() | changes["network"]
    try:
        return DetectorSettings.model_validate(named.model_dump() | changes)
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(file)) from error
