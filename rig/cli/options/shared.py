"""Options and arguments that several commands share, each declared once.

`rig make-safe` imports this module, so it imports nothing but typer and the parsers of numbers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options.numbers import LARGEST_SEED, whole_number

RESULTS = Path("results")
"""Folder of results where a command names none."""
BENCH_TOML = Path("bench.toml")
"""Bench file of a command that needs one, where the command names none."""

BenchFile = Annotated[
    Path | None,
    typer.Option(
        help="Bench file; without one, ./bench.toml or the simulated bench.", metavar="FILE"
    ),
]
BenchToml = Annotated[Path, typer.Option(help="Bench file.", metavar="FILE")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
AllowExpired = Annotated[
    bool, typer.Option("--allow-expired", help="Use calibration records that have expired.")
]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]
Seed = Annotated[
    int,
    typer.Option(
        help="Seed of the simulated bench, at least 0.",
        parser=whole_number(0, LARGEST_SEED),
        metavar="NUMBER",
    ),
]
World = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE|population",
        help="Physical parameters of the simulated bench (TOML), or `population`: skin, friction, "
        "strips and head drawn by --seed.",
    ),
]
Fault = Annotated[
    Path | None, typer.Option(help="Fault plan (TOML) of a simulated bench.", metavar="FILE")
]
WorldLog = Annotated[
    Path | None, typer.Option(help="File for a simulated bench's own log.", metavar="FILE")
]
RunFolder = Annotated[Path, typer.Option(help="Folder for run files.", metavar="FOLDER")]
WatchedFolder = Annotated[Path, typer.Option(help="Folder of results to watch.", metavar="FOLDER")]
ProcessedFolder = Annotated[
    Path | None,
    typer.Option(
        help="Folder for the results.  [default: processed/ next to each file]",
        metavar="FOLDER",
    ),
]
AnyFiles = Annotated[
    list[Path],
    typer.Argument(
        help="Run files, processed files, files of rig skin (.h5) or journals (.rigj).",
        metavar="FILE",
    ),
]
BatchPath = Annotated[Path, typer.Argument(help="Batch file (TOML).", metavar="FILE")]
BatchBench = Annotated[
    Path | None,
    typer.Option(
        help="Bench file; without one, the batch file's, ./bench.toml or simulated.", metavar="FILE"
    ),
]
Notes = Annotated[str, typer.Option(help="Remarks.", metavar="TEXT")]
Jobs = Annotated[
    int,
    typer.Option(
        help="Number of parallel processes, 1 to 64.", parser=whole_number(1, 64), metavar="COUNT"
    ),
]
