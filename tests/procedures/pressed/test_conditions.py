"""Trials of one run that press with different forces, and a place of z that is held while the force
relaxes: what a measurement of stress relaxation needs of the base class."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from packages import install, on_path

from procedures.pressed import PressedProcedure, PressedSettings
from procedures.pressed.hold import ForceHold
from procedures.pressed.hold_watch import LOST_STEPS
from procedures.pressed.record.motion import plain
from procedures.pressed.record.trial_record import TrialRecord
from procedures.pressed.summary import summary_of
from rig.core.errors import ConfigurationError, InstrumentError
from rig.files.journal.layout import Column
from rig.files.runfile.reader import RunFile
from rig.run.checked_procedure import CheckedProcedure, ProcedureFaultError
from rig.run.job import RunJob
from rig.run.points import Move

REGISTERED = "[rig.procedures]\nrelaxation = lab.relaxation:Relaxation\n"
MODULE = '''
from procedures.pressed import PressedProcedure, PressedSettings
from rig.files.journal.layout import Column


class Relaxation(PressedProcedure):
    """Press with several forces and see how they relax."""

    name, fixtures, summary_keys = "relaxation", ("plate",), ()
    columns = (
        Column("pressed_with", "N", "Force that the record says"),
        Column("number", "", "Trial that the record says"),
        Column("moved", "um", "Travel of z during the hold"),
    )

    class Settings(PressedSettings):
        forces_N: tuple[float, ...] = (2.0, 4.0)
        hold_s: float = 1.0

    def motion_s(self):
        return self.settings.hold_s

    def normal_forces_N(self):
        return self.settings.forces_N

    def under_force(self, trial):
        assert trial.normal_force_N in self.settings.forces_N
        trial.hold_place(self.settings.hold_s)

    def reading(self, record):
        moved_um = 1e3 * (record.z_mm.max() - record.z_mm.min())
        force_N, number = record.normal_force_N, record.trial
        return {"pressed_with_N": force_N, "number": number, "moved_um": moved_um}
'''


@pytest.fixture
def relaxation(rig: Any, tmp_path: Path) -> Any:
    """The command line, with the command `relaxation`."""
    modules = {"lab/__init__.py": "", "lab/relaxation.py": MODULE}
    on_path(rig, install(tmp_path / "site", "lab", REGISTERED, modules))
    return rig


@pytest.mark.thorough
def test_trials_press_with_forces_of_their_own_and_hold_their_place(relaxation: Any) -> None:
    done = relaxation.run("relaxation", "--forces", "2,3.5", "--json", "--no-figures")
    assert done.code == 0, done.stderr
    with RunFile.open(relaxation.only("*.h5")) as run:
        assert run.column("set_normal_force").tolist() == [2.0, 3.5]
        assert run.column("pressed_with").tolist() == [2.0, 3.5]
        assert run.column("number").tolist() == [1, 2]
        assert run.column("mean_normal_force") == pytest.approx([2.0, 3.5], rel=0.03)
        assert all(run.column("moved") < 0.5), "z has not been moved"
        assert np.isnan(run.column("force_error_rms")).all(), "nothing controlled the force"
    refused = relaxation.run("relaxation", "--forces", "2,20", "--no-figures")
    assert refused.code == 2
    assert "a normal force of 20 N is not above 0 N and below --largest-force 15 N" in (
        refused.stderr
    )
    refused = relaxation.run("relaxation", "--forces", "2,0.08", "--no-figures")
    assert refused.code == 2
    assert "a normal force of 0.08 N must be at least 0.1 N, the force that means" in refused.stderr


@pytest.mark.thorough
def test_a_force_that_is_gone_while_z_holds_its_place_ends_the_run(relaxation: Any) -> None:
    """The sensor dies: the servo must not press on when the hold is over."""
    (relaxation.folder / "faults.toml").write_text(
        '[[fault]]\ndevice = "force_sensor"\nkind = "dead-noisy"\nacquisition = 1\nafter_s = 4.0\n'
    )
    hold = ("relaxation", "--forces", "3", "--hold", "20s", "--no-figures")
    failed = relaxation.run(*hold, "--fault", "faults.toml", "--world-log", "world.jsonl")
    assert failed.code == 3, failed.stderr
    assert "hold the force: it reads" in failed.stderr
    assert "where z held 3 N" in failed.stderr
    assert "if the force can relax by more than half, hold the place for a shorter" in failed.stderr
    assert "normal force released" in failed.stderr


def test_a_film_in_its_clamp_is_refused_where_the_class_is_defined() -> None:
    """Its bench has no strips, and the run asked for strip_1 in the bench file."""
    with pytest.raises(ValueError, match="'film-clamp', and a PressedProcedure presses the skin"):
        type("OnFilm", (Forces,), {"fixtures": ("plate", "film-clamp")})


class Forces(PressedProcedure):
    """Two forces at two places."""

    name, fixtures = "forces", ("plate",)

    def motion_s(self) -> float:
        return 1.0

    def offsets_mm(self) -> tuple[float, ...]:
        return (0.0, 2.0)

    def normal_forces_N(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        return (1.0, 3.0)

    def under_force(self, trial: Any) -> None:
        trial.hold(1.0)

    def reading(self, record: Any) -> dict[str, float]:
        return {}


def test_each_force_has_its_trials_at_each_place() -> None:
    procedure = Forces(PressedSettings(trials=3))
    assert len(procedure.points()) == 3 * 2 * 2
    assert procedure._conditions() == ((1.0, 0.0), (1.0, 2.0), (3.0, 0.0), (3.0, 2.0))


@pytest.mark.parametrize("none", [None, float("nan"), np.float64("nan"), np.float32("nan")])
def test_a_reading_that_is_not_a_number_is_left_out_of_the_mean(none: Any) -> None:
    """A file has NaN for both, so that the results that are recomputed from it would differ."""
    readings = [
        {"invalid": "", **plain({"creep_um": value}, {"creep_um"}, "creep")}
        for value in (1.0, none, np.float64(3.0))
    ]
    assert [reading["creep_um"] for reading in readings] == [1.0, None, 3.0]
    assert summary_of(readings, ["creep_um"])["mean_creep_um"] == 2.0


def test_a_wrong_reading_is_reported_as_that_of_the_method_that_a_subclass_writes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Forces, "take", lambda self, run, point: {"trial": "first"})
    checked = CheckedProcedure(Forces(PressedSettings()))
    with pytest.raises(ProcedureFaultError, match=r"procedure forces .*: reading\(\) returned "):
        checked.take(None, checked.points()[0])  # type: ignore[arg-type]


@pytest.mark.parametrize("forces_N", [(), (0.0,), (-1.0, 2.0), (15.0,), (float("nan"),)])
def test_forces_that_cannot_be_are_refused_when_the_run_is_planned(
    monkeypatch: pytest.MonkeyPatch, forces_N: tuple[float, ...]
) -> None:
    monkeypatch.setattr(Forces, "normal_forces_N", lambda self: forces_N)
    with pytest.raises(ConfigurationError, match=r"normal.force"):
        Forces(PressedSettings()).points()


def test_the_title_states_the_forces_that_are_pressed_with() -> None:
    mounted = SimpleNamespace(film=None, fixture=SimpleNamespace(mounted="plate"))
    bench: Any = SimpleNamespace(settings=mounted)
    job = RunJob(Forces(PressedSettings()), 0, Path())
    assert job._title(bench) == "forces on plate, 1 and 3 N normal force"


def test_a_normal_force_that_has_no_effect_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"own, 1, 3 N: --normal-force 6 N has no effect"):
        Forces(PressedSettings(normal_force_N=6.0)).points()
    assert Forces(PressedSettings(normal_force_N=4.0)).points(), "the default was not given"


def test_a_normal_force_that_own_forces_are_made_of_is_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Forces, "normal_forces_N", lambda self: (1.0, self.settings.normal_force_N))
    assert Forces(PressedSettings(normal_force_N=6.0)).points()


def hold_of(stopped: list[str], silent_s: float = 0.0) -> ForceHold:
    """A hold of 4 N whose link has been silent for so long; stops of z are noted."""
    z = SimpleNamespace(stage=SimpleNamespace(stop=lambda: stopped.append("z")), commanded_mm=0.0)
    servo = SimpleNamespace(settings=SimpleNamespace(target_N=4.0))
    links = SimpleNamespace(silent_s=lambda role: silent_s)
    ticks, record = SimpleNamespace(begun=0), TrialRecord(1, 100.0, 1000.0, 4.0)
    return ForceHold(servo, z, links, None, record, ticks, 0.0, None, 15.0)  # type: ignore[arg-type]


def test_a_force_may_relax_by_half_while_z_holds_its_place_and_no_further() -> None:
    stopped: list[str] = []
    hold = hold_of(stopped)
    for force_N in (4.0, 3.0, 2.1, 2.1, 2.1, 2.1):
        hold.rest(force_N)
    for _ in range(LOST_STEPS - 1):
        hold.rest(1.9)
    assert stopped == []
    with pytest.raises(InstrumentError, match=r"it reads 1\.9 N where z held 4 N"):
        hold.rest(1.9)
    assert stopped == ["z"]


def test_a_z_stage_that_is_silent_while_it_holds_its_place_ends_the_run() -> None:
    with pytest.raises(InstrumentError, match=r"stage_z.*no answer for 0\.6 s"):
        hold_of([], silent_s=0.6).rest(4.0)


RETURNS: dict[str, tuple[str, Any, str]] = {
    "no duration": ("motion_s", None, "motion_s() returned None; let it return a number"),
    "a text for the duration": ("motion_s", "3", "motion_s() returned '3'; let it return a number"),
    "a truth value": ("motion_s", True, "motion_s() returned True; let it return a number"),
    "one place": ("offsets_mm", 1.0, "offsets_mm() returned 1.0; let it return a tuple of numbers"),
    "a text for a force": ("normal_forces_N", ("2",), "normal_forces_N() returned ('2',)"),
    "one move": (
        "moves",
        Move("stage_x.position", 10.0),
        "let it return a tuple of Move, with a comma after one alone",
    ),
}


@pytest.mark.parametrize("case", RETURNS)
def test_what_a_hook_must_not_return_is_refused_with_its_name(case: str) -> None:
    hook, found, reported = RETURNS[case]

    def method(self: Any) -> Any:
        return found

    procedure = type("Odd", (Forces,), {hook: method})(PressedSettings())
    with pytest.raises(ConfigurationError) as refused:
        procedure.points()
    assert reported in refused.value.one_line()


@pytest.mark.parametrize("seconds", [3, np.float32(3.0), np.array(3.0), Decimal("3.0")])
def test_a_hook_may_return_whatever_is_a_number(seconds: Any) -> None:
    class Odd(Forces):
        def motion_s(self) -> Any:
            return seconds

        def offsets_mm(self) -> Any:
            return (seconds * place for place in (0, 1))

    procedure = Odd(PressedSettings())
    assert len(procedure.points()) == 4
    assert procedure._offsets() == (0.0, 3.0)


def test_a_place_that_is_not_a_number_is_refused_with_its_name() -> None:
    class Odd(Forces):
        def start_mm(self, fixture: Any) -> Any:
            return "10"

    with pytest.raises(ConfigurationError, match=r"start_mm\(\) returned '10'"):
        Odd(PressedSettings()).overhead_s(SimpleNamespace(), homed=True)


CREEP = Column("creep", "um", "Travel of z")


@pytest.mark.parametrize(
    ("columns", "reported"),
    [
        (CREEP, "columns must be a tuple of Column(name, unit, meaning), with a comma after one"),
        (("creep_um",), "columns must be a tuple of Column"),
        ((CREEP, CREEP), "columns has 'creep' twice; rename one of them"),
    ],
)
def test_columns_that_cannot_be_are_refused_where_the_class_is_made(
    columns: Any, reported: str
) -> None:
    with pytest.raises((TypeError, ValueError)) as refused:
        type("Odd", (Forces,), {"columns": columns})
    assert reported in str(refused.value)


@pytest.mark.parametrize(
    ("held_N", "words"),
    [
        (20.0, "forces: a held force of 20 N is not below --largest-force 15 N"),
        (15.0, "forces: a held force of 15 N is not below --largest-force 15 N"),
        (float("nan"), "forces: a held force of nan N is not below --largest-force 15 N"),
        (None, "forces: largest_held_N of its settings is None"),
    ],
)
def test_a_held_force_that_reaches_the_limit_is_refused_before_anything_is_connected(
    held_N: Any,
    words: str,
) -> None:
    class Held(PressedSettings):
        @property
        def largest_held_N(self) -> float:  # noqa: N802
            return held_N  # type: ignore[no-any-return]

    with pytest.raises(ConfigurationError, match=words):
        Forces(Held()).points()


@pytest.mark.thorough
def test_a_run_whose_procedure_has_changed_or_is_gone_is_not_resumed(relaxation: Any) -> None:
    module = relaxation.folder / "site" / "lab" / "relaxation.py"
    raising = MODULE.replace(
        "force_N, number =", "assert record.trial == 1\n        force_N, number ="
    )
    module.write_text(raising)
    stopped = relaxation.run("relaxation", "--hold", "200ms", "--no-figures")
    assert stopped.code == 1, stopped.stderr
    journal = relaxation.only("*.rigj")

    module.write_text(
        MODULE.replace('"moved", "um"', '"travel", "um"').replace("moved_", "travel_")
    )
    changed = relaxation.run("resume", str(journal))
    assert changed.code == 2
    assert "changed since the run began: columns (moved_um then, travel_um now)" in changed.stderr

    module.write_text(MODULE.replace("hold_s", "stay_s"))
    changed = relaxation.run("resume", str(journal))
    assert changed.code == 2
    assert (
        "relaxation does not take the settings of this run here: hold_s: unknown" in changed.stderr
    )

    for metadata in module.parents[1].glob("*/entry_points.txt"):
        metadata.unlink()
    gone = relaxation.run("resume", str(journal))
    assert gone.code == 2
    assert "procedure relaxation of lab is not installed here; install lab 1" in gone.stderr
