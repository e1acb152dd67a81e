"""What goes wrong in a slip trial: one clear line, x stopped, the skin off the plate, data kept."""

from __future__ import annotations

import pytest
from tiers import mostly_nightly

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

SHORT = ("--distance", "0.5mm", "--speed", "0.5mm/s", "--rest", "100ms")
WORLD = "skin_mount.contact_mm = 12.05\n"
"""Contact soon after the search begins: what is tried here comes later."""
SLIDING = 'move = 2\nof = "stage_x"\nafter_s = 0.3\n'
"""In the slide, which lasts a second: x has been brought to its start before."""


def take(rig, world="", fault="", *given):
    """A short trial in such a World, under such a fault plan."""
    disturbed = ("--fault", rig.fault(fault)) if fault else ()
    return rig.run(
        "slip-trial", "--json", "--no-figures", "--world-log", str(rig.world_log),
        "--world", rig.world(WORLD + world), *SHORT, *disturbed, *given,
    )  # fmt: skip


def assert_reported(ended, code, words):
    """In one line, with a remedy."""
    assert ended.code == code, ended.stderr
    (error,) = ended.errors
    assert words in error
    assert "; " in error, "the remedy follows the cause"
    assert "NOT SAFE" not in ended.stderr


def last_of(rig, stage):
    """How a stage's last motion ended: where it came to rest."""
    seen = [e for e in rig.log() if e["device"] == stage and e["what"] in ("move", "at-rest")]
    assert seen[-1]["what"] == "at-rest"
    return seen[-1]["value"]


def assert_lifted(rig):
    """x stands, z is parked, the skin has left the plate that it had touched."""
    last_of(rig, "stage_x")
    assert last_of(rig, "stage_z") == pytest.approx(5.0, abs=0.01)
    touches = [e["what"] for e in rig.log() if e["what"] in ("touch-down", "lift-off")]
    assert touches == ["touch-down", "lift-off"]


def assert_kept_until_sliding(rig):
    """The discarded trial is in the file, whole up to the fault: pressed, and dragged along."""
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.point_ids() == []
        kept = {w.stream: w for w in run.waveforms(status="discarded")}
    force = kept["force"]
    assert force.values("F_n").max() > 3.8
    assert force.values("F_t").max() > 1.0
    assert kept["position"].values("x")[-1] > 10.05
    samples, frames = len(kept["strips"].counts["strip_1"]), len(force.counts["F_n"])
    assert samples / 10 == pytest.approx(frames, abs=100), "both until the same instant"


X_TROUBLES = {
    "limit switch": ("limit-switch", "limit switch reached"),
    "following error": ("drive-fault", "the axis did not follow"),
    "held fast": ("stuck", ""),
}
"""Kinds of fault, and words for them; empty: the model's own."""


@pytest.mark.parametrize("what", mostly_nightly(X_TROUBLES, ["limit switch", "held fast"]))
def test_a_stage_that_fails_in_the_slide_is_reported_and_the_skin_lifted(rig, what):
    kind, words = X_TROUBLES[what]
    ended = take(rig, "", f'[[fault]]\ndevice = "stage_x"\nkind = "{kind}"\n{SLIDING}')
    assert_reported(ended, 3, words or rig.bench.x.held_fast)
    assert ended.errors[0].startswith("error: stage_x: ")
    assert_lifted(rig)
    assert_kept_until_sliding(rig)


@pytest.mark.thorough
def test_a_stage_that_is_held_before_contact_is_reported_with_where_it_stands(rig):
    """Small targets ahead of it never make it lag: that it does not come there must be noticed."""
    ended = take(
        rig, "", '[[fault]]\ndevice = "stage_z"\nkind = "stuck"\nmove = 4\nafter_s = 0.1\n'
    )
    assert_reported(ended, 3, "stage_z: approach: stage_z is held at 11.")
    assert "check what holds the stage" in ended.errors[0]
    last_of(rig, "stage_z")


@pytest.mark.thorough
def test_a_lift_that_fails_leaves_both_stages_at_rest_and_says_so(rig):
    ended = take(rig, "", f'[[fault]]\ndevice = "stage_z"\nkind = "drive-fault"\n{SLIDING}')
    assert_reported(ended, 3, f"stage_z: {rig.bench.z.fault}")
    assert "the stage has stopped and the skin may still be pressed: stage_z: " in ended.stderr
    last_of(rig, "stage_x")
    assert last_of(rig, "stage_z") == pytest.approx(12.09, abs=0.01)
    assert_kept_until_sliding(rig)


@pytest.mark.thorough
def test_a_drive_that_goes_away_in_the_slide_does_not_keep_the_skin_pressed(rig):
    """x answers no more: it cannot be stopped, and that is reported. z goes up all the same."""
    gone = f'[[fault]]\ndevice = "stage_x"\nkind = "silence"\ncount = 0\n{SLIDING}'
    ended = take(rig, "", gone)
    assert ended.code == 7, ended.stderr
    cause, unsafe = ended.errors
    assert cause.startswith("error: stage_x: ")
    assert unsafe.startswith("error: NOT SAFE: slide could not be switched off: stage_x: ")
    done = "normal force released, acquisition off, force stream stopped."
    assert f"Bench is NOT safe (see above); done: {done}" in ended.stderr
    assert "the guard could not make the bench safe either: stage_x: " in ended.stderr
    assert_lifted(rig)
    assert_kept_until_sliding(rig)


@pytest.mark.thorough
def test_a_daq_that_goes_away_in_the_slide_drives_nothing_and_leaves_no_bench_unsafe(rig):
    gone = f'[[fault]]\ndevice = "daq"\nkind = "silence"\ncount = 0\n{SLIDING}'
    ended = take(rig, "", gone)
    assert ended.code == 3, ended.stderr
    assert ended.errors[0].startswith("error: daq: ")
    assert "NOT SAFE" not in ended.stderr
    assert "Bench is safe: " in ended.stderr
    assert_lifted(rig)
    assert_kept_until_sliding(rig)


@pytest.mark.thorough
def test_a_force_channel_that_saturates_ends_the_trial(rig):
    """3.5 mV/V are 290 N along z: somebody hits the plate."""
    hit = '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nforce_N = 500.0\nfor_s = 0.02\n'
    ended = take(rig, "", hit + SLIDING)
    assert_reported(ended, 3, "frames are saturated")
    assert_lifted(rig)
    assert_kept_until_sliding(rig)


FRAMES = {
    "lost whole": ("silence", "for_s = 0.08\n", "frames are missing: the stream has a gap"),
    "garbled": ("garbage", "", "force_sensor: stream: "),
}


@pytest.mark.thorough
@pytest.mark.parametrize("what", FRAMES)
def test_bytes_lost_on_the_serial_line_end_the_trial(rig, what):
    """What is lost without a trace is missed by counting against time, half a second later."""
    kind, lasting, words = FRAMES[what]
    plan = f'[[fault]]\ndevice = "force_sensor.stream"\nkind = "{kind}"\n'
    ended = take(rig, "", plan + lasting + SLIDING)
    assert_reported(ended, 3, words)
    assert_lifted(rig)
    assert_kept_until_sliding(rig)


@pytest.mark.thorough
def test_a_few_frames_that_are_lost_make_the_trial_invalid(rig):
    """Two messages of ten frames: what comes after them is whole, and that much too early."""
    plan = '[[fault]]\ndevice = "force_sensor.stream"\nkind = "silence"\ncount = 2\n'
    ended = take(rig, "", plan + SLIDING)
    assert ended.code == 5, ended.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        (reading,) = run.readings()
    assert reading["lost_frames"] == 20
    assert f"{reading['lost_frames']} frames of the force sensor were lost" in reading["invalid"]


@pytest.mark.thorough
def test_a_daq_whose_buffer_overruns_ends_the_trial(rig):
    ended = take(rig, "", f'[[fault]]\ndevice = "daq"\nkind = "overrun"\n{SLIDING}')
    assert_reported(ended, 3, "daq: WAV:STAT?: its buffer overran after row")
    assert_lifted(rig)
    assert_kept_until_sliding(rig)
    with RunFile.open(rig.only("*.h5")) as run:
        (strips,) = (w for w in run.waveforms(status="discarded") if w.stream == "strips")
    rows = len(strips.counts["strip_1"])
    assert f"after row {rows};" in ended.errors[0], "all that came before is kept, no more"


@pytest.mark.thorough
def test_short_blocks_are_taken_as_fast_as_they_come(rig):
    """The DAQ's buffer holds two strips for 0.3 s, looks at it are at most 40 ms apart."""
    ended = take(rig, "daq_buffer_samples = 6000\n", "", "--block", "2ms")
    assert ended.code == 0, ended.stderr
    assert "overrun" not in [e["value"] for e in rig.log() if e["what"] == "acquisition"]


@pytest.mark.thorough
def test_a_block_of_samples_that_is_lost_on_the_wire_ends_the_trial(rig):
    fault = '[[fault]]\ndevice = "daq"\nkind = "truncate"\ncommand = "WAV:DATA"\n'
    ended = take(rig, "", fault + SLIDING)
    assert_reported(ended, 3, "error: daq: WAV:DATA?")
    assert_lifted(rig)
    assert_kept_until_sliding(rig)
