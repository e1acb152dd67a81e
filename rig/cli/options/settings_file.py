"""The settings of a command from a JSON file that one of its options names."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rig.core.errors import ConfigurationError
from rig.core.toml_files import MAX_JSON_BYTES, read_text

if TYPE_CHECKING:
    from rig.core.settings import Settings

    Model = TypeVar("Model", bound=Settings)
else:
    Model = TypeVar("Model")


def read_settings(unless_given: Model, file: Path | None) -> Model:
    """Return the settings of a JSON file, or `unless_given` without one. Raises
    ConfigurationError for a file that does not fit."""
    from pydantic import ValidationError

    if file is None:
        return unless_given
    try:
        return type(unless_given).model_validate_json(
            read_text(file, "file of settings", MAX_JSON_BYTES)
        )
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, str(file)) from error
