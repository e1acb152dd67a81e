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


def reaction_s(rig):
    """World time from the opening of the door to the last command that switches something off."""
    log = rig.log()
    opened = next(x["t_us"] for x in log if x["what"] == "contact" and not x["value"]["closed"])
    stops = [x for x in log if x["t_us"] >= opened and x["what"] in ("stop", "ch1.on")]
    return None if not stops else (stops[0]["t_us"] - opened) * 1e-6


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
