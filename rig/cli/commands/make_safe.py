"""The command that makes a bench safe. It imports only what it needs, because it has to work when
other parts of the program or of the installation are broken."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.outcome import reported, say, say_failure
from rig.cli.streams import say_at_once
from rig.core.errors import ConfigurationError, ExitCode, RigError, UnsafeError
from rig.core.text import printable

if TYPE_CHECKING:
    from rig.bench.plan import Restable


BENCH_FILE = Path("bench.toml")


def make_safe(
    bench: Annotated[Path, typer.Option(help="Bench file.", metavar="FILE")] = BENCH_FILE,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Put every instrument of a bench into its safe state: motion stopped, outputs off.

    An instrument whose driver is broken, or whose table in the bench file is wrong, does not
    prevent making the others safe. A run, batch or rig jog on the bench is asked to stop first and
    gets a few seconds to make the bench safe itself. A rig monitor on the bench is ended. Ctrl-C
    does not interrupt it.
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
            _stop_users(described)
        with _only_warning():
            _take_turn(described)
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
        _refuse_a_run_at_work(described)
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
        _say_first(f"warning: {error.one_line()}")


def _say_first(text: str) -> None:
    """Print a line before the bench is safe: a terminal that is held (Ctrl-S) does not get it, and
    keeps nobody waiting."""
    say_at_once(printable(text))


def _end_readers(described: Restable) -> None:
    """End a `rig monitor` of this bench: it may have a serial port for itself."""
    from rig.run.locks.bench_users import end_readers

    if (pid := end_readers(described)) is not None:
        _say_first(f"ended rig monitor (process {pid}), which was reading this bench")


def _stop_users(described: Restable) -> None:
    """Ask the program that uses the bench now to stop, and wait for it for some seconds."""
    from rig.run.locks.bench_users import stop_users
    from rig.run.locks.lock import in_use

    if (user := in_use(described)) is None:
        return
    _say_first(f"{user}; waiting for it to stop and to make the bench safe ...")
    for error in stop_users(described):
        _say_first(f"warning: it could not be asked: {error.one_line()}")


def _take_turn(described: Restable) -> None:
    """Let another `rig make-safe` of this bench finish first."""
    from rig.run.locks.bench_users import take_turn

    with contextlib.suppress(OSError):  # a full disk: both act at the same time
        take_turn(described)


def _report_what_is_known(described: Restable) -> None:
    """Print the reports of earlier runs, and of one that has just stopped."""
    from rig.run.locks.bench_mark import read_marks
    from rig.run.locks.lock import address_names

    for mark in read_marks(address_names(described)):
        if not mark.lives:
            _say_first(mark.in_words())


def _refuse_a_run_at_work(described: Restable) -> None:
    """Raise UnsafeError if a run lives that may move again what has just been stopped."""
    from rig.run.locks.bench_users import run_at_work

    if (mark := run_at_work(described)) is not None and mark.run is not None:
        raise UnsafeError(
            f"NOT SAFE: everything was stopped, but the run of {mark.user} (process "
            f"{mark.run.pid}) has not ended and may move it again",
            f"end it (kill -9 {mark.run.pid}), then run this command again",
        )


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
