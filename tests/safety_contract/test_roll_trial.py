"""`rig roll-trial` through the real command: both patterns, the axis, and what can go wrong."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest
from nexusformat.nexus.validate import validate_application, validate_file

from rig.files.definitions import definition_path
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

ROLLER = 'shape = "cylinder", radius_mm = 30.0'
"""What the reference figures belong to (decision 0020)."""
QUIET = "strip_input = { noise_density_V_sqrtHz = 1e-7, mains_amplitude_mV = 0.0 }\n"
SHORT = ("--rest", "100ms", "--stay", "100ms")


def roller(offset_mm):
    return f"head = {{ body = {{ {ROLLER} }}, axis_offset_mm = {offset_mm} }}\n"


def roll(rig, world, *given):
    """A roll at the usual speed, or at what is the same in targets a degree."""
    usual = "--stay", "100ms", "--turn-speed", f"{0.12 * rig.bench.both_Hz}"
    turn = () if "--profile-times" in given else usual  # a curve of angles has its own
    return rig.run(
        "roll-trial", "--json", "--no-figures", "--world-log", str(rig.world_log),
        "--world", rig.world(world), "--rest", "100ms", *turn, *given,
    )  # fmt: skip


def moves(rig, device):
    return [entry for entry in rig.log() if entry["device"] == device]


def assert_off_the_object(rig):
    """Lifted, and nothing moves any more."""
    z = [e for e in moves(rig, "stage_z") if e["what"] in ("move", "at-rest")]
    assert z[-1]["what"] == "at-rest"
    assert z[-1]["value"] == pytest.approx(5.0, abs=0.01)
    touched = [e["what"] for e in rig.log() if e["what"] in ("touch-down", "lift-off")]
    assert touched[-1:] != ["touch-down"]


def the_reading(rig):
    with RunFile.open(rig.only("*.h5")) as run:
        (reading,) = run.readings()
        return reading


@pytest.mark.parametrize(
    ("stages", "speed"),
    [
        pytest.param("festo", "", marks=pytest.mark.nightly),
        pytest.param("az", "3 deg/s", marks=pytest.mark.nightly),
        pytest.param("festo-az", "5.71 deg/s", marks=pytest.mark.nightly),
        ("az-festo", "5.71 deg/s"),
    ],
)
def test_a_roll_with_default_settings_is_valid_on_every_model_of_stage(rig, stages, speed):
    """The turn is as much slower as the servo has fewer ticks, and that is said."""
    ended = rig.run("roll-trial", "--json", "--no-figures", *SHORT, "--stages", stages)
    assert ended.code == 0, ended.stderr
    reported = [line for line in ended.stderr.splitlines() if "the object is turned at" in line]
    assert len(reported) == (speed != "")
    assert all(f"turned at {speed} and not at 12 deg/s" in line for line in reported)
    assert "--turn-speed" in "".join(reported) or not speed


@pytest.mark.thorough
@pytest.mark.stages("festo", because="its servo does not hold the force at the speed of Figure 19")
@pytest.mark.parametrize(
    ("start", "v_1", "v_2"), [("-5", 5.7, -5.7), ("-6.5", -11.7, -14.3)], ids=["19b", "19a"]
)
def test_both_patterns_of_a_roll(rig, start, v_1, v_2):
    """Signs of Figure 19, and of 19 b that it is even; sizes of the model's raised cosine, which is
    steeper at its ends. The rest is as long as the strips need to come to rest."""
    ended = roll(rig, QUIET + roller(0.0), "--start", start, "--rest", "500ms")
    assert ended.code == 0, ended.stderr
    assert_off_the_object(rig)
    file = rig.only("*.h5")
    assert verify(file) == []
    assert validate_file(str(file)) == (0, 0)
    definition = definition_path("NXrig_roll_trial")
    assert validate_application(str(file), application=str(definition)) == (0, 0)
    reading = the_reading(rig)
    assert reading["peak_1_mV"] == pytest.approx(v_1, rel=0.3)
    assert reading["peak_2_mV"] == pytest.approx(v_2, rel=0.3)
    assert reading["high_roll_rms_mV"] < 0.5
    assert reading["high_rest_rms_mV"] < 0.5
    assert reading["angle_error_deg"] < 0.02
    assert reading["force_error_rms_percent"] < 3
    assert reading["largest_tangential_N"] < 0.3
    assert abs(reading["axis_offset_mm"]) < 0.3
    assert reading["ridge_lifted"] == 0
    with RunFile.open(file) as run:
        series = {w.stream: w for w in run.waveforms("trial-001")}
        ticks, angle = series["ticks"].values("elapsed"), series["rotation"].values("angle")
        assert "ridge_lift_off_us" in run.entry["simulated_truth/trial_001"]
    assert len(ticks) == len(angle)
    assert angle.max() == pytest.approx(3.5, abs=0.02)
    shown = rig.run("show", str(file), "--figures")
    assert shown.code == 0, shown.stderr
    assert file.with_suffix(".png").stat().st_size > 10_000
    assert "SIMULATED" in file.with_suffix(".svg").read_text("utf-8")


@pytest.mark.thorough
def test_a_roll_from_another_start_is_another_kind_of_press(rig):
    """The strips answer to the touch of other ridges five times as much."""
    for start in ("-5", "-6.5"):
        ended = roll(rig, QUIET + roller(0.0), "--start", start)
        assert "touch gain" not in ended.stderr
        assert ended.code in (0, 5), ended.stderr


@pytest.mark.thorough
def test_x_takes_back_what_the_axis_is_off(rig):
    ended = roll(rig, roller(2.0))
    assert ended.code == 0, ended.stderr
    reading = the_reading(rig)
    half = 1.96 * reading["axis_offset_error_mm"]
    assert reading["axis_offset_mm"] == pytest.approx(2.0, abs=0.12), "1.8 where it still turned"
    assert half < 1.0
    assert reading["largest_tangential_N"] < 0.4, "1.4 N without"
    assert_off_the_object(rig)


@pytest.mark.thorough
def test_an_axis_that_does_not_follow_a_nudge_is_not_taken_for_an_offset(rig):
    """Found by an attack: an object that did not turn at all had an offset of 0.00 mm."""
    fault = rig.fault('[[fault]]\ndevice = "rotary"\nkind = "idle"\nmove = 2\n')
    ended = roll(rig, "", "--fault", fault)
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert "rotary: measure the rotary axis: it has gone 0 deg for a nudge of 0.5 deg" in error
    assert_off_the_object(rig)


@pytest.mark.thorough
def test_stages_that_may_only_go_slowly_roll_at_their_own_speed(rig):
    """Found by an attack: the way of x and the turn upright were refused for their speeds."""
    with rig.served("--fixture", "semi-spherical-object") as path:
        text = path.read_text()
    for usual, slow in (
        ("max_speed_deg_s = 20.0", "max_speed_deg_s = 1.5"),
        ("max_acceleration_deg_s2 = 500.0", "max_acceleration_deg_s2 = 50.0"),
        ("max_speed_mm_s = 20.0", "max_speed_mm_s = 5.0"),
    ):
        assert usual in text
        text = text.replace(usual, slow)
    path.write_text(text)
    given = ("--turn-speed", "1.5", "--turn-acceleration", "40", "--angle", "0.5", *SHORT)
    ended = rig.run(
        "roll-trial", "--dry-run", "--json", "--bench", str(path), *given,
        "--world-log", str(rig.world_log),
    )  # fmt: skip
    assert ended.code == 0, ended.stderr
    assert_off_the_object(rig)


@pytest.mark.thorough
def test_an_offset_that_nothing_takes_back_is_refused(rig):
    ended = roll(rig, roller(2.0), "--alignment", "measure")
    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert "rotary" in error
    assert "more than --largest-offset 1 mm" in error
    assert_off_the_object(rig)


@pytest.mark.thorough
def test_a_head_rolls_along_a_profile_of_its_own(rig):
    longer = 100 / rig.bench.both_Hz
    times = ",".join(f"{longer * t:g}" for t in np.arange(0, 1.01, 0.1))
    angles = ",".join(f"{a:.6f}" for a in 2 * np.sin(np.pi * np.arange(0, 1.01, 0.1)) ** 2)
    asked = ("--profile-times", times, "--profile-angles", angles, "--alignment", "none")
    ended = roll(rig, "", *asked, "--angle-error", "0.1deg")
    assert ended.code == 0, ended.stderr
    assert "not known" in "\n".join(ended.object["warnings"])
    reading = the_reading(rig)
    assert reading["angle_deg"] == pytest.approx(2.0, abs=0.1)
    assert reading["angle_lag_deg"] < 0.3
    assert reading["axis_offset_mm"] is None


TROUBLES = {
    "held fast": ('kind = "stuck"', "rotary"),
    "turned by its knob": ('kind = "knob"\nby_deg = 1.0', "rotary"),
    "no answer": ('kind = "silence"\ncommand = "move abs"\nat = 2\ncount = 0', "rotary"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("what", TROUBLES)
def test_a_rotary_stage_that_fails_in_the_roll_is_reported_and_the_skin_lifted(rig, what):
    kind, words = TROUBLES[what]
    when = "" if "silence" in kind else "move = 3\nafter_s = 0.2\n"
    plan = f'[[fault]]\ndevice = "rotary"\n{kind}\n{when}'
    ended = roll(rig, roller(0.0), "--alignment", "none", "--fault", rig.fault(plan))
    assert ended.code in (3, 7), ended.stderr
    assert words in ended.errors[0]
    assert "; " in ended.errors[0], "the remedy follows the cause"
    touched = [e["what"] for e in rig.log() if e["what"] in ("touch-down", "lift-off")]
    assert touched == ["touch-down", "lift-off"]


@pytest.mark.thorough
def test_ctrl_c_in_a_roll_stops_it_and_lifts_off_and_a_resume_rolls_again(rig):
    running = rig.start(
        "roll-trial", "--no-figures", "--world-log", str(rig.world_log), "--alignment", "none",
        "--world", rig.world(roller(0.0)), "--turn-speed", "3deg/s", "--stay", "5s",
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not rig.world_log.exists() or [e["what"] for e in moves(rig, "rotary")].count("turn") < 2:
        assert time.monotonic() < deadline, "it never rolled"
        time.sleep(0.05)
    os.kill(running.process.pid, signal.SIGINT)
    ended = running.finish()
    assert ended.code == 130, ended.stderr
    assert_off_the_object(rig)
    resumed = rig.run("resume", str(rig.only("*.rigj")), "--no-figures", "--json")
    assert resumed.code == 0, resumed.stderr
    assert resumed.object["points_done"] == 1
    assert the_reading(rig)["angle_error_deg"] < 0.02


REFUSED = [
    (("--angle", "80"), "--angle 80 deg puts the object at 95 deg (15 deg upright +80 deg)"),
    pytest.param(
        ("--start", "-80"), "-80 mm from the middle is beside", marks=pytest.mark.thorough
    ),
    pytest.param(("--turn-speed", "90"), "90 deg/s is outside", marks=pytest.mark.thorough),
    pytest.param(("--profile-times", "0,1"), "needs its angle", marks=pytest.mark.thorough),
    pytest.param(("--tick", "600"), "500", marks=pytest.mark.thorough),
]


@pytest.mark.parametrize(("given", "words"), REFUSED, ids=lambda x: str(x))
def test_what_cannot_be_rolled_is_refused_before_anything_moves(rig, given, words):
    ended = roll(rig, "", *given)
    assert ended.code in (2, 4), ended.stderr
    assert words in ended.stderr
    moved = (
        [e for e in rig.log() if e["what"] in ("move", "turn")] if rig.world_log.exists() else []
    )
    assert not moved
