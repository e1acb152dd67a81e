"""What keeps a procedure from its next wait is named: to the drives, to the guard, to a person."""

from __future__ import annotations

import threading
from typing import Any

import packages
import pytest

from drivers.shared.request_log import RequestLog
from rig.core.clock import WallClock
from rig.run.hang_watch import HangWatch

PATIENCE_S = 30.0
LAB = """
def reading(event, wait):
    inner(event, wait)

def inner(event, wait):
    wait(event)
"""
PROCEDURE = """
import time

from procedures.pressed import PressedProcedure, PressedSettings


class Slow(PressedProcedure):
    '''Hold a force and think about it for ever.'''

    name = "slow"
    fixtures = ("plate",)
    columns = ()

    class Settings(PressedSettings):
        '''Nothing of its own.'''

    def motion_s(self):
        return 0.1

    def under_force(self, trial):
        trial.hold(0.1)

    def reading(self, record):
        time.sleep(600)
        return {}
"""


def lab(name: str) -> Any:
    """A module of another package."""
    module: dict[str, Any] = {"__name__": f"{name}.creep"}
    exec(compile(LAB, f"/site/{name}/creep.py", "exec"), module)
    return module


def watched(words: list[str], warnings: list[str]) -> tuple[WallClock, HangWatch]:
    clock = WallClock()
    names = {"lab_a": "procedure creep of package lab-a"}
    return clock, HangWatch(clock, names, words.append, warnings.append)


def test_a_hook_that_neither_waits_nor_returns_is_named_with_its_place() -> None:
    words: list[str] = []
    warnings: list[str] = []
    warned = threading.Event()
    clock, watch = watched(words, warnings)
    log = RequestLog(clock)
    log.note()

    def warn(text: str) -> None:
        warnings.append(text)
        warned.set()

    watch._warn = warn
    with watch:
        lab("lab_a")["reading"](warned, lambda event: event.wait(PATIENCE_S))
    named = "reading() of procedure creep of package lab-a (creep.py line 6)"
    assert words[0] == named
    assert warnings[0].startswith(f"{named} keeps the run from its next wait")
    assert clock.hung is not None
    log.note()
    assert log.whose_silence(0.5).endswith(f": it waited for {named}")


@pytest.mark.parametrize("module", ["lab_b", "procedures", "rig"])
def test_other_code_that_hangs_is_not_blamed_on_a_package(module: str) -> None:
    """The computer stands still in any code, and this program's is not the package's."""
    words: list[str] = []
    clock, watch = watched(words, words)
    looked = threading.Event()
    looks: list[str] = []
    look = watch._what_hangs

    def counted() -> str:
        looks.append(look())
        if len(looks) == 3:
            looked.set()
        return looks[-1]

    watch._what_hangs = counted  # type: ignore[method-assign]
    with watch:
        lab("lab_a")["reading"](
            looked, lambda _: lab(module)["reading"](looked, lambda it: it.wait(PATIENCE_S))
        )
    assert looked.is_set()
    assert (words == []) is (module != "lab_b")
    assert (clock.hung is None) is (module != "lab_b")


@pytest.mark.thorough
def test_a_hook_that_never_returns_is_named_where_the_guard_kills_its_run(rig: Any) -> None:
    entries = "[rig.procedures]\nslow = lab_slow:Slow\n"
    site = packages.install(rig.folder / "site", "lab-slow", entries, {"lab_slow.py": PROCEDURE})
    packages.on_path(rig, site)
    running = rig.start("slow", "--no-figures")
    running.wait_for("Resume with: rig resume ")
    ended = running.finish()
    assert ended.code == -9
    named = "reading() of procedure slow of package lab-slow (lab_slow.py line 24)"
    assert f"error: no sign of life for 5 s: it waited for {named}; the run was" in ended.stderr
