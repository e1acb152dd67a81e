"""Refuse to press with a stage whose torque is not limited.

The torque limit is the barrier behind the force limit: it bounds the force where the force sensor
reads too little or nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.bench.connected import Bench

SETTING = "torque_limit_percent"


def torque_limit_percent(bench: Bench) -> float:
    """Return the torque limit of the z stage in percent; 100 where it has none."""
    part = next((part for part in bench.plan.instruments if part.role == "stage_z"), None)
    limit: float | None = getattr(part and part.settings, SETTING, None)
    return 100.0 if limit is None else limit


def require_torque_limit(bench: Bench) -> None:
    """Raise ConfigurationError unless the bench file limits the torque of the z stage."""
    part = next((part for part in bench.plan.instruments if part.role == "stage_z"), None)
    if part is None or getattr(part.settings, SETTING, None) is not None:
        return
    where = "[stage_z] of the bench file"
    if SETTING in type(part.settings).model_fields:
        raise ConfigurationError(
            f"{where} has no {SETTING}: nothing but the force sensor would limit the force with "
            "which z presses",
            f"add {SETTING} = 30.0 to [stage_z], as low as the largest force of your runs allows "
            "(docs/bench-file.md)",
        )
    raise ConfigurationError(
        f"{where}: the driver {part.driver_name!r} has no setting {SETTING}: nothing but the force "
        "sensor would limit the force with which z presses",
        f"use a driver that sets the drive's torque limit, or give this one a setting {SETTING}",
    )
