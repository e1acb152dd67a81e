"""Refuse to press with a stage whose torque is not limited.

The torque limit is the barrier behind the force limit: it bounds the force where the force sensor
reads too little or nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.bench.connected import Bench
    from rig.bench.plan import InstrumentPlan

SETTING = "torque_limit_percent"


def torque_limit_percent(bench: Bench) -> float:
    """Return the torque limit of the z stage in percent; 100 where it has none."""
    part = _plan_of_z(bench)
    limit_percent = None if part is None else _limit_percent(part)
    return 100.0 if limit_percent is None else limit_percent


def require_torque_limit(bench: Bench) -> None:
    """Raise ConfigurationError unless the bench file limits the torque of the z stage."""
    part = _plan_of_z(bench)
    if part is None or _limit_percent(part) is not None:
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


def _plan_of_z(bench: Bench) -> InstrumentPlan | None:
    return next((part for part in bench.plan.instruments if part.role == "stage_z"), None)


def _limit_percent(part: InstrumentPlan) -> float | None:
    """Return what the bench file states; None also where the driver has no such setting."""
    limit_percent: float | None = getattr(part.settings, SETTING, None)
    return limit_percent
