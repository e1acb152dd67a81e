"""A procedure of another package that keeps back what is to end its run: the bench is made safe.

On a simulated bench of the run's own, whose World logs what really happened.
"""

from __future__ import annotations

import signal
from typing import Any

import packages
import pytest

from rig.core.errors import RigError
from rig.run import passing
from rig.run.passing import KeptBackError, Passing

CLEAR_mm = 12.0
"""Position of z above which it presses nothing."""
PROCEDURE = """
import sys
import time

from procedures.pressed import PressedProcedure, PressedSettings


class Stubborn(PressedProcedure):
    '''Hold a force and take no notice of what ends it.'''

    name = "stubborn"
    fixtures = ("plate",)
    columns = ()

    class Settings(PressedSettings):
        '''Nothing of its own.'''

    def motion_s(self):
        return 1.0

    def under_force(self, trial):
        print("under force", file=sys.stderr, flush=True)
        again = True
        while again:
            again = {again}
            try:
                trial.hold(1.0)
            except {caught} as error:
                print(f"kept back: {{error}}", file=sys.stderr)
                time.sleep(0.1)  # for five seconds, which need not keep a processor busy

    def reading(self, record):
        return {{}}
"""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now_s = [0.0]
    monkeypatch.setattr(passing.time, "monotonic", lambda: now_s[0])
    return now_s


def raised(watch: Passing, message: str) -> BaseException:
    with pytest.raises(BaseException) as caught, watch.watched():  # noqa: PT011
        raise RigError(message)
    return caught.value


def test_an_error_that_was_kept_back_is_raised_again_in_a_way_that_passes(
    clock: list[float],
) -> None:
    watch = Passing()
    assert type(raised(watch, "stopped")) is RigError
    clock[0] = 4.9
    assert type(raised(watch, "stopped again")) is RigError
    clock[0] = 5.1
    kept = raised(watch, "stopped again")
    assert isinstance(kept, KeptBackError)
    assert not isinstance(kept, Exception)
    assert kept.cause.message == "stopped"
    assert watch.given_up is None
    clock[0] = 10.2
    assert watch.given_up is kept.cause


def test_one_that_is_raised_once_only_is_insisted_on_as_well(clock: list[float]) -> None:
    """A trip is: the waits after it would raise nothing."""
    watch = Passing()
    raised(watch, "over the limit")
    clock[0] = 4.9
    with watch.watched():
        pass
    clock[0] = 5.1
    with pytest.raises(KeptBackError, match="over the limit"), watch.watched():
        pass
    clock[0] = 60.0
    assert watch.given_up is not None


def test_a_hook_that_returns_as_if_there_had_been_no_error_has_it_raised(
    clock: list[float],
) -> None:
    watch = Passing()
    with watch.first_raised():
        pass
    with pytest.raises(ValueError, match="its stream"), watch.watched():
        raise ValueError("its stream")
    with pytest.raises(ValueError, match="its stream"), watch.first_raised():
        pass
    with pytest.raises(ValueError, match="its stream"), watch.first_raised():
        raise RigError("what followed from it")


def test_an_error_that_has_passed_does_not_count_for_the_next_point(clock: list[float]) -> None:
    watch = Passing()
    raised(watch, "on hold")
    watch.passed()
    clock[0] = 60.0
    with watch.first_raised():
        pass
    assert watch.given_up is None
    assert type(raised(watch, "stopped")) is RigError


def start(rig: Any, caught: str, *given: str, again: bool = True) -> Any:
    """Start a run of the procedure that catches these exceptions around its wait, and waits again
    or not; it has begun to hold when this returns."""
    entries = "[rig.procedures]\nstubborn = lab_stubborn:Stubborn\n"
    module = PROCEDURE.format(caught=caught, again=again)
    site = packages.install(rig.folder / "site", "lab", entries, {"lab_stubborn.py": module})
    packages.on_path(rig, site)
    running = rig.start("stubborn", "--no-figures", "--world-log", str(rig.world_log), *given)
    running.wait_for("under force")
    return running


def last_z_mm(rig: Any) -> float:
    z = [e for e in rig.log() if e["device"] == "stage_z" and e["what"] == "at-rest"]
    return float(z[-1]["value"])


@pytest.mark.thorough
def test_a_procedure_that_catches_every_exception_is_stopped(rig: Any) -> None:
    running = start(rig, "Exception")
    running.send(signal.SIGINT)
    done = running.finish()
    assert done.code == 130, done.stderr
    assert "Stopped by Ctrl-C" in done.stderr
    assert "Bench is safe" in done.stderr
    assert (
        "warning: procedure stubborn of package lab suppressed what should end the run "
        "(lab_stubborn.py line 27): let exceptions of waits pass, or raise them again (stopped by "
        "Ctrl-C)"
    ) in done.stderr
    assert last_z_mm(rig) < CLEAR_mm


@pytest.mark.thorough
def test_one_that_catches_whatever_is_raised_is_killed_and_its_guard_lifts_z(rig: Any) -> None:
    running = start(rig, "BaseException")
    running.send(signal.SIGINT)
    report = rig.guard_report()
    done = running.finish()
    assert done.code == -signal.SIGKILL, done.stderr
    assert report is not None
    assert (report["safe"], report["released"]) == (True, True), report
    assert report["cause"].startswith("procedure stubborn of package lab suppressed"), report
    assert "error: procedure stubborn of package lab suppressed" in done.stderr
    assert "; the run was killed; its guard makes the bench safe ...\n" in done.stderr
    assert "Bench was made safe by the guard; " in done.stderr
    assert last_z_mm(rig) < CLEAR_mm


@pytest.mark.thorough
def test_a_trip_that_is_kept_back_is_answered_as_any_other(rig: Any) -> None:
    """It is raised once, and the procedure returns as if nothing had been: the bench is made safe
    and the point taken again, instead of a reading kept of a force that nobody holds."""
    hit = '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nforce_N = 20.0\nfor_s = 0.05\n'
    plan = rig.fault(f"{hit}after_s = 13.0\n")
    done = start(rig, "Exception", "--fault", plan, again=False).finish()
    assert done.code == 0, done.stderr
    assert "kept back: force along z of 24 N is over the limit of 15 N" in done.stderr
    assert "retaking point trial-001 once" in done.stderr
    assert "Finished: 1 of 1 trial" in done.stderr
    assert last_z_mm(rig) < CLEAR_mm
