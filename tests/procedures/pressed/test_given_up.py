"""A trial that the procedure of another package gives up: how it ends, and what follows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from packages import install, on_path

from rig.files.runfile.reader import RunFile

REGISTERED = "[rig.procedures]\nhasty = lab.hasty:Hasty\n"
MODULE = '''
from procedures.pressed import PressedProcedure, PressedSettings
from rig.run.points import RetakeError


class Hasty(PressedProcedure):
    """Give up the first trial while x moves, or for whatever goes wrong."""

    name, fixtures = "hasty", ("plate",)
    begun = 0

    class Settings(PressedSettings):
        while_x_moves: bool = False

    def motion_s(self):
        return 1.0

    def under_force(self, trial):
        self.begun += 1
        if self.settings.while_x_moves and self.begun == 1:
            trial.x.start_move(15.0, 0.5)
            raise RetakeError("x went too far")
        try:
            trial.move_x(10.5, 0.5)
        except Exception as error:
            raise RetakeError("it did not work") from error

    def reading(self, record):
        return {}
'''
DEAD = """[[fault]]
device = "force_sensor"
kind = "dead-noisy"
move = 2
of = "stage_x"
after_s = 0.4
"""


@pytest.fixture
def hasty(rig: Any, tmp_path: Path) -> Any:
    """The command line, with the command `hasty`."""
    modules = {"lab/__init__.py": "", "lab/hasty.py": MODULE}
    on_path(rig, install(tmp_path / "site", "lab", REGISTERED, modules))
    return rig


def run(hasty: Any, *given: str) -> Any:
    log = ("--world-log", str(hasty.world_log))
    return hasty.run("hasty", "--detector", "none", "--json", "--no-figures", *log, *given)


def events(hasty: Any) -> list[tuple[str, str]]:
    return [(one["device"], one["what"]) for one in hasty.log()]


@pytest.mark.thorough
def test_x_stops_and_the_record_ends_before_a_trial_that_is_given_up_is_lifted(hasty: Any) -> None:
    done = run(hasty, "--while-x-moves")
    assert done.code == 0, done.stderr
    after = events(hasty)
    after = after[after.index(("world", "touch-down")) :]
    commanded = [
        one for one in after if one[1] in ("move", "stop", "acquisition") and one[0] != "world"
    ]
    assert commanded[:4] == [
        ("stage_x", "move"), ("stage_x", "stop"), ("daq", "acquisition"), ("stage_z", "move"),
    ]  # fmt: skip
    with RunFile.open(hasty.only("*.h5")) as file:
        assert len(file.readings()) == 1
        warnings = file.outcome.warnings
    assert "trial-001: an attempt was given up: x went too far" in warnings


def test_a_trial_that_is_given_up_for_an_instruments_error_ends_the_run(hasty: Any) -> None:
    ended = run(hasty, "--fault", hasty.fault(DEAD))
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: force_sensor: hold the force: it reads")
    assert "retaking" not in ended.stderr
    assert events(hasty).count(("world", "touch-down")) == 1, "nothing is pressed again"
