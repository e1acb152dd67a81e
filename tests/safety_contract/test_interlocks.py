"""Interlock contacts, through the real command: what an opened door does in each state, what
latches, and what a person has to do before anything moves again."""

from __future__ import annotations

import contextlib
import re

import pytest
from tiers import mostly_thorough
from typist import Typist

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
        ((_, reported),) = [one for one in events(run) if one[0] == "interlock"]
        assert reported.startswith("interlock door (person) opened at ")
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


@pytest.mark.thorough
@pytest.mark.parametrize("how", HOW)
def test_whatever_reads_as_open_ends_the_run(rig, how):
    plan, reported = HOW[how]
    ended = rig.sweep(*SHORT, "--world", rig.world(DOOR), "--fault", rig.fault(plan))
    assert ended.code == 4, ended.stderr
    assert f"error: interlock door (person) {reported}" in ended.stderr
    assert rig.outputs() == [True, False], "off, and not on again"
    if reported == "cannot be read at":
        (why,) = (line for line in ended.errors if reported in line)
        assert "which is treated as open: daq" in why, "the instrument that reads it is named"
        assert "check daq, which reads it" in why, "and is what to look at"


INPUTS = {
    "an amplifier's input": ("force_sensor.2.3", ()),
    "a drive's input": ("stage_z.DIN9", ("--stages", "az")),
}


@pytest.mark.thorough
@pytest.mark.parametrize("which", INPUTS)
def test_a_contact_is_read_by_whichever_instrument_has_inputs(rig, which):
    place, options = INPUTS[which]
    plan = contact("opened", MEASURING)
    world = rig.world(f'{DOOR}input = "{place}"\nclosed_is = "low"\n')
    ended = rig.sweep(*SHORT, "--world", world, "--fault", rig.fault(plan), *options)
    assert ended.code == 4, ended.stderr
    assert "interlock door (person) opened at" in ended.errors[0]
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
@pytest.mark.parametrize("place", ["force_sensor.2.3", "daq.501.0"])
def test_a_door_stops_the_bench_while_the_procedure_sits_in_a_blocking_read(rig, place):
    """In real time: the DAQ's answer is lost, and its reader waits for 8 s. The door opens
    meanwhile; where the DAQ reads its contact, that cannot be read."""
    lost = '[[fault]]\ndevice = "daq"\nkind = "silence"\nat = 4\ncommand = "WAV:DATA"\n'
    plan = rig.fault(lost + contact("opened", "acquisition = 4\nafter_s = 0.3\n"))
    world = rig.world(f'{DOOR}input = "{place}"\nclosed_is = "low"\n')
    with rig.served("--world", world, "--fault", plan) as path:
        patient = re.sub(r"(\[daq\][^[]*timeout_s = )[0-9.]+", r"\g<1>8.0", path.read_text())
        longer = "heartbeat_timeout_s = 45.0\n\n[simulation]"
        path.write_text(patient.replace("\n[simulation]", longer, 1))
        ended = rig.run("sweep", "--bench", str(path), "--json", "--no-figures", *SHORT)
    assert ended.code == 4, ended.stderr
    why = "cannot be read at" if place.startswith("daq") else "opened at"
    assert f"error: interlock door (person) {why}" in ended.stderr
    assert rig.outputs() == [True, False]
    (lost_us,) = (line["t_us"] for line in rig.log() if line["value"] == "silence")
    off_us = [line["t_us"] for line in rig.log() if line["what"] == "ch1.on"][-1]
    assert 0 < (off_us - lost_us) * 1e-6 < 7.0, "off before the read came back"


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
        reported = [message for code, message in events(run) if code == "interlock"]
        assert "interlock air pressure (process) opened at" in reported[0]
        assert reported[1] == "interlock air pressure (process) is closed again"


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
def test_a_door_that_opens_behind_a_trip_is_reported_once(rig):
    spike = f'[[fault]]\ndevice = "force_sensor"\nkind = "spike"\n{MEASURING}'
    door = contact("opened", MEASURING, more="after_s = 0.05\n")
    ended = rig.sweep(*SHORT, "--world", rig.world(DOOR), "--fault", rig.fault(spike + door))
    assert ended.code == 4, ended.stderr
    assert "N is over the limit of 40 N" in ended.errors[0]
    assert ended.stderr.count("interlock door (person) opened at ") == 1, ended.stderr
    assert "generator off, force stream stopped" in ended.stderr


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
    assert "'door', which this bench does not have (it has: none)" in ended.errors[0]


# --- a latch outlives its run; in real time ---------------------------------------------------


@contextlib.contextmanager
def served(rig, world, plan=""):
    """A simulated bench in real time, with its bench file bench.toml."""
    options = ("--fault", rig.fault(plan)) if plan else ()
    with rig.served("--world", rig.world(world), *options):
        yield


def at_a_terminal(rig, *arguments):
    """Exit code of a command that a person types at the bench, and what it shows."""
    typist = Typist(rig, *arguments)
    try:
        return typist.ends()
    finally:
        typist.close()


@pytest.mark.thorough
def test_a_latch_outlives_its_run_until_a_person_resets_it_at_the_bench(rig):
    begun = 'move = 1\nof = "stage_z"\n'
    plan = contact("opened", begun) + contact("closed", begun, more="after_s = 2.0\n")
    sweep = ("sweep", "--no-figures", *SHORT)
    with served(rig, DOOR, plan):
        first = rig.run(*sweep)
        assert first.code == 4, first.stderr
        assert "rig interlocks reset --bench bench.toml; then start again" in first.errors[0]
        outputs = rig.outputs()
        rig.await_world("contact", count=2)  # opened, and closed again
        again = rig.run(*sweep, "--results", "elsewhere")
        assert again.code == 4, again.stderr
        assert "interlock door (person) opened at" in again.errors[0]
        assert rig.outputs() == outputs, "nothing was switched on"

        by_a_program = rig.run("interlocks", "reset")
        assert by_a_program.code == 2
        assert "typed at a terminal of the bench's computer" in by_a_program.stderr
        shown = rig.run("interlocks")
        assert re.search(r"door \(person, daq.501.0\): closed; LATCHED since 20", shown.stderr)
        code, reported = at_a_terminal(rig, "interlocks", "reset")
        assert code == 0, reported
        assert "interlock door is reset; nothing starts by itself" in reported
        assert rig.outputs() == outputs
        assert re.search(r"closed; reset 20\S+ by ", rig.run("interlocks").stderr)


def test_an_open_door_is_not_reset_and_a_terminal_elsewhere_resets_nothing(rig):
    with served(rig, DOOR + "closed = false\n"):
        first = rig.run("sweep", "--no-figures", *SHORT)
        assert first.code == 4, first.stderr
        code, reported = at_a_terminal(rig, "interlocks", "reset")
        assert code == 4
        assert "interlock door is open; close it first" in reported
        rig.env["SSH_CONNECTION"] = "10.0.0.1 1 10.0.0.2 22"
        code, reported = at_a_terminal(rig, "interlocks", "reset")
        assert code == 2
        assert "this terminal is on another computer" in reported
        assert "LATCHED" in rig.run("interlocks").stderr


def records(rig):
    """The records of the one contact: one for each name of its instrument's address."""
    found = list(rig.shared.glob("interlock-*.json"))
    assert found
    return found


@pytest.mark.thorough
def test_a_latch_that_could_not_be_recorded_keeps_the_run_from_beginning(rig):
    with served(rig, DOOR):
        assert rig.run("sweep", "--no-figures", *SHORT).code == 0
        before = rig.outputs()
        for record in records(rig):
            # A folder where the new record would be written.
            record.with_name(f".{record.name}.part").mkdir()
        ended = rig.run("sweep", "--no-figures", *SHORT)
    assert ended.code == 1, ended.stderr
    assert "of interlock 'door' cannot be written" in ended.errors[0]
    assert rig.outputs() == before


@pytest.mark.thorough
def test_a_record_that_cannot_be_read_counts_as_a_latch(rig):
    with served(rig, DOOR):
        assert rig.run("sweep", "--no-figures", *SHORT).code == 0
        for record in records(rig):
            record.write_text("{")
        ended = rig.run("sweep", "--no-figures", *SHORT)
    assert ended.code == 4, ended.stderr
    assert "cannot be read" in ended.errors[0]


PROVED = contact("opened", more="after_s = 3.0\n") + contact("closed", more="after_s = 4.0\n")


@pytest.mark.thorough
def test_a_contact_that_is_to_be_proved_is_seen_open_and_closed_before_anything_is_armed(rig):
    world = rig.world(DOOR + "proof = true\n")
    ended = rig.sweep(*SHORT, "--world", world, "--fault", rig.fault(PROVED))
    assert ended.code == 0, ended.stderr
    assert "proof test of interlock door: open it" in ended.stderr
    assert "interlock door opens and closes: recorded" in ended.stderr
    closed = [x["t_us"] for x in rig.log() if x["what"] == "contact"][-1]
    assert min(x["t_us"] for x in rig.log() if x["what"] in ("homing", "move")) > closed


@pytest.mark.thorough
def test_a_contact_that_is_welded_fails_its_proof_test_and_nothing_is_armed(rig):
    plan = contact("stuck-closed") + PROVED
    world = rig.world(DOOR + "proof = true\n")
    ended = rig.sweep(*SHORT, "--world", world, "--fault", rig.fault(plan))
    assert ended.code == 4, ended.stderr
    assert "interlock door was not seen to open within 120 s" in ended.errors[0]
    assert not [x for x in rig.log() if x["what"] in ("homing", "move")]


def test_a_proof_test_is_recorded_with_its_date(rig):
    plan = "".join(  # somebody who opens and closes it again and again
        contact("opened", more=f"after_s = {at_s}\n")
        + contact("closed", more=f"after_s = {at_s + 2}\n")
        for at_s in range(4, 100, 4)
    )
    with served(rig, DOOR, plan):
        assert "last proof test: never" in rig.run("interlocks").stderr
        proved = rig.run("interlocks", "proof", "door")
        assert proved.code == 0, proved.stderr
        assert re.search(r"last proof test: 20\S+ by ", rig.run("interlocks").stderr)


@pytest.mark.parametrize("arguments", [(), ("reset",), ("proof", "door")])
def test_without_a_bench_file_there_is_no_interlock(rig, arguments):
    ended = rig.run("interlocks", *arguments)
    assert ended.code == 2
    reported = "not found" if arguments != ("reset",) else "typed at a terminal"
    assert reported in ended.stderr


# --- in a batch ---------------------------------------------------------------------------------

NIGHT = """
[batch]
name = "night"
figures = false
detect = false

[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [300, 600] }
repeat = 2
"""


@pytest.mark.thorough
def test_a_batch_ends_at_an_opened_door_and_continues_only_after_reset_and_resume(rig):
    (rig.folder / "night.toml").write_text(NIGHT)
    plan = contact("opened", MEASURING) + contact("closed", MEASURING, more="after_s = 2.0\n")
    with served(rig, DOOR, plan):
        ended = rig.run("batch", "run", "night.toml", "--bench", "bench.toml")
        assert ended.code == 4, ended.stderr
        status = rig.run("batch", "status")
        assert "rig interlocks reset --bench" in status.stdout + status.stderr
        outputs = rig.outputs()
        assert outputs == [True, False], "no second try, no second run"
        again = rig.run("batch", "resume")
        assert again.code == 4, again.stderr
        assert rig.outputs() == outputs
        assert at_a_terminal(rig, "interlocks", "reset")[0] == 0
        assert rig.outputs() == outputs, "the reset starts nothing"
        done = rig.run("batch", "resume")
        assert done.code == 0, done.stderr


# --- by hand ------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_an_opened_door_ends_jogging_and_nothing_can_be_jogged_until_the_reset(rig):
    """On the command's own bench; bench time passes no faster than real time."""
    plan = rig.fault(contact("opened", more="after_s = 2.0\n"))
    jog = Typist(
        rig, "jog", "--world", rig.world(DOOR), "--fault", plan, "--world-log", str(rig.world_log)
    )
    try:
        code, shown = jog.ends()
    finally:
        jog.close()
    assert code == 4, shown
    assert "interlock door (person) opened at 2.0" in shown
    assert "every axis is at rest" in shown
    with served(rig, DOOR + "closed = false\n"):
        jog = Typist(rig, "jog", "--bench", "bench.toml")
        try:
            code, shown = jog.ends()
        finally:
            jog.close()
    assert code == 4, shown
    assert "rig interlocks reset --bench bench.toml" in shown.replace("\r\n", "")


@pytest.mark.thorough
def test_a_door_that_is_opened_and_closed_between_two_runs_ends_the_batch(rig):
    (rig.folder / "night.toml").write_text(NIGHT + "rest_s = 60\n")
    after_the_first_run = 'move = 4\nof = "stage_z"\nafter_s = '
    plan = contact("opened", f"{after_the_first_run}20.0\n") + contact(
        "closed", f"{after_the_first_run}22.0\n"
    )
    with served(rig, DOOR, plan):
        ended = rig.run("batch", "run", "night.toml", "--bench", "bench.toml")
        assert ended.code == 4, ended.stderr
        assert rig.outputs() == [True, False], "the second run has not begun"
        assert "LATCHED" in rig.run("interlocks").stderr
