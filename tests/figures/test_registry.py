"""Figures are declared by entry points: which are found, and what a broken one costs."""

from __future__ import annotations

import subprocess
import sys
from importlib import invalidate_caches
from pathlib import Path

import pytest
import recorded_trials as trials

from rig.figures import drawing
from rig.figures.drawing import DrawingProcess, Drawn, draw
from rig.figures.registry import figures_of

MODULE = """
import os
import time

from matplotlib.figure import Figure

def plain(run):
    return Figure()

def several(run):
    return {"": Figure(), "-b": Figure()}

def nothing(run):
    return {}

def fails(run):
    raise RuntimeError("no such column:\\n'speed'")

def leaves(run):
    print("this is not the answer")
    raise SystemExit(3)

def elsewhere(run):
    return {"/../../x": Figure()}

def number(run):
    return 3

def formula(run):
    figure = Figure()
    figure.suptitle("$\\\\nosuchcommand$")
    return figure

def sleeps(run):
    time.sleep(1e6)

def exits(run):
    os._exit(7)

constant = 3
"""


class Laboratory:
    """A package that declares figures, on the path of this process and of its children."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch):
        self.place = folder / "site"
        self._runs = folder / "runs"
        self._runs.mkdir()
        info = self.place / "lab_figures-1.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lab-figures\nVersion: 1\n")
        (self.place / "lab_figures.py").write_text(MODULE)
        self._entries = info / "entry_points.txt"
        monkeypatch.syspath_prepend(str(self.place))
        monkeypatch.setenv("PYTHONPATH", str(self.place))

    def declare(self, **functions: str) -> None:
        """Declare figures; `__` in a name is its dot, `_` its hyphen."""
        lines = [
            f"{name.replace('__', '.').replace('_', '-')} = {function}"
            for name, function in functions.items()
        ]
        self._entries.write_text("\n".join(["[rig.figures]", *lines, ""]))
        invalidate_caches()

    def run(self, procedure: str = "lab-trial", points: int = 1) -> Path:
        """The run file of a recording of the procedure."""
        recorded = {f"trial-{n}": trials.slipping() for n in range(points)}
        return trials.write_trials(
            self._runs / f"{procedure}.rigj", recorded, complete=points > 0, procedure=procedure
        )

    @property
    def pictures(self) -> set[str]:
        return {path.name for path in self._runs.glob("*.png")}


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Laboratory:
    return Laboratory(tmp_path, monkeypatch)


PLAIN, FAILS = "lab_figures:plain", "lab_figures:fails"


def test_a_packages_figures_are_drawn_with_file_names_from_their_entry_points(
    lab: Laboratory,
) -> None:
    lab.declare(lab_trial=PLAIN, lab_trial__map=PLAIN, lab_trial__two="lab_figures:several")
    drawn = draw(lab.run())
    assert drawn.warnings == ()
    stems = ["lab-trial", "lab-trial-map", "lab-trial-two", "lab-trial-two-b"]
    assert [path.name for path in drawn.files] == [
        f"{stem}{suffix}" for stem in stems for suffix in (".png", ".svg")
    ]
    assert all(path.exists() for path in drawn.files)


def test_a_figure_of_another_procedure_is_not_drawn(lab: Laboratory) -> None:
    lab.declare(lab_trial=PLAIN, lab=PLAIN, lab_trial_2=PLAIN)
    assert len(draw(lab.run()).files) == 2


def test_nothing_to_draw_is_no_failure(lab: Laboratory) -> None:
    lab.declare(lab_trial="lab_figures:nothing")
    assert draw(lab.run()) == Drawn()
    lab.declare()
    assert draw(lab.run("unheard-of")) == Drawn()


def test_a_figure_of_no_procedure_is_reported_with_what_was_meant(lab: Laboratory) -> None:
    lab.declare(slip_trail__map=PLAIN)
    (warning,) = draw(lab.run()).warnings
    assert warning == (
        "the figure slip-trail.map (lab_figures:plain) of lab-figures belongs to no installed "
        "procedure; did you mean slip-trial?"
    )


def draw_in_child(file: Path) -> Drawn:
    with DrawingProcess() as process:
        return process.draw(file)


def test_a_process_that_is_not_asked_ends_and_draws_nothing(lab: Laboratory) -> None:
    lab.declare(lab_trial=PLAIN)
    lab.run()
    with DrawingProcess() as process:
        child = process._child
    assert child is not None
    assert child.returncode is not None
    assert lab.pictures == set()


def test_a_run_without_a_completed_point_has_no_figures(lab: Laboratory) -> None:
    lab.declare(lab_trial=FAILS)
    run = lab.run(points=0)
    assert draw(run) == Drawn()


def test_the_picture_of_the_procedure_is_not_overwritten(lab: Laboratory) -> None:
    lab.declare(**{"import": FAILS, "import__own": PLAIN})
    drawn = draw(lab.run("import"))
    assert lab.pictures == {"import.png", "import-own.png"}
    (warning,) = drawn.warnings
    assert warning.startswith("the figure import (lab_figures:fails) of lab-figures could not")
    lab.declare(**{"import": PLAIN})
    (warning,) = draw(lab.run("import")).warnings
    assert warning == (
        "the figure import (lab_figures:plain) of lab-figures was left out: another figure has "
        "its file name"
    )


@pytest.mark.parametrize(
    ("function", "why"),
    [
        ("lab_figures:fails", "lab_figures.py line 17: RuntimeError: no such column: 'speed'"),
        ("lab_figures:leaves", "lab_figures.py line 21: SystemExit: 3"),
        ("lab_figures:missing", "AttributeError: module 'lab_figures' has no attribute 'missing'"),
        ("no_such_module:plain", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("lab_figures:constant", "its value is not a function"),
        ("lab_figures:number", "TypeError: it returned int where a Figure is expected"),
        ("lab_figures:elsewhere", "ValueError: '/../../x' cannot be a part of a file name"),
        ("lab_figures:formula", "ValueError: "),
    ],
)
def test_a_figure_that_is_broken_disables_only_itself(
    lab: Laboratory, function: str, why: str
) -> None:
    lab.declare(lab_trial=function, lab_trial__good=PLAIN)
    drawn = draw(lab.run())
    assert lab.pictures == {"lab-trial-good.png"}
    (warning,) = drawn.warnings
    assert warning.startswith(
        f"the figure lab-trial ({function}) of lab-figures could not be drawn: {why}"
    )
    assert "\n" not in warning
    (traceback,) = drawn.tracebacks
    assert traceback.startswith("Traceback (most recent call last)")


def test_a_name_of_another_form_is_refused(lab: Laboratory) -> None:
    lab.declare(lab_trial__a__b=PLAIN)
    (warning,) = draw(lab.run()).warnings
    assert "its name must be PROCEDURE or PROCEDURE.WHAT" in warning


def test_a_folder_that_takes_no_picture_is_reported_once(lab: Laboratory) -> None:
    lab.declare(lab_trial=PLAIN, lab_trial__map=PLAIN)
    (warning,) = draw(lab.run(), Path("/proc/nowhere")).warnings
    assert warning.startswith("no figure was drawn: /proc/nowhere cannot be written to")


def test_the_child_draws_the_same_and_hands_on_the_warnings(lab: Laboratory) -> None:
    lab.declare(lab_trial="lab_figures:leaves", lab_trial__good=PLAIN)
    run = lab.run()
    child, here = draw_in_child(run), draw(run)
    assert (child.files, child.warnings) == (here.files, here.warnings)
    assert len(child.tracebacks) == 1
    assert lab.pictures == {"lab-trial-good.png"}


def test_a_child_that_dies_is_a_warning(lab: Laboratory, monkeypatch: pytest.MonkeyPatch) -> None:
    (lab.place / "lab_figures.py").write_text("import os; os._exit(7)")
    lab.declare(lab_trial=PLAIN)
    run = lab.run()
    (warning,) = draw_in_child(run).warnings
    assert warning == (
        "the figure lab-trial (lab_figures:plain) of lab-figures and those after it were not "
        "drawn: the process that draws ended early (exit code 7); "
        f"`rig show --figures {run}` draws them again"
    )


def test_the_figures_before_one_that_ends_the_process_are_listed(lab: Laboratory) -> None:
    lab.declare(lab_trial=PLAIN, lab_trial__exits="lab_figures:exits")
    drawn = draw_in_child(lab.run())
    assert [path.name for path in drawn.files] == ["lab-trial.png", "lab-trial.svg"]
    (warning,) = drawn.warnings
    assert warning.startswith("the figure lab-trial.exits (lab_figures:exits) of lab-figures and")


@pytest.mark.thorough
def test_a_child_that_does_not_end_is_ended(
    lab: Laboratory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The child has limits of its own, which end what is not busy in C."""
    lab.declare(lab_trial=PLAIN, lab_trial__slow="lab_figures:sleeps")
    monkeypatch.setattr(drawing, "TIMEOUT_S", 6.0)
    monkeypatch.setattr(drawing, "GRACE_S", 2.0)
    waited: list[bool] = []
    with DrawingProcess() as process:
        drawn = process.draw(lab.run(), lambda: waited.append(True))
    assert waited == [True]
    assert [path.name for path in drawn.files] == ["lab-trial.png", "lab-trial.svg"]
    (warning,) = drawn.warnings
    assert warning.startswith(
        "the figure lab-trial.slow (lab_figures:sleeps) of lab-figures and those after it were "
        "not drawn: it took longer than 8 s; `rig show --figures "
    )


@pytest.mark.thorough
def test_a_figure_that_never_returns_is_interrupted_and_costs_those_after_it(
    lab: Laboratory, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.declare(lab_trial=PLAIN, lab_trial__a="lab_figures:sleeps", lab_trial__b=PLAIN)
    run = lab.run()
    monkeypatch.setattr(drawing, "TIMEOUT_S", 6.0)
    drawn = draw(run)
    assert lab.pictures == {"lab-trial.png"}
    slow, left_out = drawn.warnings
    assert slow.startswith(
        "the figure lab-trial.a (lab_figures:sleeps) of lab-figures could not be drawn: "
        "lab_figures.py line 35: it took longer than "
    )
    assert left_out == (
        "the figure lab-trial.b (lab_figures:plain) of lab-figures was left out: the 6 s for all "
        "figures of a file were over"
    )


def test_our_own_figures_can_all_be_loaded() -> None:
    kinds = ("sweep", "slip-trial", "roll-trial", "path-trial", "import", "processed")
    own = [f for kind in kinds for f in figures_of(kind) if f.package == "tactile-rig"]
    names = [figure.entry.name for figure in own]
    assert names == [
        *("sweep", "sweep.gain", "sweep.linearity", "sweep.readings"),
        *("slip-trial", "slip-trial.grip", "slip-trial.series"),
        *("roll-trial", "roll-trial.series"),
        *("path-trial", "path-trial.series", "import", "processed"),
    ]
    assert all(callable(figure.load()) for figure in own)


def test_the_registry_imports_nothing_expensive() -> None:
    script = (
        "import rig.figures.registry as r, rig.figures.drawing, sys; r.figures_of('sweep'); "
        "print(*{'numpy', 'matplotlib', 'h5py', 'scipy'} & set(sys.modules))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert ended.stdout.split() == []
