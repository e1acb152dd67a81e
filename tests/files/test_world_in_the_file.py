"""Every file of a simulated run has the whole World: a sweep, one that is resumed, and trials with
what they press on; for those of a batch see cli/commands/test_batch.py."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import h5py
import pytest

from rig.files.runfile.reader import RunFile
from rig.physics.pvdf import corner_frequency
from rig.physics.vibrator import drawn_film

QUICK = ("--frequencies", "300", "--no-figures", "--json", "--seed", "3")


def world_of(file: Path) -> dict[str, Any]:
    """The numbers and texts of a file's World, by their paths."""
    found: dict[str, Any] = {}

    def note(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item[()]

    with h5py.File(file) as run:
        run["entry/simulated_world"].visititems(note)
        assert run["entry/outcome/simulated"][()]
    return found


def is_film_of_seed(world: dict[str, Any], seed: int) -> bool:
    mechanics, circuit = drawn_film(seed)
    return (
        world["mounted_film/circuit/film_capacitance_pF"] == circuit.film_capacitance_pF
        and world["mounted_film/circuit/d33_C_N"] == circuit.d33_C_N
        and world["mounted_film/vibrator/drop_2/frequency_Hz"] == mechanics.drops[1].frequency_Hz
        and world["clamp/gain_per_newton_dB"] == 0.02
        and corner_frequency(circuit) > 0
    )


@pytest.mark.thorough
def test_a_sweep_has_the_film_that_was_drawn_with_units(rig: Any) -> None:
    ended = rig.run("sweep", *QUICK)
    assert ended.code == 0, ended.stderr
    file = rig.folder / ended.object["file"]
    world = world_of(file)
    assert is_film_of_seed(world, 3)
    assert not is_film_of_seed(world, 4)
    with h5py.File(file) as run:
        drop = run["entry/simulated_world/mounted_film/vibrator/drop_2/frequency_Hz"]
        assert drop.attrs["units"] == "Hz"


@pytest.mark.thorough
def test_the_file_of_a_resumed_run_has_it_with_the_results_of_all_points(rig: Any) -> None:
    sweep = rig.start("sweep", "--frequencies", "3,4,5,300", "--seed", "3", "--no-figures")
    sweep.wait_for("1/4")
    sweep.send(signal.SIGINT)
    stopped = sweep.finish()
    assert stopped.code == 130, stopped.stderr
    ended = rig.run("resume", str(rig.only("*.rigj")), "--no-figures")
    assert ended.code == 0, ended.stderr
    file = rig.only("*.h5")
    assert is_film_of_seed(world_of(file), 3)
    with RunFile.open(file) as run:
        assert run.outcome.attempt == 2
        assert run.results is not None
        assert run.results.values["points"] == 4


@pytest.mark.parametrize(
    ("command", "shape"),
    [
        pytest.param(("slip-trial", "--distance", "0.3"), None, marks=pytest.mark.nightly),
        pytest.param(("roll-trial", "--angle", "4"), "cylinder", marks=pytest.mark.thorough),
        pytest.param(("path-trial",), None, marks=pytest.mark.nightly),
    ],
)
def test_trials_have_the_skin_and_what_it_is_pressed_on(
    rig: Any, command: tuple[str, ...], shape: str | None
) -> None:
    ended = rig.run(*command, "--no-figures", "--json")
    assert ended.code == 0, ended.stderr
    world = world_of(rig.folder / json.loads(ended.stdout)["file"])
    assert world["skin/finger_radius_mm"] == 750.0
    if shape is None:
        assert "head/body/shape" not in world
    else:
        assert world["head/body/shape"] == shape.encode()
        assert world["head/body/radius_mm"] == 30.0
        assert world["head/upright_deg"] == 15.0
