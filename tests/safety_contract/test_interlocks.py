"""Interlock contacts, through the real command: what an opened door does in each state, what
latches, and what a person has to do before anything moves again."""

from __future__ import annotations

import pytest
from tiers import mostly_thorough

from rig.files.runfile.reader import RunFile

SHORT = ("--frequencies", "300,600")
DOOR = '[[interlock]]\nname = "door"\nclass = "person"\n'
AIR = '[[interlock]]\nname = "air pressure"\nclass = "process"\ninput = "daq.501.1"\n'
MEASURING = "acquisition = 5\n"
"""A record of a point, the film pressed and vibrating."""
MOMENTS = {
    "homing": "after_s = 0.6\n",
    "on the way to contact": 'move = 3\nof = "stage_z"\nafter_s = 0.5\n',
    "while a point is taken": MEASURING,
    "on the way up at the end": 'move = 4\nof = "stage_z"\nafter_s = 0.1\n',
}


def contact(kind, moment="", name="door", more=""):
    """A fault plan's entry about a contact."""
    return f'[[fault]]\ndevice = "interlock"\nname = "{name}"\nkind = "{kind}"\n{moment}{more}'


def events(run):
    """Codes and messages of the file's events."""
    codes = [code.decode() for code in run.entry["events/code"][()]]
    return list(zip(codes, [m.decode() for m in run.entry["events/message"][()]], strict=True))


@pytest.mark.parametrize("moment", mostly_thorough(MOMENTS, ["while a point is taken"]))
def test_an_opened_door_ends_the_run_and_the_file_tells_when(rig, moment):
    ended = rig.sweep(
        *SHORT, "--world", rig.world(DOOR), "--fault", rig.fault(contact("opened", MOMENTS[moment]))
    )
    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: interlock door (person) opened at ")
    assert "start again" in error
    assert "retaking" not in ended.stderr
    assert rig.outputs()[-1:] in ([], [False])
    with RunFile.open(rig.only("*.h5")) as run:
        ((_, told),) = [one for one in events(run) if one[0] == "interlock"]
        assert told.startswith("interlock door (person) opened at ")
        assert run.outcome.status == "failed"


HOW = {
    "a broken wire": (contact("stuck-open", MEASURING), "opened at"),
    "a bouncing contact": (contact("bouncing", MEASURING), "opened at"),
    "a door that is closed again at once": (
        contact("opened", MEASURING) + contact("closed", MEASURING, more="after_s = 0.05\n"),
        "opened at",
    ),
    "an input that does not answer": (
        '[[fault]]\ndevice = "daq"\nkind = "silence"\ncommand = "MEAS:DIG"\ncount = 0\n'
        + MEASURING,
        "cannot be read at",
    ),
}


@pytest.mark.parametrize("how", mostly_thorough(HOW, ["an input that does not answer"]))
def test_whatever_reads_as_open_ends_the_run(rig, how):
    plan, told = HOW[how]
    ended = rig.sweep(*SHORT, "--world", rig.world(DOOR), "--fault", rig.fault(plan))
    assert ended.code == 4, ended.stderr
    assert f"error: interlock door (person) {told}" in ended.stderr
    assert rig.outputs() == [True, False], "off, and not on again"


def test_a_contact_of_the_process_holds_the_run_and_lets_it_go_on_by_itself(rig):
    plan = contact("opened", MEASURING, "air pressure") + contact(
        "closed", MEASURING, "air pressure", "after_s = 2.0\n"
    )
    ended = rig.sweep(*SHORT, "--world", rig.world(AIR), "--fault", rig.fault(plan))
    assert ended.code == 0, ended.stderr
    assert "hold: the interlock air pressure (process) is open; the bench is safe" in ended.stderr
    assert rig.outputs() == [True, False, True, False]
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.point_ids() == ["300Hz-1N", "600Hz-1N"]
        told = [message for code, message in events(run) if code == "interlock"]
        assert "interlock air pressure (process) opened at" in told[0]
        assert told[1] == "interlock air pressure (process) is closed again"


@pytest.mark.thorough
def test_a_person_at_the_door_while_the_run_is_on_hold_ends_it(rig):
    plan = contact("opened", MEASURING, "air pressure") + contact(
        "opened", MEASURING, more="after_s = 1.5\n"
    )
    ended = rig.sweep(*SHORT, "--world", rig.world(AIR + DOOR), "--fault", rig.fault(plan))
    assert ended.code == 4, ended.stderr
    assert "interlock door (person) opened at" in ended.errors[0]
    assert "Resumed." not in ended.stderr
    assert rig.outputs() == [True, False]


def test_a_door_that_is_open_lets_nothing_begin(rig):
    ended = rig.sweep(*SHORT, "--world", rig.world(DOOR + "closed = false\n"))
    assert ended.code == 4, ended.stderr
    assert "interlock door (person) opened at 0.0" in ended.errors[0]
    assert rig.outputs() == []
    assert not [x for x in rig.log() if x["what"] in ("homing", "move")]


@pytest.mark.thorough
def test_a_drive_that_fails_behind_an_open_door_is_not_the_first_cause(rig):
    """An e-stop takes the power of the drive and opens its second contact."""
    fault = '[[fault]]\ndevice = "stage_z"\nkind = "drive-fault"\n'
    plan = contact("opened", MEASURING) + fault + MEASURING
    ended = rig.sweep(*SHORT, "--world", rig.world(DOOR), "--fault", rig.fault(plan))
    assert ended.code == 4, ended.stderr
    assert "interlock door (person) opened at" in ended.errors[0]


@pytest.mark.thorough
def test_a_fault_of_a_contact_that_the_bench_has_not_is_refused(rig):
    ended = rig.sweep(*SHORT, "--fault", rig.fault(contact("opened")))
    assert ended.code == 2, ended.stderr
    assert "'door', which this bench has not (it has: none)" in ended.errors[0]
