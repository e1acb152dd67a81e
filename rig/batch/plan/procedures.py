"""The procedures that are installed, as a batch asks for them by name."""

from __future__ import annotations

from functools import cache

from rig.core.entry_points import PROCEDURES, load, names
from rig.core.errors import ConfigurationError, shortened
from rig.run.procedure import Procedure


@cache
def known() -> tuple[str, ...]:
    """Their names."""
    return names(PROCEDURES)


@cache
def installed(name: str) -> Procedure:
    """The procedure of this name; ConfigurationError where there is none, or none that loads."""
    if name not in known():
        raise ConfigurationError(
            f"procedure = {shortened(name)!r} is unknown", f"known are {', '.join(known())}"
        )
    procedure: Procedure = load(PROCEDURES, name)
    return procedure
