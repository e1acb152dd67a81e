"""What a run has to do about force and motion, through the real command: trips, holds, preload."""

from __future__ import annotations

import re
import signal
import time

import pytest

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

SHORT = ("--frequencies", "300,600")
LISTENING = 2
"""Acquisitions before the first point: the record before anything vibrates, on two ranges."""


def moves(rig):
    """Targets of the z stage in the World's log."""
    return [
        line["value"]["target_mm"]
        for line in rig.log()
        if line["device"] == "stage_z" and line["what"] == "move"
    ]


def rest(rig):
    """Where the z stage came to rest last."""
    stood = [x["value"] for x in rig.log() if (x["device"], x["what"]) == ("stage_z", "at-rest")]
    return stood[-1]


def spikes(*acquisitions, force_N=30.0, after_s=0.0):
    """A fault plan of pushes on the probe."""
    return "".join(
        f'[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nacquisition = {number}\n'
        f"force_N = {force_N}\nfor_s = 0.02\nafter_s = {after_s}\n"
        for number in acquisitions
    )


@pytest.mark.thorough
def test_a_sweep_presses_holds_and_parks(rig):
    ended = rig.sweep(*SHORT)
    assert ended.code == 0, ended.stderr
    assert moves(rig)[-1] == pytest.approx(5.0)
    assert rest(rig) == pytest.approx(5.0, abs=0.02)
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.column("preload") == pytest.approx(25.0, rel=0.02)
        assert run.column("load_amplitude") == pytest.approx(1.0, rel=0.01)


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.stages("festo", because="the push has to fall into the approach")
def test_a_push_in_free_air_is_no_contact_and_the_stage_does_not_hunt_for_the_preload(rig):
    push = '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\n'
    plan = rig.fault(push + SEARCHING + "after_s = 0.8\nforce_N = 2.1\nfor_s = 0.16\n")
    ended = rig.sweep(*SHORT, "--preload", "23.6N", "--fault", plan)
    assert ended.code == 0, ended.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        said = [message.decode() for message in run.entry["events/message"][()]]
        assert "the contact was not confirmed: the approach continues" in said
        assert run.column("preload") == pytest.approx(23.6, rel=0.02)
    stood = [x for x in rig.log() if (x["device"], x["what"]) == ("stage_z", "at-rest")]
    assert len(stood) < 25


@pytest.mark.thorough
def test_a_force_over_its_limit_trips_and_the_point_is_retaken_once(rig):
    ended = rig.sweep(*SHORT, "--fault", rig.fault(spikes(LISTENING + 2)))
    assert ended.code == 0, ended.stderr
    assert "over the limit of 40 N" in ended.stderr
    assert "retaking point 300Hz-1N once" in ended.stderr
    assert rig.outputs() == [True, False, True, False]
    assert [round(mm) for mm in moves(rig)].count(5) == 4, (
        "parked first, after the trip, at the end"
    )
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.point_ids() == ["300Hz-1N", "600Hz-1N"]
        assert b"trip" in run.entry["events/code"][()].tolist()


def test_a_second_trip_ends_the_run(rig):
    again = range(LISTENING + 2, LISTENING + 13)
    ended = rig.sweep(*SHORT, "--fault", rig.fault(spikes(*again)))
    assert ended.code == 4
    assert len(ended.errors) == 1
    assert "over the limit" in ended.errors[0]
    assert rig.outputs()[-1] is False
    assert rest(rig) == pytest.approx(5.0, abs=0.02)


@pytest.mark.thorough
def test_points_kept_before_a_force_trip_survive_a_second_trip(rig):
    frequencies = [300 + 100 * k for k in range(10)]
    asked = ("--frequencies", ",".join(map(str, frequencies)))
    again = range(LISTENING + 11, LISTENING + 51)
    ended = rig.sweep(*asked, "--fault", rig.fault(spikes(*again)))
    reported = re.findall(r"^\d+/10 (\S+)$", ended.stderr, re.MULTILINE)

    assert ended.code == 4, ended.stderr
    assert "once" in ended.stderr
    assert rig.outputs()[-1] is False
    assert rest(rig) == pytest.approx(5.0, abs=0.02)
    assert 1 <= len(reported) < 10
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.point_ids() == reported == [f"{f}Hz-1N" for f in frequencies[: len(reported)]]
        assert run.outcome.status == "failed"
        assert b"trip" in run.entry["events/code"][()].tolist()


@pytest.mark.thorough
def test_a_trip_acts_while_the_procedure_sits_in_a_blocking_read(rig):
    """In real time: the DAQ's answer is lost, its reader waits 2 s; the force rises meanwhile."""
    path = rig.folder / "a-bench.toml"
    fault = rig.fault(
        f'[[fault]]\ndevice = "daq"\nkind = "silence"\nat = {LISTENING + 2}\ncommand = "WAV:DATA"\n'
        + spikes(LISTENING + 2, after_s=0.3)
    )
    serving = rig.start(
        "simulate", "--write", str(path), "--world-log", str(rig.world_log),
        "--fault", fault,
    )  # fmt: skip
    serving.wait_for("Ctrl-C ends it")
    patient = re.sub(r"(\[daq\][^[]*timeout_s = )[0-9.]+", r"\g<1>2.0", path.read_text())
    patient = patient.replace("communication_timeout_ms = 2000", "communication_timeout_ms = 5000")
    path.write_text(patient)
    ended = rig.run("sweep", "--bench", str(path), "--json", "--no-figures", *SHORT)
    serving.send(signal.SIGINT)
    serving.finish()

    assert ended.code == 0, ended.stderr
    assert "over the limit" in ended.stderr
    log = rig.log()
    (spike,) = [line for line in log if line["value"] == "spike"]
    off = next(
        line
        for line in log
        if line["what"] == "ch1.on" and not line["value"] and line["t_us"] > spike["t_us"]
    )
    assert (off["t_us"] - spike["t_us"]) * 1e-6 < 1.2, "off before the read came back"
    away = next(
        line
        for line in log
        if line["what"] == "move" and line["device"] == "stage_z" and line["t_us"] > spike["t_us"]
    )
    assert away["t_us"] >= off["t_us"]
    assert away["value"]["target_mm"] == pytest.approx(5.0)


def be_patient(bench_file):
    """Time-outs that a busy computer does not meet, of links, drives and the guard."""
    text = re.sub(r"timeout_s = [0-9.]+", "timeout_s = 4.0", bench_file.read_text())
    text = text.replace("communication_timeout_ms = 2000", "communication_timeout_ms = 10000")
    text = text.replace("\n[simulation]", "heartbeat_timeout_s = 45.0\n\n[simulation]", 1)
    bench_file.write_text(text)


@pytest.mark.thorough
def test_a_hold_makes_safe_and_the_point_is_retaken_when_it_is_over(rig):
    """Ctrl-Z pauses; the same again lets it go on."""
    with rig.served() as path:
        be_patient(path)
        sweep = rig.start(
            "sweep", "--bench", str(path), "--json", "--no-figures",
            "--frequencies", "2,300", "--settling", "2s",
        )  # fmt: skip
        rig.await_world("ch1.on", True)
        sweep.send(signal.SIGTSTP)
        sweep.wait_for(r"^PAUSED \(bench is safe\)")
        safe = rig.outputs()
        assert safe[-1] is False
        sweep.send(signal.SIGTSTP)
        ended = sweep.finish()
    assert ended.code == 0, ended.stderr
    assert_switched_off_between(rig, more_than=safe)
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.point_ids() == ["2Hz-1N", "300Hz-1N"]
        assert b"hold" in run.entry["events/code"][()].tolist()


def assert_switched_off_between(rig, more_than=(True, False)):
    """In real time a busy computer may add a hold: on again more often, but never without off."""
    outputs = rig.outputs()
    assert len(outputs) > len(more_than)
    assert outputs == [True, False] * (len(outputs) // 2)


SEARCHING = 'move = 3\nof = "stage_z"\n'
"""Tasks of the stage: parked, close to the film, and down until it is felt, which takes 3 s; then
it presses. The next one is the way up."""
MEASURING = "acquisition = 10\n"
"""A record of a slow point, the film pressed and vibrating."""


def silence(moment, for_s):
    """A fault plan: the force sensor sends nothing from a moment on, for so long."""
    return f'[[fault]]\ndevice = "force_sensor.stream"\nkind = "silence"\n{moment}for_s = {for_s}\n'


def held(run):
    """How many holds the file reports."""
    return run.entry["events/code"][()].tolist().count(b"hold")


SILENT = {
    "while a point is taken": (MEASURING, 0.6, [True, False, True, False]),
    "for longer than parking takes": (MEASURING, 4.0, [True, False, True, False]),
    "on the way to contact": (SEARCHING, 1.0, [True, False]),
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", SILENT)
def test_a_force_sensor_that_is_silent_for_a_while_is_a_hold(rig, case):
    moment, for_s, outputs = SILENT[case]
    asked = ("--frequencies", "2,3,300", "--order", "descending")
    ended = rig.sweep(*asked, "--fault", rig.fault(silence(moment, for_s)))

    assert ended.code == 0, ended.stderr
    assert "hold: the force sensor is silent; the bench is safe" in ended.stderr
    assert "Resumed." in ended.stderr
    assert "the film may still be pressed" not in ended.stderr
    assert rig.outputs() == outputs
    assert [round(mm) for mm in moves(rig)].count(5) == 4, "parked, on hold, to start anew, at last"
    assert rest(rig) == pytest.approx(5.0, abs=0.02)
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.outcome.status == "complete"
        assert run.point_ids() == ["2Hz-1N", "3Hz-1N", "300Hz-1N"]
        assert held(run) == 1
        assert run.column("preload").min() > 24, "pressed anew, though it creeps"


def test_a_run_does_not_continue_after_a_hold_that_left_the_film_pressed(rig):
    """The sensor falls silent while a point is taken; something presses on it when the stage has
    gone up for the hold, and no longer when the hold is over."""
    push = '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nforce_N = 3.0\n'
    pressed = f'{push}for_s = 3.0\nmove = 4\nof = "stage_z"\nafter_s = 0.3\n'
    plan = rig.fault(f"{silence(MEASURING, 0.6)}\n{pressed}")
    ended = rig.sweep("--frequencies", "2,3,300", "--order", "descending", "--fault", plan)

    assert ended.code == 7, ended.stderr
    (reported,) = [line for line in ended.errors if "is still pressed with" in line]
    assert reported.startswith("error: stage_z: unload: the film is still pressed with ")
    assert "Resumed." not in ended.stderr
    assert "Bench is stopped, but the film is still pressed with" in ended.stderr
    assert rig.outputs() == [True, False], "not switched on again"
    assert [round(mm) for mm in moves(rig)].count(5) == 2, "parked, and up for the hold"
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.outcome.status == "failed"
        assert held(run) == 1


@pytest.mark.thorough
def test_a_contact_that_stays_loose_ends_the_run_with_its_counts(rig):
    """The force sensor is silent for half a second again and again, each time while the skin is
    pressed (12 s after the run's begin, then 7 to 10 s after a gap): no trial is completed."""
    gaps = "".join(silence(f"after_s = {seconds}\n", 0.5) for seconds in range(14, 300, 8))
    ended = rig.run(
        *("slip-trial", "--json", "--no-figures", "--fault", rig.fault(gaps)),
        *("--world-log", str(rig.world_log)),
    )

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert "6 holds at trial-001, the limit is 5 ([holds] per_point of the bench file)" in error
    assert "check the sensor's plug and cable, " in error
    assert ended.object["holds"] == 6
    assert ended.object["presses"] <= 6
    assert rest(rig) == pytest.approx(5.0, abs=0.02)


@pytest.mark.thorough
def test_a_force_sensor_that_is_silent_while_the_stage_is_homed_is_a_hold(rig):
    """There is no way back yet to a place that nobody knows, and nothing is pressed."""
    ended = rig.sweep(*SHORT, "--fault", rig.fault(silence("at = 3\n", 0.6)))

    assert ended.code == 0, ended.stderr
    assert "hold: the force sensor is silent; the bench is safe" in ended.stderr
    stage = [line["what"] for line in rig.log() if line["device"] == "stage_z"]
    assert stage.count("homing") == 2
    assert rest(rig) == pytest.approx(5.0, abs=0.02)
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.point_ids() == ["300Hz-1N", "600Hz-1N"]
        assert held(run) == 1


@pytest.mark.thorough
def test_a_force_sensor_that_stays_silent_ends_the_run(rig):
    asked = ("--frequencies", "2,3,300", "--order", "descending")
    ended = rig.sweep(*asked, "--fault", rig.fault(silence(MEASURING, 60.0)))

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert re.match(r"error: force_sensor: stream: no frame for 5(\.[01])? s; ", error)
    assert rig.outputs() == [True, False]
    assert rest(rig) == pytest.approx(5.0, abs=0.02)
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.point_ids() == ["300Hz-1N"]
        assert held(run) == 1


def test_a_hold_that_came_and_went_within_one_blocking_call_is_acted_on(rig):
    """In real time: the bench stands still for a while and answers late; its frames come late too,
    none is lost."""
    with rig.served() as path:
        be_patient(path)
        sweep = rig.start(
            "sweep", "--bench", str(path), "--json", "--no-figures", "--frequencies", "300,600"
        )
        rig.await_world("ch1.on", True)
        rig.serving.send(signal.SIGSTOP)
        time.sleep(1.0)
        rig.serving.send(signal.SIGCONT)
        ended = sweep.finish()

    assert ended.code == 0, ended.stderr
    assert "hold: the force sensor is silent; the bench is safe" in ended.stderr
    assert_switched_off_between(rig)
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.point_ids() == ["300Hz-1N", "600Hz-1N"]
        assert held(run) >= 1


@pytest.mark.thorough
def test_a_hold_that_came_and_went_while_a_call_timed_out_has_the_point_retaken(rig):
    """In real time: the DAQ's answer is lost; Ctrl-Z twice while its reader waits for it.

    A busy computer may deliver two Ctrl-Z as one, which pauses. The SIGCONT afterwards lets a
    paused run continue and changes nothing otherwise.
    """
    path = rig.folder / "a-bench.toml"
    lost = (
        f'[[fault]]\ndevice = "daq"\nkind = "silence"\nat = {LISTENING + 1}\ncommand = "WAV:DATA"\n'
    )
    serving = rig.start(
        "simulate", "--write", str(path), "--world-log", str(rig.world_log),
        "--fault", rig.fault(lost),
    )  # fmt: skip
    serving.wait_for("Ctrl-C ends it")
    be_patient(path)
    impatient = re.sub(r"(\[daq\][^[]*timeout_s = )[0-9.]+", r"\g<1>6.0", path.read_text())
    path.write_text(impatient)
    sweep = rig.start("sweep", "--bench", str(path), "--json", "--no-figures", *SHORT)
    rig.await_world("injected", "silence")  # the reader waits from now on, for 6 s
    for _ in range(2):
        sweep.send(signal.SIGTSTP)
        time.sleep(0.2)
    sweep.wait_for("(?i)paused")
    sweep.send(signal.SIGCONT)
    ended = sweep.finish()
    serving.send(signal.SIGINT)
    serving.finish()

    assert ended.code == 0, ended.stderr
    assert "PAUSED (bench is safe)" in ended.stderr
    assert ended.errors == []
    assert_switched_off_between(rig)
    with RunFile.open(rig.only("*.h5")) as run:
        assert run.point_ids() == ["300Hz-1N", "600Hz-1N"]


@pytest.mark.parametrize(
    ("world", "options", "code", "reported"),
    [
        ("clamp.contact_mm = 13.5", (), 3, "no contact is felt down to 13 mm"),
        *(
            pytest.param(*case, marks=pytest.mark.thorough)
            for case in (
                ("clamp.contact_mm = 11.0", (), 3, "before any contact can be (contact_from_mm"),
                ("clamp.stiffness_N_mm = 10.0", (), 4, "deeper than contact_to_mm = 13 mm"),
                ("force_sensor_zero_mV_V = [0.0, 0.0, 3.7]", (), 3, "are saturated"),
                ("", ("--load", "20N"), 4, "not below 0.8 of --preload 25 N"),
                ("", ("--preload", "60N"), 4, "outside -40 to 40 N"),
                ("", ("--load", "19N", "--preload", "30N"), 4, "outside -40 to 40 N"),
            )
        ),
    ],
    ids=[
        "never felt", "in mid-air", "beyond the stage", "saturated",
        "load above preload", "preload above limit", "both above limit",
    ],
)  # fmt: skip
def test_what_is_wrong_with_the_preload_ends_in_one_line(rig, world, options, code, reported):
    ended = rig.sweep(*SHORT, *options, "--world", rig.world(world))
    assert ended.code == code, ended.stderr
    assert len(ended.errors) == 1, ended.stderr
    assert reported in ended.errors[0]
    assert True not in rig.outputs()


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "reported"),
    [("drive-fault", "the axis did not follow"), ("reference-lost", "lost its reference")],
)
def test_a_drive_that_fails_on_the_way_to_the_preload_is_reported_in_one_line(rig, kind, reported):
    plan = f'[[fault]]\ndevice = "stage_z"\nkind = "{kind}"\n{SEARCHING}after_s = 1.0\n'
    ended = rig.sweep(*SHORT, "--fault", rig.fault(plan))
    assert ended.code == 3, ended.stderr
    assert len(ended.errors) == 1, ended.stderr
    assert reported in ended.errors[0]
    assert True not in rig.outputs()


@pytest.mark.thorough
def test_a_drive_that_fails_while_the_film_vibrates_is_noticed_within_a_record(rig):
    """The procedure sits in a record of a second and asks the stage nothing."""
    plan = f'[[fault]]\ndevice = "stage_z"\nkind = "drive-fault"\n{MEASURING}'
    sweep = ("--frequencies", "2,3,300", "--order", "descending")
    ended = rig.sweep(*sweep, "--fault", rig.fault(plan))
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith(f"error: stage_z: {rig.bench.z.fault}")
    assert "the axis did not follow" in error
    assert rig.outputs() == [True, False]
    (fault,) = [e["t_us"] for e in rig.log() if (e["device"], e["what"]) == ("stage_z", "fault")]
    off = [e["t_us"] for e in rig.log() if e["what"] == "ch1.on"][-1]
    assert 0 <= (off - fault) * 1e-6 < rig.bench.z.asked_every_s + 0.02
    assert verify(rig.only("*.h5")) == []


@pytest.mark.thorough
def test_a_sensor_that_freezes_while_the_film_is_pressed_ends_the_run_at_once(rig):
    """Without it the stage would press on, to the drive's torque limit."""
    lasting = SEARCHING + "after_s = 2.1\nfor_s = 2.0\n"
    plan = f'[[fault]]\ndevice = "force_sensor"\nkind = "frozen"\n{lasting}'
    ended = rig.sweep(*SHORT, "--fault", rig.fault(plan))
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: force_sensor: stream: 20 frames in a row are the same")
    log = rig.log()
    (frozen_us,) = [x["t_us"] for x in log if x["what"] == "injected"]
    stopped_us = next(x["t_us"] for x in log if x["what"] == "stop" and x["t_us"] > frozen_us)
    assert stopped_us - frozen_us <= 40_000
    assert rest(rig) == pytest.approx(5.0, abs=0.02)


@pytest.mark.thorough
def test_a_trip_on_the_way_up_is_reported_and_the_way_up_continues(rig):
    """The points are taken, the stage is half way up: stopping there would leave the film pressed
    where it cannot be seen why."""
    push = '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nforce_N = 60.0\n'
    plan = rig.fault(f'{push}move = 4\nof = "stage_z"\nafter_s = 0.3\n')
    ended = rig.sweep(*SHORT, "--fault", plan)

    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert "N is over the limit of 40 N" in error
    assert ended.object["points_done"] == 2
    assert "may still be pressed" not in ended.stderr
    assert moves(rig)[-2:] == [pytest.approx(5.0)] * 2, "stopped, and gone on with"
    assert rest(rig) == pytest.approx(5.0, abs=0.02)


@pytest.mark.thorough
def test_a_gap_in_the_force_stream_ends_the_run(rig):
    ended = rig.sweep("--frequencies", "2,3,4", "--fault", rig.fault(silence(SEARCHING, 0.08)))
    assert ended.code == 3, ended.stderr
    assert "the stream has a gap" in ended.errors[0]
    assert rig.outputs()[-1:] != [True]
    assert rest(rig) == pytest.approx(5.0, abs=0.02)


@pytest.mark.thorough
def test_the_wrong_fixture_is_refused_before_any_motion(rig):
    with rig.served() as path:
        path.write_text(path.read_text().replace('"film-clamp"', '"plate"'))
        ended = rig.run("sweep", "--no-figures", *SHORT)
    assert ended.code == 2
    assert "the bench has the plate mounted" in ended.stderr
    assert moves(rig) == []
