"""Lets the program work with an installed package whose list of entry points cannot be read.

``importlib.metadata`` raises for all packages where one has an ``entry_points.txt`` that does not
parse or is not text, and so does every library that looks for its own plug-ins there (pydantic,
numba). Once `tolerate` has been called, such a package registers nothing.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import Any

from rig.core.errors import is_stop

_unreadable: dict[str, str] = {}
_tolerant: list[property] = []
"""The look-ups that replace those of a module, so that none is replaced twice."""


def tolerate() -> None:
    """Let every distribution without readable entry points have none, in this process."""
    # A look-up of our own would not do: pydantic and numba ask importlib.metadata themselves while
    # they are imported, and it has no other place at which one package's file can be left out.
    _tolerate(importlib.metadata)


def tolerate_in_backport() -> None:
    """Do the same for ``importlib_metadata``, if it is installed: some libraries look there, where
    an older version of Python lacks what they need of ``importlib.metadata``."""
    try:
        backport = importlib.import_module("importlib_metadata")
    except ImportError:
        return
    _tolerate(backport)


def _tolerate(metadata: Any) -> None:
    original = metadata.Distribution.entry_points
    if original in _tolerant:
        return
    read, none = original.fget, metadata.EntryPoints(())

    def entry_points(self: Any) -> Any:
        try:
            return read(self)
        except Exception as error:  # whatever the file holds
            if is_stop(error):
                raise
            # The folder and not the metadata, which may be unreadable as well.
            name = getattr(getattr(self, "_path", None), "name", "without a name")
            reason = " ".join(str(error).split())
            _unreadable[str(name)] = f"{type(error).__name__}: {reason}"
            return none

    metadata.Distribution.entry_points = property(entry_points)
    _tolerant.append(metadata.Distribution.entry_points)


def warnings() -> list[str]:
    """Return a line for each installed package whose entry points could not be read so far."""
    return [
        f"the package in {name} is not used: its entry_points.txt cannot be read ({reason}); "
        "install it again or uninstall it"
        for name, reason in sorted(_unreadable.items())
    ]
