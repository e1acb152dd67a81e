"""The smallest procedure, `procedures.example`, as a package of its own on the command line."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packages import install, on_path

from procedures.example import Creep
from procedures.pressed import PressedProcedure, PressedSettings
from rig.files.journal.layout import Column
from rig.files.runfile.reader import RunFile
from rig.run.load_procedure import fault_of

REGISTERED = "[rig.procedures]\ncreep = procedures.example:Creep\n"
LIFTED_mm = 5.0
"""Where z waits on the simulated bench."""


@pytest.fixture
def creep(rig: Any, tmp_path: Path) -> Any:
    """The command line, with the example as the command `creep`."""
    on_path(rig, install(tmp_path / "site", "lab-creep", REGISTERED))
    return rig


def arguments(rig: Any, *given: str) -> list[str]:
    world = ("--world", rig.world(""), "--world-log", str(rig.world_log))
    return ["creep", "--json", "--no-figures", *world, *given]


def assert_lifted(rig: Any) -> None:
    z = [e for e in rig.log() if e["device"] == "stage_z" and e["what"] in ("move", "at-rest")]
    assert z[-1]["what"] == "at-rest"
    assert z[-1]["value"] == pytest.approx(LIFTED_mm, abs=0.01)
    touched = [e["what"] for e in rig.log() if e["what"] in ("touch-down", "lift-off")]
    assert touched[-1:] == ["lift-off"]


@pytest.mark.thorough
def test_a_run_presses_holds_reads_and_lifts_also_where_it_is_interrupted(creep: Any) -> None:
    settings = ("--hold", "4s", "-n", "2", "--normal-force", "3N")
    running = creep.start(*arguments(creep, *settings))
    creep.await_world("touch-down")
    running.send(signal.SIGINT)
    stopped = running.finish()
    assert stopped.code == 130, stopped.stderr
    assert stopped.object["points_done"] < 2
    assert_lifted(creep)
    for file in (stopped.object["file"], stopped.object["journal"]):
        shown = creep.run("show", file).stdout
        assert "status: stopped (" in shown
        assert "resume with: rig resume " in shown
        assert len(shown.splitlines()) < 24, "it fits a terminal"

    resumed = creep.run("resume", stopped.object["journal"], "--no-figures", "--json")
    assert resumed.code == 0, resumed.stderr
    assert resumed.object["points_done"] == 2
    assert abs(resumed.object["summary"]["mean_creep_um"]) < 1, "the simulated skin does not creep"
    file = creep.only("*.h5")
    with RunFile.open(file) as run:
        motion_s = run.column("motion_to") - run.column("motion_from")
        assert motion_s == pytest.approx([4.0, 4.0], abs=0.05)
        assert run.column("mean_normal_force") == pytest.approx([3.0, 3.0], rel=0.02)
        assert run.settings["hold_s"] == 4.0
        (samples,) = run.waveforms("trial-002", stream="force")
        assert len(samples.values("F_n")) > 4000
    assert "\n  creep: " in creep.run("show", str(file)).stdout


@pytest.mark.thorough
def test_a_batch_of_it_is_planned(creep: Any) -> None:
    (creep.folder / "night.toml").write_text(
        '[batch]\nname = "creep"\n[[experiment]]\nprocedure = "creep"\n'
        '[experiment.matrix]\nnormal_force_N = [2, 4]\nhold_s = [1, "2 s"]\n'
    )
    planned = creep.run("batch", "plan", "night.toml")
    assert planned.code == 0, planned.stderr
    _heading, *runs = planned.stdout.splitlines()
    assert len(runs) == 4
    assert "normal_force_N=4 hold_s=2" in runs[-1]


@pytest.mark.thorough
def test_a_hold_too_short_to_be_judged_is_refused_before_anything_moves(creep: Any) -> None:
    refused = creep.run(*arguments(creep, "--hold", "50ms"))
    assert refused.code == 2, refused.stderr
    assert "would take 0.05 s; a trial needs at least 0.1 s" in refused.stderr
    assert not [e for e in creep.log() if e["what"] == "move"] if creep.world_log.exists() else True


MOVING = '''
import numpy as np
from procedures.pressed import PressedProcedure, PressedSettings
from rig.files.journal.layout import Column
from rig.run.points import Move

class Wipe(PressedProcedure):
    """Move to and fro under the force."""
    name, fixtures = "creep", ("plate",)
    columns = (Column("way", "mm", "Way of x"), Column("remark", "", "What was seen", "text"))

    class Settings(PressedSettings):
        way_mm: float = 0.3

    def motion_s(self): return 4 * self.settings.way_mm
    def moves(self): return (Move("stage_x.position", 10 + self.settings.way_mm, ("way_mm",)),)
    def under_force(self, trial):
        trial.move_x(10 + self.settings.way_mm, 0.5)
        trial.move_x(10, 0.5)
        FAULT
    def reading(self, record):
        assert len(record.position_t_s) == len(record.z_mm) == len(record.x_mm) > 50
        assert len(record.force_t_s) == len(record.normal_N) == len(record.tangential_N)
        assert len(record.signal_t_s) == len(record.v_1) == len(record.v_2) == len(record.v_d)
        assert np.all(np.diff(record.position_t_s) > 0) and record.position_t_s[0] < 0.05
        assert np.allclose(np.diff(record.force_t_s), 1e-3)
        assert np.allclose(np.diff(record.signal_t_s), 1e-3)
        assert abs(record.normal_N.mean() - 4) < 0.2 and np.ptp(record.tangential_N) > 1
        assert np.array_equal(record.v_d, record.v_1 - record.v_2) and np.ptp(record.v_d) > 1e-3
        return {"way_mm": np.ptp(record.x_mm), "remark": "seen"}
'''


def install_moving(rig: Any, tmp_path: Path, fault: str) -> None:
    modules = {"lab/__init__.py": "", "lab/creep.py": MOVING.replace("FAULT", fault)}
    entries = "[rig.procedures]\ncreep = lab.creep:Wipe\n"
    on_path(rig, install(tmp_path / "site", "lab-creep", entries, modules))


@pytest.mark.thorough
def test_x_moves_under_the_force_and_the_record_has_all_of_it(rig: Any, tmp_path: Path) -> None:
    install_moving(rig, tmp_path, "")
    done = rig.run(*arguments(rig))
    assert done.code in (0, 5), done.stderr
    assert done.object["points_done"] == 1
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.column("way") == pytest.approx([0.3], abs=0.01)
        assert list(run.column("remark")) == ["seen"]
        (rows,) = run.waveforms("trial-001", stream="position")
        assert np.ptp(rows.values("x")) == pytest.approx(0.3, abs=0.01)
    refused = rig.run(*arguments(rig, "--way", "100mm"))
    assert refused.code == 4, refused.stderr
    assert "(from --way 100 mm)" in refused.stderr


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        pytest.param(
            *("trial.move_x(10.2, -1)", "stage_x speed -1 mm/s is outside"),
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            "trial.x.start_move(15.0, 0.01); 1 / 0",
            "a fault in the package lab-creep: lab/creep.py line 20: ZeroDivisionError",
            marks=pytest.mark.thorough,
        ),
    ],
)
def test_whatever_it_raises_under_the_force_the_skin_is_lifted(
    rig: Any, tmp_path: Path, fault: str, said: str
) -> None:
    install_moving(rig, tmp_path, fault)
    failed = rig.run(*arguments(rig))
    assert failed.code not in (0, 5)
    assert said in failed.stderr
    assert "normal force released" in failed.stderr
    assert_lifted(rig)


def test_the_example_is_about_ten_lines_and_nothing_keeps_it_from_being_loaded() -> None:
    assert fault_of(Creep, "creep") is None
    assert Creep.summary_keys[0] == "creep_um"
    assert Creep.layout.plot("creep_by_trial").axes == ("trial",)


def test_a_class_that_cannot_work_is_refused_where_it_is_defined() -> None:
    with pytest.raises(TypeError, match=r"Short\.under_force must be under_force\(self, trial\)"):

        class Short(Creep):
            def under_force(self) -> None:  # type: ignore[override]
                pass

    with pytest.raises(ValueError, match="every trial has a column 'stiffness'"):

        class Double(Creep):
            columns = (Column("stiffness", "N/mm", "Stiffness"),)

    class Empty(PressedProcedure):
        """Nothing."""

        name, fixtures, Settings = "empty", ("plate",), PressedSettings

    assert fault_of(Empty, "empty") == "lacks motion_s, reading, under_force"
