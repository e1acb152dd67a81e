"""Show the interlock contacts of a bench, reset them after an opening, test that they work.

Without a subcommand it shows each contact: level, latch, last proof test.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.options.shared import BENCH_TOML, BenchToml, Debug
from rig.cli.outcome import reported, say
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan
    from rig.run.interlocks.store import InterlockStore
    from rig.run.interlocks.watch import InterlockWatch

SameBench = Annotated[
    Path | None, typer.Option(help="Bench file.  [default: bench.toml]", metavar="FILE")
]
Contact = Annotated[
    str | None,
    typer.Argument(help="Name of the contact.  [default: all that are latched]", metavar="NAME"),
]
REMOTE = ("SSH_CONNECTION", "SSH_TTY")
"""Variables of a shell that someone has opened from another computer."""

app = typer.Typer(
    name="interlocks",
    invoke_without_command=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.callback()
def show(context: typer.Context, bench: BenchToml = BENCH_TOML, debug: Debug = False) -> None:
    """Show the interlock contacts of a bench, reset them after an opening, test that they work.

    Without a subcommand it shows each contact: level, latch, last proof test.
    """
    context.obj = bench
    if context.invoked_subcommand is not None:
        return
    with reported(debug):
        plan, records = _declared(bench)
        with _looking(plan, records) as watch:
            for contact in plan.settings.interlock:
                record = records.get(contact.name)
                line = f"{contact.name} ({contact.kind}, {contact.input}): "
                line += watch.level(contact.name)
                if record.opened is not None:
                    line += f"; LATCHED since {record.opened}: {record.why}"
                elif record.reset is not None:
                    line += f"; reset {record.reset} by {record.reset_by}"
                proof = "never" if record.proof is None else f"{record.proof} by {record.proof_by}"
                say(f"{line}; last proof test: {proof}")


@app.command()
def reset(
    context: typer.Context, name: Contact = None, bench: SameBench = None, debug: Debug = False
) -> None:
    """Reset `person` contacts that have opened.

    A contact is reset only when it is closed again. At the bench only, from a terminal of its
    computer: look at the bench first, nothing else checks it. The time and the user are recorded.
    Nothing starts by itself afterwards.
    """
    with reported(debug):
        _require_terminal()
        plan, records = _declared(bench or context.obj, name)
        latched = [
            contact.name
            for contact in plan.settings.interlock
            if name in (None, contact.name) and records.get(contact.name).opened is not None
        ]
        if not latched:
            say(
                f"{plan.settings.name}: nothing is latched"
                if name is None
                else f"{name} is not latched"
            )
            return
        from rig.run.interlocks.proof import reset as reset_latch

        with _looking(plan, records) as watch:
            for one in latched:
                reset_latch(watch, one)
                say(f"interlock {one} is reset; nothing starts by itself: start the run again")


@app.command()
def proof(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the contact.", metavar="NAME")],
    bench: SameBench = None,
    debug: Debug = False,
) -> None:
    """Test a contact by opening and closing it by hand.

    The date is recorded when the program has seen both.
    """
    from rig.run.interlocks.proof import prove
    from rig.run.stopping import StopFlag

    with reported(debug), StopFlag() as stop:
        plan, records = _declared(bench or context.obj, name)
        with _looking(plan, records, stop.check) as watch:
            prove(watch, name, say)


def _require_terminal() -> None:
    """Raise ConfigurationError unless a person types this at the computer of the bench."""
    if not sys.stdin.isatty():
        raise ConfigurationError(
            "a reset is typed at a terminal of the bench's computer, not given by another program",
            "look at the bench, then run it there",
        )
    if remote := next((name for name in REMOTE if name in os.environ), None):
        raise ConfigurationError(
            f"a reset is typed at the bench, and this terminal is on another computer ({remote})",
            "go to the bench, look at it, then run it there",
        )


def _declared(path: Path, name: str | None = None) -> tuple[BenchPlan, InterlockStore]:
    """Return the bench and the records of its contacts. Raises ConfigurationError if it has none,
    or none of that name."""
    from rig.bench.plan import read_bench
    from rig.run.interlocks.store import InterlockStore

    hint = "interlocks belong to a bench with a bench file: name it with --bench"
    if not path.exists():
        raise ConfigurationError(f"bench file {path} not found", hint)
    plan = read_bench(path, hint)
    known = [contact.name for contact in plan.settings.interlock]
    if not known:
        raise ConfigurationError(
            f"{path} declares no interlock", "add an [[interlock]] table for each contact"
        )
    if name is not None and name not in known:
        raise ConfigurationError(
            f"{path} declares no interlock {name!r}", f"it declares {', '.join(known)}"
        )
    return plan, InterlockStore(plan, lasting=True)


@contextmanager
def _looking(
    plan: BenchPlan, records: InterlockStore, in_each_wait: Callable[[], None] = lambda: None
) -> Iterator[InterlockWatch]:
    """Watch the contacts without acting on them, under the bench's lock."""
    from rig.run.interlocks.watch import watched
    from rig.run.locks.lock import BenchLock

    with BenchLock(plan), watched(plan, records, in_each_wait, looks_only=True) as watch:
        yield watch
