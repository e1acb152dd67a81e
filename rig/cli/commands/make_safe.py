"""The command that makes a bench safe. It imports only what it needs, because it has to work when
other parts of the program or of the installation are broken."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.outcome import reported, say, say_failure
from rig.core.errors import ConfigurationError, ExitCode, RigError, UnsafeError

if TYPE_CHECKING:
    from rig.bench.plan import Restable


BENCH_FILE = Path("bench.toml")


def make_safe(
    bench: Annotated[Path, typer.Option(help="Bench file.", metavar="FILE")] = BENCH_FILE,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Put every instrument of a bench into its safe state: motion stopped, outputs off.

    An instrument whose driver is broken, or whose table in the bench file is wrong, does not
    prevent making the others safe. A run on the bench is not waited for: it fails when its
    instruments stop without its command. A rig monitor on the bench is ended. Ctrl-C does not
    interrupt it.
    """
    from rig.run.stopping import StopFlag

    with reported(debug), StopFlag():
        from rig.bench.plan import parse_to_make_safe
        from rig.core.toml_files import MAX_TOML_BYTES, read_text
        from rig.run.making_safe.guard import make_bench_safe

        if not bench.exists():
            raise ConfigurationError(
                f"no {bench} here" if bench == BENCH_FILE else f"bench file {bench} not found",
                "name the bench file with --bench (a simulated bench that a command starts for "
                "itself makes itself safe)",
            )
        text = read_text(bench, "bench file", MAX_TOML_BYTES)
        described = parse_to_make_safe(text, str(bench))
        if not described.instruments and not described.failures:
            raise ConfigurationError(
                f"the bench file {bench} names no instruments: nothing was made safe",
                "add their tables, or name the file of your bench with --bench",
            )
        with _only_warning():
            _end_readers(described)
        with _only_warning():
            _report_what_is_known(described)
        failures, safe = make_bench_safe(text, str(bench))
        roles = [part.role for part in described.instruments if part.role not in failures]
        name = str(bench) if described.settings is None else described.settings.name
        if roles:
            say(f"{name}: {', '.join(roles)} made safe")
        if not safe or described.settings is None:
            for role, why in failures.items():
                say_failure(UnsafeError(f"{role}: {why}"), debug)
            with _only_warning():
                _mark_unsafe(described, name, failures)
            raise UnsafeError(
                f"NOT SAFE: {', '.join(failures) or name}. Switch the bench off by hand and find "
                "out why"
            )
        _clear_marks(described)
        if failures:
            raise RigError(
                "; ".join(f"{role}: {why}" for role, why in failures.items()),
                "the bench is safe, since it drives nothing; check its connection",
                ExitCode.INSTRUMENT,
            )


@contextlib.contextmanager
def _only_warning() -> Iterator[None]:
    """Show what the block raises, since it must not prevent making the bench safe."""
    try:
        yield
    except RigError as error:
        say(f"warning: {error.one_line()}")


def _end_readers(described: Restable) -> None:
    """End a `rig monitor` of this bench: it may have a serial port for itself."""
    from rig.run.locks.bench_readers import end_readers

    if (pid := end_readers(described)) is not None:
        say(f"ended rig monitor (process {pid}), which was reading this bench")


def _report_what_is_known(described: Restable) -> None:
    """Print the reports of earlier runs, and the program that uses the bench now."""
    from rig.run.locks.bench_mark import read_marks
    from rig.run.locks.lock import address_names, in_use

    for mark in read_marks(address_names(described)):
        if not mark.lives:
            say(mark.in_words())
    if (user := in_use(described)) is not None:
        say(f"{user}; it is made safe all the same, and what runs on it will fail")


def _mark_unsafe(described: Restable, name: str, failures: Mapping[str, str]) -> None:
    """Refuse the bench to every run until this command has succeeded. The mark of a run that is
    still at work stays its own: the run fails, and says itself how it leaves the bench."""
    from rig.run.locks.bench_mark import BenchMarks, read_marks
    from rig.run.locks.lock import address_names

    names = address_names(described)
    free = [one for one in names if not any(mark.lives for mark in read_marks([one]))]
    BenchMarks(free, name, None).unsafe(failures)


def _clear_marks(described: Restable) -> None:
    """Remove the marks of earlier runs, also where the bench had other addresses then; that of one
    that is still at work is its own to remove."""
    from rig.run.locks.bench_mark import clear_marks, read_marks
    from rig.run.locks.lock import address_names

    names = address_names(described)
    then = {name for mark in read_marks(names) for name in mark.names}
    clear_marks(
        [
            name
            for name in (*names, *sorted(then - set(names)))
            if not any(mark.lives for mark in read_marks([name]))
        ]
    )
