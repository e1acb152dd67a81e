"""The running bench in a terminal: the same watch as the page's, drawn with rich."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from rig.core.text import printable
from rig.core.units import counted
from rig.page.watch import BenchWatch

DRAWN_EVERY_S = 0.25
COLOURS = {
    "running": "white on blue",
    "holding": "black on yellow",
    "pressed": "black on dark_orange",
    "safe": "white on green",
    "UNSAFE": "bold white on red",
    "unknown": "black on grey70",
}
BARS = " ▁▂▃▄▅▆▇█"
BAR_BINS = 60
FEWEST_BARS = 8
SHOWN_EVENTS = 6
OLD_S = 2.0
"""Age in s from which a value is said to be old."""


def show_run(watch: BenchWatch, console: Console, go_on: Callable[[], bool]) -> None:
    """Show what the watch sees, at least once, until `go_on` returns False."""
    with drawn_in_place(console) as live:
        live.update(run_panel(watch), refresh=True)
        while go_on():
            watch.poll()
            live.update(run_panel(watch), refresh=True)
            if not watch.behind:
                time.sleep(DRAWN_EVERY_S)


@contextmanager
def drawn_in_place(console: Console) -> Iterator[Live]:
    """Give what draws in the same place again and again. In a file, too, its last line is whole:
    rich ends it on a terminal only."""
    try:
        with Live(console=console, auto_refresh=False, transient=False) as live:
            yield live
    finally:
        if not console.is_terminal:
            console.line()


def run_panel(watch: BenchWatch) -> Group:
    """Return what a terminal shows of the watch now."""
    with watch.lock:
        view, word = watch.view, watch.word
        shown = view.summary()
        latest = watch.last_file
        parts: list[Text | Table] = []
        if mark := (latest or shown).get("mark", ""):
            text = printable(f" {mark}: these are not measurements ")
            parts.append(Text(text, "bold white on purple"))
        line = Text(f" {word.word} ", COLOURS[word.word])
        line.append(printable(f" {word.reason}"), "default")
        parts.append(line)
        if shown:
            sample = f"sample {shown['sample'] or 'not named'}"
            parts.append(
                plain(
                    f"{shown['procedure']}: {_progress(watch, shown)}; {sample}; "
                    f"{shown['last_s']:.1f} s"
                )
            )
        if latest:
            text = f"latest run: {latest['file']}, {latest['status']}, exit {latest['exit']}"
            parts.append(plain(text))
        if (values := _values(watch)).row_count:
            parts.append(values)
        parts += [
            plain(f"{event['t']:.2f} s {event['code']}: {event['text']}")
            for event in list(view.events)[-SHOWN_EVENTS:]
        ]
    return Group(*parts)


def _progress(watch: BenchWatch, shown: Mapping[str, Any]) -> str:
    """Return how far a run is, or has come."""
    done = f"{shown['done']} of {counted(shown['planned'], 'point')}"
    if shown["valid"] is not None and shown["valid"] < shown["done"]:
        done += f", {shown['valid']} of them valid"
    if shown["end"] is not None:
        return f"{shown['end']['status']}, {done}"
    if watch.holder is None:
        return f"interrupted, {done}"
    left_s = shown["left_s"]
    left = "time left not known yet" if left_s is None else f"about {left_s:.0f} s left"
    point = shown["point"] or "none open"
    valid = "" if shown["valid"] is None else f"{shown['valid']} of {shown['done']} valid, "
    return f"point {shown['n']} of {shown['planned']} ({point}), {valid}{left}"


def plain(text: str) -> Text:
    """Return text from a file, which must not control the terminal: rich passes escapes on."""
    return Text(printable(text))


def _values(watch: BenchWatch) -> Table:
    table = value_table()
    view = watch.view
    quiet = watch.holder is None or view.end is not None or watch.silent_s() > OLD_S
    for name, ring in view.rings.items():
        old = quiet or view.last_s - ring.latest_s > OLD_S
        history = ring.since(ring.last_key - BAR_BINS)
        for number, channel in enumerate(ring.channels):
            if ring.latest:
                highs = history["high"][number]
                units = f"{ring.units} (old)" if old else ring.units
                label = name if channel == name else f"{name} {channel}"
                add_value(table, label, ring.latest[number], units, highs)
    return table


def value_table() -> Table:
    """Return an empty table of values with their last seconds as bars, for which names, values and
    units leave the room. Where there is too little for these, names continue on the next line: no
    value is cut."""
    table = Table(box=None, pad_edge=False)
    table.add_column("channel", overflow="fold")
    table.add_column("latest", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("last seconds")
    return table


def add_value(
    table: Table, name: str, latest: float, units: str, history: list[float | None]
) -> None:
    """Add one value with its history, oldest first, scaled to its own range."""
    table.add_row(plain(name), Text(f"{latest:.5g}"), plain(units), Bars(history))


@dataclass(frozen=True)
class Bars:
    """A history as bars: as much of its latest part as there is room for."""

    history: list[float | None]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(bars(self.history[-options.max_width :]), no_wrap=True)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(min(FEWEST_BARS, len(self.history)), len(self.history))


def bars(values: list[float | None]) -> str:
    """Return values as a line of bars between the smallest and the largest of them."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    low, high = min(known), max(known)
    span = (high - low) or 1.0
    return "".join(
        " " if value is None else BARS[round((value - low) / span * (len(BARS) - 1))]
        for value in values
    )
