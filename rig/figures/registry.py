"""The figures of each kind of file: the entry points of the group ``rig.figures``.

Their names say which files they belong to (`rig.core.file_entry_points`); what follows the dot is
added to the picture's file name, as in ``-gain`` for ``sweep.gain``. The function takes the open
file (`rig.files.runfile.reader.RunFile`, or `rig.files.processed.reader.ProcessedFile`) and returns
a matplotlib Figure, or Figures by the suffix that each adds to the file's name: "" for the first.
An empty dictionary means that there is nothing to draw in this file.
"""

from __future__ import annotations

from rig.core.file_entry_points import FIGURES, FileEntry, entries_of

RegisteredFigure = FileEntry
"""One entry point of the group ``rig.figures``."""


def figures_of(kind: str) -> list[RegisteredFigure]:
    """Return the figures of files of one kind: a procedure's name, `import` or `processed`.

    The procedure's own figure comes first, then further ones by their names. Of several packages
    that declare the same name this project comes first, then the others by their names."""
    return entries_of(FIGURES, kind)
