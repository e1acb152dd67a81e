"""Output images by what they ask of the drive, and what input images say about it.

Values only: nothing here communicates with a drive. The bits are those of
`drivers.festo_cmmt.frames`.
"""

from __future__ import annotations

from drivers.festo_cmmt.frames import (
    FULL_SCALE,
    Inputs,
    Outputs,
    PosStw2,
    PosZsw1,
    Stw1,
    Stw2,
    Zsw1,
)
from drivers.festo_cmmt.settings import FestoCmmtSettings

POWER_OFF = (
    Stw1.NO_COAST_STOP
    | Stw1.NO_QUICK_STOP
    | Stw1.ENABLE_OPERATION
    | Stw1.CONTROL_BY_PLC
    | Stw1.NO_INTERMEDIATE_STOP
)
STOP = POWER_OFF | Stw1.ON  # the reject bit is a zero
TASK = STOP | Stw1.DO_NOT_REJECT_TASK | Stw1.ACTIVATE_TASK
HOME = STOP | Stw1.DO_NOT_REJECT_TASK | Stw1.START_HOMING
LIMITS = PosStw2.SOFTWARE_LIMITS | PosStw2.HARDWARE_LIMITS


def at_rest(settings: FestoCmmtSettings) -> Outputs:
    """Return the image of an axis under power that has nothing to do: its task is rejected."""
    full = settings.full_acceleration_mm_s2
    fixed_stop = Stw2.NONE if settings.torque_limit_percent is None else Stw2.TRAVEL_TO_FIXED_STOP
    return Outputs(
        stw1=STOP,
        pos_stw2=LIMITS,
        stw2=fixed_stop,
        override=FULL_SCALE,
        acceleration=round(settings.acceleration_mm_s2 / full * FULL_SCALE),
        deceleration=round(settings.deceleration_mm_s2 / full * FULL_SCALE),
    )


def task_is_taken(seen: Inputs) -> bool:
    """Return whether the drive has acknowledged the task."""
    return Zsw1.TASK_ACKNOWLEDGED in seen.zsw1 and PosZsw1.MDI in seen.pos_zsw1


def gives_way(seen: Inputs) -> bool:
    """Return whether no task and no homing is in force any more, or the axis has no power."""
    idle = Zsw1.TASK_ACKNOWLEDGED not in seen.zsw1 and PosZsw1.HOMING not in seen.pos_zsw1
    return idle or Zsw1.OPERATION_ENABLED not in seen.zsw1
