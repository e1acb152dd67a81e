"""A description of a file that fits a screen, whatever the file holds.

`rig show FILE` prints it; `--all` and `--json` have everything. A heading is never left out. Below
it the sections share the lines that are left: results come first, then settings, then the rest.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from rig.core.errors import shortened
from rig.core.text import printable

LINES = 23
"""Lines that are used of a terminal's 24; the prompt takes one."""
COLUMNS = 80
_LEAST = 3
"""Lines that a section gets in any case: its name, one text, and how many more there are."""


@dataclass(frozen=True)
class Section:
    """Texts under a name."""

    name: str
    texts: Sequence[str]
    rank: int = 1
    """The section of the lowest rank takes the lines that it wants first."""

    @property
    def least(self) -> int:
        """Lines that it needs in any case, with its texts shortened."""
        return len(self.within(min(_LEAST, 1 + len(self.texts))))

    def within(self, room: int) -> list[str]:
        """Return at most `room` lines of the section. `room` has to be 3 or more, or 2 for a single
        text. Each text is whole, as long as a line is left for each that follows; otherwise as many
        texts as fit are shown."""
        if not self.texts:
            return []
        if len(self.texts) == 1 and len(line := f"{self.name}: {self.texts[0]}") <= COLUMNS:
            return [line]
        lines, fit = [f"{self.name}:"], len(self.texts) < room
        texts = self.texts if fit else self.texts[: room - 2]
        spare = room - 1 - len(texts) if fit else 0
        for text in texts:
            whole = _wrapped(text)
            if len(whole) - 1 <= spare:
                spare -= len(whole) - 1
                lines += whole
            else:
                lines.append("  " + shortened(text, COLUMNS - 2))
        more = len(self.texts) - len(texts)
        return [*lines, f"  ... and {more} more; --all shows them"] if more else lines


def on_a_screen(
    head: Sequence[str], sections: Sequence[Section], foot: Sequence[str], most: int = LINES
) -> list[str]:
    """Return at most `most` lines of at most `COLUMNS` characters.

    Each text of `head` is shortened to a line, unless lines are left over at the end, and each of
    `foot` to two. They have to leave room for three lines by section.
    """
    printed = [
        Section(one.name, [printable(text) for text in one.texts], one.rank) for one in sections
    ]
    above = [shortened(printable(line), COLUMNS) for line in head]
    below = [line for text in foot for line in _in_two_lines(printable(text))]
    left = most - len(above) - len(below)
    found: dict[int, list[str]] = {}
    order = sorted(range(len(printed)), key=lambda k: printed[k].rank)
    for place, k in enumerate(order):
        others = sum(printed[other].least for other in order[place + 1 :])
        found[k] = printed[k].within(max(left - others, printed[k].least))
        left -= len(found[k])
    for place, line in reversed(list(enumerate(head))):
        whole = textwrap.wrap(
            printable(line), COLUMNS, subsequent_indent="  ", break_on_hyphens=False
        )
        if 1 < len(whole) <= left + 1:
            above[place : place + 1] = whole
            left -= len(whole) - 1
    return [*above, *(line for k in range(len(printed)) for line in found[k]), *below]


def end_of(path: str, longest: int) -> str:
    """Return a path with its beginning left out where it is too long: its end says more.

    >>> end_of("/data/lab/results/run.h5", 16)
    '...esults/run.h5'
    """
    return path if len(path) <= longest else "..." + path[3 - longest :]


def _in_two_lines(text: str) -> list[str]:
    first, *rest = textwrap.wrap(text, COLUMNS, subsequent_indent="  ", break_on_hyphens=False)
    return (
        [first, "  " + shortened(" ".join(map(str.strip, rest)), COLUMNS - 2)] if rest else [first]
    )


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(
        text, COLUMNS, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False
    ) or ["  "]
