"""What is checked when a procedure is loaded, and of what its hooks raise and return."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from made_up import LAYOUT, Example, run_of
from pydantic import Field

from rig.cli.commands.procedures import ProcedureRequest
from rig.cli.options.groups import group_parameters
from rig.core.entry_points import PROCEDURES, names
from rig.core.errors import ConfigurationError, ExitCode
from rig.core.settings import Settings
from rig.files.journal.format import MAX_JSON
from rig.files.journal.layout import Column, Layout, Plot, Trace
from rig.files.journal.reader import read_journal
from rig.files.runfile.reader import RunFile
from rig.run.checked_procedure import CheckedProcedure, ProcedureFaultError, internal, reading_fault
from rig.run.load_procedure import COMMON_OPTIONS, fault_of, load_procedure
from rig.run.points import Move, Point
from rig.run.procedure import Procedure, StreamPlan
from rig.run.results import differences, results_of

X = Column("x", "V", "x")


def made(**members: Any) -> type[Example]:
    """A subclass of a procedure without fault."""
    return type("Changed", (Example,), {"__module__": __name__, **members})


def of_columns(*columns: Column, traces: tuple[Trace, ...] = ()) -> Layout:
    """A layout of columns, the first of which is plotted over itself."""
    plot = Plot("data", columns[0].name, (columns[1].name,))
    return Layout("NXrig_noop", "1", columns, (plot,), traces=traces)


class ListOfForces(Settings):
    """A setting that validates, and that a text on the command line cannot be."""

    forces_N: list[float] = Field(default=[1.0, 2.0])
    """Forces."""


class ZeroTwice(Settings):
    zero: bool = True
    no_zero: bool = False


class OneForce(Settings):
    """A default that its own type refuses."""

    forces_N: tuple[float, ...] = 3.0  # type: ignore[assignment]
    """Forces."""


class ShortHold(Settings):
    """A default outside its own bounds."""

    hold_s: float = Field(default=0.1, ge=0.2)
    """Time."""


class TwoHolds(Settings):
    """Settings that would make one option."""

    hold_s: float = 1.0
    """Time."""
    hold_mm: float = 1.0
    """Way."""


class OwnSeed(Settings):
    """A setting that every command has already."""

    seed: int = 1
    """Seed."""


def misspelt(self: Any, fixture: Any, homed: bool) -> float:
    return 1.0


def generator(self: Any, run: Any) -> Any:
    yield run


async def coroutine(self: Any, run: Any, point: Any) -> dict[str, Any]:
    return {}


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "a misspelt hook": (
        {"overheads_s": misspelt},
        "has 'overheads_s', which is not a hook; did you mean 'overhead_s'?",
    ),
    "two letters swapped": ({"refien": misspelt}, "did you mean 'refine'?"),
    "a misspelt attribute": ({"stream": ()}, "did you mean 'streams'?"),
    "too few arguments": (
        {"take": lambda self, run: {}},
        "has take(self, run), which must be take(self, run, point)",
    ),
    "too many arguments": (
        {"refine": lambda self, settings, readings: ()},
        "has refine(self, settings, readings), which must be refine(self, readings)",
    ),
    "a value in place of a method": ({"arm": 1}, "has 'arm' that is not a plain method"),
    "a coroutine": ({"take": coroutine}, "has 'take' with 'async', so that its lines would not be"),
    "a generator": (
        {"arm": generator},
        "has 'arm' with 'yield', so that its lines would not be run",
    ),
    "no settings in __init__": ({"__init__": lambda self: None}, "has an __init__() that does not"),
    "another name": ({"name": "exampel"}, "has the name 'exampel', which must be that"),
    "an unknown fixture": ({"fixtures": ("table",)}, "has the fixture 'table'; known are film-"),
    "fixtures as a word": ({"fixtures": "plate"}, "has fixtures that are not a tuple"),
    "Settings of another kind": ({"Settings": dict}, "has Settings that are not a subclass"),
    "a layout of another kind": ({"layout": {}}, "has a layout that is not a"),
    "two columns of one key": (
        {"layout": of_columns(X, Column("y", "V", "y", key="x_V"))},
        "whose columns 'x' and 'y' show the same key 'x_V'",
    ),
    "an unknown unit": (
        {"layout": of_columns(X, Column("y", "furlong/blink", "y"))},
        "whose column 'y' has the unknown unit 'furlong/blink'",
    ),
    "a trace of no stream": (
        {"layout": of_columns(X, Column("y", "", "y"), traces=(Trace("t", "ticks", "a"),))},
        "whose trace 't' shows the stream 'ticks', which is not one of its streams",
    ),
    "a trace of no channel": (
        {
            "layout": of_columns(X, Column("y", "", "y"), traces=(Trace("t", "ticks", "a"),)),
            "streams": (StreamPlan("ticks", "clock", ("b",), "Ticks"),),
        },
        "whose trace 't' shows the channel 'a', which the stream 'ticks' does not have",
    ),
    "a stream of no type": (
        {"streams": (StreamPlan("ticks", "clock", ("b",), "Ticks", "float"),)},
        "has a stream 'ticks' that cannot be recorded: dtype 'float': expected an integer or float "
        "such as '<i2'",
    ),
    "times of no stream": (
        {"streams": (StreamPlan("position", "clock", ("z",), "z", "<f8", times="tick"),)},
        "has a stream 'position' whose times are the stream 'tick', which is not one of its "
        "streams of one channel",
    ),
    "two settings with one option": (
        {"Settings": TwoHolds},
        "has the settings 'hold_s' and 'hold_mm', which would both be the option --hold",
    ),
    "a setting that every procedure has": (
        {"Settings": OwnSeed},
        "has the setting 'seed', whose option --seed every procedure has already",
    ),
    "a setting that no option can give": (
        {"Settings": ListOfForces},
        "has the setting 'forces_N' of a type that --forces cannot give; several numbers are "
        "tuple[float, ...]",
    ),
    "a switch whose opposite is another one": (
        {"Settings": ZeroTwice},
        "has the settings 'zero' and 'no_zero', which would both be the option --no-zero",
    ),
    "a default of another type": (
        {"Settings": OneForce},
        "has a setting with a default that it refuses: forces_N = 3.0 N: must be a list",
    ),
    "a default outside its bounds": (
        {"Settings": ShortHold},
        "has a setting with a default that it refuses: hold_s = 0.1 s: must be at least 0.2 s",
    ),
    "one word for points": ({"point_name": "trial"}, "has a point_name that is not a pair"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_class_that_cannot_be_used_is_refused_with_the_reason(case: str) -> None:
    members, reported = FAULTS[case]
    fault = fault_of(made(**members), "example")
    assert fault is not None
    assert reported in fault


def under_force(self: Any, trial: Any) -> Any:
    yield trial.hold(1.0)


async def offsets_mm(self: Any) -> tuple[float, ...]:
    return (0.0,)


@pytest.mark.parametrize(
    ("hook", "word"), [(under_force, "yield"), (offsets_mm, "async"), (generator, "yield")]
)
def test_a_hook_of_another_base_of_this_program_that_would_do_nothing_is_refused(
    hook: Any, word: str
) -> None:
    name = "refine" if hook is generator else hook.__name__
    own = type("Own", (Pressing,), {"__module__": "lab.own", name: hook})
    assert f"has {name!r} with {word!r}" in str(fault_of(own, "example"))


class Pressing(Example):
    """A base class of this program, with hooks of its own."""

    def under_force(self, trial: Any) -> None:
        """Do what the procedure is about."""

    def offsets_mm(self) -> tuple[float, ...]:
        """Return how far along x the trials begin."""
        return (0.0,)


Pressing.__module__ = "procedures.pressed.procedure"


def numbers(self: Any) -> Any:
    yield 1.0
    yield 2.0


def test_numbers_may_be_generated_and_a_package_names_its_own_helpers() -> None:
    helping = {"__module__": "lab.base", "windows": lambda self: ()}
    base = type("Base", (Pressing,), helping)
    own = {"__module__": "lab.own", "offsets_mm": numbers, "values_in_title": numbers}
    assert fault_of(type("Own", (base,), {**own, "windows": numbers}), "example") is None


MOVES: dict[str, tuple[Any, str]] = {
    "a number": (3.0, "point first asks for 3.0, which is not a Move"),
    "a text for the value": (Move("stage_x.position", "3"), "whose value is not a number"),  # type: ignore[arg-type]
    "a text for the settings": (
        Move("stage_x.position", 3.0, "hold_s"),  # type: ignore[arg-type]
        "its settings are a text; write them as ('hold_s',)",
    ),
    "an unknown setting": (
        Move("stage_x.position", 3.0, ("way_mm",)),
        "there is not a setting 'way_mm'",
    ),
}


def test_points_that_are_not_points_are_reported_with_file_and_line_of_the_hook() -> None:
    def points(self: Any) -> None:
        """Forget to return them."""

    line = points.__code__.co_firstlineno
    with pytest.raises(ProcedureFaultError) as refused:
        CheckedProcedure(made(points=points)(Settings())).points()
    assert refused.value.one_line() == (
        "procedure example of package test_procedure: "
        f"test_procedure.py line {line}: points() returned None in place of points"
    )


@pytest.mark.parametrize("case", MOVES)
def test_a_move_that_cannot_be_checked_is_refused_with_the_plan(case: str) -> None:
    move, reported = MOVES[case]
    procedure = made(points=lambda self: (Point("first", 1, (move,)),))(Settings())
    with pytest.raises(ProcedureFaultError) as refused:
        CheckedProcedure(procedure).points()
    assert reported in refused.value.one_line()


def test_what_is_not_a_procedure_is_refused() -> None:
    assert "names a module" in str(fault_of(ModuleType("lab.creep"), "creep"))
    assert "is not a subclass of rig.run.procedure.Procedure" in str(fault_of(dict, "creep"))
    bare = type("Bare", (Procedure,), {"name": "bare"})
    assert fault_of(bare, "bare") == "lacks fixtures, Settings, layout, arm, points, take"


def test_sound_procedures_are_not_refused() -> None:
    assert fault_of(Example, "example") is None
    assert fault_of(made(helper=lambda self: 1, pointer=1), "example") is None
    for name in names(PROCEDURES):
        assert load_procedure(name).name == name


def test_the_options_of_every_procedure_are_reserved() -> None:
    made_by_typer = {"figures": ("--figures", "--no-figures"), "as_json": ("--json",)}
    fields = [option.name for option in group_parameters(ProcedureRequest)]
    own = {
        option
        for name in fields
        for option in made_by_typer.get(name, ("--" + name.replace("_", "-"),))
    }
    assert own | {"--help"} == COMMON_OPTIONS


GOOD = {"x_V": 1.0, "y_mm_s": None, "note": "as it should be"}


@pytest.mark.parametrize(
    ("reading", "reported"),
    [
        (GOOD, None),
        (GOOD | {"x_V": np.float64(1), "y_mm_s": 3, "simulated_truth": "{}"}, None),
        (GOOD | {"x_V": True, "note": None}, None),
        (GOOD | {"x_V": float("nan")}, None),
        ({"x_V": 1.0, "note": ""}, "no 'y_mm_s', which its layout declares (use None"),
        (
            {"x_V": 1.0, "y_mms": 2.0, "note": ""},
            "'y_mms', which its layout does not declare; did you mean 'y_mm_s'?",
        ),
        (GOOD | {"x_V": "1.0"}, "'x_V' = '1.0' (a str), which its layout declares as a number"),
        (GOOD | {"note": 3}, "'note' = 3 (an int), which its layout declares as text"),
        (GOOD | {"x_V": [1.0]}, "(a list), which its layout declares as a number"),
        (None, "None, not a reading (a dict)"),
    ],
)
def test_a_reading_has_what_the_layout_declares(reading: Any, reported: str | None) -> None:
    fault = reading_fault(LAYOUT, reading)
    assert fault == reported or (reported is not None and fault is not None and reported in fault)


def second_only(reading: Any) -> Callable[..., Any]:
    """A `take` whose second reading is another one."""

    def take(self: Example, run: Any, point: Any) -> Any:
        good = Example.take(self, run, point)
        return good if point.id == "first" else reading

    return take


def dividing(self: Any, *_: Any) -> Any:
    return 1 / 0


def leaving(self: Any, *_: Any) -> Any:
    raise SystemExit(0)


def test_a_reading_with_a_fault_ends_the_run_in_order_and_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = made(take=second_only({"x_V": 1.0, "note": ""}))(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert outcome.code is ExitCode.INTERNAL
    (failure,) = outcome.failures
    assert failure.one_line() == (
        "procedure example of package test_procedure: take() returned no 'y_mm_s', which its "
        "layout declares (use None for no value)"
    )
    assert procedure.log == ["on", "first", "second", "off", "guard: safe", "guard: done"]
    assert outcome.file is not None
    with RunFile.open(outcome.file) as run:
        assert run.point_ids() == ["first"]


@pytest.mark.parametrize("hook", ["import_ahead", "points", "check", "arm", "take", "refine"])
@pytest.mark.parametrize("what", [dividing, leaving])
def test_what_a_hook_raises_is_the_fault_of_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hook: str, what: Callable[..., Any]
) -> None:
    procedure = made(**{hook: what})(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert outcome.code is ExitCode.INTERNAL
    assert outcome.status == "failed"
    (failure,) = outcome.failures
    line = what.__code__.co_firstlineno + 1
    raised = "ZeroDivisionError: division by zero" if what is dividing else "SystemExit: 0"
    assert failure.message == (
        f"a fault in the package test_procedure: test_procedure.py line {line}: {raised}"
    )
    assert failure.__cause__ is not None, "its traceback goes to the log"
    assert procedure.log.count("off") == procedure.log.count("on") or hook == "arm"


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (np.zeros((2, 3)), "scale: 2 channels need as many values"),
        (np.zeros((2, 2), int), "stream held: an array of int64 (2, 2), expected rows of <f8 (2,)"),
        (np.zeros(2), "stream held: an array of the shape (2,), expected (n, channels)"),
    ],
)
def test_rows_that_a_stream_does_not_have_are_the_fault_of_the_package_at_that_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: Any, words: str
) -> None:
    def take(self: Example, run: Any, point: Any) -> Any:
        run.streams.record_rows("held", 0, rows, None)

    held = StreamPlan("held", "clock", ("z", "force"), "Held", "<f8")
    procedure = made(take=take, streams=(held,))(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch)
    (failure,) = outcome.failures
    line = take.__code__.co_firstlineno + 1
    assert failure.message == (
        f"a fault in the package test_procedure: test_procedure.py line {line}: ValueError: {words}"
    )


@pytest.mark.parametrize("what", [dividing, leaving])
def test_a_summary_that_fails_costs_the_results_and_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: Callable[..., Any]
) -> None:
    procedure = made(summarise=what)(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert (outcome.code, outcome.status) == (ExitCode.DONE, "complete")
    assert outcome.failures == []
    (warning,) = outcome.warnings
    assert warning.startswith("no results in the run file: ")
    assert "a fault in the package test_procedure" in warning
    assert procedure.log[-1] == "guard: done"
    assert outcome.file is not None
    with RunFile.open(outcome.file) as run:
        assert run.outcome.status == "complete"
        assert run.point_ids() == ["first", "second"]
        assert run.results is None


def test_a_summary_that_never_returns_is_ended_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.run.checked_procedure.LONGEST_SUMMARY_S", 0.5)
    endless = made(summarise=lambda *_: time.sleep(1e6))(Settings())
    with pytest.raises(ProcedureFaultError, match=r"summarise\(\) was ended: it took longer than"):
        results_of(endless, [], simulated=False)


def test_what_a_hook_prints_does_not_mix_with_what_the_command_prints(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def printing(self: Any) -> tuple[Point, ...]:
        print("planning")
        return (Point("first", 1, ()),)

    CheckedProcedure(made(points=printing)(Settings())).points()
    assert capsys.readouterr() == ("", "planning\n")


def inside_itself() -> dict[str, Any]:
    values: dict[str, Any] = {}
    values["again"] = values
    return values


A_RUN_FILE_CANNOT = "which a run file cannot hold; return numbers, texts, truth values or None"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"c": {1, 2}}, f"'c' = {{1, 2}} (a set), {A_RUN_FILE_CANNOT}"),
        ({"c": b"x"}, f"'c' = b'x' (a bytes), {A_RUN_FILE_CANNOT}"),
        ({"a": {"z": [1.0, 2j]}}, f"'a.z.2' = 2j (a complex), {A_RUN_FILE_CANNOT}"),
        ({"d": date(2026, 1, 1)}, "'d' = datetime.date(2026, 1, 1) (a date), which a run file"),
        ({"z": np.array([1j])}, "'z.1' = 1j (a complex), which a run file cannot hold"),
        ({"z": np.longdouble(1)}, "(a longdouble), which a run file cannot hold"),
        ({"a": {(1, 2): 3.0}}, "'a' = (1, 2) (a tuple), which is a key, and keys are texts"),
        ({"n": 10**400}, "(an int), which is beyond 1.8e+308, the largest number of a run file"),
        ({"n": -(10**5000)}, "'n' = a value (an int), which is beyond 1.8e+308"),
        (inside_itself(), "values nested deeper than"),
    ],
)
def test_a_result_that_a_run_file_cannot_hold_is_named_with_its_package(
    values: dict[str, Any], words: str
) -> None:
    with pytest.raises(ProcedureFaultError) as raised:
        results_of(made(summarise=lambda *_: values)(Settings()), [], simulated=False)
    said = raised.value.one_line()
    assert said.startswith("procedure example of package test_procedure: summarise() returned ")
    assert words in said
    assert "return numbers, texts, truth values or None, or lists and dicts of them" in said


def test_results_that_are_too_long_for_a_run_file_are_the_fault_of_their_package() -> None:
    long = {"text": "x" * (MAX_JSON + 1)}
    with pytest.raises(ProcedureFaultError, match=r"summarise\(\) returned values of \d+ bytes"):
        results_of(made(summarise=lambda *_: long)(Settings()), [], simulated=False)


def test_results_with_a_number_beyond_the_floats_are_compared_exactly() -> None:
    assert differences({"n": 10**400}, {"n": 10**400}) == {}
    assert set(differences({"n": 10**400, "m": 1.0}, {"n": 1.5, "m": 1.0})) == {"n"}


def five(*_: Any) -> int:
    return 5


def one_text(*_: Any) -> str:
    return "all is well"


@pytest.mark.parametrize(
    ("what", "words"),
    [
        (dividing, "a fault in the package test_procedure: test_procedure.py line"),
        (five, "in_brief() returned an int, not a list of lines"),
        (one_text, "in_brief() returned a str, not a list of lines"),
    ],
)
def test_a_fault_in_brief_is_a_warning_and_the_results_are_shown_one_by_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    what: Callable[..., Any],
    words: str,
) -> None:
    monkeypatch.setattr("rig.run.saving.log.propagate", True)
    procedure = made(in_brief=what)(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert outcome.code is ExitCode.DONE
    (warning,) = outcome.warnings
    assert warning.startswith("the results are not shown in brief: ")
    assert words in warning
    assert list(outcome.in_brief) == [f"{k}: {v}" for k, v in outcome.summary.items()]
    assert "Traceback" in caplog.text or "ProcedureFaultError" in caplog.text


def test_the_end_is_on_the_disk_before_the_summary_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []

    def summarise(procedure: Any, readings: Any) -> dict[str, Any]:
        (journal,) = tmp_path.rglob("*.rigj")
        contents = read_journal(journal)
        seen.extend([*procedure.log, contents.ends[-1].status, *contents.kept_ids()])
        return {"points": len(readings)}

    outcome = run_of(made(summarise=summarise)(Settings()), tmp_path, monkeypatch)
    assert outcome.code is ExitCode.DONE
    assert seen[-4:] == ["guard: safe", "complete", "first", "second"]
    assert outcome.file is not None
    with RunFile.open(outcome.file) as run:
        assert run.results is not None
        assert run.results.values == {"points": 2}


def test_an_unknown_procedure_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="procedure 'that-nobody-has' is unknown"):
        load_procedure("that-nobody-has")


def test_a_computer_without_memory_is_not_a_defect_of_the_program() -> None:
    lacking = internal(MemoryError())
    assert lacking.message == "there is not enough memory"
    assert "ulimit -v" in str(lacking.hint)
    assert "this is a defect of the program" in str(internal(KeyError("x")).hint)
