"""Entry points whose names say to which files they belong: figures, overlays and analyses.

    creep = "lab.creep_figure:draw"               of every run file of the procedure `creep`
    "slip-trial.friction" = "lab.friction:draw"   a further one, of slip trials

Before the first dot stands the name of a procedure, `import` for an imported recording, or
`processed` for a processed file. The value is ``module:function``. Nothing is imported here before
`FileEntry.load`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from rig.core.entry_points import OWN_PACKAGE, PROCEDURES, cause, names, place_in
from rig.core.errors import ConfigurationError, RigError

FIGURES = "rig.figures"
OVERLAYS = "rig.overlays"
"""Figures of several runs of one procedure (``rig show --overlay``)."""
ANALYSES = "rig.analyses"
NOUNS = {FIGURES: "figure", OVERLAYS: "overlay", ANALYSES: "analysis"}
PROCESSED = "processed"
"""Name before the dot of what belongs to processed files."""
IMPORTED = "import"
_NAME = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)?")


@dataclass(frozen=True)
class FileEntry:
    """One entry point of such a group."""

    entry: EntryPoint

    @property
    def suffix(self) -> str:
        """Ending that its name adds to a file's name: "" for the one of the procedure itself."""
        _, dot, what = self.entry.name.partition(".")
        return f"-{what}" if dot else ""

    @property
    def package(self) -> str:
        """Name of the package that declares it."""
        return "an unknown package" if self.entry.dist is None else self.entry.dist.name

    @property
    def version(self) -> str:
        """Version of that package."""
        return "" if self.entry.dist is None else self.entry.dist.version

    def __str__(self) -> str:
        noun = NOUNS[self.entry.group]
        return f"the {noun} {self.entry.name} ({self.entry.value}) of {self.package}"

    def load(self) -> Callable[[Any], Any]:
        """Import its function and return it. Raises ConfigurationError for a name of another form
        or a value that is not a function, and whatever the package raises while it is imported."""
        if _NAME.fullmatch(self.entry.name) is None:
            raise ConfigurationError(
                "its name must be PROCEDURE or PROCEDURE.WHAT, of letters, digits, - and _"
            )
        function: Any = self.entry.load()
        if not callable(function):
            raise ConfigurationError("its value is not a function")
        found: Callable[[Any], Any] = function
        return found

    def fault(self, error: BaseException) -> str:
        """Return what its code has raised, in one line, with file and line where they are known."""
        top = self.entry.module.split(".")[0]
        # Code of this package, which calls the function, is around everything.
        module = self.entry.module if top == __name__.split(".")[0] else top
        if isinstance(error, RigError):
            words = error.one_line()
        elif isinstance(error, SyntaxError):
            return cause(error)
        else:
            text = " ".join(str(error).split())
            words = f"{type(error).__name__}: {text}" if text else type(error).__name__
        return f"{place_in(module, error)}{words}"


def entries_of(group: str, kind: str) -> list[FileEntry]:
    """Return the entry points for files of one kind: a procedure's name, `import` or `processed`.

    The procedure's own comes first, then further ones by their names. Of several packages that
    declare the same name this project comes first, then the others by their names."""
    found = [one for one in _all(group) if one.entry.name.partition(".")[0] == kind]
    return sorted(found, key=lambda f: (f.entry.name, f.package != OWN_PACKAGE, f.package))


def strays(group: str, also: Iterable[str] = ()) -> Iterator[str]:
    """Yield a sentence for each entry point that belongs to no file there can be, because its name
    begins with no installed procedure. `also` are further known beginnings."""
    known = (*names(PROCEDURES), IMPORTED, PROCESSED, *also)
    for one in _all(group):
        kind = one.entry.name.partition(".")[0]
        if kind not in known:
            near = difflib.get_close_matches(kind, known, 1)
            meant = f"; did you mean {near[0]}?" if near else ""
            yield f"{one} belongs to no installed procedure{meant}"


def _all(group: str) -> list[FileEntry]:
    return [FileEntry(entry) for entry in entry_points(group=group)]
