"""A run that could not make its bench safe leaves it to the guard: what that is worth."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import made_up
import pytest

from rig.bench.connected import Bench
from rig.core.errors import ExitCode, InstrumentError, RigError, UnsafeError
from rig.core.settings import Settings
from rig.run import execute as execution
from rig.run.context import Run
from rig.run.making_safe.guard_link import judged
from rig.run.saving import RunSaving

STILL_OVER = UnsafeError("stage_z: unload: 20 N, over the limit of 15 N", "move it away by hand")
NO_ANSWER = InstrumentError("stage_z", "stop", "no answer within 1 s", "check its cable")


class Pressing(made_up.Example):
    """Presses something that its shutdown action does not release."""

    why: RigError

    def arm(self, run: Run) -> None:
        def off() -> None:
            raise self.why

        run.arm("normal force", off, done="normal force released")


@pytest.mark.parametrize(("why", "named"), [(STILL_OVER, "normal force"), (NO_ANSWER, "")])
def test_the_guard_hears_what_is_still_pressed_over_its_limit(
    why: RigError, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = Pressing(Settings())
    procedure.why = why
    outcome = made_up.run_of(procedure, tmp_path, monkeypatch)
    assert outcome.code is ExitCode.UNSAFE
    assert procedure.log[-1] == f"guard: take over {named}"


def test_the_guard_is_given_the_bench_before_the_data_are_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To save may take minutes, for which what could not be switched off would stay on."""
    procedure = Pressing(Settings())
    procedure.why = NO_ANSWER
    save = RunSaving.save

    def noting(saving: RunSaving) -> None:
        procedure.log.append("saving")
        save(saving)

    monkeypatch.setattr(RunSaving, "save", noting)
    outcome = made_up.run_of(procedure, tmp_path, monkeypatch)
    assert outcome.file is not None
    assert procedure.log[-2:] == ["guard: take over ", "saving"]


def test_a_link_that_does_not_close_keeps_the_bench_from_its_guard_for_a_while_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With signs of life: else the guard would kill the run, and nothing would be saved."""
    procedure = Pressing(Settings())
    procedure.why = NO_ANSWER
    release = threading.Event()
    monkeypatch.setattr(execution, "HAND_OVER_S", 0.3)
    monkeypatch.setattr(Bench, "hand_over", lambda _: release.wait(60.0))
    monkeypatch.setattr(made_up.Guard, "beat", lambda guard: guard._log.append("beat"))
    outcome = made_up.run_of(procedure, tmp_path, monkeypatch)
    release.set()
    assert outcome.file is not None
    assert procedure.log[-2:] == ["beat", "guard: take over "]


def test_the_data_are_saved_although_the_guard_cannot_be_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = Pressing(Settings())
    procedure.why = NO_ANSWER

    def fail(*_: object) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(made_up.Guard, "take_over", fail)
    with pytest.raises(ZeroDivisionError):
        made_up.run_of(procedure, tmp_path, monkeypatch)
    assert len(list(tmp_path.glob("*/*.h5"))) == 1


class Paused(made_up.Example):
    """Is paused by Ctrl-Z while the bench is made safe."""

    switched_off = False

    def arm(self, run: Run) -> None:
        def off() -> None:
            assert callable(signal.getsignal(signal.SIGTSTP)), "the process would be suspended"
            os.kill(os.getpid(), signal.SIGTSTP)
            run.clock.sleep(0.1)
            self.switched_off = True

        run.arm("normal force", off, done="normal force released")


def test_ctrl_z_while_the_bench_is_made_safe_suspends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = Paused(Settings())
    before = signal.getsignal(signal.SIGTSTP)
    outcome = made_up.run_of(procedure, tmp_path, monkeypatch, pauses=True)
    assert outcome.code is ExitCode.DONE
    assert procedure.switched_off
    assert signal.getsignal(signal.SIGTSTP) is before


@pytest.mark.parametrize(
    ("over_limit", "released", "safe"),
    [(["normal force"], False, False), (["normal force"], True, True), ([], False, True)],
)
def test_a_force_that_remains_over_its_limit_is_safe_only_where_z_was_seen_clear(
    over_limit: list[str], released: bool, safe: bool
) -> None:
    pressed = "still pressed at 12.44 mm, 20.0 N"
    taken = judged({"safe": True, "pressed": pressed, "released": released}, over_limit)
    assert (taken.safe, taken.released) == (safe, released)
    assert pressed in taken.summary
    assert ("normal force may still be over the limit" in taken.summary) == (not safe)
