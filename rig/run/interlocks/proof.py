"""What a person does with an interlock contact: reset its latch, and prove that it opens and
closes. Nothing may be armed.
"""

from __future__ import annotations

from collections.abc import Callable

from rig.control.interlock import STEADY_S, Contact, InterlockState
from rig.run.interlocks.watch import AT_REST, InterlockError, InterlockWatch

PROOF_S = 120.0
"""Time that a person has to open a contact for a proof test, and again to close it."""
CLOSE_S = 2 * STEADY_S
"""Time within which a contact that is to be reset has to be seen closed."""


def reset(watch: InterlockWatch, name: str) -> None:
    """End the latch of a contact, here and in its record.

    Raises InterlockError if the contact is open or has not been closed for `STEADY_S`, RigError if
    the record cannot be written.
    """
    if not watch.wait_for(name, lambda one: one.state is InterlockState.RELEASED, CLOSE_S):
        raise InterlockError(f"interlock {name} is {watch.level(name)}", "close it first")
    watch.store.reset(name)
    watch.forget_opening(name)


def prove(watch: InterlockWatch, name: str, say: Callable[[str], None]) -> None:
    """Have a person open and close a contact, and record that both were seen. `say` shows what the
    person is to do.

    Raises InterlockError if the contact is latched, or does not open or close in time.
    """
    if watch.store.get(name).opened is not None:
        raise watch.error(name)
    with watch.proving(name):
        if not _closes_within(watch, name):
            say(f"interlock {name} is {watch.level(name)}: close it first")
        _require_closed(watch, name)
        say(f"proof test of interlock {name}: open it (within {PROOF_S:g} s)")
        if not watch.wait_for(name, _is_seen_open, PROOF_S):
            raise InterlockError(
                f"interlock {name} was not seen to open within {PROOF_S:g} s",
                "the contact may be welded or bridged: repair it, then start again",
            )
        say(f"interlock {name} is seen to be open: close it (within {PROOF_S:g} s)")
        _require_closed(watch, name)
    watch.store.prove(name)
    watch.note("info", "interlock", f"interlock {name} was seen to open and to close")
    say(f"interlock {name} opens and closes: recorded")


def _is_seen_open(contact: Contact) -> bool:
    return contact.blocks_motion and contact.readable


def _closes_within(watch: InterlockWatch, name: str, seconds: float = 0.0) -> bool:
    """Wait until a contact is closed, and forget its opening, which was meant; return whether it is
    in time."""
    if not watch.wait_for(name, lambda contact: contact.state in AT_REST, seconds):
        return False
    watch.forget_opening(name)
    return True


def _require_closed(watch: InterlockWatch, name: str) -> None:
    if not _closes_within(watch, name, PROOF_S):
        raise InterlockError(
            f"interlock {name} was not seen to close within {PROOF_S:g} s",
            "close it, look at its wire and its switch, then start again",
        )
