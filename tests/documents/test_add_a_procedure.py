"""docs/add-a-procedure.md, followed literally."""

from __future__ import annotations

from dataclasses import fields
from textwrap import indent
from typing import Any

import pytest
from page import Page
from tiers import mostly_nightly

from procedures.pressed.record.motion import MotionRecord
from procedures.sweep import preload
from rig.bench.settings import BenchSettings
from rig.core.clock import SIGN_OF_LIFE_S
from rig.files.runfile.reader import RunFile
from rig.run.streams.recorded import RecordedStreams

PAGE = "add-a-procedure.md"


@pytest.mark.thorough
def test_the_package_runs_as_the_page_says(rig: Any) -> None:
    page = Page(PAGE, rig)
    assert page.strange_commands() == []
    page.make()
    ended = page.run_rig()
    assert len(ended) == 7
    for command, done in ended.items():
        assert done.code == 0, (command, done.stderr)
    helped, rehearsed, run, shown, verified, other, planned = ended.values()
    assert "Hold a force and watch the skin creep." in helped.stdout
    assert "How long the force is held. [default: 10 s]" in " ".join(helped.stdout.split())
    assert "2 of 2 trials" in run.stderr
    assert "creep: " in shown.stdout
    assert "sound (complete, 2 of 2 trials)" in verified.stdout
    assert "1 of 1 trial" in other.stderr
    _heading, *runs = planned.stdout.splitlines()
    assert len(runs) == 4
    first, second = sorted(rig.results.rglob("*_creep_*.h5"))
    assert len(list(rig.results.rglob("*.h5"))) == 2, "a dry run leaves no file"
    with RunFile.open(first) as run_file, RunFile.open(second) as changed:
        assert run_file.settings["hold_s"] == 1.5
        assert run_file.header.procedure_package == "lab-creep"
        program = run_file.entry["program_name"]
        assert program.attrs["procedure_package"] == "lab-creep"
        assert program.attrs["procedure_version"] == "1.0"
        assert all(abs(run_file.column("creep")) < 1)
        moved_mm = changed.column("contact")[0] - run_file.column("contact")[0]
        assert moved_mm == pytest.approx(0.2, abs=0.02), "the World's file says where contact is"
    assert rehearsed.stdout == ""


@pytest.mark.thorough
def test_the_page_s_own_test_passes(rig: Any) -> None:
    page = Page(PAGE, rig)
    page.make()
    tested = page.run_test()
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert "1 passed" in tested.stdout


@pytest.mark.thorough
def test_the_motion_along_x_that_the_page_shows_runs(rig: Any) -> None:
    page = Page(PAGE, rig)
    (motion,) = (b for b in page.text.split("```python\n") if b.startswith("def moves"))
    hold = "    def under_force(self, trial):\n        trial.hold(self.settings.hold_s)\n"
    assert hold in page.files["lab_creep/creep.py"]
    page.make(
        (hold, indent(motion.partition("```")[0], "    ")),
        ("        hold_s:", "        way_mm: float = 0.3\n        hold_s:"),
        ("import Column\n", "import Column\nfrom rig.run.points import Move\n"),
    )
    done = rig.run("creep", "--no-figures", "--way", "0.2")
    assert done.code in (0, 5), done.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        (rows,) = run.waveforms("trial-001", stream="position")
        assert rows.values("x")[-1] == pytest.approx(10.2, abs=0.01)


@pytest.mark.thorough
def test_the_stress_relaxation_that_the_page_shows_runs(rig: Any) -> None:
    page = Page(PAGE, rig)
    blocks = page.text.split("```python\n")
    (shown,) = (b for b in blocks if b.startswith("class Settings") and "hold_place" in b)
    source = page.files["lab_creep/creep.py"]
    settings = source[source.index("    class Settings") : source.index("    def motion_s")]
    hold = "    def under_force(self, trial):\n        trial.hold(self.settings.hold_s)\n"
    page.make((settings, indent(shown.partition("```")[0], "    ") + "\n"), (hold, ""))
    done = rig.run("creep", "--no-figures", "--hold", "500ms", "--forces", "2,3N")
    assert done.code == 0, done.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.column("set_normal_force").tolist() == [2.0, 3.0]
        assert all(abs(run.column("creep")) < 0.5), "z stays where it is"
    assert "  2 N: 0.00 um\n" in done.stderr
    assert "  creep: " not in done.stderr, "no mean over both forces"


READING = "    def reading(self, record):"
RETURNED = 'return {"creep_um": 1e3 * (record.z_mm[-1] - record.z_mm[0])}'
MISTAKES = {
    "lacks reading": (READING, "    def _reading(self, record):"),
    "Creep.under_force must be under_force(self, trial)": (
        "def under_force(self, trial)",
        "def under_force(self)",
    ),
    "which is not a hook; did you mean 'summarise'?": (
        READING,
        f"    def sumarise(self, readings): return {{}}\n\n{READING}",
    ),
    "which is not the key of one of its columns (creep_um)": (RETURNED, 'return {"creep_mm": 1}'),
    "which its layout declares (use None for no value)": (RETURNED, "return {}"),
    "every trial has a column 'stiffness'": (
        'Column("creep", "um",',
        'Column("stiffness", "um",',
    ),
    "a fault in the package lab-creep: lab_creep/creep.py line": (RETURNED, "return 1 / 0"),
    "a trial needs at least 0.1 s": ("return self.settings.hold_s", "return 0.05"),
}


SHOWN_ELSEWHERE = (
    "which its layout declares (use None for no value)",
    "a fault in the package lab-creep: lab_creep/creep.py line",
    "a trial needs at least 0.1 s",
)
"""Messages that a thorough test of cli/test_broken_packages or procedures/test_example expects."""


@pytest.mark.parametrize(
    "message", mostly_nightly(MISTAKES, thorough=MISTAKES.keys() - set(SHOWN_ELSEWHERE))
)
def test_a_mistake_gives_the_message_that_the_page_explains(rig: Any, message: str) -> None:
    page = Page(PAGE, rig)
    assert f"`{message}" in page.text
    old, new = MISTAKES[message]
    assert old in page.files["lab_creep/creep.py"]
    page.make((old, new))
    failed = rig.run("creep", "--hold", "0.2", "--no-figures")
    assert failed.code not in (0, 5)
    assert message in failed.stderr


def test_the_page_says_for_how_long_a_reading_may_compute(rig: Any) -> None:
    text = Page(PAGE, rig).text
    assert f"after {SIGN_OF_LIFE_S:g} s of computing the drives are no longer fed" in text
    default_s = BenchSettings.model_fields["heartbeat_timeout_s"].default
    assert f"after `heartbeat_timeout_s` of the bench file ({default_s:g} s)" in text


@pytest.mark.thorough
def test_other_messages_are_those_of_the_page(rig: Any) -> None:
    page = Page(PAGE, rig)
    missing = rig.run("creep")
    assert missing.code == 2
    assert "No such command 'creep'" in missing.stderr
    page.make(("class Creep(", "class class Creep("))
    assert "creep (unavailable: lab-creep: " in " ".join(rig.run("--help").stdout.split())


def test_what_the_page_names_of_the_program_is_there(rig: Any) -> None:
    text = Page(PAGE, rig).text
    for owner, name in (
        (RecordedStreams, "run.streams.record_raw"),
        (RecordedStreams, "run.streams.record_rows"),
        (preload, "procedures.sweep.preload.press"),
    ):
        assert f"`{name}" in text
        assert callable(getattr(owner, name.rpartition(".")[2]))
    for field in fields(MotionRecord):
        assert f"`{field.name}`" in text or f"record.{field.name}" in text
