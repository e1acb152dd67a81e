"""A parking place that is not clear of contact: making safe never moves z deeper than it stands."""

from __future__ import annotations

import pytest
from tiers import mostly_nightly, mostly_thorough

INSIDE = """
name = "real"
[fixture]
mounted = "{mounted}"
parked_mm = {parked_mm}
contact_from_mm = 12.95
contact_to_mm = 13.0
"""
WATCHED = "[watch]\nforce_limit_N = {limit_N}\nreaction_s = 0.06\n"
"""The World looks at the true force: over the limit it may rise by what braking takes, no more."""
OBJECTS = {  # command, fixture, World settings, true contact in mm, force limit in N, options
    "film": ("sweep", "film-clamp", "clamp", 11.8, 40.0, ("--frequencies", "300")),
    "skin": ("slip-trial", "plate", "skin_mount", 12.05, 15.0, ("--distance", "0.5mm")),
}


def rehearse(rig, what, parked_mm):
    """A run with a bench file whose object is taller than it says; its places are used, not its
    instruments."""
    command, mounted, world, contact_mm, limit_N, asked = OBJECTS[what]
    path = rig.folder / "taller.toml"
    path.write_text(INSIDE.format(mounted=mounted, parked_mm=parked_mm))
    watched = f"{world}.contact_mm = {contact_mm}\n{WATCHED.format(limit_N=limit_N)}"
    return rig.run(
        command, "--bench", str(path), "--dry-run", "--json", "--stages", rig.bench.stages,
        "--world-log", str(rig.world_log), "--world", rig.world(watched), *asked,
    )  # fmt: skip


def motion(rig):
    """Targets and places of rest of z, in order, as ("move" or "at-rest", mm)."""
    found = []
    for entry in rig.log():
        if entry["device"] == "stage_z" and entry["what"] in ("move", "at-rest"):
            value = entry["value"]
            mm = value if entry["what"] == "at-rest" else value["target_mm"]
            found.append((entry["what"], mm))
    return found


def largest_N(rig):  # noqa: N802 - the unit keeps its capital
    """Largest true force by which the stages have pressed."""
    return next(entry["value"] for entry in rig.log() if entry["what"] == "largest-force")


def violations(rig):
    return [entry["value"] for entry in rig.log() if entry["what"] == "violation"]


@pytest.mark.parametrize("what", mostly_nightly(OBJECTS, ["skin"]))
def test_an_object_on_the_way_to_the_parking_place_is_felt_and_z_goes_back_not_deeper(rig, what):
    """Parking itself presses: the way is slow and watched, and z goes back to where it came from
    long before the force limit is reached."""
    contact_mm, limit_N = OBJECTS[what][3:5]
    ended = rehearse(rig, what, 12.6)
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert "on the way to parked_mm = 12.6 mm: something is in the way" in error
    assert "NOT SAFE" not in ended.stderr
    assert violations(rig) == []
    assert largest_N(rig) < limit_N / 2
    story = motion(rig)
    parking = [n for n, step in enumerate(story) if step == ("move", pytest.approx(12.6))]
    assert parking
    for begun in parking:
        (stopped_mm, *after) = [mm for _, mm in story[begun + 1 :]][:2]
        assert contact_mm < stopped_mm < 12.6 - 0.05, "the trip came before the parking place"
        assert after
        assert after[0] < contact_mm, "back, off the object"
    assert story[-1][0] == "at-rest"
    assert story[-1][1] < contact_mm


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.thorough
def test_a_stop_on_the_way_down_to_the_parking_place_does_not_continue_down(rig):
    """In free air, in a trial's first way to where it parks: back, though nothing is pressed."""
    plan = '[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nforce_N = 30.0\nfor_s = 0.02\n'
    fault = rig.fault(f'{plan}move = 1\nof = "stage_z"\nafter_s = 0.2\n')
    ended = rig.run(
        "slip-trial", "--json", "--no-figures", "--world-log", str(rig.world_log),
        "--distance", "0.5mm", "--fault", fault,
    )  # fmt: skip
    assert ended.code == 4, ended.stderr
    story = motion(rig)
    begun = [kind for kind, _ in story].index("move")
    (down, first), (rest, stopped_mm), (back, second), *_ = story[begun:]
    assert (down, rest, back) == ("move", "at-rest", "move")
    assert first == pytest.approx(5.0)
    assert stopped_mm < first - 0.05
    assert second < stopped_mm


STILL_PRESSED = {
    "a little": (3.0, 3, "error: stage_z: unload: "),
    "over the limit of the run": (45.0, 7, ""),
    "over that of the sensor, too": (60.0, 7, ""),
}


@pytest.mark.parametrize("how", mostly_thorough(STILL_PRESSED, ["a little"]))
def test_what_is_still_pressed_after_the_last_way_up_is_reported(rig, how):
    """Something lies on the sensor while the stage goes up after the last point."""
    force_N, code, begins = STILL_PRESSED[how]
    push = f'[[fault]]\ndevice = "force_sensor"\nkind = "spike"\nforce_N = {force_N}\n'
    plan = rig.fault(f'{push}for_s = 30.0\nmove = 4\nof = "stage_z"\nafter_s = 0.3\n')
    ended = rig.sweep("--frequencies", "300,600", "--fault", plan)
    assert ended.code == code, ended.stderr
    reported = next(line for line in ended.errors if "the film is still pressed with" in line)
    assert reported.startswith(begins)
    assert " N at 5.0" in reported
    assert ("over the limit of 40 N" in reported) == (code == 7)
    failed = "the guard could not make the bench safe either: stage_z: still pressed at 5.0"
    assert (failed in ended.stderr) == (code == 7)
    assert "made safe by the guard" not in ended.stderr
    assert ended.object["points_done"] == 2
    assert motion(rig)[-1] == ("at-rest", pytest.approx(5.0, abs=0.02))


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.thorough
def test_a_stage_that_may_only_go_slowly_releases_what_it_has_pressed(rig):
    """Found by an attack: the way off was refused for its speed, and the film stayed pressed."""
    with rig.served() as path:
        text = path.read_text()
        assert text.count("max_speed_mm_s = 20.0") == 1
        path.write_text(text.replace("max_speed_mm_s = 20.0", "max_speed_mm_s = 4.0"))
    given = ("--frequencies", "300", "--no-figures", "--dry-run", "--bench", str(path))
    ended = rig.run("sweep", *given, "--world-log", str(rig.world_log))
    assert ended.code == 0, ended.stderr
    assert motion(rig)[-1] == ("at-rest", pytest.approx(5.0, abs=0.02))


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.parametrize("parked_mm", mostly_thorough([11.8, 12.9], [11.8]))
def test_a_parking_place_that_is_not_clear_is_refused_and_the_bench_can_be_made_safe(
    rig, parked_mm
):
    with rig.served() as path:
        text = path.read_text()
        assert "[fixture]\n" in text
        path.write_text(text.replace("[fixture]\n", f"[fixture]\nparked_mm = {parked_mm}\n"))
        refused = rig.run("sweep", "--bench", str(path), "--no-figures", "--frequencies", "300")
        made_safe = rig.run("make-safe", "--bench", str(path))

    assert refused.code == 2, refused.stderr
    (error,) = refused.errors
    assert f"[fixture] parked_mm = {parked_mm:g} mm is not clear of contact" in error
    assert "contact_from_mm = 12 mm" in error
    assert "set parked_mm to 11.7 mm or less" in error
    assert made_safe.code == 0, made_safe.stderr
    assert [mm for kind, mm in motion(rig) if kind == "move"] == []


TALL = """
name = "real"
[fixture]
mounted = "{mounted}"
contact_from_mm = 12.0
contact_to_mm = 13.0
"""


@pytest.mark.parametrize("what", mostly_nightly(OBJECTS, ["film"]))
def test_an_object_that_is_taller_than_stated_is_met_slowly_enough_to_stop(rig, what):
    """On the first way down of a run z has not been there yet: a stiff film, or skin."""
    command, mounted, world, _, limit_N, asked = OBJECTS[what]
    path = rig.folder / "tall.toml"
    path.write_text(TALL.format(mounted=mounted))
    stiff = "clamp.stiffness_N_mm = 900.0\n" if what == "film" else ""
    watched = f"{world}.contact_mm = 10.7\n{stiff}{WATCHED.format(limit_N=limit_N)}"
    ended = rig.run(
        command, "--bench", str(path), "--dry-run", "--json", "--stages", rig.bench.stages,
        "--world-log", str(rig.world_log), "--world", rig.world(watched), *asked,
    )  # fmt: skip
    assert ended.code == 3, ended.stderr
    (error,) = ended.errors
    assert "before any contact can be (contact_from_mm = 12 mm)" in error
    assert violations(rig) == []
    assert largest_N(rig) < limit_N
    assert motion(rig)[-1] == ("at-rest", pytest.approx(5.0, abs=0.02))


@pytest.mark.usefixtures("usual_ways")
def test_a_contact_too_stiff_for_the_slowest_speed_is_refused_before_anything_moves(rig):
    path = rig.folder / "stiff.toml"
    text = TALL.format(mounted="film-clamp")
    path.write_text(text.replace("contact_from", "stiffest_contact_N_mm = 1e9\ncontact_from"))
    ended = rig.run(
        "sweep", "--bench", str(path), "--dry-run", "--stages", rig.bench.stages,
        "--world-log", str(rig.world_log), "--frequencies", "300",
    )  # fmt: skip
    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert "stage_z: a speed of 0.5 mm/s towards a contact is above" in error
    assert "stiffest contact 1e+09 N/mm, reaction 0.0" in error
    assert "deceleration 200 mm/s2" in error
    assert [kind for kind, _ in motion(rig)] == []


@pytest.mark.usefixtures("usual_ways")
def test_a_force_that_z_cannot_brake_within_the_limit_is_refused_before_anything_moves(rig):
    ended = rig.run(
        "slip-trial", "--normal-force", "14.99999N", "--no-figures",
        "--world-log", str(rig.world_log),
    )  # fmt: skip
    assert ended.code == 4, ended.stderr
    assert "from which it stops within 1e-05 N: stiffest contact 250 N/mm" in ended.errors[0]
    assert "a smaller force" in ended.errors[0]
    assert [kind for kind, _ in motion(rig)] == []
