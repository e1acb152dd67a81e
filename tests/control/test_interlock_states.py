"""The states of an interlock contact, without any input."""

from __future__ import annotations

import pytest

from rig.control.interlock import STEADY_S, UNREAD_S, Contact, ContactEvent, InterlockState


def seen(contact: Contact, levels: str, every_s: float = 0.02, begin_s: float = 0.0) -> list[str]:
    """Read the contact at constant intervals, c closed and o open; return the events."""
    events = (contact.read(one == "c", begin_s + k * every_s) for k, one in enumerate(levels))
    return [event.value for event in events if event is not None]


def test_a_contact_of_the_process_is_over_once_it_has_been_closed_for_long_enough() -> None:
    contact = Contact("air", "process", 0.0)
    assert seen(contact, "cco") == ["opens"]
    assert contact.blocks_motion
    assert not contact.latched
    assert seen(contact, "c" * 24, begin_s=1.0) == []
    assert seen(contact, "cc", begin_s=1.0 + STEADY_S) == ["closes"]
    assert not contact.blocks_motion


def test_a_contact_of_a_person_latches_until_it_is_reset_while_it_is_closed() -> None:
    contact = Contact("door", "person", 0.0)
    with pytest.raises(ValueError, match="closed cannot be reset"):
        contact.reset()
    assert seen(contact, "o") == ["opens"]
    with pytest.raises(ValueError, match="opened cannot be reset"):
        contact.reset()
    assert seen(contact, "c" * 60, begin_s=1.0) == ["closes"]
    assert contact.state is InterlockState.RELEASED
    assert contact.latched
    assert contact.blocks_motion
    assert seen(contact, "o", begin_s=5.0) == ["opens"]
    assert seen(contact, "c" * 60, begin_s=6.0) == ["closes"]
    contact.reset()
    assert not contact.blocks_motion


@pytest.mark.parametrize("kind", ["person", "process"])
def test_a_contact_that_bounces_is_open_until_it_has_been_still(kind) -> None:
    contact = Contact("door", kind, 0.0)
    assert seen(contact, "oc" * 200) == ["opens"]
    assert contact.blocks_motion


def test_a_contact_that_is_not_read_counts_as_open() -> None:
    contact = Contact("door", "person", 0.0)
    assert contact.judge(UNREAD_S) is None
    assert contact.judge(UNREAD_S + 0.01) is ContactEvent.OPENS
    assert not contact.readable
    assert contact.judge(10.0) is None, "it opens once"
    assert contact.latched


def test_a_latch_of_an_earlier_run_is_there_before_anything_is_read() -> None:
    contact = Contact("door", "person", 0.0, latched=True)
    assert contact.blocks_motion
    assert seen(contact, "c" * 60) == ["closes"]
    assert contact.state is InterlockState.RELEASED
