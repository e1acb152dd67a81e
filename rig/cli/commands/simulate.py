"""The command ``rig simulate``, which serves a simulated bench."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from rig.bench.settings import Fixture
from rig.cli.options.numbers import LARGEST_SEED, one_of, whole_number
from rig.cli.options.settings import SimulatedStages
from rig.cli.options.shared import Debug, World
from rig.cli.outcome import reported, say
from rig.core.atomic import write_text
from rig.core.errors import ConfigurationError, OutputError
from rig.core.text import in_shell

if TYPE_CHECKING:
    from rig.bench.simulated import BenchFactory


def simulate(
    fixture: Annotated[
        Fixture,
        typer.Option(
            help="Mounted fixture.",
            parser=one_of(*get_args(Fixture)),
            metavar="[film-clamp|plate|semi-spherical-object]",
        ),
    ] = "film-clamp",
    stages: SimulatedStages = None,
    replace: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=DRIVER",
            help="Use the installed simulator of another driver, such as force_sensor=acme-f10.",
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            help="Seed of films and noise, at least 0.",
            parser=whole_number(0, LARGEST_SEED),
            metavar="NUMBER",
        ),
    ] = 0,
    world: World = None,
    fault: Annotated[Path | None, typer.Option(help="Fault plan (TOML).", metavar="FILE")] = None,
    world_log: Annotated[
        Path | None, typer.Option(help="File for the World's own log.", metavar="FILE")
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(help="Write the bench file here instead of to stdout.", metavar="FILE"),
    ] = None,
    debug: Debug = False,
) -> None:
    """Serve the simulated bench in real time and print the bench file that drives it."""
    with reported(debug):
        from rig.core.entry_points import BENCHES, load

        def ready(text: str) -> None:
            if write is None:
                print(text, flush=True)  # noqa: T201 - stdout carries data
            else:
                _write_bench_file(write, text)
            where = f"with --bench {in_shell(write)}" if write else "with this bench file"
            say(f"SIMULATED bench, seed {seed}, in real time; drive it {where}; Ctrl-C ends it")

        options = {"world": world, "fault": fault, "world_log": world_log}
        paths = {name: None if path is None else str(path) for name, path in options.items()}
        chosen: dict[str, Any] = {} if stages is None else {"stages": stages}
        factory: BenchFactory = load(BENCHES, "simulated")
        chosen["replace"] = _replaced(replace or [])
        factory.serve({"fixture": fixture, **chosen, "seed": seed, **paths}, ready, say)
        say("the simulated bench has ended")


def _replaced(given: list[str]) -> dict[str, str]:
    """Return the drivers of ``--replace`` by role."""
    replaced: dict[str, str] = {}
    for text in given:
        role, equals, driver = text.partition("=")
        if not (role and equals and driver) or role in replaced:
            raise ConfigurationError(
                f"--replace {text!r} does not name a role and a driver, each role once",
                "write for example --replace force_sensor=acme-f10",
            )
        replaced[role] = driver
    return replaced


def _write_bench_file(path: Path, text: str) -> None:
    """Write the file whole or not at all: another program may be waiting for it to appear."""
    try:
        write_text(path, text, durable=False)
    except OSError as error:
        raise OutputError(
            f"the bench file {path} cannot be written: {error.strerror}",
            "name a file in an existing folder",
        ) from error
