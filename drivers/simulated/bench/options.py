"""The options of a simulated bench that a command line or a caller chooses."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from rig.core.entry_points import SIMULATORS, BrokenPackageError, find, load, names
from rig.core.errors import ConfigurationError, shortened

if TYPE_CHECKING:
    from drivers.simulated.faults.plan import FaultPlan
    from drivers.simulated.instruments.core import InstrumentCore
    from drivers.simulated.world.settings import WorldSettings

LINGER_S = 10.0
"""Time in s for which a bench continues in real time after its owner has died, so that the guard
can connect and act."""

Fixture = Literal["film-clamp", "plate", "semi-spherical-object"]
HEAD: Fixture = "semi-spherical-object"
Stages = Literal["festo", "az", "festo-az", "az-festo"]
"""Drives on Modbus TCP, on one Modbus RTU line, or z of the first kind and x of the second."""

REPLACEABLE = ("generator", "daq", "stage_z", "stage_x", "rotary", "force_sensor")
"""Roles whose simulated instrument may be another one of the entry-point group
``rig.simulators``."""
USUAL_FORCE_SENSOR = "me-gsv8"
GENERATOR_DRIVER = "keysight-33500b"
DAQ_DRIVER = "keysight-u2300a"
ROTARY_DRIVER = "zaber-rst"

STAGE_ROLES = ("stage_z", "stage_x")
DRIVES = {"festo-cmmt": "festo", "oriental-az": "az"}
"""The kind of drive that a driver controls, by the driver's name."""


@dataclass(frozen=True)
class Options:
    """Options of a simulated bench."""

    fixture: Fixture = "film-clamp"
    """Mounted fixture: the film in its clamp, or the skin above a plate or a head that rolls."""
    stages: Stages = "festo"
    """Kinds of the drives of z and x."""
    replace: dict[str, str] = field(default_factory=dict)
    """Driver whose simulator replaces the usual one, by role."""
    seed: int = 0
    slaved: bool = False
    world: str | None = None
    """TOML file with World settings, or "population" for a World that the seed draws."""
    fault: str | None = None
    """TOML file with a fault plan."""
    world_log: str | None = None
    """File to which the World's log is appended."""
    linger_s: float = LINGER_S
    results: str | None = None
    """Folder in which the owner records: where the fault plan's disk is."""


def check_replaced(replace: Mapping[str, str]) -> None:
    """Raise ConfigurationError for a role whose instrument cannot be replaced, and for a simulator
    that is not installed, is broken or has another role."""
    for role, driver in replace.items():
        if role not in REPLACEABLE:
            raise ConfigurationError(
                f"the simulated bench has no {role}",
                f"what can be replaced: {', '.join(REPLACEABLE)}",
            )
        if find(SIMULATORS, driver) is None:
            known = ", ".join(names(SIMULATORS))
            raise ConfigurationError(
                f"simulator {shortened(driver)!r} is unknown",
                f"--replace knows {known}; the project's other stages are chosen with --stages "
                "(see --help)",
            )
        simulator_of(role, driver)


def simulator_of(role: str, driver: str) -> type[InstrumentCore]:
    """Return the class of the simulator that is registered for a driver. Raises ConfigurationError
    where it cannot play the role."""
    from drivers.simulated.instruments.core import InstrumentCore

    def find_fault(found: Any) -> str | None:
        if not (isinstance(found, type) and issubclass(found, InstrumentCore)):
            return "is not derived from a core of drivers.simulated.instruments"
        if missing := sorted(getattr(found, "__abstractmethods__", ())):
            return f"lacks {', '.join(missing)}"
        untouched = (InstrumentCore.answer, InstrumentCore.exchanges)
        if (found.answer, found.exchanges) == untouched:
            return "lacks answer or exchanges"
        if found.link not in ("serial", "tcp"):
            return f"has the link {found.link!r}, which must be 'serial' or 'tcp'"
        return None

    found: type[InstrumentCore] = load(SIMULATORS, driver, find_fault)
    if role not in found.roles:
        raise ConfigurationError(
            f"the simulator of the driver {driver!r} is for the role {' or '.join(found.roles)}, "
            f"not for {role}",
            "use " + " or ".join(f"--replace {own}={driver}" for own in found.roles),
        )
    return found


def fault_of_simulator(
    replace: Mapping[str, str], error: Exception, what: str = "cannot be started"
) -> BrokenPackageError | None:
    """Return the error that names the package of the simulator whose code took part in `error`, of
    the drivers in `replace` by role; None where none did. `what` says what has become of it."""
    found = None
    for role, driver in replace.items():
        module = simulator_of(role, driver).__module__
        top = module.split(".")[0]
        entry = find(SIMULATORS, driver)
        own = [
            (str(frame.f_globals.get("__name__")), f"{frame.f_code.co_filename} line {line}")
            for frame, line in traceback.walk_tb(error.__traceback__)
            if str(frame.f_globals.get("__name__")).split(".")[0] == top
        ]
        if entry is not None and own and top not in ("drivers", "rig"):
            text = " ".join(str(error).split())
            fault = BrokenPackageError(
                entry, f"{what}: {own[-1][1]}: {type(error).__name__}: {text}"
            )
            if any(name == module for name, _ in own):  # not another simulator of this package
                return fault
            found = found or fault
    return found


def options_for(drivers: Mapping[str, str]) -> dict[str, Any]:
    """Return the fields of `Options` that give the bench the simulators of these drivers, which are
    given by role, as far as it has them."""
    chosen: dict[str, Any] = {}
    if (stages := variant_for(drivers)) is not None:
        chosen["stages"] = stages
    own = {
        role: drivers[role]
        for role in REPLACEABLE
        if role in drivers and find(SIMULATORS, drivers[role]) is not None
    }
    return {**chosen, "replace": own} if own else chosen


def variant_for(drivers: Mapping[str, str]) -> Stages | None:
    """Return the stages with the limits of these drivers, given by role; None where there are none.
    Beside a stage that has a simulator of its own, any will do."""
    names = [drivers.get(role, drivers.get("stage_z", "")) for role in STAGE_ROLES]
    own = [find(SIMULATORS, name) is not None for name in names]
    kinds = {DRIVES.get(name) for name, simulated in zip(names, own, strict=True) if not simulated}
    if None in kinds:
        return None
    beside = next(iter(kinds), next(iter(DRIVES.values())))
    z, x = (beside if own[k] else DRIVES[name] for k, name in enumerate(names))
    named = z if z == x else f"{z}-{x}"
    return next(stages for stages in get_args(Stages) if stages == named)


def driver_names(options: Options) -> tuple[str, ...]:
    """Return the names of the drivers in the bench file of a bench with these options."""
    stages = STAGE_ROLES[:1] if options.fixture == "film-clamp" else STAGE_ROLES
    by_kind = {kind: name for name, kind in DRIVES.items()}
    usual = {"daq": DAQ_DRIVER, "force_sensor": USUAL_FORCE_SENSOR}
    usual |= {stage: by_kind[drive_kind(options.stages, stage)] for stage in stages}
    if options.fixture == "film-clamp":
        usual["generator"] = GENERATOR_DRIVER
    if options.fixture == HEAD:
        usual["rotary"] = ROTARY_DRIVER
    names = (options.replace.get(role, name) for role, name in usual.items())
    return tuple(dict.fromkeys(names))


def drive_kind(stages: Stages, name: str) -> str:
    """Return the kind of the drive of one stage."""
    z, _, x = stages.partition("-")
    return z if name == "stage_z" or not x else x


def world_settings(options: Options) -> WorldSettings:
    """Return the World's settings: those of a file, of a drawn skin, or the built-in ones.

    Raises ConfigurationError for a file that cannot be used, and for `--world population` on the
    film clamp.
    """
    from drivers.simulated.world.settings import read_world

    if options.fixture == "film-clamp":
        if options.world == "population":
            raise ConfigurationError(
                "--world population draws a skin, and the film clamp has none",
                "leave out --world: the film of the clamp is drawn from --seed anyway",
            )
        return read_world(options.world)
    from drivers.simulated.world.plate_world import HeadWorldSettings, PlateWorldSettings
    from drivers.simulated.world.population import POPULATION, drawn_world

    kind = HeadWorldSettings if options.fixture == HEAD else PlateWorldSettings
    if options.world == POPULATION:
        return drawn_world(kind, options.seed)
    return read_world(options.world, kind)


def fault_plan(options: Options) -> FaultPlan:
    """Return the fault plan of the options for the instruments of this bench; empty without one.

    Raises ConfigurationError for a file that cannot be used, and for faults of devices that the
    bench lacks.
    """
    from drivers.simulated.faults.plan import (
        DEVICES,
        DISK,
        GENERATOR,
        ON_TCP,
        ROTARY,
        STAGE_X,
        STAGES,
        FaultPlan,
        devices_by_fault,
    )

    if options.fault is None:
        return FaultPlan()
    missing = {GENERATOR} if options.fixture == HEAD else {ROTARY}
    missing |= {"film-clamp": {STAGE_X}, "plate": {GENERATOR}}.get(options.fixture, set())
    if not options.slaved:
        missing.add(DISK)  # whoever records is another process
    on_a_line = [
        name
        for name in ON_TCP
        if name in options.replace and simulator_of(name, options.replace[name]).link == "serial"
    ]
    on_a_line += [
        name
        for name in STAGES
        if name not in options.replace and drive_kind(options.stages, name) == "az"
    ]
    devices_by_kind = devices_by_fault(on_a_line)
    there = [name for name in DEVICES if name not in missing]
    return FaultPlan.read(Path(options.fault), there, devices_by_kind)
