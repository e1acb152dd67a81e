"""The command ``rig monitor``, which shows the bench in the terminal."""

from __future__ import annotations

import signal
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options.numbers import real_number
from rig.cli.options.shared import RESULTS, Debug, WatchedFolder
from rig.cli.outcome import reported, say
from rig.core.errors import ExitCode
from rig.run.bench_selector import existing_bench_file


def monitor(
    results: WatchedFolder = RESULTS,
    bench: Annotated[
        Path | None,
        typer.Option(
            help="Bench file, whose instruments are read if no run uses it.  "
            "[default: ./bench.toml if it exists]",
            metavar="FILE",
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="End after this time.  [default: at Ctrl-C]", metavar="s", parser=real_number(0)
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Show forces, strips, positions and state in the terminal; nothing moves.

    A run is followed by its journal. Without one, the sensors and stages of the bench file are
    read; nothing is set or switched. A run cannot begin on that bench until the monitor has ended.
    """
    with reported(debug):
        from rich.console import Console

        from rig.page.terminal import show_run
        from rig.page.watch import BenchWatch

        chosen = existing_bench_file(bench)
        shown_since_s: list[float] = []  # the first showing: what is loaded before takes its time

        terminated = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: terminated.set())

        def go_on() -> bool:
            if not shown_since_s:
                shown_since_s.append(time.monotonic())
            over = seconds is not None and time.monotonic() >= shown_since_s[0] + seconds
            return not over and not terminated.is_set()

        watch = BenchWatch(results, chosen)
        watch.poll()
        console = Console()
        if chosen is None or watch.holder is not None or watch.signs.holder is not None:
            show_run(watch, console, go_on)
            _say_if(terminated)
            return
        from rig.bench.plan import read_bench
        from rig.page.live_bench import show_bench
        from rig.run.locks.bench_mark import read_marks
        from rig.run.locks.lock import BenchLock

        plan = read_bench(chosen)
        with ExitStack() as at_the_end:
            lock = at_the_end.enter_context(BenchLock(plan, only_reads=True))
            for mark in read_marks(lock.names):
                say(f"warning: {mark.in_words()}")
            show_bench(plan, console, go_on)
        _say_if(terminated)


def _say_if(terminated: threading.Event) -> None:
    """Say that the monitor was ended by SIGTERM, which `rig make-safe` sends, and exit."""
    if terminated.is_set():
        say("ended by SIGTERM, such as rig make-safe sends; the monitor left nothing running")
        raise typer.Exit(int(ExitCode.SIGTERM))
