"""Make settings from values; a validator that fails is reported as a fault of its package."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from rig.core.entry_points import place_in
from rig.core.errors import ExitCode, RigError
from rig.core.settings import Settings

T = TypeVar("T", bound=Settings)


STORED = {"stored": True}
"""Context in which the settings of a file are read: a validator may accept what was valid where it
was written, such as the name of a detector that is not installed here."""


def stored_settings(model: type[T], values: Mapping[str, Any]) -> T:
    """Return the settings that a file states, by field, to compute and show its results; not to run
    with them. Raises ValidationError for values that this version refuses."""
    return model.model_validate_json(json.dumps(dict(values)), context=STORED)


def validated(model: type[T], values: Mapping[str, Any]) -> T:
    """Return settings of these values, by field.

    Raises pydantic's ValidationError for values that are refused; RigError where a validator fails
    with any other exception than ValueError, which is a fault of the package that it belongs to.
    """
    try:
        return model.model_validate(values)
    except (ValidationError, RigError):
        raise
    except Exception as error:
        place = place_in(model.__module__.split(".")[0], error)
        raise RigError(
            f"{model.__module__}.{model.__qualname__} cannot check these settings: "
            f"{place}{type(error).__name__}: {error}",
            "a validator must raise ValueError for what it refuses; report it to whoever "
            "maintains that package",
            ExitCode.INTERNAL,
        ) from error
