"""The command that makes a bench safe. It imports only what it needs, because it has to work when
other parts of the program or of the installation are broken."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.outcome import reported, say
from rig.core.errors import ConfigurationError, UnsafeError


def make_safe(
    bench: Annotated[Path, typer.Option(help="Bench file.")] = Path("bench.toml"),
    results: Annotated[Path, typer.Option(help="Folder with the guard's report.")] = Path(
        "results"
    ),
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Put every instrument of a bench into its safe state: motion stopped, outputs off.

    An instrument whose driver is broken, or whose table in the bench file is wrong, does not
    prevent making the others safe. A run on the bench is not waited for: it fails when its
    instruments stop without its command. Ctrl-C does not interrupt it.
    """
    from rig.run.stopping import StopFlag

    with reported(debug), StopFlag():
        from rig.bench.plan import parse_to_make_safe
        from rig.core.toml_files import MAX_TOML_BYTES, read_text
        from rig.run.guard import make_bench_safe, report_path
        from rig.run.lock import in_use

        if not bench.exists():
            raise ConfigurationError(
                f"there is no bench file {bench}",
                "name the one of the bench with --bench; the simulated bench that a command starts "
                "for itself makes itself safe",
            )
        text = read_text(bench, "bench file", MAX_TOML_BYTES)
        described = parse_to_make_safe(text, str(bench))
        if (user := in_use(described)) is not None:
            say(f"{user}; it is made safe all the same, and what runs on it will fail")
        failures = make_bench_safe(text, str(bench))
        roles = [part.role for part in described.instruments if part.role not in failures]
        name = str(bench) if described.settings is None else described.settings.name
        if roles:
            say(f"{name}: {', '.join(roles)} made safe")
        if failures or described.settings is None:
            raise UnsafeError(
                "; ".join(f"{role}: {why}" for role, why in failures.items()),
                "switch the bench off by hand and find out why",
            )
        report_path(results, name).unlink(missing_ok=True)
