"""A detector from its name and a TOML file that overrides some of its parameters."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.errors import ConfigurationError
from rig.core.toml_files import MAX_JSON_BYTES, read_text, read_toml

if TYPE_CHECKING:
    from rig.core.settings import Settings
    from rig.detector.low_pass import LowPassSettings
    from rig.detector.registered import ChosenDetector

EITHER = {"lag_deg": "stop_Hz", "stop_Hz": "lag_deg"}
"""Fields of a low-pass filter that determine each other: a given one replaces the other."""


def low_pass_values(named: LowPassSettings, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a low-pass filter with some of them changed."""
    replaced = {other: None for given, other in EITHER.items() if given in changes}
    return named.model_dump() | replaced | dict(changes)


def detector_with_settings(name: str, file: Path | None) -> ChosenDetector:
    """Return the named detector, its parameters overridden by those in a TOML file.

    Raises ConfigurationError for an unknown name, a package that cannot be used, an unknown
    parameter or an invalid value.
    """
    from pydantic import ValidationError

    from rig.detector.registered import chosen_detector, detector_names

    if name not in (known := detector_names()):
        raise ConfigurationError(f"--detector {name}: must be one of {', '.join(known)}")
    chosen = chosen_detector(name)
    if file is None:
        return chosen
    changes = read_toml(file, "file of settings")
    if "logic" in changes:
        raise ConfigurationError(f"{file}: logic: unknown key", "--detector names the logic")
    if isinstance(network := changes.get("network"), str):
        # The file that `rig train` writes, beside the file that names it.
        changes["network"] = _network(file.parent / network)
    settings = chosen.settings
    try:
        changed = type(settings).model_validate(_changed(settings, changes))
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(file)) from error
    return replace(chosen, settings=changed)


def _network(file: Path) -> Any:
    try:
        return json.loads(read_text(file, "network file", MAX_JSON_BYTES))
    except ValueError as error:
        raise ConfigurationError(
            f"{file}: no network: {error}", "give a file that `rig train` has written"
        ) from error


def _changed(settings: Settings, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of settings with some of them changed, tables within tables, too."""
    from rig.core.settings import Settings
    from rig.detector.low_pass import LowPassSettings

    values = settings.model_dump()
    for name, value in changes.items():
        named = getattr(settings, name, None)
        if isinstance(named, LowPassSettings) and isinstance(value, Mapping):
            values[name] = low_pass_values(named, value)
        elif isinstance(named, Settings) and isinstance(value, Mapping):
            values[name] = _changed(named, value)
        else:
            values[name] = value
    return values
