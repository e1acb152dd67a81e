"""The script of each role. A new role is one more entry in `ROLES`."""

from __future__ import annotations

from collections.abc import Mapping

from rig.testing.daq import DAQ
from rig.testing.force_sensor import FORCE_SENSOR
from rig.testing.generator import GENERATOR
from rig.testing.script import Role
from rig.testing.stage import ROTARY, STAGE

ROLES: Mapping[str, Role] = {
    "generator": GENERATOR,
    "daq": DAQ,
    "stage_z": STAGE,
    "stage_x": STAGE,
    "rotary": ROTARY,
    "force_sensor": FORCE_SENSOR,
}
