"""The base class of a procedure of your own that presses the skin on an object.

    class Creep(PressedProcedure):
        \"\"\"Hold a force and watch the skin creep.\"\"\"

        name, fixtures = "creep", ("plate",)
        columns = (Column("creep", "um", "Travel of z during the hold"),)

        class Settings(PressedSettings):
            hold_s: float = 10.0
            \"\"\"How long the force is held.\"\"\"

        def motion_s(self):
            return self.settings.hold_s

        def under_force(self, trial):
            trial.hold(self.settings.hold_s)

        def reading(self, record):
            return {"creep_um": 1e3 * (record.z_mm[-1] - record.z_mm[0])}

The base class finds the object, presses it with ``--normal-force``, calls `under_force` while the
strips, the forces and the positions are recorded, and lifts. Whatever ends a trial, x stops first,
then z goes up: a subclass cannot leave that out. docs/add-a-procedure.md shows the whole package.
"""

from __future__ import annotations

import inspect
import itertools
import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from contextlib import suppress
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar

from procedures.pressed.approach.way_down import require_possible
from procedures.pressed.grip import GripSettings, grip_reading
from procedures.pressed.points import pressed_overhead_s, refuse_below_contact, trial_points
from procedures.pressed.record.layout import ASKED, CALIBRATED, GRIP, HELD, RECORDED, TOUCHED
from procedures.pressed.settings import PressedSettings
from procedures.pressed.trial_procedure import TrialProcedure
from rig.bench.limits import require
from rig.core.errors import ConfigurationError, RigError, shortened
from rig.files.journal.layout import Column, Layout, Plot, Trace
from rig.run.points import RetakeError

if TYPE_CHECKING:
    from procedures.pressed.record.motion import MotionRecord
    from procedures.pressed.trial import PressedTrial
    from rig.bench.connected import Bench
    from rig.bench.settings import FixtureSettings
    from rig.run.context import Run
    from rig.run.points import Move, Point, Reading

LEAST_MOTION_S = 0.1
"""Shortest motion that is judged: ten ticks of the servo, ten positions."""
START_mm = 10.0
"""Position of x at which a trial begins where the fixture has no middle, as in a slip trial."""

HOOKS = (
    "motion_s",
    "moves",
    "start_mm",
    "offsets_mm",
    "normal_forces_N",
    "under_force",
    "reading",
)
"""Methods whose arguments are checked where a subclass is defined."""

MOTION = (
    Column("motion_from", "s", "Start of the motion, since the start of the record"),
    Column("motion_to", "s", "End of the motion, since the start of the record"),
)
TRACES = (
    Trace("data", "signals", "v_d", ("v_1", "v_2"), title="Differential PVDF signal"),
    Trace("force", "force", "F_n", ("F_t",), title="Forces"),
    Trace("position", "position", "z", ("z_commanded", "x"), title="Positions"),
)


class PressedProcedure(TrialProcedure):
    """A procedure that presses the skin on an object, holds a force, does something, and lifts.

    A subclass has a `name`, `fixtures`, `columns` and the methods `motion_s`, `under_force` and
    `reading`. Everything else has a default. Do not override `arm` or `take`: they keep the bench
    safe.
    """

    Settings = PressedSettings
    columns: ClassVar[tuple[Column, ...]] = ()
    """The columns that `reading` fills, in addition to those that every trial has. The run file
    gets a plot over the trials for each number, and the summary its mean and standard deviation."""
    reading_hook = "reading"

    settings: Any

    def __init_subclass__(cls, **keywords: Any):
        """Check the class where it is defined, and derive its layout and summary.

        Raises TypeError for a method with the wrong arguments, and ValueError for columns that
        cannot be and for a fixture without skin.
        """
        super().__init_subclass__(**keywords)
        _require_skin(cls)
        _require_columns(cls)
        for hook in HOOKS:
            arguments = tuple(inspect.signature(getattr(PressedProcedure, hook)).parameters)
            try:
                inspect.signature(getattr(cls, hook)).bind(*arguments)
            except TypeError:
                raise TypeError(
                    f"{cls.__name__}.{hook} must be {hook}({', '.join(arguments)})"
                ) from None
        if "layout" not in vars(cls):
            cls.layout = layout_of(cls)
        if "summary_keys" not in vars(cls):
            own = tuple(column.key for column in cls.columns if column.kind == "number")
            cls.summary_keys = (*own, *TrialProcedure.summary_keys)

    # --- the hooks of a subclass ----------------------------------------------------------------

    @abstractmethod
    def motion_s(self) -> float:
        """Return the bench time in s that `under_force` is expected to take, from the settings.

        Progress and the estimates of a batch depend on it; it must be at least 0.1 s.
        """

    @abstractmethod
    def under_force(self, trial: PressedTrial) -> None:
        """Do what the procedure is about. The skin is pressed and the normal force is held.

        Use `trial.hold(seconds)` and `trial.move_x(to_mm, speed_mm_s)`; the force is held during
        both, and everything is recorded; `trial.hold_at(force_N)` changes it. In
        `trial.hold_place(seconds)` z stays where it is and the force may relax. Do not wait in any
        other way: outside of them nothing watches the contact. `trial.normal_force_N` is the force
        of this trial. An exception ends the run; the skin is lifted all the same.
        """

    @abstractmethod
    def reading(self, record: MotionRecord) -> Mapping[str, Any]:
        """Return the value of every one of the `columns`, by its key; None for no value.

        `record` has what was recorded during `under_force`. The skin has been lifted already. An
        exception ends the run; what was recorded is saved as a discarded attempt.
        """

    def moves(self) -> tuple[Move, ...]:
        """Return what `under_force` will ask of the instruments, to be checked before the run.

        For instance ``Move("stage_x.position", 12.0, ("distance_mm",))``, where the last part names
        the settings that the value comes from, for the message that refuses it.
        """
        return ()

    def start_mm(self, fixture: FixtureSettings) -> float:
        """Return the position of x in mm at which a trial begins.

        The default is the middle of the object, ``centre_mm`` of the bench file's [fixture], or
        10 mm where the fixture has none.
        """
        return START_mm if fixture.centre_mm is None else fixture.centre_mm

    def offsets_mm(self) -> tuple[float, ...]:
        """Return how far along x from `start_mm` the trials begin, in mm, one after the other.

        Each of them gets ``--trials`` trials, which are numbered through. The default is one place,
        `start_mm` itself. `reading` finds the position of x in `record.x_mm`.
        """
        return (0.0,)

    def normal_forces_N(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        """Return the normal forces in N that the trials press with, one after the other.

        Each of them gets ``--trials`` trials at every place of `offsets_mm`. The default is one,
        ``--normal-force``. A force below 0.1 N, which means contact, or one that is not below
        ``--largest-force``, is refused before anything moves.
        """
        return (self.settings.normal_force_N,)

    def values_in_title(self) -> tuple[float, ...]:
        """Return the forces of `normal_forces_N`, in N."""
        return self._forces()

    # --- what the base class does with them -----------------------------------------------------

    def import_ahead(self) -> None:
        """Import what a trial needs: never while something is switched on."""
        super().import_ahead()
        import procedures.pressed.record.motion
        import procedures.pressed.trial  # noqa: F401 - with numpy: not for `--help`

    def points(self) -> tuple[Point, ...]:
        """Return one point for each trial.

        Raises ConfigurationError for a motion that is too short.
        """
        (motion_s,) = self._numbers("motion_s", (self.motion_s(),))
        if not (math.isfinite(motion_s) and motion_s >= LEAST_MOTION_S):
            raise ConfigurationError(
                f"{self.name}: what is done under the force would take {motion_s:g} s; a trial "
                f"needs at least {LEAST_MOTION_S:g} s",
                "ask for a longer one",
            )
        self._refuse_force_without_effect()
        self._refuse_too_large_a_force()
        moves = self.moves()
        if not isinstance(moves, (tuple, list)):
            raise self._wrong_return(
                "moves", moves, "a tuple of Move, with a comma after one alone"
            )
        return trial_points(self.settings, tuple(moves), motion_s, 0.0, len(self._conditions()))

    def overhead_s(self, fixture: FixtureSettings, homed: bool) -> float:
        """Return the bench time in s that the ways in z, homing and parking are expected to
        take."""
        offsets, x_mm = self._offsets(), self._start_mm(fixture)
        presses = self.settings.trials * len(self._conditions())
        apart_mm = (max(offsets) - min(offsets)) / max(len(offsets) - 1, 1)
        return pressed_overhead_s(self.settings, fixture, homed, presses, x_mm, apart_mm)

    def check(self, bench: Bench) -> None:
        """Refuse a fixture that does not state where contact is, or a begin that x cannot reach."""
        super().check(bench)
        require_possible(bench, self.settings.largest_force_N, max(self._forces()))
        start_mm = self._start_mm(bench.settings.fixture)
        for offset_mm in self._offsets():
            require("stage_x position", start_mm + offset_mm, bench.limits()["stage_x.position"])

    def arm(self, run: Run) -> None:
        """Watch the force; register the end of everything before it begins; park."""
        self._arm_with_x(run, "motion")

    def take(self, run: Run, point: Point) -> Reading:
        """Make ready, press, do what the subclass does under the force, lift; then its reading."""
        # Imported by import_ahead(), and not at the top: numpy would slow a command's `--help`.
        from procedures.pressed.record.motion import motion_record, plain
        from procedures.pressed.record.reading import reading_of
        from procedures.pressed.record.trial_record import TrialRecord
        from procedures.pressed.trial import PressedTrial

        series = self._series
        assert series is not None, "arm() comes first"
        number = int(point.condition)
        conditions = self._conditions()
        force_N, offset_mm = conditions[(number - 1) % len(conditions)]
        record = TrialRecord(number, series.rates.tick_Hz, run.force.rate_S_s, force_N)
        trial = PressedTrial(run, series, record)
        trial.make_ready(self._start_mm(run.bench.settings.fixture) + offset_mm)
        trial.start_recording()
        with trial.longer_blocks_if_too_slow():
            trial.press()
            trial.begin_motion()
            self._under_force(trial)
            trial.complete_motion(LEAST_MOTION_S)
            trial.stop_recording()
        trial.lift()
        reading = reading_of(run, record) | trial.record_load_rates()
        reading |= {"motion_from_s": record.motion_from_s, "motion_to_s": record.motion_to_s}
        if isinstance(self.settings, GripSettings):
            reading |= grip_reading(record)
        own = self.reading(motion_record(record))
        run.check_stop()  # computing takes a while: still alive
        return reading | plain(own, {column.key for column in self.columns}, self.name)

    def _under_force(self, trial: PressedTrial) -> None:
        """Call `under_force`. A trial that it gives up ends as any other: x stops, then z goes up.

        An error that it gives up the trial for is raised instead of RetakeError: nothing is to be
        pressed again by an instrument that has failed.
        """
        try:
            self.under_force(trial)
            return
        except RetakeError as given_up:
            if (cause := _error_behind(given_up)) is None:
                trial.abandon()
                raise
        raise cause

    def _start_mm(self, fixture: FixtureSettings) -> float:
        """Return `start_mm`, which has to be a number."""
        (start_mm,) = self._numbers("start_mm", (self.start_mm(fixture),))
        return start_mm

    def _numbers(self, hook: str, found: Any) -> tuple[float, ...]:
        """Return the numbers that a hook has returned. Raises ConfigurationError, which names the
        hook, for anything else."""
        if isinstance(found, Iterable):
            found = tuple(found)
            # A number is what float() takes, such as a Decimal, but not a text or a truth value.
            if not any(isinstance(one, str | bytes | bool) for one in found):
                with suppress(TypeError, ValueError):
                    return tuple(map(float, found))
        one_alone = hook in ("motion_s", "start_mm")
        shown = found[0] if one_alone else found
        raise self._wrong_return(hook, shown, "a number" if one_alone else "a tuple of numbers")

    def _wrong_return(self, hook: str, found: Any, wanted: str) -> ConfigurationError:
        return ConfigurationError(
            f"{self.name}: {hook}() returned {shortened(repr(found))}", f"let it return {wanted}"
        )

    def _offsets(self) -> tuple[float, ...]:
        """Return `offsets_mm`, of which there has to be one at least."""
        offsets = self._numbers("offsets_mm", self.offsets_mm())
        if not offsets or not all(map(math.isfinite, offsets)):
            raise ConfigurationError(
                f"{self.name}: offsets_mm() returned {offsets}, in which no trial can be made",
                "return at least one place",
            )
        return offsets

    def _forces(self) -> tuple[float, ...]:
        """Return `normal_forces_N`, of which there has to be one at least, all possible."""
        forces = self._numbers("normal_forces_N", self.normal_forces_N())
        largest_N = self.settings.largest_force_N
        if not forces:
            raise ConfigurationError(
                f"{self.name}: normal_forces_N() returned no force, and a trial needs one",
                "return at least one force",
            )
        for force_N in forces:
            if not 0 < force_N < largest_N:
                raise ConfigurationError(
                    f"{self.name}: a normal force of {force_N:g} N is not above 0 N and below "
                    f"--largest-force {largest_N:g} N",
                    "press with another force, or raise --largest-force if skin and bench bear it",
                )
            refuse_below_contact(self.name, force_N)
        return forces

    def _refuse_force_without_effect(self) -> None:
        """Raise ConfigurationError for a ``--normal-force`` that is not the default and that a
        procedure with forces of its own does not press with."""
        given_N = self.settings.normal_force_N
        default_N = type(self.settings).model_fields["normal_force_N"].default
        if type(self).normal_forces_N is PressedProcedure.normal_forces_N or given_N == default_N:
            return
        forces = self._forces()
        usual = type(self)(self.settings.model_copy(update={"normal_force_N": default_N}))
        if forces == usual._forces():
            own = ", ".join(f"{force_N:g}" for force_N in forces)
            raise ConfigurationError(
                f"{self.name} has forces of its own, {own} N: --normal-force {given_N:g} N "
                "has no effect",
                "leave --normal-force out",
            )

    def _refuse_too_large_a_force(self) -> None:
        """Raise ConfigurationError where the settings ask for a held force that is not below
        ``--largest-force``."""
        held_N, limit_N = self.settings.largest_held_N, self.settings.largest_force_N
        if not isinstance(held_N, Real):
            raise ConfigurationError(
                f"{self.name}: largest_held_N of its settings is {shortened(repr(held_N))}",
                "let it return a number",
            )
        if not held_N < limit_N:
            raise ConfigurationError(
                f"{self.name}: a held force of {held_N:g} N is not below --largest-force "
                f"{limit_N:g} N",
                "hold a smaller force, or raise --largest-force if skin and bench bear it",
            )

    def _conditions(self) -> tuple[tuple[float, float], ...]:
        """Return normal force in N and offset in mm of the trials, one after the other."""
        return tuple(itertools.product(self._forces(), self._offsets()))


def _error_behind(given_up: RetakeError) -> RigError | None:
    """Return the first error that was being handled when a trial was given up; None if none was."""
    found: RigError | None = None
    error: BaseException | None = given_up
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, RigError) and not isinstance(error, RetakeError):
            found = error
        error = error.__cause__ or error.__context__
    return found


def _require_skin(procedure: type[PressedProcedure]) -> None:
    """Raise ValueError for a fixture that has a film and no skin: there are no strips to record."""
    fixtures: Any = getattr(procedure, "fixtures", ())
    if isinstance(fixtures, (tuple, list)) and "film-clamp" in fixtures:
        raise ValueError(
            f"{procedure.__name__}.fixtures has 'film-clamp', and a PressedProcedure presses the "
            "skin on 'plate' or 'semi-spherical-object'; to press a film derive from "
            "rig.run.procedure.Procedure and press with procedures.sweep.preload.press"
        )


def _require_columns(procedure: type[PressedProcedure]) -> None:
    """Raise TypeError where the columns are not a tuple of columns, and ValueError for two of one
    name."""
    columns: Any = procedure.columns
    if not (isinstance(columns, (tuple, list)) and all(isinstance(c, Column) for c in columns)):
        raise TypeError(
            f"{procedure.__name__}.columns must be a tuple of Column(name, unit, meaning), with "
            f"a comma after one alone; it is {shortened(repr(columns))}"
        )
    names = [column.name for column in columns]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{procedure.__name__}.columns has {twice[0]!r} twice; rename one of them")


def layout_of(procedure: type[PressedProcedure]) -> Layout:
    """Return the layout of a procedure: the columns of every trial and its own, a plot over the
    trials for each of its numbers, and signals, forces and positions over time. Raises ValueError
    for a column that every trial has already."""
    grip = GRIP if issubclass(procedure.Settings, GripSettings) else ()
    common = (*ASKED, *HELD, *TOUCHED, *CALIBRATED, *grip, *MOTION, *RECORDED)
    names = {column.name for column in common}
    if taken := [column.name for column in procedure.columns if column.name in names]:
        raise ValueError(
            f"{procedure.__name__}: every trial has a column {taken[0]!r}; rename yours"
        )
    return Layout(
        definition=f"NXrig_{getattr(procedure, 'name', 'pressed').replace('-', '_')}",
        version="1",
        columns=(
            *ASKED,
            *HELD,
            *procedure.columns,
            *TOUCHED,
            *CALIBRATED,
            *grip,
            *MOTION,
            *RECORDED,
        ),
        plots=tuple(
            Plot(f"{column.name}_by_trial", column.name, ("trial",), title=column.meaning)
            for column in procedure.columns
            if column.kind == "number"
        ),
        traces=TRACES,
    )
