"""The procedures that are installed, as a batch asks for them by name."""

from __future__ import annotations

import json
from functools import cache

from pydantic import ValidationError

from rig.batch.plan.conditions import BatchCondition
from rig.core.entry_points import PROCEDURES, names
from rig.core.errors import ConfigurationError, shortened
from rig.run.load_procedure import load_procedure
from rig.run.procedure import Procedure


@cache
def known() -> tuple[str, ...]:
    """Return the names of the installed procedures."""
    return names(PROCEDURES)


@cache
def installed(name: str) -> type[Procedure]:
    """Return the class of the procedure of this name. Raises ConfigurationError if there is none,
    or if it cannot be loaded."""
    if name not in known():
        raise ConfigurationError(
            f"procedure = {shortened(name)!r} is unknown", f"known are {', '.join(known())}"
        )
    return load_procedure(name)


def procedure_of(condition: BatchCondition) -> Procedure:
    """Return the procedure of a condition, with its settings. Raises ConfigurationError if it is
    not installed, cannot be loaded, or refuses the settings, as another version of it may."""
    own = installed(condition.procedure)
    given = json.dumps(dict(condition.settings))
    try:
        return own(own.Settings.model_validate_json(given))
    except ValidationError as error:
        where = f"{condition.procedure}, condition {condition.id}"
        raise ConfigurationError.from_validation(error, where) from error
