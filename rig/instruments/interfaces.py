"""What the instrument of each role has: the members of its protocol and the limits it states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from rig.instruments.roles import (
    DataAcquisition,
    ForceSensor,
    LinearStage,
    RotaryStage,
    SignalGenerator,
)


class RoleInterface(NamedTuple):
    """What an instrument has to offer to be used in a role."""

    protocol: type
    quantities: frozenset[str]
    """Names of the quantities that `limits` must have."""


_LINEAR = RoleInterface(LinearStage, frozenset({"position", "speed", "update_rate"}))
INTERFACES: Mapping[str, RoleInterface] = {
    "generator": RoleInterface(SignalGenerator, frozenset({"frequency", "amplitude"})),
    "daq": RoleInterface(DataAcquisition, frozenset({"rate"})),
    "stage_z": _LINEAR,
    "stage_x": _LINEAR,
    "rotary": RoleInterface(RotaryStage, frozenset({"angle", "speed", "acceleration"})),
    "force_sensor": RoleInterface(ForceSensor, frozenset({"rate", "force"})),
}


def members(protocol: type) -> dict[str, Any]:
    """Return the public members of a protocol, inherited ones included."""
    return {
        name: member
        for base in reversed(protocol.__mro__[:-1])
        for name, member in vars(base).items()
        if not name.startswith("_") and (callable(member) or isinstance(member, property))
    }
