"""A stage whose answers are sound in form and wrong: it does not act, shows an old state, or shows
a position where it cannot be."""

from __future__ import annotations

import pytest
from tiers import mostly_nightly

from rig.files.runfile.reader import RunFile

WATCHED = "[watch]\nforce_limit_N = 15.0\nreaction_s = 0.06\n"
SLIDING = "acquisition = 1\nafter_s = 3.0\n"
"""Under the normal force."""
DOWN = 'move = 2\nof = "stage_z"\nafter_s = 1.0\n'
"""On the first way down to the contact range."""
WRONG = {
    "idle on the way down": (
        "idle",
        DOWN,
        "does not do what its drive acknowledges|has not arrived",
    ),
    "idle under force": ("idle", SLIDING, ""),
    "stale on the way down": ("stale-status", DOWN, ""),
    "stale under force": ("stale-status", SLIDING, ""),
    "a leap on the way down": ("wrong-position", DOWN, "reads |ran past"),
    "a leap under force": ("wrong-position", SLIDING, "reads |ran past"),
}
THOROUGH = ["idle under force", "stale on the way down", "a leap under force"]
"""Each kind, and each moment."""
LEAPS = [name for name in WRONG if "leap" in name]


def said(rig, what):
    return [entry["value"] for entry in rig.log() if entry["what"] == what]


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.parametrize("what", mostly_nightly(WRONG, THOROUGH))
def test_a_stage_that_answers_and_does_not_act_ends_the_run_without_more_force(rig, what):
    """Where z can be moved it is lifted. Where it cannot, the force that remains is reported."""
    kind, moment, words = WRONG[what]
    plan = rig.fault(f'[[fault]]\ndevice = "stage_z"\nkind = "{kind}"\n{moment}')
    ended = rig.run(
        "slip-trial", "--distance", "1mm", "--json", "--no-figures", "--fault", plan,
        "--world", rig.world(WATCHED), "--world-log", str(rig.world_log),
    )  # fmt: skip
    assert ended.code in (3, 7), ended.stderr
    assert ended.errors[0].startswith("error: stage_z: ")
    if words:
        assert any(word in ended.errors[0] for word in words.split("|")), ended.errors
    assert said(rig, "violation") == []
    assert said(rig, "largest-force")[-1] < 5.0
    remains_N = said(rig, "last-force")[-1]
    if what in LEAPS or moment == DOWN:
        assert remains_N == 0.0
    elif remains_N > 0.4:
        assert "force_sensor reads" in ended.stderr or "NOT SAFE" in ended.stderr


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.thorough
@pytest.mark.stages("festo", because="the moment of contact is that of these stages")
def test_a_stage_that_shows_an_old_place_at_contact_touches_five_times_and_no_more(rig):
    """The place that it shows freezes just before contact. Commanded from there it touches and lets
    go; without a bound it did so for as long as the night lasted."""
    plan = rig.fault(
        '[[fault]]\ndevice = "stage_z"\nkind = "stale-status"\nmove = 3\nafter_s = 1.343\n'
    )
    ended = rig.run(
        "sweep", "--frequencies", "200", "--load", "0.8N", "--preload", "20N", "--no-figures",
        "--fault", plan, "--world", rig.world("[watch]\nforce_limit_N = 40.0\nreaction_s = 0.06\n"),
        "--world-log", str(rig.world_log),
    )  # fmt: skip
    assert ended.code in (3, 7), ended.stderr
    assert "contact was felt 5 times" in ended.errors[0], ended.stderr
    assert said(rig, "violation") == []
    assert said(rig, "largest-force")[-1] < 5.0
    assert len(said(rig, "pressed")) <= 6


@pytest.mark.thorough
@pytest.mark.stages("festo", because="a flipped bit does not pass the checksum of the other's line")
def test_one_flipped_bit_of_a_position_is_asked_for_again_and_counted_in_the_file(rig):
    """Bit 16 of the position is 6.6 mm."""
    plan = rig.fault(
        '[[fault]]\ndevice = "stage_z"\nkind = "flip"\ncommand = "FC3 100"\nbyte = 22\nbit = 0\n'
        f"{SLIDING}"
    )
    ended = rig.run(
        "slip-trial", "--distance", "1mm", "--json", "--no-figures", "--fault", plan,
        "--world-log", str(rig.world_log),
    )  # fmt: skip
    assert ended.code == 0, ended.stderr
    assert "1 times a stage answered a position where it cannot have been" in ended.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        (reading,) = run.readings()
        streams = {waveform.stream: waveform for waveform in run.waveforms("trial-001")}
    assert said(rig, "injected") == ["flip"]
    assert reading["misread_positions"] == 1
    assert streams["position"].values("z").max() < 14.0
