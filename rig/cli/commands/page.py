"""The command ``rig page``, which shows the bench in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options.numbers import real_number, whole_number
from rig.cli.options.shared import RESULTS, Debug, WatchedFolder
from rig.cli.outcome import reported, say, start_log
from rig.core.errors import ConfigurationError
from rig.run.bench_selector import existing_bench_file

PORT = 8470


def page(
    results: WatchedFolder = RESULTS,
    bench: Annotated[
        Path | None,
        typer.Option(
            help="Bench file, for making the bench safe without a run.  "
            "[default: ./bench.toml if it exists]",
            metavar="FILE",
        ),
    ] = None,
    port: Annotated[
        int,
        typer.Option(
            help="Port on 127.0.0.1, up to 65535; 0 for any free port.",
            parser=whole_number(0, 65535),
            metavar="NUMBER",
        ),
    ] = PORT,
    rate: Annotated[
        float,
        typer.Option(
            help="Maximum redraws per second, 1 to 20.", metavar="Hz", parser=real_number(1, 20)
        ),
    ] = 5.0,
    read_only: Annotated[
        bool, typer.Option("--read-only", help="View only: nothing can be stopped from the page.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Show the running bench in a browser, with STOP.

    It follows the journals of the results folder from a separate process, started before, during
    or after a run. Ctrl-C ends the page, never a run.
    """
    with reported(debug):
        try:
            from rig.page.server import PageState, serve
        except ImportError as error:
            raise ConfigurationError(
                f"the page needs the extra 'page', which is not installed ({error.name})",
                'install it: uv pip install "tactile-rig[page]"',
            ) from error
        from rig.page.access import Access
        from rig.page.history import RunIndex
        from rig.page.watch import BenchWatch

        chosen = existing_bench_file(bench)
        access = Access(read_only)
        state = PageState(BenchWatch(results, chosen), RunIndex(results), access, rate)
        existed = results.is_dir()
        results.mkdir(parents=True, exist_ok=True)  # a page of no folder would show nothing

        def ready(address: str) -> None:
            if not read_only:
                say(f"watch and stop: {address}#token={access.stop_token}")
            say(f"watch only:     {address}#token={access.watch_token}")
            if not existed:
                say(f"{results} did not exist: name the folder of the runs with --results")
            say(f"showing {results}; Ctrl-C ends the page, not the run")

        start_log(results)
        serve(state, port, ready)
