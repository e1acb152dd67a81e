"""``rig train`` trains the network of the detector ``rig`` on simulated trials.

It writes a file in the format of the network that the program contains. The file states the seeds
of the trials, and scoring refuses these seeds.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.outcome import reported, say
from rig.core.atomic import write_text
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.detector.network import Network
    from rig.evaluation.scored_trials import Floats


def train(
    out: Annotated[Path, typer.Option(help="Network file to write (JSON).", dir_okay=False)],
    seeds: Annotated[
        str, typer.Option(help="Seeds of the random trials, END excluded.", metavar="FIRST:END")
    ] = "0:1500",
    units: Annotated[int, typer.Option(help="Units of the hidden layer.", min=1, max=256)] = 16,
    epochs: Annotated[
        int, typer.Option(help="Number of passes over all rows.", min=1, max=1000)
    ] = 30,
    seed: Annotated[
        int, typer.Option(help="Seed of the initial weights and of the order of the rows.", min=0)
    ] = 0,
    jobs: Annotated[int, typer.Option(help="Number of parallel processes.", min=1, max=64)] = 1,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")] = False,
) -> None:
    """Train the network of the detector `rig` on simulated trials whose truth is known."""
    with reported(debug):
        from rig.evaluation.scoring.seeds import FIRST_REPORTING_SEED, seed_range

        drawn = seed_range(seeds)
        if not drawn.tunes:
            raise ConfigurationError(
                f"--seeds {seeds}: seeds from {FIRST_REPORTING_SEED} on are reserved for "
                "reporting; no detector is trained on them",
                f"choose seeds below {FIRST_REPORTING_SEED}",
            )
        if out.exists():
            raise ConfigurationError(f"{out}: exists already", "choose another file")
        if not out.parent.is_dir():
            raise ConfigurationError(
                f"{out.parent}: no such folder", "create it, or choose another folder"
            )
        network = _trained(drawn.first, drawn.end, units, epochs, seed, jobs)
        text = json.dumps(network.model_dump(mode="json"), indent=1) + "\n"
        write_text(out, text)
        typer.echo(
            f"saved {out}: network of {units} units, trained on simulated trials, seeds {drawn}"
        )


def _trained(first: int, end: int, units: int, epochs: int, seed: int, jobs: int) -> Network:
    import numpy as np

    import rig
    from rig.core.cache import user_cache
    from rig.detector.detector import DETECTOR_VERSION, IncipientSlipDetector, NETWORK_RATE_Hz
    from rig.detector.kernel import INPUTS
    from rig.detector.network import OUTPUTS, Network
    from rig.detector.settings import named_detectors
    from rig.evaluation.labelled_trials import LabelledTrial
    from rig.evaluation.scored_trials import Population, Traits, each_trial
    from rig.evaluation.scoring.seeds import SeedRange
    from rig.evaluation.training import TrainingRows, TrainingTrial, learn, rows_of
    from rig.physics.population import PopulationSettings, StripFrontEndSettings
    from rig.physics.skin.condensed import build_skin

    cache, ranges = user_cache(), PopulationSettings()
    population = Population(
        skin=build_skin(ranges.skin, cache),
        settings=ranges,
        front_end=StripFrontEndSettings(),
        swapped_gains=False,
        kinds=("slide", "roll", "hold", "tap"),
        seeds=SeedRange(first=first, end=end),
        cache=cache,
    )
    silent = Network(
        name="silent", inputs=INPUTS, hidden=((0.0,) * (len(INPUTS) + 1),),
        output=((0.0, -50.0),) * len(OUTPUTS), first_seed=0, last_seed=0, trained_by="nothing",
    )  # fmt: skip
    parameters = named_detectors()["rig"].model_copy(update={"network": silent})
    # Designs and caches the filters here, so that the forked workers do not each do it.
    IncipientSlipDetector(parameters, NETWORK_RATE_Hz)

    def taught(trial: LabelledTrial, volts: Floats, _: Traits) -> TrainingRows:
        shown = IncipientSlipDetector(parameters, trial.rate_Hz).network_inputs(volts)
        return rows_of(
            TrainingTrial(
                inputs=shown.inputs,
                time_s=shown.rows / trial.rate_Hz,
                rolls=trial.kind == "roll",
                motion_s=trial.motion_s,
                ridge_slip_s=trial.ridge_slip_s,
                lift_off_s=trial.lift_off_s,
            )
        )

    total = len(population.trials())

    def done(number: int) -> None:
        if number * 10 // total != (number - 1) * 10 // total:
            say(f"train: {number} of {total} trials")

    lessons = list(each_trial(population, taught, jobs, done))
    rows = TrainingRows(
        *(
            np.concatenate([getattr(one, name) for one in lessons])
            for name in ("inputs", "right", "weight")
        )
    )
    say(f"train: {len(rows.inputs)} rows")

    def show(epoch: int, loss: float) -> None:
        say(f"train: epoch {epoch + 1} of {epochs}, loss {loss:.5f}")

    hidden, output = learn(rows, units=units, epochs=epochs, seed=seed, on_epoch=show)
    return Network(
        name=f"rig-{DETECTOR_VERSION}",
        inputs=INPUTS,
        hidden=_rounded(hidden),
        output=_rounded(output),
        first_seed=first,
        last_seed=end - 1,
        trained_by=(
            f"rig train --seeds {first}:{end} --units {units} --epochs {epochs} --seed {seed}, "
            f"tactile-rig {rig.__version__}, detector {DETECTOR_VERSION}; simulated trials only"
        ),
    )


def _rounded(weights: Floats) -> tuple[tuple[float, ...], ...]:
    """Rounds weights to six digits: readable, and more than the training determines."""
    return tuple(tuple(float(f"{one:.6g}") for one in row) for row in weights)
