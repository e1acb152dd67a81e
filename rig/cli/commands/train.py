"""``rig train`` trains the network of the detector ``rig`` on trials whose truth is known: of the
skin model, of the whole simulated bench, and of run files.

It writes a file in the format of the network that the program contains. The file states on what it
was trained, and scoring refuses the seeds. A fifth of the trials is held out and judged at the end.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.commands.model_errors import model_errors
from rig.cli.options.new_file import check_new_file
from rig.cli.options.numbers import LARGEST_SEED, whole_number
from rig.cli.options.settings_file import read_settings
from rig.cli.options.shared import Debug, Jobs
from rig.cli.outcome import reported, say
from rig.cli.progress import TenthsProgress, WireProgress
from rig.core.atomic import write_text
from rig.core.errors import ConfigurationError
from rig.core.units import counted
from rig.files.errors import RecordingError

if TYPE_CHECKING:
    from rig.detector.network import Network
    from rig.evaluation.lessons import Lesson
    from rig.evaluation.scored_trials import Floats
    from rig.evaluation.scoring.seeds import SeedRange
    from rig.evaluation.training import TrainingRows
    from rig.physics.population import PopulationSettings, StripFrontEndSettings

MODEL_SEEDS = "0:100"
"""Seeds of the model's trials where nothing is named."""
HEARINGS = 4
"""Number of times that each simulated trial is heard: of the model through as many front ends, of
the bench twice as it was recorded and through two."""


def train(
    out: Annotated[
        Path, typer.Option(help="Network file to write (JSON).", dir_okay=False, metavar="FILE")
    ],
    seeds: Annotated[
        str | None,
        typer.Option(
            help="Seeds of trials of the skin model, END excluded. Each seed gives one trial of "
            f"each kind.  [default: {MODEL_SEEDS}; none with --wire or --files]",
            metavar="FIRST:END",
        ),
    ] = None,
    wire: Annotated[
        str | None,
        typer.Option(
            help="Seeds of trials on the whole simulated bench. Those not stored yet are made (5 "
            "s of processor time or more each).",
            metavar="FIRST:END",
        ),
    ] = None,
    files: Annotated[
        Path | None,
        typer.Option(
            help="CSV list of run files, labelled as for `rig score --files`. Roll trials need no "
            "label: they have no slip.",
            metavar="FILE",
        ),
    ] = None,
    population: Annotated[
        Path | None,
        typer.Option(help="JSON file with the ranges of the model's trials.", metavar="FILE"),
    ] = None,
    front_end: Annotated[
        Path | None,
        typer.Option(
            help="JSON file with the ranges of the front end of the model's trials.", metavar="FILE"
        ),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option(
            "--all",
            help="Learn from all trials and hold none out, once the other options are chosen.",
        ),
    ] = False,
    members: Annotated[
        int,
        typer.Option(
            help="Number of networks that are trained separately and averaged into one, 1 to 16.",
            parser=whole_number(1, 16),
            metavar="COUNT",
        ),
    ] = 2,
    units: Annotated[
        int,
        typer.Option(
            help="Hidden units of each network, 1 to 256.",
            parser=whole_number(1, 256),
            metavar="COUNT",
        ),
    ] = 64,
    epochs: Annotated[
        int,
        typer.Option(
            help="Number of passes over all recordings, 1 to 1000.",
            parser=whole_number(1, 1000),
            metavar="COUNT",
        ),
    ] = 40,
    seed: Annotated[
        int,
        typer.Option(
            help="Seed of the initial weights and of the order of the recordings, at least 0.",
            parser=whole_number(0, LARGEST_SEED),
            metavar="NUMBER",
        ),
    ] = 0,
    jobs: Jobs = 1,
    debug: Debug = False,
) -> None:
    """Train the network of the detector `rig` on trials whose truth is known."""
    with reported(debug), model_errors("omit its seed"):
        from rig.evaluation.lessons import LESSON_FRONT_END, LESSON_POPULATION

        check_new_file("--out", out)  # now, not after hours of training
        if seeds is None and wire is None and files is None:
            seeds = MODEL_SEEDS
        if seeds is None and (population or front_end):
            option = "--population" if population else "--front-end"
            raise ConfigurationError(
                f"{option} changes trials of the skin model, and none are asked for",
                f"add --seeds FIRST:END, or leave out {option}",
            )
        ranges = read_settings(LESSON_POPULATION, population)
        if ranges.ridge > ranges.skin.ridges:
            raise ConfigurationError(
                f"{population}: ridge {ranges.ridge}: the skin has only {ranges.skin.ridges} "
                "ridges",
                f"choose 1 to {ranges.skin.ridges}",
            )
        sources = Sources(
            seeds=_tuning_seeds("--seeds", seeds),
            wire=_tuning_seeds("--wire", wire),
            files=files,
            population=ranges,
            front_end=read_settings(LESSON_FRONT_END, front_end),
            everything=everything,
            jobs=jobs,
        )
        sources.check_files()
        numbers = f"--members {members} --units {units} --epochs {epochs} --seed {seed}"
        command = " ".join(["rig train", *sources.words(population, front_end), numbers])
        try:
            network, held_out = _trained(out.stem, sources, members, units, epochs, seed, command)
        except (KeyboardInterrupt, SystemExit):
            say(
                "train: interrupted, and no network is saved; trials that were computed are "
                "stored, so that the same command repeats only the training"
            )
            raise
        wanted, out = out, _free(out)
        if out != wanted:  # as by a second training, which ended before this one
            say(f"train: {wanted} has been written meanwhile; this network is saved as {out}")
            network = network.model_copy(update={"name": out.stem})
        text = json.dumps(network.model_dump(mode="json"), indent=1) + "\n"
        try:
            write_text(out, text)
        except OSError as error:
            raise RecordingError(
                out,
                f"the network cannot be written: {error.strerror or error}",
                "free space there and repeat the command, which gives the same network",
            ) from error
        size = f"{len(network.hidden)} units"
        typer.echo(f"saved {out}: network of {size}, trained on {network.trained_on}")
        if held_out:  # after it, as this takes a while and may be interrupted
            _judge(network, held_out)


def _free(file: Path) -> Path:
    """Return the file, or where it exists, the first of ``NAME-2``, ``NAME-3`` that does not."""
    number, free = 1, file
    while free.exists():
        number += 1
        free = file.with_stem(f"{file.stem}-{number}")
    return free


@dataclass(frozen=True)
class Sources:
    """The trials and files that a network learns from."""

    seeds: SeedRange | None
    """Trials of the skin model."""
    wire: SeedRange | None
    """Trials on the simulated bench."""
    files: Path | None
    """List of run files."""
    population: PopulationSettings
    front_end: StripFrontEndSettings
    everything: bool
    """True if nothing is held out."""
    jobs: int
    counted: dict[str, int] = field(default_factory=dict)
    """Number of trials by source, as far as they have been read."""
    held: dict[str, int] = field(default_factory=dict)
    """Number of those that are held out, likewise."""

    def words(self, population: Path | None, front_end: Path | None) -> list[str]:
        """Return the options of the command that names these sources."""
        given = {
            "--seeds": self.seeds, "--wire": self.wire, "--files": self.files,
            "--population": population, "--front-end": front_end,
        }  # fmt: skip
        words = [f"{option} {value}" for option, value in given.items() if value is not None]
        return [*words, "--all"] if self.everything else words

    def said(self) -> str:
        """Return how many trials of each source there were, in words."""
        return ", ".join(f"{counted(n, 'trial')} {of}" for of, n in self.counted.items())

    def learnt(self) -> str:
        """Return how many trials of each source are not held out, in words."""
        numbers = {of: number - self.held.get(of, 0) for of, number in self.counted.items()}
        return ", ".join(f"{counted(n, 'trial')} {of}" for of, n in numbers.items() if n)

    def check_files(self) -> None:
        """Raise RigError for a list of run files that cannot be used, before trials of the other
        sources are made."""
        from rig.detector.built_in import Rig
        from rig.detector.resampling import check_rate
        from rig.evaluation.labelled_files import listed_trials
        from rig.evaluation.lessons import sides_of

        if self.files is None:
            return
        groups = []
        for one, _ in listed_trials(self.files):
            try:
                if not Rig.accepts(one.rate_Hz):
                    check_rate(one.rate_Hz)
            except ValueError as error:
                raise ConfigurationError(f"{one.where}: {one.name}: {error}") from error
            groups.append((one.sample, one.day))
        if not self.everything:
            sides_of(groups)

    def lessons(self) -> Iterator[Lesson]:
        """Yield all lessons, source by source. Raises ConfigurationError for a file that cannot
        be used."""
        for source, lessons in (
            ("of the skin model", self._of_the_model()),
            ("on the simulated bench", self._of_the_bench()),
            ("of run files", self._of_files()),
        ):
            for one in lessons:
                self.counted[source] = self.counted.get(source, 0) + one.first
                if one.held_out and not self.everything:
                    self.held[source] = self.held.get(source, 0) + one.first
                yield one
            if source in self.counted:
                held = self.held.get(source, 0)
                left_out = f", {held} of them held out" if held else ""
                say(f"train: {counted(self.counted[source], 'trial')} {source}{left_out}")

    def _of_the_model(self) -> Iterator[Lesson]:
        from rig.core.cache import user_cache
        from rig.evaluation.labelled_trials import LabelledTrial
        from rig.evaluation.lessons import LESSON_KINDS, model_lessons
        from rig.evaluation.scored_trials import Population, Traits, each_trial
        from rig.physics.skin.condensed import build_skin

        if self.seeds is None:
            return
        cache = user_cache()
        population = Population(
            skin=build_skin(self.population.skin, cache),
            settings=self.population,
            front_end=self.front_end,
            swapped_gains=False,
            kinds=LESSON_KINDS,
            seeds=self.seeds,
            cache=cache,
        )
        total = len(population.trials())

        def heard(trial: LabelledTrial, _: Floats, __: Traits) -> list[Lesson]:
            return list(model_lessons(trial, self.front_end, HEARINGS))

        done = TenthsProgress("train", "trials of the skin model", total)
        for lessons in each_trial(population, heard, self.jobs, done):
            yield from lessons

    def _of_the_bench(self) -> Iterator[Lesson]:
        from rig.core.cache import user_cache
        from rig.evaluation.lessons import LESSON_WIRE_KINDS, bench_lessons
        from rig.evaluation.wire.making import make_trials

        if self.wire is None:
            return
        progress = WireProgress("train", self.jobs)
        kinds, seeds = LESSON_WIRE_KINDS, self.wire.seeds()
        # In the order of their names, so that the same command gives the same network.
        made = sorted(
            make_trials(kinds, seeds, user_cache(), self.jobs, progress),
            key=lambda one: (one.trial.seed, kinds.index(one.trial.kind)),
        )
        for one in made:
            if one.record is None:
                say(f"train: {one.trial.name} could not be made: {one.failed}")
            yield from bench_lessons(one, HEARINGS)

    def _of_files(self) -> Iterator[Lesson]:
        from rig.evaluation.labelled_files import listed_trials
        from rig.evaluation.lessons import file_lesson, sides_of

        if self.files is None:
            return
        listed = [one for one, _ in listed_trials(self.files)]
        if self.everything:
            sides = [False] * len(listed)
        else:
            sides = sides_of([(one.sample, one.day) for one in listed])
        for one, held_out in zip(listed, sides, strict=True):
            yield file_lesson(one, held_out)


def _tuning_seeds(option: str, text: str | None) -> SeedRange | None:
    from rig.evaluation.scoring.seeds import FIRST_REPORTING_SEED, seed_range

    if text is None:
        return None
    drawn = seed_range(text, option, "0:100")
    if not drawn.tunes:
        raise ConfigurationError(
            f"{option} {text}: seeds from {FIRST_REPORTING_SEED} on are reserved for reporting; "
            "no detector is trained on them",
            f"choose seeds below {FIRST_REPORTING_SEED}",
        )
    return drawn


def _trained(
    name: str, sources: Sources, members: int, units: int, epochs: int, seed: int, command: str
) -> tuple[Network, list[Lesson]]:
    """Return the network, and the lessons that were held out."""
    import rig
    from rig.detector.detector import DETECTOR_VERSION
    from rig.detector.kernel import INPUTS
    from rig.detector.network import Network
    from rig.evaluation.lessons import Teacher
    from rig.evaluation.training import learn_together

    teacher = Teacher()
    learnt: list[TrainingRows] = []
    held_out: list[Lesson] = []
    for lesson in sources.lessons():
        if lesson.held_out and not sources.everything:
            held_out.append(lesson)
            continue
        try:
            learnt.append(teacher.rows_of(lesson))
        except ValueError as error:
            raise ConfigurationError(f"{lesson.name}: {error}") from error
    if not learnt or not (held_out or sources.everything):
        raise ConfigurationError(
            f"{sources.said() or 'no trials'}: too few to train on some and to hold others out",
            "take at least five seeds, or files of two samples",
        )
    if not any(len(one.inputs) for one in learnt):
        raise ConfigurationError(
            f"{sources.said()}: in none of them is the skin touched, so there is nothing to learn",
            "check the channels and that the strips' signals are in volts",
        )
    if not any((one.slip >= 0).any() for one in learnt):
        raise ConfigurationError(
            f"{sources.said()}: those to learn from have no slip of the whole ridge, so the "
            "network would never alarm",
            "add trials with slips (label, ridge_slip_s)"
            + ("" if sources.everything else ", or hold none out with --all"),
        )
    if not any((one.right[:, 1] > 0).any() for one in learnt):
        say("train: no trial to learn from is a roll, so the network does not report rolls")
    say(f"train: {sum(len(one.inputs) for one in learnt)} rows")

    def show(epoch: int, loss: float) -> None:
        if (epoch + 1) * 10 // epochs != epoch * 10 // epochs:
            say(f"train: epoch {epoch + 1} of {epochs}, loss {loss:.5f}")

    hidden, output = learn_together(learnt, members, units, epochs, seed, show)
    seeds = [one for one in (sources.seeds, sources.wire) if one is not None]
    network = Network(
        name=name,
        inputs=INPUTS,
        hidden=_rounded(hidden),
        output=_rounded(output),
        first_seed=min((one.first for one in seeds), default=0),
        last_seed=max((one.end for one in seeds), default=0) - 1,
        trained_by=f"{command}, tactile-rig {rig.__version__}, detector {DETECTOR_VERSION}",
        trained_on=sources.learnt(),
    )
    return network, held_out


def _judge(network: Network, held_out: list[Lesson]) -> None:
    """Print how the network does on what it has not seen."""
    from rig.evaluation.lessons import judged

    typer.echo("held out (a fifth of the seeds, samples and days):")
    for name, hits, of, low, high in judged(network, held_out):
        typer.echo(f"  {name}: {hits}/{of} ({low:.0%} to {high:.0%})")


def _rounded(weights: Floats) -> tuple[tuple[float, ...], ...]:
    """Round weights to six digits: readable, and more than the training determines."""
    return tuple(tuple(float(f"{one:.6g}") for one in row) for row in weights)
