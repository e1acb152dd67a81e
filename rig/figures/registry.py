"""The figures of each kind of file: the entry points of the group ``rig.figures``.

The name of an entry point says which files its figure belongs to:

    sweep = "rig.figures.sweep:draw_measured"         the figure of a run of the procedure `sweep`
    "sweep.gain" = "rig.figures.sweep:draw_fitted"    a further one; its file name ends in `-gain`

Before the first dot stands the name of a procedure, `import` for an imported recording, or
`processed` for a processed file. The value is ``module:function``. The function takes the open file
(`rig.files.runfile.reader.RunFile`, or `rig.files.processed.reader.ProcessedFile`) and returns a
matplotlib Figure, or Figures by the suffix that each adds to the file's name: "" for the first. An
empty dictionary means that there is nothing to draw in this file.

Nothing is imported here before a figure is loaded. A broken package loses only its own figures.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GROUP = "rig.figures"
PROCESSED = "processed"
"""Name before the dot of the figures of processed files."""
OWN_PACKAGE = "tactile-rig"
_NAME = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)?")

Draw = Callable[[Any], "Figure | Mapping[str, Figure]"]
"""The function that an entry point names; its argument is the open file."""


@dataclass(frozen=True)
class RegisteredFigure:
    """One entry point of the group ``rig.figures``."""

    entry: EntryPoint

    @property
    def suffix(self) -> str:
        """Suffix that the figure adds to the file's name: "" for the figure of the procedure
        itself."""
        _, dot, what = self.entry.name.partition(".")
        return f"-{what}" if dot else ""

    @property
    def package(self) -> str:
        """Name of the package that declares it."""
        return "an unknown package" if self.entry.dist is None else self.entry.dist.name

    def __str__(self) -> str:
        return f"the figure {self.entry.name} ({self.entry.value}) of {self.package}"

    def load(self) -> Draw:
        """Import its function. ConfigurationError for a name of another form or a value that is
        not a function; whatever the package raises while it is imported."""
        if _NAME.fullmatch(self.entry.name) is None:
            raise ConfigurationError(
                "its name must be PROCEDURE or PROCEDURE.WHAT, of letters, digits, - and _"
            )
        function = self.entry.load()
        if not callable(function):
            raise ConfigurationError("its value is not a function")
        draw: Draw = function
        return draw


def figures_of(kind: str) -> list[RegisteredFigure]:
    """The figures of files of one kind: a procedure's name, `import` or `processed`.

    The procedure's own figure comes first, then further ones by their names. Of several packages
    that declare the same name this project comes first, then the others by their names."""
    found = [
        RegisteredFigure(entry)
        for entry in entry_points(group=GROUP)
        if entry.name.partition(".")[0] == kind
    ]
    return sorted(found, key=lambda f: (f.entry.name, f.package != OWN_PACKAGE, f.package))
