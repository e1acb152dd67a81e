"""The command that makes a bench safe. It imports only what it needs, because it has to work when
other parts of the program or of the installation are broken."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from rig.cli.options.shared import BENCH_TOML, BenchToml, Debug
from rig.cli.outcome import reported, say_all, say_failure
from rig.cli.streams import say_at_once
from rig.core.entry_points import cause
from rig.core.errors import ConfigurationError, ExitCode, RigError, UnsafeError
from rig.core.text import printable

if TYPE_CHECKING:
    from rig.run.locks.bench_users import StopRequests


def make_safe(
    bench: BenchToml = BENCH_TOML,
    debug: Debug = False,
) -> None:
    """Put every instrument of a bench into its safe state: motion stopped, outputs off.

    An instrument whose driver is broken, or whose table in the bench file is wrong, does not
    prevent making the others safe. A run, batch or rig jog on the bench is asked to stop first
    and gets up to 25 s to make the bench safe itself; it usually takes 1 to 3 s. A rig monitor on
    the bench is ended. Ctrl-C does not interrupt rig make-safe.
    """
    from rig.run.stopping import StopFlag

    with reported(debug), StopFlag():
        from rig.bench.plan import OF_THE_FILE, parse_to_make_safe
        from rig.core.toml_files import MAX_TOML_BYTES, read_text
        from rig.run.locks.bench_users import StopRequests, take_turn
        from rig.run.locks.lock import address_names
        from rig.run.making_safe.guard import make_bench_safe

        if not bench.exists():
            raise ConfigurationError(
                f"no {bench} here" if bench == BENCH_TOML else f"bench file {bench} not found",
                "name the bench file with --bench (a simulated bench that a command starts for "
                "itself makes itself safe)",
            )
        try:
            text = read_text(bench, "bench file", MAX_TOML_BYTES)
            described = parse_to_make_safe(text, str(bench))
        except ConfigurationError as error:
            raise ConfigurationError(
                f"nothing was made safe: {error.message}",
                f"{error.hint or 'name the file of your bench with --bench'}; until this command "
                "has succeeded, switch the bench off by hand if it is not at rest",
            ) from error
        if not described.instruments and not described.failures:
            raise ConfigurationError(
                f"the bench file {bench} names no instruments: nothing was made safe",
                "add their tables, or name the file of your bench with --bench",
            )
        names: Sequence[str] = ()
        requests = StopRequests()
        with _only_warning():  # once, because it may ask a name server
            names = address_names(described)
        with _only_warning():
            _end_readers(names)
        with _only_warning():
            _stop_users(names, requests)
        with _only_warning():
            take_turn(names)
        with _only_warning():
            _report_what_is_known(names)
        failures, safe = make_bench_safe(text, str(bench))
        roles = [part.role for part in described.instruments if part.role not in failures]
        name = str(bench) if described.settings is None else described.settings.name
        made_safe = f"{name}: {', '.join(roles)} made safe" if roles else ""
        # Marks before words, for which a terminal may have to be waited for.
        if not safe or described.settings is None:
            with _only_warning():
                _mark_unsafe(names, name, failures)
            say_all(made_safe)
            for role, why in failures.items():
                say_failure(UnsafeError(f"{role}: {why}"), debug)
            if list(failures) == [OF_THE_FILE]:
                raise UnsafeError(
                    f"NOT SAFE: every instrument that {bench} names was made safe, but because of "
                    "the rest of the file it is not known whether these are all",
                    "correct the file, then run this command again",
                )
            raise UnsafeError(
                f"NOT SAFE: {', '.join(failures) or name}. Switch the bench off by hand and find "
                "out why"
            )
        if (at_work := _at_work(names, requests)) is not None:
            say_all(made_safe)
            raise at_work
        try:
            _clear_marks(names)
        finally:
            say_all(made_safe)
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
    except Exception as error:  # noqa: BLE001 - whatever it is, the instruments come next
        text = error.one_line() if isinstance(error, RigError) else cause(error)
        _say_first(f"warning: {text}")


def _say_first(text: str) -> None:
    """Print a line before the bench is safe: a terminal that is held (Ctrl-S) does not get it, and
    keeps no one waiting."""
    say_at_once(printable(text))


def _end_readers(names: Sequence[str]) -> None:
    """End a `rig monitor` of this bench: it may have a serial port for itself."""
    from rig.run.locks.bench_users import end_readers

    if (pid := end_readers(names)) is not None:
        _say_first(f"ended rig monitor (process {pid}), which was reading this bench")


def _stop_users(names: Sequence[str], requests: StopRequests) -> None:
    """Ask the program that uses the bench now to stop, and wait until it has made the bench
    safe."""
    from rig.run.locks.bench_users import ask_users, await_users
    from rig.run.locks.lock import names_in_use

    if (user := names_in_use(names)) is None:
        return
    _say_first(f"{user}; waiting for it to stop and to make the bench safe ...")
    ask_users(names, requests)
    for error in requests.failures:
        _say_first(f"warning: it could not be asked: {error.one_line()}")
    for journal in requests.runs:
        with _only_warning():  # a batch would take its next run
            from rig.batch.running import stop_batch_of

            stop_batch_of(journal)
    await_users(names, requests)


def _report_what_is_known(names: Sequence[str]) -> None:
    """Print the reports of earlier runs, and of one that has just stopped."""
    from rig.run.locks.bench_mark import read_marks

    for mark in read_marks(names):
        if not mark.lives:
            _say_first(mark.in_words())


def _at_work(names: Sequence[str], requests: StopRequests) -> UnsafeError | None:
    """Return an error if a program may move again what has just been stopped, or if that is not
    known."""
    from rig.run.locks.bench_users import still_at_work

    try:
        if not names:
            raise LookupError("its addresses are not known")
        user = still_at_work(names, requests)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is not known
        user = f"another program ({cause(error)})", "make sure that none uses the bench"
    if user is None:
        return None
    return UnsafeError(
        f"NOT SAFE: everything was stopped, but {user[0]} still uses the bench and may move it "
        "again",
        f"{user[1]}, then run this command again",
    )


def _mark_unsafe(names: Sequence[str], bench: str, failures: Mapping[str, str]) -> None:
    """Refuse the bench to every run until this command has succeeded. The mark of a run that is
    still at work stays its own: the run fails, and says itself how it leaves the bench."""
    from rig.run.locks.bench_mark import BenchMarks, read_marks

    free = [one for one in names if not any(mark.lives for mark in read_marks([one]))]
    BenchMarks(free, bench, None).unsafe(failures)


def _clear_marks(names: Sequence[str]) -> None:
    """Remove the marks of earlier runs, also where the bench had other addresses then; that of one
    that is still at work is its own to remove. Note what was made safe."""
    from rig.run.locks.bench_mark import clear_marks, note_made_safe, read_marks

    then = {name for mark in read_marks(names) for name in mark.names}
    cleared = [
        name
        for name in (*names, *sorted(then - set(names)))
        if not any(mark.lives for mark in read_marks([name]))
    ]
    clear_marks(cleared)
    with _only_warning():
        note_made_safe([name for name in cleared if name in names])
