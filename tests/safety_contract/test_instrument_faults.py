"""Instruments that fall silent, lie, or go away: one line, safe, exit 3; worse is exit 7."""

from __future__ import annotations

import itertools
import re

import pytest
from tiers import mostly_nightly

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

FREQUENCIES = ("--frequencies", "20,210,310,410,510")
KINDS = ("silence", "garbage", "close", "truncate", "stale")
IN_THE_MIDDLE = 14
"""Of the records of this sweep, and so of every command of a record, one after its first point and
before its last."""
SWITCHING_OFF = 3
"""The generator is switched off when it is connected, before it is switched on, and at the end."""


POINTS = [f"{frequency}Hz-1N" for frequency in FREQUENCIES[1].split(",")]


def assert_points_are_kept(rig, ended):
    """Those that were taken before, all of them and no other, and at least one of five."""
    reported = re.findall(r"^\d/5 (.*)$", ended.stderr, re.MULTILINE)
    assert 1 <= len(reported) < 5
    assert reported == POINTS[: len(reported)]
    assert ended.object["points_done"] == len(reported)
    assert verify(rig.only("*.h5")) == []
    with RunFile.open(rig.only("*.h5")) as run:
        assert list(run.point_ids()) == reported


DAQ_FAULTS = list(itertools.product(KINDS, ("WAV:DATA", "DIG", "WAV:COMP")))
"""What the driver does with each kind at each request is walked by its contract
(tests/drivers/role_contract)."""


@pytest.mark.parametrize(
    "fault",
    mostly_nightly(
        DAQ_FAULTS,
        [("truncate", "WAV:DATA"), ("close", "DIG"), ("close", "WAV:COMP")],
        [("silence", "WAV:DATA")],
    ),
    ids="-".join,
)
def test_a_daq_that_fails_once_ends_the_run_safely(rig, fault):
    kind, command = fault
    plan = f'[[fault]]\ndevice = "daq"\nkind = "{kind}"\ncommand = "{command}"\n'
    plan += f"at = {IN_THE_MIDDLE}\n"
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: daq: ")
    assert command in error
    assert "; " in error, "the remedy follows the cause"
    assert rig.outputs() == [True, False]
    assert_points_are_kept(rig, ended)


@pytest.mark.parametrize("kind", mostly_nightly(KINDS[:4], ["close", "garbage"]))
def test_a_generator_that_fails_once_is_still_switched_off(rig, kind):
    plan = f'[[fault]]\ndevice = "generator"\nkind = "{kind}"\ncommand = "SOUR1:FREQ"\nat = 4\n'
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: generator: SOUR1:FREQ")
    assert rig.outputs() == [True, False]
    assert SAFE in ended.stderr


SAFE = "Bench is safe: generator off, preload released, force stream stopped."
DONE = "Bench is NOT safe (see above); done: preload released, force stream stopped."
SLOW = ("--frequencies", "2,3,4,5,300", "--order", "descending")
SLOW_POINTS = [f"{frequency}Hz-1N" for frequency in (300, 5, 4, 3, 2)]
"""Slow enough for stage and force sensor to be asked and heard many times after the first point."""
WHILE_TAKING = {"acquisition": 12}
"""In the middle of them."""
ON_THE_WAY_BACK = {"move": 4, "after_s": 0.3}
"""Of the stage, after the last point: it was parked, came close, and pressed."""


def plan_of(device, kind, command="", **keys):
    reported = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return f'[[fault]]\ndevice = "{device}"\nkind = "{kind}"\ncommand = "{command}"\n{reported}'


def assert_ended_safely(rig, ended, device, points=SLOW_POINTS, least=1):
    """One line, exit 3, nothing vibrates or moves, the file holds the points that were reported."""
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith(f"error: {device}: ")
    assert "; " in error, "the remedy follows the cause"
    assert "NOT SAFE" not in ended.stderr
    assert rig.outputs()[-1:] != [True]
    stage = [entry for entry in rig.log() if entry["device"] == "stage_z"]
    motion = [entry["what"] for entry in stage if entry["what"] in ("move", "homing", "at-rest")]
    assert motion[-1:] != ["move"]
    reported = re.findall(r"^\d/5 (.*)$", ended.stderr, re.MULTILINE)
    assert least <= len(reported) < 5
    assert reported == points[: len(reported)]
    assert verify(rig.only("*.h5")) == []
    with RunFile.open(rig.only("*.h5")) as run:
        assert sorted(run.point_ids()) == sorted(reported)


@pytest.mark.parametrize("kind", mostly_nightly(KINDS, ["silence", "stale", "close"]))
def test_a_stage_that_fails_once_ends_the_run_safely(rig, kind):
    plan = plan_of("stage_z", kind, **WHILE_TAKING)
    ended = rig.sweep(*SLOW, "--fault", rig.fault(plan))
    assert_ended_safely(rig, ended, "stage_z")


@pytest.mark.thorough
def test_a_connection_that_breaks_on_the_way_back_is_made_anew_and_the_film_is_lifted(rig):
    ended = rig.sweep(*SLOW, "--fault", rig.fault(plan_of("stage_z", "close", **ON_THE_WAY_BACK)))
    assert ended.code == 0, ended.stderr
    assert ended.object["points_done"] == 5
    assert "warning: on the way up: stage_z: " in ended.stderr
    assert "it was asked again and the film lifted: z is at 5.0" in ended.stderr
    stage = [(x["what"], x["value"]) for x in rig.log() if x["device"] == "stage_z"]
    moves = [(what, value) for what, value in stage if what in ("move", "at-rest")]
    assert moves[-1] == ("at-rest", pytest.approx(5.0, abs=0.02))


@pytest.mark.parametrize(
    "kind", mostly_nightly(["garbage", "close", "silence", "truncate"], ["close", "truncate"])
)
def test_a_force_stream_that_breaks_ends_the_run_safely_with_the_film_unloaded(rig, kind):
    """Half a batch may end with a whole frame: so few that are missing are no gap yet. Frames that
    are missing are a hold first, for they may be late."""
    lasting = {"for_s": 0.08} if kind in ("silence", "truncate") else {}
    plan = plan_of("force_sensor.stream", kind, **WHILE_TAKING, **lasting)
    ended = rig.sweep(*SLOW, "--fault", rig.fault(plan))
    assert_ended_safely(rig, ended, "force_sensor")
    parked = [x["value"] for x in rig.log() if (x["device"], x["what"]) == ("stage_z", "at-rest")]
    assert parked[-1] == pytest.approx(5.0, abs=0.02)
    assert "may still be pressed" not in ended.stderr


@pytest.mark.thorough
def test_frames_that_come_late_disturb_nothing(rig):
    plan = plan_of("force_sensor.stream", "stale", **WHILE_TAKING, count=5)
    ended = rig.sweep(*SLOW, "--fault", rig.fault(plan))
    assert ended.code == 0, ended.stderr
    assert ended.object["points_done"] == 5
    assert ended.object["warnings"] == []


START, STOP = "24", "23"
"""Requests to the amplifier that begin and end its stream."""


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["silence", "garbage", "close", "truncate", "stale"])
def test_a_force_sensor_that_fails_to_start_ends_the_run_before_any_motion(rig, kind):
    ended = rig.sweep(*SLOW, "--fault", rig.fault(plan_of("force_sensor", kind, START)))
    assert_ended_safely(rig, ended, "force_sensor", least=0)
    assert ended.object["points_done"] == 0
    assert "move" not in {entry["what"] for entry in rig.log()}


@pytest.mark.thorough
def test_a_force_stream_that_cannot_be_ended_is_reported_but_leaves_nothing_unsafe(rig):
    """A sensor drives nothing. The stream is ended when it is connected, and at the end."""
    ended = rig.sweep(
        *FREQUENCIES, "--fault", rig.fault(plan_of("force_sensor", "silence", STOP, at=2))
    )
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: force stream: force_sensor: StopTransmission: no answer")
    assert "Bench is safe: generator off, preload released." in ended.stderr
    assert ended.object["points_done"] == 5
    assert verify(rig.only("*.h5")) == []


@pytest.mark.thorough
def test_an_off_that_fails_too_is_reported_after_the_first_cause(rig):
    plan = (
        f'[[fault]]\ndevice = "daq"\nkind = "silence"\ncommand = "DIG"\n'
        f"at = {IN_THE_MIDDLE}\n"
        '[[fault]]\ndevice = "generator"\nkind = "silence"\ncommand = "OUTP1 0"\n'
        f"at = {SWITCHING_OFF}\ncount = 0\n"
    )
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 7, ended.stderr
    first, second = ended.errors
    assert first.startswith("error: daq: DIG")
    assert "NOT SAFE: generator output" in second
    assert DONE in ended.stderr, "the other shutdown actions still ran"
    assert "the guard could not make the bench safe either" in ended.stderr
    assert_points_are_kept(rig, ended)


def test_an_off_that_fails_once_is_done_by_the_guard(rig):
    plan = (
        f'[[fault]]\ndevice = "daq"\nkind = "silence"\ncommand = "DIG"\n'
        f"at = {IN_THE_MIDDLE}\n"
        '[[fault]]\ndevice = "generator"\nkind = "silence"\ncommand = "OUTP1 0"\n'
        f"at = {SWITCHING_OFF}\ncount = 1\n"
    )
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 7, ended.stderr
    assert "the guard then made the bench safe" in ended.stderr
    assert rig.outputs()[-1] is False


DEVICES = ("generator", "daq", "stage_z", "force_sensor")


def test_a_bench_that_does_not_answer_at_all_is_reported_with_every_device(rig):
    plan = "".join(
        f'[[fault]]\ndevice = "{device}"\nkind = "silence"\ncount = 0\n' for device in DEVICES
    )
    ended = rig.sweep(*FREQUENCIES, "--fault", rig.fault(plan))

    assert ended.code == 3
    wanted = ("generator: *IDN?", "daq: *IDN?", "stage_z: ", "force_sensor: ")
    for error, words in zip(ended.errors, wanted, strict=True):
        assert words in error
    assert not list(rig.results.rglob("*.h5"))


@pytest.mark.thorough
def test_a_film_that_is_not_connected_is_reported(rig):
    unconnected = rig.world('film = "open-circuit"\n')
    ended = rig.sweep(*FREQUENCIES, "--longest-point", "2s", "--world", unconnected)

    assert ended.code == 3
    (error,) = ended.errors
    assert "film: signal at 20 Hz" in error
    assert "no more than noise" in error
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
def test_a_point_whose_time_is_over_after_the_first_look_names_the_time_that_it_may_take(rig):
    ended = rig.sweep("--frequencies", "0.1")

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert "response at 0.1 Hz under 1 N: not measured within 20 s (--longest-point)" in error
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
def test_a_load_that_is_never_steady_is_reported_when_the_time_of_its_point_is_over(rig):
    """The load cell's channel also carries 0.3 N at 283 Hz: a beat no two short records agree on,
    for as long as hundreds of them take."""
    beat = "[load_cell_input]\nmains_amplitude_mV = 30.0\nmains_frequency_Hz = 283.0\n"
    asked = ("--frequencies", "300", "--longest-point", "12s")
    ended = rig.sweep(*asked, "--world", rig.world(beat))

    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert error.startswith("error: generator: load at 300 Hz: ")
    assert "N after 12 s, 1 N ± 1 % wanted (--longest-point, --load-tolerance); check" in error
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
def test_a_saturated_input_is_reported_and_the_points_before_it_are_kept(rig):
    ended = rig.sweep(*FREQUENCIES, "--world", rig.world("film_gain = 500\n"))

    assert ended.code == 3
    (error,) = ended.errors
    assert "channel film at 210 Hz" in error
    assert "10 V range" in error, "the largest one has been tried"
    assert "choose a smaller load" in error
    assert ended.object["points_done"] == 1
    assert rig.outputs() == [True, False]
