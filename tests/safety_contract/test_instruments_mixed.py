"""The same sweep with other instruments and links: the procedure does not know the difference."""

from __future__ import annotations

from itertools import cycle

import pytest
from benches import DAQ_MODELS, PAIRS
from tiers import mostly_nightly

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify
from rig.physics.vibrator import drawn_film, true_response

FREQUENCIES = "20,210,2100,15000"


@pytest.mark.thorough
@pytest.mark.parametrize(("daq", "link"), list(zip(DAQ_MODELS, ["socket", "hislip"], strict=True)))
def test_every_daq_and_every_link_of_the_generator_measures_the_film(rig, daq, link):
    world = rig.world(f'daq_model = "{daq}"\ngenerator_link = "{link}"\n')
    ended = rig.sweep("--frequencies", FREQUENCIES, "--seed", "5", "--world", world)

    assert ended.code == 0, ended.stderr
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert next(i for i in run.header.instruments if i.role == "daq").model == daq
        truth = true_response(run.column("frequency"), *drawn_film(5))
        for part, variance in (("real", "real"), ("imag", "imag")):
            pull = (run.column(f"response_{part}") - getattr(truth, part)) / (
                run.column(f"response_var_{variance}") ** 0.5
            )
            assert abs(pull).max() < 4.5


@pytest.mark.parametrize(
    "pair",
    mostly_nightly(
        zip(PAIRS, cycle(DAQ_MODELS), strict=False), [("az", "U2542A"), ("festo-az", "U2331A")]
    ),
    ids="-".join,
)
def test_every_pair_of_stages_slides_the_skin(rig, pair):
    stages, daq = pair
    world = f'daq_model = "{daq}"\nskin_mount.contact_mm = 12.05\n'
    ended = rig.run(
        "slip-trial", "--stages", stages, "--no-figures", "--json", "--world", rig.world(world),
        "--world-log", str(rig.world_log), "--distance", "0.4mm", "--rest", "100ms",
    )  # fmt: skip
    assert ended.code == 0, ended.stderr
    touched = [e["what"] for e in rig.log() if e["what"] in ("touch-down", "lift-off")]
    assert touched == ["touch-down", "lift-off"]
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        models = {i.role: i.model for i in run.header.instruments}
        assert models["daq"] == daq
        assert models["stage_z"].startswith("AZ") == stages.startswith("az")
        assert models["stage_x"].startswith("AZ") == stages.endswith("az")
        assert run.settings["loading"] == "slide"
        (reading,) = run.readings()
    assert reading["tick_Hz"] == (50 if stages.startswith("az") else 100)
    assert reading["force_error_rms_percent"] < 2
    assert reading["kinetic_friction"] == pytest.approx(0.65, rel=0.03)


@pytest.mark.parametrize("stages", mostly_nightly(["az", "festo-az"], ["az"]))
def test_a_head_rolls_on_other_stages(rig, stages):
    head = "head = { body = { shape = 'cylinder', radius_mm = 30.0 }, axis_offset_mm = 1.0 }\n"
    ended = rig.run(
        "roll-trial", "--stages", stages, "--no-figures", "--json", "--world", rig.world(head),
        "--rest", "100ms", "--stay", "100ms", "--turn-speed", "4deg/s",
    )  # fmt: skip
    assert ended.code == 0, ended.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        (reading,) = run.readings()
    assert reading["largest_tangential_N"] < 0.5
    assert reading["force_error_rms_percent"] < 3
