"""A bench without a run in the terminal: forces, signals and positions, as the instruments say.

The bench is locked meanwhile as for a run, since an instrument answers one program at a time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from rig.bench.plan import BenchPlan
from rig.core.errors import ConfigurationError
from rig.core.text import printable
from rig.page.live_links import LiveLink, SensorLink, StageLink, links_of, reading
from rig.page.terminal import DRAWN_EVERY_S, add_value, drawn_in_place, plain, value_table


def show_bench(plan: BenchPlan, console: Console, go_on: Callable[[], bool]) -> None:
    """Read the instruments of a bench and show their values, at least once, until `go_on` returns
    False.

    The caller holds the bench's lock. An instrument that cannot be read says so in a line of its
    own and is tried again. Raises ConfigurationError if the bench has nothing to read.
    """
    links, unreadable = links_of(plan)
    if not links and not unreadable:
        raise ConfigurationError(
            f"{plan.source}: the bench has neither a stage nor a force sensor nor a DAQ to read",
            "name another bench file with --bench",
        )
    with reading(links), drawn_in_place(console) as live:
        live.update(panel(plan, links, unreadable), refresh=True)
        while go_on():
            time.sleep(DRAWN_EVERY_S)
            live.update(panel(plan, links, unreadable), refresh=True)


def panel(plan: BenchPlan, links: Sequence[LiveLink], unreadable: Sequence[str]) -> Group:
    """Return what a terminal shows of the links now."""
    parts: list[Text | Table] = []
    if plan.settings.simulation is not None or any(link.simulated for link in links):
        parts.append(Text(" SIMULATED: these are not measurements ", "bold white on purple"))
    parts.append(
        plain(
            f"bench {plan.settings.name}: no run; nothing is moved or set. Forces as they are, not "
            "tared"
        )
    )
    stages = [link for link in links if isinstance(link, StageLink)]
    parts += _stage_lines(stages, unreadable)
    table = value_table()
    for link in links:
        if isinstance(link, SensorLink):
            with link.lock:
                for name, value in link.values.items():
                    add_value(table, name, value.latest, value.units, list(value.history))
    parts.append(table)
    for link in links:
        if link.failure:
            text = f"{link.role} cannot be read: {link.failure}; trying again"
            parts.append(Text(printable(text), "red"))
    return Group(*parts)


def _stage_lines(stages: Sequence[StageLink], unreadable: Sequence[str]) -> list[Text | Table]:
    """Return the stages as a table, without those whose link has failed."""
    table = Table(box=None, pad_edge=False)
    table.add_column("stage", no_wrap=True)
    table.add_column("position", justify="right", no_wrap=True)
    for column in ("reference", "servo", "motion"):
        table.add_column(column, no_wrap=True)
    table.add_column("fault")
    for link in stages:
        with link.lock:
            status = link.status
        if status is not None:
            table.add_row(
                link.role,
                f"{status.position:.4f} {link.units}",
                "homed" if status.homed else Text("not homed", "yellow"),
                plain(status.servo),
                Text("moves", "yellow") if status.moving else "at rest",
                Text(printable(status.fault), "bold red") if status.fault else "none",
            )
    lines: list[Text | Table] = [table] if table.row_count else []
    if any(link.status is not None and link.status.moving for link in stages):
        lines.append(
            Text(
                "A stage moves, not by a run: stages are asked less often, so that a drive's own "
                "time-out can stop it",
                "yellow",
            )
        )
    lines += [plain(f"{role}: position not offered by its driver") for role in unreadable]
    return lines
