"""Places outside the travel of the stages are refused before anything moves."""

from __future__ import annotations

import pytest
from tiers import mostly_thorough

FIXTURE = """
name = "real"
[fixture]
mounted = "{mounted}"
parked_mm = {parked_mm}
contact_from_mm = 12.0
contact_to_mm = {contact_to_mm}
centre_mm = {centre_mm}
upright_deg = 15.0
"""
PLACES = {"mounted": "film-clamp", "parked_mm": 5.0, "contact_to_mm": 13.0, "centre_mm": 10.0}
OUTSIDE = {
    "the parking place": ("sweep", {"parked_mm": -3.0}, "parked_mm = -3 mm is outside 0 to 14 mm"),
    "the latest contact": (
        "sweep",
        {"contact_to_mm": 30.0},
        "contact_to_mm = 30 mm is outside 0 to 14 mm of the stage_z",
    ),
    "the middle of the object": (
        "roll-trial",
        {"mounted": "semi-spherical-object", "centre_mm": 55.0},
        "centre_mm = 55 mm is outside 0 to 40 mm of the stage_x",
    ),
}


def never_moved(rig):
    return not any(e["what"] in ("homing", "move", "jog") for e in rig.log())


@pytest.mark.parametrize("what", mostly_thorough(OUTSIDE, ["the parking place"]))
def test_a_place_of_the_fixture_outside_the_travel_is_refused_before_anything_moves(rig, what):
    command, places, words = OUTSIDE[what]
    path = rig.folder / "far.toml"
    path.write_text(FIXTURE.format(**(PLACES | places)))
    ended = rig.run(
        command, "--bench", str(path), "--dry-run", "--stages", rig.bench.stages,
        "--world-log", str(rig.world_log),
    )  # fmt: skip
    assert ended.code == 2, ended.stderr
    (error,) = ended.errors
    assert f"{path}" in error or "[fixture]" in error
    assert words in error
    assert "correct " in error
    assert never_moved(rig)


@pytest.mark.thorough
def test_a_place_outside_the_travel_is_refused_on_a_bench_file_too(rig):
    """Over the wire of a bench that runs in real time, and of another fixture that is mounted."""
    also = '[[also_mounted]]\nmounted = "plate"\ncontact_from_mm = 12.0\ncontact_to_mm = 30.0\n'
    with rig.served() as path:
        path.write_text(path.read_text() + also)
        ended = rig.run("sweep", "--bench", str(path), "--no-figures", "--frequencies", "300")
    assert ended.code == 2, ended.stderr
    (error,) = ended.errors
    assert "[[also_mounted]] plate contact_to_mm = 30 mm is outside 0 to 14 mm" in error
    assert never_moved(rig)


@pytest.mark.parametrize("start", mostly_thorough(["20mm", "-9mm"], ["20mm"]))
def test_a_roll_that_begins_beside_the_skin_is_refused_before_anything_moves(rig, start):
    ended = rig.run("roll-trial", "--start", start, "--world-log", str(rig.world_log))
    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert f"--start {start.removesuffix('mm')} mm from the middle is beside the ridges" in error
    assert "from -8.7 to 8.7 mm" in error
    assert never_moved(rig)


@pytest.mark.parametrize(
    ("stated", "instead", "words"),
    [
        ("upright_deg = 15.0", "upright_deg = 0.2", "the object to -0.3 deg (0.2 deg upright -0.5"),
        pytest.param(
            "centre_mm = 10.0", "centre_mm = 5.01", "x to -0.01 mm (0.01 mm, where the roll begins",
            marks=pytest.mark.thorough,
        ),
    ],
)  # fmt: skip
def test_a_measurement_of_the_axis_beyond_a_limit_is_refused_before_anything_moves(
    rig, stated, instead, words
):
    """Found by an attack: it was refused 18 s later, with the skin pressed."""
    head = {"mounted": "semi-spherical-object", "contact_to_mm": 13.6}
    path = rig.folder / "close.toml"
    path.write_text(FIXTURE.format(**(PLACES | head)).replace(stated, instead))
    given = ("--bench", str(path), "--dry-run", "--stages", rig.bench.stages)
    ended = rig.run("roll-trial", *given, "--world-log", str(rig.world_log))
    assert ended.code == 4, ended.stderr
    (error,) = ended.errors
    assert f"--alignment compensate nudges {words}" in error
    assert never_moved(rig)
