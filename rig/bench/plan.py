"""Read and check a bench file: settings of the bench, and of a driver for each role.

The driver modules come from the entry-point group ``rig.drivers``, so a laboratory adds its own
without touching this package. All errors of a file are shown at once.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rig.bench.addresses import address_values
from rig.bench.driver_settings import (
    channels_name,
    channels_of,
    communication_timeout,
    mark_errors,
)
from rig.bench.interlocks import unreadable
from rig.bench.settings import ROLES, STRIPS, BenchSettings, Fixture
from rig.core.entry_points import (
    DRIVERS,
    OWN_PACKAGE,
    BrokenPackageError,
    find,
    load,
    package,
)
from rig.core.errors import (
    ConfigurationError,
    RigError,
)
from rig.core.settings import Settings, wiring_of
from rig.core.toml_files import MAX_TOML_BYTES, parse_toml, read_text
from rig.instruments.calibration import (
    CalibrationFiles,
)
from rig.instruments.roles import (
    DriverModule,
)

WAITS_PER_CALL = 2
"""Time-outs that one call on an instrument may wait for: one to reconnect, one for the answer."""
RETRY_S = 0.1
"""Time in s from the end of a link's time-out until the next request has reached the drive: a wait
slice, a new connection, and a computer that is busy."""
OF_THE_FILE = "bench file"
"""Key of the faults of a bench file that are not those of an instrument's table."""


@dataclass(frozen=True)
class InstrumentPlan:
    """The driver and settings of one role, validated but not connected."""

    role: str
    driver_name: str
    driver: DriverModule
    settings: Settings


@dataclass(frozen=True)
class BenchPlan:
    """A bench file that was read and found valid."""

    settings: BenchSettings
    instruments: tuple[InstrumentPlan, ...]
    text: str
    """Text of the file, unchanged."""
    source: str
    """Origin of the plan, for messages and the run file."""
    stand_ins: tuple[str, ...] = ()
    """Lines of a dry run on simulated instruments that replace those of the bench file."""
    file: Path | None = None
    """The bench file; None for a simulated bench that the command started itself."""

    @property
    def mounted(self) -> tuple[Fixture, ...]:
        """Fixtures on the bench, the one of [fixture] first."""
        return tuple(fixture.mounted for fixture in self.settings.fixtures)

    def require_fixture(self, *accepted: Fixture) -> BenchPlan:
        """Return the plan on the first mounted fixture of those `accepted`. Raises
        ConfigurationError, which refuses the run, if none of them is mounted."""
        for mounted in self.mounted:
            if mounted in accepted:
                return self.on(mounted)
        raise ConfigurationError(
            f"the bench has the {' and the '.join(self.mounted)} mounted, this procedure needs "
            f"{' or '.join(accepted)}",
            f"mount it and correct [fixture] in {self.source}",
        )

    def on(self, fixture: Fixture) -> BenchPlan:
        """Return the plan with one of the mounted fixtures as its [fixture], on which a run
        works."""
        if fixture == self.settings.fixture.mounted:
            return self
        fixtures = self.settings.fixtures
        chosen = next(one for one in fixtures if one.mounted == fixture)
        others = tuple(one for one in fixtures if one.mounted != fixture)
        changed = {"fixture": chosen, "also_mounted": others}
        return replace(self, settings=self.settings.model_copy(update=changed))


def longest_call_s(settings: Settings) -> float:
    """Return the longest time in s that a call on an instrument with these settings may wait for
    its link."""
    return WAITS_PER_CALL * float(getattr(settings, "timeout_s", 0.0))


def read_bench(
    path: Path, hint: str = "give the file with --bench, or leave it out for the simulated bench"
) -> BenchPlan:
    """Read and validate a bench file. Raises ConfigurationError, which lists every fault of it;
    `hint` is the remedy where the file cannot be read."""
    plan = parse_bench(read_text(path, "bench file", MAX_TOML_BYTES, hint), str(path))
    return replace(plan, file=path)


def parse_bench(text: str, source: str) -> BenchPlan:
    """Validate the text of a bench file, all errors at once.

    Raises ConfigurationError, which names them.
    """
    tables = parse_toml(text, source)
    findings: list[ConfigurationError] = []
    plans = []
    described = [role for role in ROLES if role in tables]
    for role in described:
        with _collect(findings):
            plans.append(_plan_instrument(role, tables.pop(role), source))
    settings = None
    with _collect(findings):
        settings = _settings(tables, source)
    if settings is not None and ("daq" not in described or any(p.role == "daq" for p in plans)):
        findings += map(ConfigurationError, _wiring_errors(settings, plans, source))
    if settings is not None and len(plans) == len(described):
        drivers = {part.role: part.driver for part in plans}
        found = unreadable(settings.interlock, drivers)
        findings += [ConfigurationError(f"{source}: {one}") for one in found]
    if settings is not None:
        findings += map(ConfigurationError, _heartbeat_findings(settings, plans, source))
    findings += _mark_findings(plans, source)
    for part in plans:
        if lack := _lack_of_timeout(part.driver_name, part.driver):
            findings.append(
                ConfigurationError(f"{source}: [{part.role}]: {lack.message}", lack.hint)
            )
    findings += _communication_findings(plans, source)
    findings += _address_findings(plans, source)
    # The record of a bench that a command has simulated for itself has no ports: they are new each
    # time.
    if settings is None or settings.simulation is None:
        findings += _same_instrument_findings(plans, source)
    if findings or settings is None:
        hints = dict.fromkeys(finding.hint or "correct the bench file" for finding in findings)
        raise ConfigurationError("; ".join(f.message for f in findings), "; ".join(hints))
    return BenchPlan(settings, tuple(plans), text, source)


@dataclass(frozen=True)
class Restable:
    """The instruments of a bench file that can be made safe, and why the others cannot."""

    instruments: tuple[InstrumentPlan, ...]
    failures: dict[str, str]
    """Reason why an instrument cannot be made safe, by role; under OF_THE_FILE, the faults of
    the rest of the file."""
    settings: BenchSettings | None
    """Settings of the bench itself; None if they are wrong."""


def parse_to_make_safe(text: str, source: str) -> Restable:
    """Return the instruments of a bench file, for making them safe.

    A fault in the table of one instrument or in its driver must not prevent making the others safe,
    so it is returned, not raised. Raises ConfigurationError if the text describes no instrument.
    """
    tables = parse_toml(text, source)
    described = [role for role in ROLES if role in tables]
    instruments = []
    failures: dict[str, str] = {}
    for role in described:
        try:
            instruments.append(_plan_instrument(role, tables.pop(role), source))
        except RigError as error:
            failures[role] = error.one_line()
        except Exception as error:  # noqa: BLE001 - a driver's settings must not stop the others
            failures[role] = f"{type(error).__name__}: {error}"
    settings = None
    try:
        settings = _settings(tables, source)
    except ConfigurationError as error:
        if not described:
            raise
        failures[OF_THE_FILE] = error.one_line()
    return Restable(tuple(instruments), failures, settings)


def rehearsal(
    real: BenchPlan, simulated: BenchPlan, models: Mapping[str, str] | None = None
) -> BenchPlan:
    """Return the simulated bench under a real bench file's limits: its fixture, its load limit, the
    extent of its skin and its drivers' settings, except for those that a driver marks as `Wiring`.

    `models` names the simulated instruments by role, for the lines about those that stand in for
    an instrument of which there is no simulator.
    """
    own = {(part.role, part.driver_name): part.settings for part in real.instruments}
    instruments = []
    for part in simulated.instruments:
        which = (part.role, part.driver_name)
        if which in own:
            kept = {k: v for k, v in part.settings if k in wiring_of(type(part.settings))}
            part = replace(part, settings=own[which].model_copy(update=kept))
        instruments.append(part)
    limits: dict[str, Any] = {
        "fixture": real.settings.fixture,
        "also_mounted": real.settings.also_mounted,
        # Calibration records of real sensors do not describe simulated ones.
        "calibrations": CalibrationFiles(),
    }
    if real.settings.load_cell is not None and simulated.settings.load_cell is not None:
        kept = {"sensitivity_V_N": simulated.settings.load_cell.sensitivity_V_N}
        limits["load_cell"] = real.settings.load_cell.model_copy(update=kept)
    if real.settings.skin is not None and simulated.settings.skin is not None:
        kept = {"ridges_extent_mm": real.settings.skin.ridges_extent_mm}
        limits["skin"] = simulated.settings.skin.model_copy(update=kept)
    settings = simulated.settings.model_copy(update=limits)
    return replace(
        simulated,
        settings=settings,
        instruments=tuple(instruments),
        stand_ins=tuple(_stand_ins(real, simulated, models or {})),
    )


def _stand_ins(real: BenchPlan, simulated: BenchPlan, models: Mapping[str, str]) -> Iterator[str]:
    """Yield a line for each role that another model plays on the simulated bench than on the real
    one, and one for the interlocks."""
    if real.settings.interlock:
        names = ", ".join(one.name for one in real.settings.interlock)
        yield f"interlocks are not read in a dry run: {names}"
    wanted = {part.role: part.driver_name for part in real.instruments}
    for part in simulated.instruments:
        driver = wanted.get(part.role, part.driver_name)
        if driver != part.driver_name:
            model = models.get(part.role, f"instrument of driver {part.driver_name!r}")
            yield (
                f"{part.role}: no simulator for driver {driver!r} is installed; the dry run uses "
                f"the simulated {model} in its place"
            )


def _settings(tables: dict[str, Any], source: str) -> BenchSettings:
    """Return the settings of the bench itself from its tables without those of the instruments."""
    try:
        return BenchSettings.model_validate(tables)
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, source) from error


@contextlib.contextmanager
def _collect(findings: list[ConfigurationError]) -> Iterator[None]:
    try:
        yield
    except ConfigurationError as error:
        findings.append(error)


def _plan_instrument(role: str, table: Any, source: str) -> InstrumentPlan:
    where = f"{source}: [{role}]"
    if not isinstance(table, dict) or not isinstance(table.get("driver"), str):
        raise ConfigurationError(f"{where}: names no driver")
    name = table["driver"]
    try:
        module: DriverModule = load(DRIVERS, name)
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error.message}", error.hint) from error
    if role not in module.ROLES:
        roles = " or ".join(module.ROLES)
        raise ConfigurationError(f"{where}: driver {name!r} is for the role {roles}")
    try:
        settings = module.Settings.model_validate(table)
    except ValidationError as error:
        if "timeout_s" in table and (lack := _lack_of_timeout(name, module)):
            raise ConfigurationError(f"{where}: {lack.message}", lack.hint) from error
        raise ConfigurationError.from_validation(error, where) from error
    if (own := getattr(settings, "role", role)) != role:
        raise ConfigurationError(f"{where}: its settings are those of the {own}")
    return InstrumentPlan(role, name, module, settings)


def _lack_of_timeout(name: str, module: DriverModule) -> BrokenPackageError | None:
    """Return the fault of a driver whose Settings have no ``timeout_s``, which every driver needs.
    It is a fault for runs only: `rig make-safe` works with such a driver."""
    entry = find(DRIVERS, name)
    if entry is None or "timeout_s" in module.Settings.model_fields:
        return None
    return BrokenPackageError(entry, "has Settings that lack timeout_s")


def _wiring_errors(
    settings: BenchSettings, plans: list[InstrumentPlan], source: str
) -> Iterator[str]:
    """Yield a fault for each part whose signal is not wired to a channel of the DAQ."""
    daq = next((plan.settings for plan in plans if plan.role == "daq"), None)
    wired = {} if daq is None else channels_of(daq)
    key = "channels" if daq is None else channels_name(daq)
    carriers = {"film": ("film",), "load_cell": ("load_cell",), "skin": STRIPS}
    for name, channels in carriers.items():
        for channel in channels:
            if getattr(settings, name) is None or channel in wired:
                continue
            if key is None:
                yield (
                    f"{source}: [{name}] is described, but the driver of [daq] has no setting of "
                    "its channels; mark it in the driver's Settings, as in "
                    "channels: Channels[dict[str, int]] (rig.core.settings.Channels)"
                )
                break
            yield f"{source}: [{name}] is described, but [daq.{key}] wires no {channel}"


def _heartbeat_findings(
    settings: BenchSettings, plans: list[InstrumentPlan], source: str
) -> Iterator[str]:
    """Yield a fault for each instrument that a run may wait for longer than its heartbeat
    time-out."""
    for plan in plans:
        longest_s = longest_call_s(plan.settings)
        if longest_s >= settings.heartbeat_timeout_s:
            yield (
                f"{source}: heartbeat_timeout_s {settings.heartbeat_timeout_s:g} is not above "
                f"{longest_s:g} s, which one call of the {plan.role} may take with its timeout_s"
            )


def _mark_findings(plans: list[InstrumentPlan], source: str) -> Iterator[ConfigurationError]:
    """Yield a fault for each mark of a driver's settings that the bench cannot read. Bench files
    with this fault are refused for runs only, as those of `_communication_findings`."""
    for plan in plans:
        for wrong in mark_errors(type(plan.settings)):
            yield ConfigurationError(
                f"{source}: [{plan.role}]: driver {plan.driver_name!r}: {wrong}",
                "correct the driver's Settings",
            )


def _communication_findings(
    plans: list[InstrumentPlan], source: str
) -> Iterator[ConfigurationError]:
    """Yield a fault for each drive that stops by its own communication time-out before a request
    whose answer was lost can be followed by the next one: it would stand, pressed, with a fault.

    The settings of such a drive state that time-out as well as ``timeout_s``. Bench files with this
    fault are refused for runs only: `rig make-safe` works with them.
    """
    for plan in plans:
        drive = communication_timeout(plan.settings)
        if drive is None:
            continue
        link_s = float(getattr(plan.settings, "timeout_s", 0.0))
        if link_s + RETRY_S <= drive.seconds:
            continue
        least_ms = math.ceil(2.5e3 * link_s)
        least = f"{least_ms:g} ms" if drive.unit == "ms" else f"{least_ms * 1e-3:g} s"
        yield ConfigurationError(
            f"{source}: [{plan.role}] timeout_s = {link_s:g} s leaves no time for a second request "
            f"within {drive.name} = {drive.value:g} {drive.unit}: after one lost answer the drive "
            "would stop by itself, with what it presses still pressed",
            f"set timeout_s to {drive.seconds * 0.4:g} s or less for [{plan.role}], or "
            f"{drive.name} to {least} or more",
        )


def _same_instrument_findings(
    plans: list[InstrumentPlan], source: str
) -> Iterator[ConfigurationError]:
    """Yield a fault for each two tables that name one instrument: what is meant for one axis would
    move the other, past its limits. `rig make-safe` works with such a file.

    One instrument of this program's drivers plays one role. That of another package may have
    several axes behind one address, which its own settings distinguish.
    """
    seen: dict[tuple[Any, ...], str] = {}
    for plan in plans:
        entry = find(DRIVERS, plan.driver_name)
        if entry is None or package(entry) != OWN_PACKAGE:
            continue
        values = address_values(plan.settings)
        if (unit := getattr(plan.settings, "unit_id", None)) is not None:
            values["unit_id"] = unit
        key = (plan.driver_name, *sorted(values.items()))
        if values and key in seen:
            same = ", ".join(f"{name} = {value}" for name, value in values.items())
            yield ConfigurationError(
                f"{source}: [{seen[key]}] and [{plan.role}] name the same instrument ({same}): "
                f"what is meant for {plan.role} would act on {seen[key]}",
                "give each its own address",
            )
        seen.setdefault(key, plan.role)


def _address_findings(plans: list[InstrumentPlan], source: str) -> Iterator[ConfigurationError]:
    """Yield a fault for each instrument whose settings name no address: its locks and latches could
    not be distinguished from those of other benches. `rig make-safe` works without an address."""
    for plan in plans:
        if address_values(plan.settings):
            continue
        entry = find(DRIVERS, plan.driver_name)
        owner = "" if entry is None else f" of the package {package(entry)}"
        yield ConfigurationError(
            f"{source}: [{plan.role}]: no setting of the driver {plan.driver_name!r}{owner} says "
            "where the instrument is, so the bench cannot be locked against other programs",
            "mark that setting in the driver's Settings, as in port: Address[str] "
            "(docs/add-a-driver.md); if it is marked, give it in the bench file",
        )
