"""The bench: from a bench file to connected instruments that refuse what is outside the limits.

A bench file names, for each role, a driver and its settings. The driver modules come from the
entry-point group ``rig.drivers``, so a laboratory adds its own without touching this package. All
errors of a file are shown at once, and all instruments are tried before a connection failure is
reported.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, Protocol, Self, TypeVar

from pydantic import Field, ValidationError, model_validator

from rig.bench.keep_alives import KeepAlives
from rig.core.clock import Clock
from rig.core.entry_points import DRIVERS, load
from rig.core.errors import (
    ConfigurationError,
    LimitError,
    RigError,
    SeveralFailuresError,
)
from rig.core.settings import Settings, wiring_of
from rig.core.toml_files import MAX_TOML_BYTES, parse_toml, read_text
from rig.instruments.calibration import (
    CalibrationFiles,
    FilmCalibration,
    ForceCalibration,
    LoadCellCalibration,
    header_entry,
    read_calibration,
    require_valid,
)
from rig.instruments.roles import (
    DataAcquisition,
    DriverModule,
    ForceSensor,
    Identity,
    Instrument,
    LinearStage,
    Reach,
    RotaryStage,
    SignalGenerator,
)

ROLES = ("generator", "daq", "stage_z", "stage_x", "rotary", "force_sensor")

WAITS_PER_CALL = 2
"""A call on an instrument may wait twice for its time-out: to reconnect, and for the answer."""

T = TypeVar("T")
R = TypeVar("R", FilmCalibration, ForceCalibration, LoadCellCalibration)

Fixture = Literal["film-clamp", "plate", "semi-spherical-object"]
Strip = Literal["strip_1", "strip_2"]
STRIPS: tuple[Strip, ...] = ("strip_1", "strip_2")
"""The skin's two channels as the DAQ's wiring names them: S1 and S2 of the paper."""


class FilmSettings(Settings):
    """The film under test and its amplifier."""

    amplifier_gain: float = Field(default=1.0, gt=0)
    """Gain between film and DAQ."""
    area_mm2: float = Field(default=8.0, gt=0)
    """Contact area of the indentor."""
    name: str = ""
    """Which film: its label or batch."""


class LoadCellSettings(Settings):
    """The dynamic force sensor that carries the film."""

    name: str = ""
    """Which cell: its label or serial number."""
    sensitivity_V_N: float = Field(gt=0)
    """Output per newton."""
    max_load_N: float = Field(default=20.0, gt=0)
    """Largest peak load that film and cell may see; beyond it the run trips."""


class SkinSettings(Settings):
    """The artificial finger skin and the amplifiers of its two strips."""

    name: str = ""
    """Which skin: its label or batch."""
    amplifier_gain: float = Field(default=1000.0, gt=0)
    """Gain between a strip and the DAQ."""
    ridge: int = Field(default=3, ge=1)
    """The ridge that holds the strips, 1 is the leftmost."""
    b_dB: dict[Strip, float] = Field(default_factory=dict)
    """Calibrated b (paper eq. 2) by strip, without the amplifier's gain; none until calibrated. A
    calibration record in use replaces it."""
    b_error_dB: dict[Strip, float] = Field(default_factory=dict)
    """Standard error of each b."""
    films: dict[Strip, str] = Field(default_factory=dict)
    """Label of the film in each strip: a calibration record has to be of it."""

    @model_validator(mode="after")
    def _every_level_has_its_error(self) -> Self:
        if self.b_dB.keys() != self.b_error_dB.keys():
            raise ValueError("b_dB and b_error_dB have to name the same strips")
        if any(error < 0 for error in self.b_error_dB.values()):
            raise ValueError("b_error_dB is below 0")
        return self


class FixtureSettings(Settings):
    """What is mounted on the bench."""

    mounted: Fixture
    """A procedure refuses to run on the wrong fixture."""
    contact_from_mm: float | None = None
    """Position of the z stage at which the probe meets the object at the earliest: contact felt
    before means that something is in the way."""
    contact_to_mm: float | None = None
    """Position at which it has met the object: no contact by then means that there is none."""
    parked_mm: float = 5.0
    """Position at which the z stage waits, clear of everything. One that is not clear of contact
    refuses each run that presses, not this file: the bench can still be made safe with it."""
    centre_mm: float | None = None
    """Of an object that rolls: position of x at which the middle of the skin is above it."""
    upright_deg: float | None = None
    """Of an object that rolls: angle of the rotary stage at which it stands upright."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        first_mm, last_mm = self.contact_from_mm, self.contact_to_mm
        if first_mm is not None and last_mm is not None and first_mm > last_mm:
            raise ValueError(
                f"contact_from_mm ({first_mm:g}) is above contact_to_mm ({last_mm:g}); "
                "contact is felt from the former to the latter"
            )
        return self


class BenchSettings(Settings):
    """A bench file without its instruments, whose tables belong to their drivers."""

    name: str = Field(min_length=1, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    """Name of the bench, used in messages and file names."""
    simulation: dict[str, Any] | None = None
    """Present on a simulated bench: its seed and World. A simulated instrument marks a run as
    simulated all the same."""
    heartbeat_timeout_s: float = Field(default=5.0, ge=1, le=600)
    """A run silent for longer is taken for hung: the guard ends it and makes the bench safe."""
    fixture: FixtureSettings
    also_mounted: tuple[FixtureSettings, ...] = ()
    """Fixtures that are mounted beside it, each with its own places: runs on any of them need
    nobody to change the bench between them."""
    film: FilmSettings | None = None
    load_cell: LoadCellSettings | None = None
    skin: SkinSettings | None = None
    calibrations: CalibrationFiles = CalibrationFiles()
    """Calibration records in use; their values replace those of this file."""

    @model_validator(mode="after")
    def _each_fixture_once(self) -> Self:
        mounted = [fixture.mounted for fixture in self.fixtures]
        for name in mounted:
            if mounted.count(name) > 1:
                raise ValueError(f"[fixture] and [[also_mounted]] name the {name} twice")
        return self

    @property
    def fixtures(self) -> tuple[FixtureSettings, ...]:
        """All that is mounted."""
        return (self.fixture, *self.also_mounted)


@dataclass(frozen=True)
class InstrumentPlan:
    """One role's driver and settings, validated but not connected."""

    role: str
    driver_name: str
    driver: DriverModule
    settings: Settings


@dataclass(frozen=True)
class BenchPlan:
    """A validated bench file."""

    settings: BenchSettings
    instruments: tuple[InstrumentPlan, ...]
    text: str
    """The file verbatim."""
    source: str
    """Where it came from, for messages and the run file."""
    stand_ins: tuple[str, ...] = ()
    """What a dry run has to say of instruments that stand in for those of the bench file."""

    @property
    def mounted(self) -> tuple[Fixture, ...]:
        """The fixtures on the bench, that of [fixture] first."""
        return tuple(fixture.mounted for fixture in self.settings.fixtures)

    def require_fixture(self, *accepted: Fixture) -> BenchPlan:
        """The plan on the first mounted fixture of those `accepted`; ConfigurationError, which
        refuses the run, where none is."""
        for mounted in self.mounted:
            if mounted in accepted:
                return self.on(mounted)
        raise ConfigurationError(
            f"the bench has the {' and the '.join(self.mounted)} mounted, this procedure needs "
            f"{' or '.join(accepted)}",
            f"mount it and correct [fixture] in {self.source}",
        )

    def on(self, fixture: Fixture) -> BenchPlan:
        """The plan with one of the mounted fixtures as that of [fixture], which a run works on."""
        if fixture == self.settings.fixture.mounted:
            return self
        fixtures = self.settings.fixtures
        chosen = next(one for one in fixtures if one.mounted == fixture)
        others = tuple(one for one in fixtures if one.mounted != fixture)
        changed = {"fixture": chosen, "also_mounted": others}
        return replace(self, settings=self.settings.model_copy(update=changed))


class GuardedGenerator:
    """A signal generator that refuses values outside the bench's limits at every call."""

    def __init__(self, inner: SignalGenerator):
        self._inner = inner

    @property
    def identity(self) -> Identity:
        """Who the generator is."""
        return self._inner.identity

    def reach(self) -> Mapping[str, Reach]:
        """The generator's limits."""
        return self._inner.reach()

    def sine(self, frequency_Hz: float, amplitude_V: float) -> None:
        """A sine within the limits; LimitError before anything is sent otherwise."""
        limits = self._inner.reach()
        require("frequency", frequency_Hz, limits["frequency"])
        require("amplitude", amplitude_V, limits["amplitude"])
        self._inner.sine(frequency_Hz, amplitude_V)

    def output(self, on: bool) -> None:
        """Switch the output."""
        self._inner.output(on)

    def output_is_on(self) -> bool:
        """The output's state."""
        return self._inner.output_is_on()

    def make_safe(self) -> None:
        """Output off."""
        self._inner.make_safe()

    def close(self) -> None:
        """Let go of the link."""
        self._inner.close()


@dataclass
class Bench:
    """Connected instruments and what is known of the bench around them."""

    plan: BenchPlan
    clock: Clock
    instruments: dict[str, Instrument]
    keep_alives: KeepAlives = field(default_factory=KeepAlives)
    strip_calibrations: dict[Strip, FilmCalibration] = field(default_factory=dict)
    """Records in use for the skin's strips."""

    @property
    def settings(self) -> BenchSettings:
        """The bench file's own part."""
        return self.plan.settings

    @property
    def generator(self) -> SignalGenerator:
        """The signal generator; ConfigurationError where the bench has none."""
        return self._role("generator")  # type: ignore[return-value]

    @property
    def daq(self) -> DataAcquisition:
        """The DAQ; ConfigurationError where the bench has none."""
        return self._role("daq")  # type: ignore[return-value]

    @property
    def stage_z(self) -> LinearStage:
        """The z stage; ConfigurationError where the bench has none."""
        return self._role("stage_z")  # type: ignore[return-value]

    @property
    def stage_x(self) -> LinearStage:
        """The x stage; ConfigurationError where the bench has none."""
        return self._role("stage_x")  # type: ignore[return-value]

    @property
    def rotary(self) -> RotaryStage:
        """The rotary stage; ConfigurationError where the bench has none."""
        return self._role("rotary")  # type: ignore[return-value]

    @property
    def force_sensor(self) -> ForceSensor:
        """The force sensor; ConfigurationError where the bench has none."""
        return self._role("force_sensor")  # type: ignore[return-value]

    @property
    def film(self) -> FilmSettings:
        """The film; ConfigurationError where the bench file describes none."""
        return self._part("film", self.settings.film)

    @property
    def load_cell(self) -> LoadCellSettings:
        """The load cell; ConfigurationError where the bench file describes none."""
        return self._part("load_cell", self.settings.load_cell)

    @property
    def skin(self) -> SkinSettings:
        """The skin; ConfigurationError where the bench file describes none."""
        return self._part("skin", self.settings.skin)

    @property
    def simulated(self) -> bool:
        """Whether anything of this bench is simulated: declared, or admitted by an instrument."""
        admitted = any(i.identity.simulated for i in self.instruments.values())
        return self.settings.simulation is not None or admitted

    def reach(self) -> dict[str, Reach]:
        """Every instrument's limits as ``role.quantity``, and the load cell's."""
        limits = {
            f"{role}.{quantity}": reach
            for role, instrument in self.instruments.items()
            for quantity, reach in instrument.reach().items()
        }
        if self.settings.load_cell is not None:
            largest = self.settings.load_cell.max_load_N
            limits["load_cell.load"] = Reach(0.0, largest, "N", "load cell")
        return limits

    def close(self) -> None:
        """Let go of every link, each in isolation."""
        _close_all(self.instruments)
        self.clock.close()

    def _role(self, role: str) -> Instrument:
        if role not in self.instruments:
            raise ConfigurationError(
                f"{self.plan.source}: the bench has no {role}", f"add a [{role}] table"
            )
        return self.instruments[role]

    def _part(self, name: str, part: T | None) -> T:
        if part is None:
            raise ConfigurationError(
                f"{self.plan.source}: the bench file describes no {name}", f"add a [{name}] table"
            )
        return part


def require(what: str, value: float, reach: Reach, where: str = "") -> None:
    """Raise LimitError that names value, unit, limit, device and place unless `reach` holds it."""
    if reach.holds(value):
        return
    place = f"{where}: " if where else ""
    raise LimitError(
        f"{place}{what} {value:g} {reach.unit} is outside {reach.low:g} to {reach.high:g} "
        f"{reach.unit} of the {reach.owner}",
        "choose a value inside, or correct the bench file if the limit is wrong",
    )


def read_bench(path: Path) -> BenchPlan:
    """Read and validate a bench file; ConfigurationError tells all that is wrong with it."""
    hint = "give the file with --bench, or leave it out for the simulated bench"
    return parse_bench(read_text(path, "bench file", MAX_TOML_BYTES, hint), str(path))


def parse_bench(text: str, source: str) -> BenchPlan:
    """Validate the text of a bench file, all errors at once."""
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
    if settings is not None:
        findings += map(ConfigurationError, _impatience(settings, plans, source))
    if findings or settings is None:
        hints = dict.fromkeys(finding.hint or "correct the bench file" for finding in findings)
        raise ConfigurationError("; ".join(f.message for f in findings), "; ".join(hints))
    return BenchPlan(settings, tuple(plans), text, source)


@dataclass(frozen=True)
class Restable:
    """What of a bench file can be made safe, and why the rest cannot."""

    instruments: tuple[InstrumentPlan, ...]
    failures: dict[str, str]
    """By role, why an instrument is out of reach; under "bench file" what is wrong with the rest of
    the file."""
    settings: BenchSettings | None
    """None where the rest of the file is wrong."""


def parse_to_make_safe(text: str, source: str) -> Restable:
    """What a bench file says of its instruments, for making them safe.

    What is wrong with one instrument or its driver keeps no other from being made safe, so it is
    returned and not raised. ConfigurationError where the text describes no instrument at all.
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
        failures["bench file"] = error.one_line()
    return Restable(tuple(instruments), failures, settings)


def _settings(tables: dict[str, Any], source: str) -> BenchSettings:
    """A bench file's own part, what is left of it without its instruments."""
    try:
        return BenchSettings.model_validate(tables)
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, source) from error


def rehearsal(
    real: BenchPlan, simulated: BenchPlan, models: Mapping[str, str] | None = None
) -> BenchPlan:
    """The simulated bench under a real bench file's limits: its fixture, its load limit and its
    drivers' settings, except for those that a driver marks as `Wiring`.

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
        "calibrations": CalibrationFiles(),  # those of real sensors are nothing to simulated ones
    }
    if real.settings.load_cell is not None and simulated.settings.load_cell is not None:
        kept = {"sensitivity_V_N": simulated.settings.load_cell.sensitivity_V_N}
        limits["load_cell"] = real.settings.load_cell.model_copy(update=kept)
    settings = simulated.settings.model_copy(update=limits)
    return replace(
        simulated,
        settings=settings,
        instruments=tuple(instruments),
        stand_ins=tuple(_stand_ins(real, simulated, models or {})),
    )


def _stand_ins(real: BenchPlan, simulated: BenchPlan, models: Mapping[str, str]) -> Iterator[str]:
    """A line for each role that another model plays on the simulated bench than on the real one."""
    wanted = {part.role: part.driver_name for part in real.instruments}
    for part in simulated.instruments:
        driver = wanted.get(part.role, part.driver_name)
        if driver != part.driver_name:
            model = models.get(part.role, f"instrument of driver {part.driver_name!r}")
            yield (
                f"{part.role}: no simulator for driver {driver!r} is installed; the dry run uses "
                f"the simulated {model} in its place"
            )


def connect(plan: BenchPlan, clock: Clock, before_each: Callable[[], None] = lambda: None) -> Bench:
    """Connect to every instrument; where some fail, all failures are told and none stays open.

    What `before_each` raises, before an instrument is connected, ends it at once.
    """
    instruments: dict[str, Instrument] = {}
    failures: list[RigError] = []
    keep_alives = KeepAlives()
    clock.each_slice(keep_alives.feed)
    for part in plan.instruments:
        try:
            before_each()
        except BaseException:
            _close_all(instruments)
            raise
        try:
            instrument = part.driver.connect(part.settings, clock)
        except RigError as error:
            failures.append(error)
            continue
        except BaseException:
            _close_all(instruments)
            raise
        guarded = GuardedGenerator(instrument) if part.role == "generator" else instrument  # type: ignore[arg-type]
        instruments[part.role] = guarded
        if hasattr(instrument, "keep_alive"):
            keep_alives.add(part.role, instrument.keep_alive)
    if failures:
        _close_all(instruments)
        raise failures[0] if len(failures) == 1 else SeveralFailuresError(failures)
    return Bench(plan, clock, instruments, keep_alives)


def apply_calibrations(
    bench: Bench, now: datetime, allow_expired: bool = False
) -> tuple[list[dict[str, Any]], list[str]]:
    """Use the calibration records that the bench file names, each checked against its sensor.

    Returns the records as a run's header carries them, and warnings. ConfigurationError for one
    that is expired (unless told), another sensor's, or a simulated one on a real bench.
    """
    files, plan = bench.settings.calibrations, bench.plan
    folder = Path(plan.source).parent
    entries: list[dict[str, Any]] = []
    warnings: list[str] = []

    def used(file: Path, kind: type[R], sensor: str) -> R:
        path = folder / file
        record = read_calibration(path, kind)
        warnings.extend(
            require_valid(
                record,
                sensor,
                now,
                source=path,
                simulated_bench=bench.simulated,
                allow_expired=allow_expired,
                warning_days=files.expiry_warning_days,
            )
        )
        entries.append(header_entry(record, path))
        return record

    if files.film is not None:
        used(files.film, FilmCalibration, bench.film.name)
    if files.force_sensor is not None:
        sensor = bench.force_sensor
        force = used(files.force_sensor, ForceCalibration, sensor.identity.serial_number)
        sensor.calibrate(force.matrix_N_mV_V)
    if files.load_cell is not None:
        cell = used(files.load_cell, LoadCellCalibration, bench.load_cell.name)
        calibrated = {"sensitivity_V_N": cell.sensitivity_V_N.value}
        part = bench.load_cell.model_copy(update=calibrated)
        bench.plan = replace(plan, settings=plan.settings.model_copy(update={"load_cell": part}))
    for strip in STRIPS:
        file = getattr(files, strip)
        if file is not None:
            film = bench.skin.films.get(strip, "")
            bench.strip_calibrations[strip] = used(file, FilmCalibration, film)
    return entries, warnings


def _close_all(instruments: Mapping[str, Instrument]) -> None:
    for instrument in instruments.values():
        with contextlib.suppress(RigError, OSError):
            instrument.close()


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
        raise ConfigurationError.from_validation(error, where) from error
    if (own := getattr(settings, "role", role)) != role:
        raise ConfigurationError(f"{where}: its settings are those of the {own}")
    return InstrumentPlan(role, name, module, settings)


def _wiring_errors(
    settings: BenchSettings, plans: list[InstrumentPlan], source: str
) -> Iterator[str]:
    """Parts that the bench file describes but whose signal no terminal of the DAQ carries."""
    wired = next((getattr(p.settings, "channels", {}) for p in plans if p.role == "daq"), {})
    carriers = {"film": ("film",), "load_cell": ("load_cell",), "skin": STRIPS}
    for name, channels in carriers.items():
        for channel in channels:
            if getattr(settings, name) is not None and channel not in wired:
                yield f"{source}: [{name}] is described, but [daq.channels] wires no {channel}"


def _impatience(settings: BenchSettings, plans: list[InstrumentPlan], source: str) -> Iterator[str]:
    """A run that waits for an instrument must not be taken for one that hangs."""
    for plan in plans:
        longest_s = WAITS_PER_CALL * getattr(plan.settings, "timeout_s", 0.0)
        if longest_s >= settings.heartbeat_timeout_s:
            yield (
                f"{source}: heartbeat_timeout_s {settings.heartbeat_timeout_s:g} is not above "
                f"{longest_s:g} s, which one call of the {plan.role} may take with its timeout_s"
            )


class BenchFactory(Protocol):
    """What an entry point of group ``rig.benches`` names: a module that can be a bench."""

    def variants(self) -> tuple[str, ...]:
        """The names of the benches that it can be, for the option ``stages``; the usual one is the
        first."""
        ...

    def variant_for(self, drivers: Mapping[str, str]) -> str | None:
        """The variant that stands in for a bench with these drivers (names by role): its stages
        have their limits. None where it has none for them."""
        ...

    def options_for(self, drivers: Mapping[str, str]) -> dict[str, Any]:
        """Options for `start` that give the bench the simulators of these drivers (names by role),
        as far as they are installed."""
        ...

    def begin(self) -> RunningBench:
        """Begin to start the bench as a process of its own, its time slaved to the caller, before
        anybody knows how it is to be."""
        ...

    def start(self, options: dict[str, Any], begun: RunningBench | None = None) -> RunningBench:
        """Go on to start a bench that has `begun`, or another one, as `options` say."""
        ...

    def serve(self, options: dict[str, Any], ready: Callable[[str], None]) -> None:
        """Be the bench in real time until stopped; `ready` gets the text of its bench file."""
        ...


class RunningBench(Protocol):
    """A simulated bench that was started for one run."""

    def ready(self) -> dict[str, Any]:
        """Wait until it listens: ``control_port``, ``bench_toml``, ``recorded_toml``, the same text
        without the process's port numbers, and ``models``, the instruments' by role."""
        ...

    def wait(self, timeout_s: float = 5.0) -> None:
        """Wait for the process to end."""
        ...

    def abandon(self) -> None:
        """End the process, to which nothing has been connected."""
        ...
