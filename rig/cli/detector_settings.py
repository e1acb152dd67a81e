"""Which detector and which low-pass somebody wants: a name, and what is to be otherwise."""

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
"""Of a low-pass: each of them decides the other, so that one that is given replaces the other."""


def low_pass_values(named: LowPassSettings, changes: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a low-pass with some of them changed."""
    replaced = {other: None for given, other in EITHER.items() if given in changes}
    return named.model_dump() | replaced | dict(changes)


def detector_settings(name: str, file: Path | None) -> DetectorSettings:
    """The detector of that name, with the parameters that a TOML file gives otherwise.

    ConfigurationError for an unknown name, an unknown parameter, or a value that is none.
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
