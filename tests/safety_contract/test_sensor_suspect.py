"""A force sensor that reads too little or nothing: the stage does not press on."""

from __future__ import annotations

import json
import signal

import h5py
import pytest
from tiers import mostly_nightly, mostly_thorough

WATCHED = "[watch]\nforce_limit_N = {limit_N}\n"
PROCEDURES = {  # World settings, options, torque limit as force in N, force limit in N
    "sweep": ("clamp.contact_mm = 12.1\n", ("--frequencies", "300"), 45.0, 40.0),
    "slip-trial": ("skin_mount.contact_mm = 12.05\n", ("--distance", "0.5mm"), 25.0, 15.0),
    "roll-trial": ("skin_mount.contact_mm = 12.05\n", ("--angle", "2deg"), 25.0, 15.0),
}

APPROACH = 'move = 4\nof = "stage_z"\n'
"""From the beginning of a trial's approach on, the first slow way down."""


def run(rig, procedure, fault, *asked, world=None):
    """A run with a fault of the force sensor; the World notes the largest true force."""
    own, options, _, _ = PROCEDURES[procedure]
    plan = rig.fault(f'[[fault]]\ndevice = "force_sensor"\n{fault}\n')
    watched = f"{world or own}{WATCHED.format(limit_N=100.0)}"
    return rig.run(
        procedure, "--json", "--no-figures", "--world-log", str(rig.world_log), "--fault", plan,
        "--world", rig.world(watched), *options, *asked,
    )  # fmt: skip


def largest_N(rig):  # noqa: N802 - the unit keeps its capital
    """The largest force that the stages have truly pressed with."""
    (force_N,) = [entry["value"] for entry in rig.log() if entry["what"] == "largest-force"]
    return force_N


def pressed_for_s(rig):
    """From the first touch-down to the lift-off that follows it, in s."""
    log = rig.log()
    touched_us = next(e["t_us"] for e in log if e["what"] == "touch-down")
    lifted = (e["t_us"] for e in log if e["what"] == "lift-off")
    return 1e-6 * (next(t_us for t_us in lifted if t_us > touched_us) - touched_us)


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.parametrize("procedure", mostly_nightly(PROCEDURES, ["sweep", "slip-trial"]))
def test_a_dead_sensor_is_named_by_the_torque_before_the_force_limit_is_reached(rig, procedure):
    ended = run(rig, procedure, 'kind = "dead-noisy"')
    assert ended.code == 3, ended.stderr
    assert "the torque of stage_z has changed by" in ended.errors[0]
    assert "suspect the force sensor" in ended.errors[0]
    assert largest_N(rig) < 0.75 * PROCEDURES[procedure][3]
    if procedure != "sweep":
        assert pressed_for_s(rig) < 3.0


WRONG_TORQUE = '[[fault]]\ndevice = "stage_z"\nkind = "wrong-torque"\n{keys}\n'
DEAD = '[[fault]]\ndevice = "force_sensor"\nkind = "dead-noisy"\n'


def run_with(rig, procedure, plan):
    """A run under a whole fault plan; the World notes the largest true force."""
    own, options, _, _ = PROCEDURES[procedure]
    return rig.run(
        procedure, "--json", "--no-figures", "--world-log", str(rig.world_log),
        "--fault", rig.fault(plan), "--world", rig.world(f"{own}{WATCHED.format(limit_N=100.0)}"),
        *options,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("procedure", "keys", "said"),
    [
        *(
            pytest.param(*case, marks=pytest.mark.thorough)
            for case in (
                ("sweep", 'shows = "zero"', True),
                ("slip-trial", 'shows = "scaled"\nfactor = 0.1', False),
            )
        ),
        *(
            pytest.param(*case, marks=pytest.mark.nightly)
            for case in (
                ("slip-trial", 'shows = "zero"', True),
                ("roll-trial", 'shows = "frozen"\nmove = 1', True),
            )
        ),
    ],
)
def test_a_torque_that_does_not_belong_to_the_force_ends_no_run_and_is_said_where_it_never_changes(
    rig, procedure, keys, said
):
    ended = run_with(rig, procedure, WRONG_TORQUE.format(keys=keys))
    assert ended.code == 0, ended.stderr
    assert ("shows the same torque" in ended.stderr) == said, ended.stderr
    assert largest_N(rig) < PROCEDURES[procedure][3]


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.parametrize("procedure", mostly_nightly(["sweep", "slip-trial"], ["sweep"]))
def test_behind_a_dead_sensor_and_a_wrong_torque_the_torque_limit_bounds_the_force(rig, procedure):
    """Two witnesses that are silent at once: the stage is held, and z goes up."""
    plan = WRONG_TORQUE.format(keys='shows = "zero"') + DEAD
    ended = run_with(rig, procedure, plan)
    assert ended.code == 3, ended.stderr
    # The watch of the torque, or the drive, whichever is first.
    assert "its torque limit" in ended.errors[0]
    assert "suspect the force sensor" in ended.errors[0]
    assert largest_N(rig) <= PROCEDURES[procedure][2] + 0.5
    last_N = [entry["value"] for entry in rig.log() if entry["what"] == "last-force"]
    assert last_N == [0.0]


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.thorough
@pytest.mark.parametrize(
    ("after_s", "largest"), [(0.8, 0.0), pytest.param(1.2, 15.0, marks=pytest.mark.thorough)]
)
def test_noise_alone_is_not_taken_for_a_contact_that_is_pressed(rig, after_s, largest):
    """Noise that is felt as contact in free air, and hides whether the force changes.

    Its mean may by chance look like a force; then the torque of z tells, below the force limit.
    """
    noise = f'kind = "dead-noisy"\nnoise_N = 0.3\n{APPROACH}after_s = {after_s}'
    ended = run(rig, "slip-trial", noise, world="skin_mount.contact_mm = 12.9\n")
    assert ended.code == 3, ended.stderr
    assert "the force sensor" in ended.errors[0]
    assert largest_N(rig) <= largest


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.thorough
def test_the_servo_orders_nothing_deeper_than_the_latest_contact(rig):
    """The sensor reads less and less of a force that is held: z would follow it for ever."""
    drift = f'kind = "drift"\nrate_N_s = -1.0\n{APPROACH}after_s = 7.0'
    world = "skin_mount.contact_mm = 12.92\n"
    ended = run(rig, "slip-trial", drift, "--rest", "20s", world=world)
    # The servo's bound, or the torque, which changes while the sensor's force does not.
    assert ended.code in (3, 4), ended.stderr
    assert any(
        words in ended.errors[0]
        for words in ("deeper than contact_to_mm = 13 mm", "suspect the force sensor")
    )
    deepest_mm = max(
        e["value"]["target_mm"]
        for e in rig.log()
        if e["device"] == "stage_z" and e["what"] == "move"
    )
    assert deepest_mm <= 13.0021
    assert largest_N(rig) < 15.0


@pytest.mark.parametrize("how", mostly_thorough(["run", "dry-run"], ["run"]))
def test_an_axis_that_presses_without_a_torque_limit_is_refused_before_anything_moves(rig, how):
    with rig.served() as path:
        lines = path.read_text().splitlines()
        path.write_text("\n".join(line for line in lines if "torque_limit" not in line) + "\n")
        dry = ["--dry-run"] if how == "dry-run" else []
        refused = rig.run(
            "sweep", "--bench", str(path), "--no-figures", "--frequencies", "300", *dry
        )
        made_safe = rig.run("make-safe", "--bench", str(path))

    assert refused.code == 2, refused.stderr
    assert "[stage_z] of the bench file has no torque_limit_percent" in refused.errors[0]
    assert "add torque_limit_percent = " in refused.errors[0]
    assert made_safe.code == 0, made_safe.stderr
    assert [e for e in rig.log() if e["what"] == "move"] == []


HELD = 'move = 4\nof = "stage_z"\nafter_s = 2.5\n'
"""While the force is held, on every model of stage."""


@pytest.mark.thorough
def test_one_axis_that_is_stuck_ends_the_run_and_is_named(rig):
    ended = run(rig, "slip-trial", f'kind = "one-axis-stuck"\naxis = "y"\n{HELD}', "--rest", "3s")
    assert ended.code == 3, ended.stderr
    assert "axis y has had the same value" in ended.errors[0]
    log = rig.log()
    stuck_us = next(e["t_us"] for e in log if e["what"] == "injected")
    lifted_us = next(e["t_us"] for e in log if e["what"] == "lift-off" and e["t_us"] > stuck_us)
    assert lifted_us - stuck_us < 500_000


@pytest.mark.thorough
@pytest.mark.parametrize("procedure", ["sweep", "roll-trial"])
@pytest.mark.parametrize("axis", ["x", "z"])
def test_every_procedure_that_records_force_watches_every_axis(rig, procedure, axis):
    ended = run(rig, procedure, f'kind = "one-axis-stuck"\naxis = "{axis}"')
    assert ended.code == 3, ended.stderr
    assert f"axis {axis} has had the same value" in ended.errors[0]
    assert largest_N(rig) == 0.0


def test_a_sensor_that_dies_while_the_force_is_held_ends_the_run_before_the_servo_presses_on(rig):
    ended = run(rig, "slip-trial", f'kind = "dead-noisy"\n{HELD}', "--rest", "3s")
    assert ended.code == 3, ended.stderr
    assert "N where z held 4 N" in ended.errors[0]
    assert "suspect the force sensor" in ended.errors[0]
    assert largest_N(rig) < 15.0


@pytest.mark.thorough
def test_a_drift_under_a_held_force_is_ended_by_the_torque(rig):
    """The servo would follow the drift by 2 N/s to the torque limit, far over the force limit."""
    drift = f'kind = "drift"\nrate_N_s = -2.0\n{HELD}'
    ended = run(rig, "slip-trial", drift, "--rest", "12s")
    assert ended.code == 3, ended.stderr
    assert "force_sensor: hold the force: the torque of stage_z has changed by" in ended.errors[0]
    assert largest_N(rig) < 15.0


def test_a_zero_that_drifts_in_free_air_ends_the_run_before_anything_is_pressed(rig):
    ended = run(rig, "sweep", 'kind = "drift"\nrate_N_s = -2.0')
    assert ended.code == 3, ended.stderr
    assert "force_sensor" in ended.errors[0], "as a change on the way down, or as a drift at rest"
    assert largest_N(rig) == 0.0


@pytest.mark.thorough
@pytest.mark.stages("festo", because="a longer trial drifts as far as if something were pressed")
def test_a_zero_that_has_moved_while_the_force_was_held_makes_the_trial_invalid(rig):
    ended = run(rig, "slip-trial", f'kind = "drift"\naxis = "x"\nrate_N_s = 0.2\n{HELD}')
    assert ended.code == 5, ended.stderr
    assert "the force sensor's zero has moved by" in ended.stderr
    assert "along x" in ended.stderr


@pytest.mark.thorough
def test_a_zero_that_has_moved_as_if_something_were_pressed_is_the_end_of_an_invalid_trial(rig):
    """The trial is invalid as well, and that does not take the place of the instrument's code."""
    ended = run(rig, "slip-trial", f'kind = "drift"\naxis = "x"\nrate_N_s = 0.6\n{HELD}')
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert "the skin is still pressed with" in error
    assert "trial-001 is invalid: the force sensor's zero has moved by" in ended.stderr


@pytest.mark.parametrize("procedure", mostly_nightly(["sweep", "slip-trial"], ["sweep"]))
def test_a_scale_that_has_become_wrong_is_refused_before_the_force_is_held(rig, procedure):
    usual = run(rig, procedure, 'kind = "wrong-scale"\nfactor = 1.0')
    assert usual.code == 0, usual.stderr
    wanted_N = largest_N(rig)
    rig.world_log.unlink()
    refused = run(rig, procedure, 'kind = "wrong-scale"\nfactor = 0.1')
    assert refused.code == 3, refused.stderr
    assert "earlier runs of this kind" in refused.errors[0]
    assert "--accept REASON" in refused.errors[0]
    assert largest_N(rig) < min(6 * wanted_N, PROCEDURES[procedure][2] + 0.5)


@pytest.mark.thorough
def test_a_strip_whose_touch_gain_is_not_what_it_was_ends_the_run(rig):
    nothing = 'kind = "wrong-scale"\nfactor = 1.0'
    for _ in range(2):
        usual = run(rig, "slip-trial", nothing)
        assert usual.code == 0, usual.stderr
        assert "warning: the touch gain" not in usual.stderr
    file = rig.only("press-references.json")
    known = json.loads(file.read_text())
    (reference,) = known["references"].values()
    reference["touch_gains"]["strip_2"]["value_V_s_N"] *= 4
    file.write_text(json.dumps(known))
    rig.world_log.unlink()
    refused = run(rig, "slip-trial", nothing)
    assert refused.code == 3, refused.stderr
    assert "the touch gain of strip_2 is" in refused.errors[0]
    assert "--accept REASON" in refused.errors[0]
    assert [e["value"] for e in rig.log() if e["what"] == "last-force"] == [0.0]


@pytest.mark.thorough
def test_a_run_that_does_not_fit_is_accepted_with_a_reason_that_the_file_keeps(rig):
    reads_more = 'kind = "wrong-scale"\nfactor = 4.0'
    assert run(rig, "sweep", 'kind = "wrong-scale"\nfactor = 1.0').code == 0
    refused = run(rig, "sweep", reads_more)
    assert refused.code == 3, refused.stderr
    accepted = run(rig, "sweep", reads_more, "--accept", "a stiffer clamp")
    assert accepted.code == 0, accepted.stderr
    file = rig.folder / accepted.object["file"]
    with h5py.File(file) as opened:
        assert opened["entry"].attrs["accepted"] == "a stiffer clamp"
    assert "accepted: a stiffer clamp" in rig.run("show", str(file), "--no-figures").stdout
    again = run(rig, "sweep", reads_more)
    assert again.code == 0, again.stderr


@pytest.mark.thorough
def test_a_resumed_run_is_compared_with_the_presses_of_its_own_sample(rig):
    world, options, _, _ = PROCEDURES["slip-trial"]
    own = ("--sample", "A", "--world", rig.world(world), "--no-figures", "--json")
    running = rig.start("slip-trial", *own, *options, "-n", "2")
    running.wait_for(r"^1/2 trial-001")
    running.send(signal.SIGINT)
    stopped = running.finish()
    assert stopped.object["points_done"] >= 1, stopped.stderr
    resumed = rig.run("resume", stopped.object["journal"], "--no-figures")
    assert resumed.code == 0, resumed.stderr
    assert "nothing to compare it with" not in resumed.stderr
    known = json.loads(rig.only("press-references.json").read_text())
    assert len(known["references"]) == 1
