"""The promises of each role, as scripts that any driver of the role can run through.

A script is a sequence of steps in the order of an experiment. A step calls the instrument and
checks the result against the truth: what the simulated instrument did, or what its terminals
carried. A step may be repeated after a failure, so a call that failed half-way must not spoil the
next one. The last step of a script needs no other before it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rig.core.errors import InstrumentError
from rig.testing.raising import raising

PATIENCE_S = 10.0
"""Wall time within which something has to happen that no clock of the bench decides."""


@dataclass(frozen=True)
class Step:
    """One thing a procedure does, with the check of its outcome."""

    name: str
    act: Callable[[Any, Any], None]
    """Takes the instrument and its `Service`; raises AssertionError where a wrong value came."""


@dataclass(frozen=True)
class Role:
    """A role's protocol and what its drivers are put through."""

    protocol: type
    quantities: frozenset[str]
    """Names of the quantities that `limits` must have."""
    script: tuple[Step, ...]
    excite: Callable[[Any, Any], None]
    """Leaves the instrument in a state from which it has to be made safe."""
    attend: Callable[[Any, Any], Callable[[], None] | None] = lambda instrument, service: None
    """Do what the runner does by itself for a connected instrument of the role; return what ends
    it."""
    apart: tuple[Step, ...] = ()
    """Steps for an instrument that has just been connected. They are run without faults only,
    because they expect an error, or because the loss of an answer has no visible effect in them."""


def same(what: str, got: object, wanted: object) -> None:
    """Fail unless two values are equal; the message has both."""
    assert got == wanted, f"{what} is {got!r}; it must be {wanted!r}"


def near(what: str, got: float, wanted: float, within: float, unit: str) -> None:
    """Fail unless a value is within a tolerance of another; the message has all three."""
    assert abs(got - wanted) <= within, (
        f"{what} is {got:.6g} {unit}; it must be {wanted:.6g} {unit} within {within:.3g} {unit}"
    )


def at_rest(service: Any, when: str) -> None:
    """Fail unless the simulated instrument does nothing that has to be stopped."""
    assert service.at_rest(), f"the instrument is not at rest {when}"


def soon(holds: Callable[[], bool]) -> bool:
    """Return whether something holds now or shortly: the instrument may not acknowledge."""
    deadline = time.monotonic() + PATIENCE_S
    while not (held := holds()) and time.monotonic() < deadline:
        time.sleep(0.001)
    return held


def rest(instrument: Any, service: Any) -> None:
    """Step: `make_safe` brings the instrument to rest."""
    instrument.make_safe()
    at_rest(service, "after make_safe()")


def refused(service: Any, act: Callable[[], None], what: str, words: str) -> None:
    """Fail unless `act` raises an InstrumentError with these words, and nothing moves."""
    with raising(InstrumentError, what) as caught:
        act()
    assert words in caught.error.message, (
        f"{what} is refused with {caught.error.message!r}, in which {words!r} is missing"
    )
    assert caught.error.hint, f"{what} is refused without a hint"
    service.sleep(0.2)
    at_rest(service, f"after {what} was refused")
