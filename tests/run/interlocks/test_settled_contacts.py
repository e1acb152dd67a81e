"""The watch of the contacts in real time: what is armed is stopped from its own threads, and before
a failure is handled every contact has been read, of a fast and of a slow instrument."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from rig.bench.interlocks import InterlockSettings
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError
from rig.run.holds import Holds
from rig.run.interlocks.contact_readings import FRESH_S
from rig.run.interlocks.watch import InterlockError, InterlockWatch

EVERY_S = {"daq": 0.0, "stage_z": 0.1}
"""Shortest interval between two readings, by role: a DAQ is read every 20 ms."""
PATIENCE_S = 60.0


class Inputs:
    """An instrument that reads one contact, which a test opens, or which it breaks or holds up."""

    def __init__(self) -> None:
        self.closed, self.broken = True, False
        self.answers = threading.Event()
        self.answers.set()
        self.begun_s: list[float] = []

    def inputs_high(self, names: Sequence[str]) -> Mapping[str, bool]:
        """The level of the contact."""
        self.begun_s.append(time.monotonic())
        self.answers.wait(PATIENCE_S)
        if self.broken:
            raise InstrumentError("it", "read inputs", "has no power", "look")
        return dict.fromkeys(names, self.closed)


class Store:
    """Latches that last as long as the test."""

    lasting = False

    def __init__(self) -> None:
        self.latched: list[str] = []

    def check_writable(self) -> None:
        """It can be."""

    def get(self, name: str) -> Any:
        """No contact was opened before."""
        return SimpleNamespace(opened=None, why="")

    def latch(self, name: str, why: str) -> None:
        """It is opened."""
        self.latched.append(name)


@contextmanager
def watched(
    act: Callable[[], list[str]] = list,
) -> Iterator[tuple[InterlockWatch, dict[str, Inputs]]]:
    """Two contacts, watched in real time: a door at the DAQ, an e-stop at a drive."""
    instruments = {role: Inputs() for role in EVERY_S}
    contacts = (
        InterlockSettings.model_validate({"name": "door", "input": "daq.501.0", "class": "person"}),
        InterlockSettings.model_validate(
            {"name": "e-stop", "input": "stage_z.DIN3", "class": "person"}
        ),
    )
    parts = [
        SimpleNamespace(role=role, driver=SimpleNamespace(INPUTS_EVERY_S=every_s))
        for role, every_s in EVERY_S.items()
    ]
    bench: Any = SimpleNamespace(
        clock=WallClock(),
        settings=SimpleNamespace(interlock=contacts),
        plan=SimpleNamespace(instruments=parts),
        instruments=instruments,
    )
    store: Any = Store()
    watch = InterlockWatch(bench, Holds(), act, store)
    watch.begin()
    try:
        yield watch, instruments
    finally:
        for one in instruments.values():
            one.answers.set()
        watch.end()


def test_every_contact_is_read_again_before_a_failure_is_handled() -> None:
    """The fast instrument's readings do not stand in for the slow one's."""
    with watched() as (watch, instruments):
        for n in range(6):
            time.sleep(0.017 * n)
            called_s = time.monotonic()
            watch.settle()
            for one in instruments.values():
                assert one.begun_s[-1] > called_s


@pytest.mark.parametrize("after_s", [0.0, 0.03, 0.06, 0.09])
@pytest.mark.parametrize("role", EVERY_S)
def test_a_contact_that_has_just_opened_is_the_first_cause(role: str, after_s: float) -> None:
    """An e-stop that takes the power from a drive is not reported as a fault of the drive."""
    with watched() as (watch, instruments):
        time.sleep(after_s)
        instruments[role].closed = False
        watch.settle()
        with pytest.raises(InterlockError, match=r"person.* opened"):
            watch.check()


@pytest.mark.parametrize("role", EVERY_S)
def test_a_contact_that_cannot_be_read_any_more_is_known_to_be_open_in_bounded_time(
    role: str,
) -> None:
    """Its instrument fails at once, again and again: a failure does not count as a reading."""
    with watched() as (watch, instruments):
        instruments[role].broken = True
        called_s = time.monotonic()
        watch.settle()
        assert time.monotonic() - called_s < 2 * FRESH_S
        with pytest.raises(InterlockError, match="cannot be read"):
            watch.check()
        called_s = time.monotonic()
        watch.settle()  # as the next one that handles a failure
        assert time.monotonic() - called_s < FRESH_S, "what is known to be open is not waited for"


def opened(inputs: Inputs) -> None:
    inputs.closed = False


def broken(inputs: Inputs) -> None:
    inputs.broken = True


def silent(inputs: Inputs) -> None:
    inputs.answers.clear()


@pytest.mark.parametrize("happens", [opened, broken, silent])
@pytest.mark.parametrize("role", EVERY_S)
def test_what_is_armed_is_stopped_while_the_procedure_waits_for_something_else(
    role: str, happens: Callable[[Inputs], None]
) -> None:
    """The procedure's thread is in one blocking call and looks at no contact; that call ends only
    when the emergency actions have run."""
    stopped = threading.Event()
    stopped_by: list[threading.Thread] = []

    def act() -> list[str]:
        stopped_by.append(threading.current_thread())
        stopped.set()
        return []

    with watched(act) as (watch, instruments):
        happens(instruments[role])
        assert stopped.wait(PATIENCE_S), "nothing was stopped before the call returned"
        assert threading.current_thread() not in stopped_by
        watch.poll()  # as the procedure's next wait
        with pytest.raises(InterlockError, match="opened at" if happens is opened else "cannot be"):
            watch.check()
    assert len(stopped_by) == 1
