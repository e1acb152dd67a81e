"""What the commands of ``rig skin`` keep of a model: its quantities as HDF5, and its figures."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rig.core.errors import OutputError

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

    from rig.core.settings import Settings
    from rig.files.model_file import ModelQuantity
    from rig.physics.design_map import DesignMap
    from rig.physics.loading_history import History
    from rig.physics.trials import SkinTrial


@dataclass(frozen=True)
class Model:
    """What a command has computed, to be kept beside its figures."""

    stem: str
    title: str
    settings: dict[str, Settings]
    results: dict[str, ModelQuantity]


def quantities_of_trial(trial: SkinTrial) -> dict[str, ModelQuantity]:
    """Return what is kept of a slide or roll: signals, forces, statuses and times of slip."""
    from rig.files.model_file import ModelQuantity

    block, truth = trial.block, trial.truth
    step, sample, ridge = ("time",), ("sample_time",), ("ridge",)
    return {
        "time": ModelQuantity(trial.time_s, "s", "end of each step", step),
        "sample_time": ModelQuantity(trial.sample_time_s, "s", "time of each sample", sample),
        "v_1": ModelQuantity(trial.sampled[:, 0], "V", "signal of strip 1 as sampled", sample),
        "v_2": ModelQuantity(trial.sampled[:, 1], "V", "signal of strip 2 as sampled", sample),
        "v_d": ModelQuantity(trial.v_d, "V", "v_1 - v_2 as sampled", sample),
        "F_n": ModelQuantity(block.normal_force_N, "N", "normal force", step),
        "F_t": ModelQuantity(block.tangential_force_N, "N", "tangential force on the skin", step),
        "x": ModelQuantity(block.position_mm, "mm", "position of the object", step),
        "status": ModelQuantity(
            block.status, "", "status of each node: 0 apart, 1 stick, others slip", (*step, "node")
        ),
        "ridge_first_slip": ModelQuantity(truth.first_slip_s, "s", "slip of the first node", ridge),
        "ridge_whole_slip": ModelQuantity(
            truth.whole_slip_s, "s", "slip of the whole ridge", ridge
        ),
        "gross_slip": ModelQuantity(truth.gross_slip_s, "s", "slip of the whole skin"),
        "motion": ModelQuantity(trial.motion_s, "s", "start of the motion"),
    }


def quantities_of_history(found: History) -> dict[str, ModelQuantity]:
    """Return what is kept of the paper's 4.2."""
    from rig.files.model_file import ModelQuantity

    step, ridge = ("step",), ("ridge",)
    return {
        "step": ModelQuantity(found.step, "", "number of the step, from 1", step),
        "F_n": ModelQuantity(found.normal_force_N, "N", "given normal force", step),
        "F_t": ModelQuantity(found.tangential_force_N, "N", "given tangential force", step),
        "F_t_transmitted": ModelQuantity(
            found.friction_force_N, "N", "F_t that friction bears", step
        ),
        "stress": ModelQuantity(
            found.stress_MPa, "MPa", "mean stress of the strips S1 and S2", (*step, "strip")
        ),
        "status": ModelQuantity(
            found.status, "", "status of each node: 0 apart, 1 stick, others slip", (*step, "node")
        ),
        "ridge_of_node": ModelQuantity(
            found.ridge_of_node, "", "ridge, 0 is the leftmost", ("node",)
        ),
        "ridge_first_slip": ModelQuantity(found.truth.first_slip_s, "s", "first node slips", ridge),
        "ridge_whole_slip": ModelQuantity(
            found.truth.whole_slip_s, "s", "whole ridge slips", ridge
        ),
        "gross_slip": ModelQuantity(found.truth.gross_slip_s, "s", "slip of the whole skin"),
        "stable_step": ModelQuantity(found.stable_step_us, "us", "largest stable explicit step"),
    }


def quantities_of_map(found: DesignMap) -> dict[str, ModelQuantity]:
    """Return what is kept of a map."""
    from rig.files.model_file import ModelQuantity

    places = ("ridge", "bottom", "offset", "component")
    settings = found.settings
    return {
        "bottom": ModelQuantity(
            settings.bottoms_mm, "mm", "lower edge above the foot", ("bottom",)
        ),
        "offset": ModelQuantity(settings.offsets_mm, "mm", "distance from the axis", ("offset",)),
        "hump": ModelQuantity(found.hump_V, "V", "v_d before the ridge slips; xx, yy, xy", places),
        "hf_peak": ModelQuantity(
            found.peak_V, "V", "largest |v_d| above 100 Hz as it slips; xx, yy, xy", places
        ),
    }


def save_model(model: Model, drawn: dict[str, Figure], results: Path) -> list[Path]:
    """Save the data as HDF5 and each figure as PNG and SVG in `results`, with a number if one of
    the names is taken: what took minutes to compute is not lost, and nothing is overwritten.
    Returns the paths of the files, the data first. Raises OutputError where they cannot be
    written."""
    from rig.figures.style import save
    from rig.files.model_file import write_model

    try:
        results.mkdir(parents=True, exist_ok=True)
        data, number = _reserved(results, model.stem, list(drawn))
        try:
            write_model(data, model.title, "rig skin", model.settings, model.results)
        except BaseException:
            data.unlink(missing_ok=True)
            raise
        figures = [
            file
            for stem, figure in drawn.items()
            for file in save(figure, results / f"{stem}{number}.png", simulated=True)
        ]
    except OSError as error:
        raise OutputError(
            f"the results cannot be written to {results}: {error.strerror}",
            "choose another folder with --results",
        ) from error
    return [data, *figures]


def _reserved(results: Path, stem: str, stems: list[str]) -> tuple[Path, str]:
    """Create the empty data file under a name that neither it nor a figure has yet; return it and
    the ending of the names: "", "-2", "-3", ... Two commands at once get different ones."""
    for added in itertools.chain([""], (f"-{number}" for number in itertools.count(2))):
        taken = (results / f"{each}{added}{kind}" for each in stems for kind in (".png", ".svg"))
        data = results / f"{stem}{added}.h5"
        if any(path.exists() for path in taken):
            continue
        try:
            data.touch(exist_ok=False)
        except FileExistsError:
            continue
        return data, added
    raise AssertionError("endings have no end")
