"""The bench file that drives a simulated bench, and the figures that both sides have to know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drivers.simulated.bench.options import (
    DAQ_DRIVER,
    GENERATOR_DRIVER,
    HEAD,
    ROTARY_DRIVER,
    Options,
    drive_kind,
)
from rig.core.toml_files import toml_value

if TYPE_CHECKING:
    from drivers.simulated.world.settings import WorldSettings

LINK_TIMEOUT_S = 1.5
"""Wall time the bench file gives every link: a loaded machine may let a process wait for long."""

STAGE_TIMEOUT_S = 0.9
"""The same of a stage's link: two have to fit into the drive's communication time-out."""
STAGE_COMMUNICATION_TIMEOUT_ms = 2000
"""Time after which a stage that hears nothing stops by itself."""

AZ_STEPS_PER_MM = 3000.0
"""9000 steps a revolution at a lead of 3 mm (assumed): 0.33 um, a fine one of the series."""

SKIN_UNIT_MM = 0.0001
"""A count of the stages that carry the skin: 1 um would be 0.15 N of normal force (assumed)."""

Z_REACH_MM, X_REACH_MM = 14.0, 40.0
"""Ranges of the stages from their references, in mm."""
ROTARY_REACH_deg = 30.0
"""Largest angle of the rotary stage to either side."""


@dataclass(frozen=True)
class Endpoints:
    """Addresses at which the bench listens."""

    daq: str
    stages: dict[str, int | str]
    """Ports of the drives on TCP by role, or the serial line that both are on."""
    own: dict[str, dict[str, Any]]
    """The whole tables of the instruments that have a core of their own, by role."""
    generator: str = ""
    rotary: str = ""


def bench_toml(
    options: Options,
    world: WorldSettings,
    endpoints: Endpoints,
    interlocks: Sequence[dict[str, Any]] = (),
) -> str:
    """Return the bench file that drives this bench; `interlocks` are its ``[[interlock]]``
    tables.

    ``[simulation]`` has what was set of the World, ``[simulation.world]`` all of it.
    """
    stages = {} if options.stages == "festo" else {"stages": options.stages}
    changed = world.model_dump(mode="json", exclude_unset=True, by_alias=True)
    whole = world.model_dump(mode="json", exclude_none=True, by_alias=True)
    whole |= _film_of(options, world)
    simulation = {"seed": options.seed, **stages, **changed}
    lines = "".join(f"{key} = {toml_value(value)}\n" for key, value in simulation.items())
    resolved = "".join(f"{key} = {toml_value(value)}\n" for key, value in whole.items())
    tables = _film_tables if options.fixture == "film-clamp" else _skin_tables
    return f"""# A simulated bench: whatever is measured on it is computed, not measured.
name = "simulated"

[simulation]
{lines}
[simulation.world]
{resolved}
[fixture]
mounted = "{options.fixture}"
contact_from_mm = 12.0
contact_to_mm = {13.6 if options.fixture == HEAD else 13.0}
{_declared_contact(world)}{_head_lines(options)}
{tables(options, endpoints)}
{_own_table(endpoints, "force_sensor")}{_interlock_tables(interlocks)}"""


def _film_of(options: Options, world: WorldSettings) -> dict[str, Any]:
    """Return the vibrator and the film as the seed has drawn them; nothing for a bench with the
    skin. Each drop has a table of its own, because a list would reach the run file as text."""
    if options.fixture != "film-clamp":
        return {}
    from drivers.simulated.world.mounted_film import drawn_film

    mechanics, circuit = drawn_film(world, options.seed)
    vibrator = mechanics.model_dump(mode="json", exclude_none=True)
    drops = {f"drop_{number}": drop for number, drop in enumerate(vibrator.pop("drops"), 1)}
    return {"mounted_film": {"vibrator": vibrator | drops, "circuit": circuit.model_dump()}}


def _own_table(endpoints: Endpoints, role: str) -> str:
    """Return the table of an instrument that has a core of its own."""
    lines = (f"{key} = {toml_value(value)}\n" for key, value in endpoints.own[role].items())
    return f"[{role}]\n{''.join(lines)}"


def _interlock_tables(interlocks: Sequence[dict[str, Any]]) -> str:
    return "".join(
        "\n[[interlock]]\n" + "".join(f"{key} = {toml_value(own)}\n" for key, own in one.items())
        for one in interlocks
    )


def _declared_contact(world: WorldSettings) -> str:
    """Return the line of the fixture that states its stiffest contact, where it is to state one."""
    if world.stiffest_contact_N_mm is None:
        return ""
    return f"stiffest_contact_N_mm = {world.stiffest_contact_N_mm}\n"


def _head_lines(options: Options) -> str:
    """Return the lines with the position of the head, in the table of the fixture."""
    if options.fixture != HEAD:
        return ""
    from drivers.simulated.world.contact_geometry import HeadSettings

    head = HeadSettings()
    return f"centre_mm = {head.centre_mm}\nupright_deg = {head.upright_deg}\n"


def _film_tables(options: Options, endpoints: Endpoints) -> str:
    return f"""[film]
name = "simulated film {options.seed}"
amplifier_gain = 1.0
area_mm2 = 8.0

[load_cell]
name = "simulated cell {options.seed}"
sensitivity_V_N = 0.1
max_load_N = 20.0

{_generator_table(endpoints)}
{_daq_table(endpoints, "load_cell = 101, film = 102")}

{_stage_table(options, endpoints, "z", Z_REACH_MM, 45.0)}"""


def _generator_table(endpoints: Endpoints) -> str:
    if "generator" in endpoints.own:
        return _own_table(endpoints, "generator")
    return f"""[generator]
driver = "{GENERATOR_DRIVER}"
resource = "{endpoints.generator}"
timeout_s = {LINK_TIMEOUT_S}
max_amplitude_V = 10.0
"""


def _skin_tables(options: Options, endpoints: Endpoints) -> str:
    return f"""[skin]
name = "simulated skin {options.seed}"
amplifier_gain = 1000.0
ridge = 3

{_daq_table(endpoints, "strip_1 = 101, strip_2 = 102")}

{_stage_table(options, endpoints, "z", Z_REACH_MM, 25.0)}
{_stage_table(options, endpoints, "x", X_REACH_MM, 30.0)}{_rotary_table(options, endpoints)}"""


def _daq_table(endpoints: Endpoints, channels: str) -> str:
    if "daq" in endpoints.own:
        return _own_table(endpoints, "daq")
    return f"""[daq]
driver = "{DAQ_DRIVER}"
resource = "{endpoints.daq}"
timeout_s = {LINK_TIMEOUT_S}
channels = {{ {channels} }}"""


def _rotary_table(options: Options, endpoints: Endpoints) -> str:
    if options.fixture != HEAD:
        return ""
    if "rotary" in endpoints.own:
        return f"\n{_own_table(endpoints, 'rotary')}"
    from drivers.simulated.instruments.zaber_rst import SimulatedRotarySettings

    return f"""
[rotary]
driver = "{ROTARY_DRIVER}"
port = "{endpoints.rotary}"
timeout_s = {LINK_TIMEOUT_S}
microstep_deg = {SimulatedRotarySettings().microstep_deg}
low_limit_deg = 0.0
high_limit_deg = {ROTARY_REACH_deg}
max_speed_deg_s = 20.0
max_acceleration_deg_s2 = 500.0
"""


def _stage_table(
    options: Options, endpoints: Endpoints, axis: str, high_limit_mm: float, torque_percent: float
) -> str:
    if (role := f"stage_{axis}") in endpoints.own:
        return _own_table(endpoints, role)
    number, where = "zx".index(axis), endpoints.stages[role]
    if drive_kind(options.stages, f"stage_{axis}") == "az":
        link = f"""driver = "oriental-az"
axis = "{axis}"
port = "{where}"
parity = "N"
unit_id = {number + 1}
steps_per_mm = {AZ_STEPS_PER_MM}
"""
    else:
        link = f"""driver = "festo-cmmt"
axis = "{axis}"
host = "127.0.0.1"
port = {where}
"""
        if options.fixture != "film-clamp":
            link += f"position_unit_mm = {SKIN_UNIT_MM}\n"
    return f"""[stage_{axis}]
{link}timeout_s = {STAGE_TIMEOUT_S}
low_limit_mm = 0.0
high_limit_mm = {high_limit_mm}
max_speed_mm_s = 20.0
communication_timeout_ms = {STAGE_COMMUNICATION_TIMEOUT_ms}
torque_limit_percent = {torque_percent}
"""
