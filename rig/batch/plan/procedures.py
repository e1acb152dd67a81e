"""The procedures that are installed, as a batch asks for them by name."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from rig.bench.bench import entry
from rig.core.errors import ConfigurationError, shortened
from rig.run.procedure import Procedure

GROUP = "rig.procedures"


@cache
def known() -> tuple[str, ...]:
    """Their names."""
    return tuple(sorted(found.name for found in entry_points(group=GROUP)))


@cache
def installed(name: str) -> Procedure:
    """The procedure of this name; ConfigurationError where there is none, or none that loads."""
    found = entry(GROUP, name) if name in known() else None
    if found is None:
        raise ConfigurationError(
            f"procedure = {shortened(name)!r} is unknown", f"known are {', '.join(known())}"
        )
    try:
        procedure: Procedure = found.load()
    except ImportError as error:
        raise ConfigurationError(
            f"procedure {name!r} cannot be loaded: {error}", "install what it needs"
        ) from error
    return procedure
