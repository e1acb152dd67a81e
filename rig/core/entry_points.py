"""Loads what installed packages register with this one: procedures, drivers, simulators, benches
and detectors.

A package names modules, and for a procedure or a detector a class (``module:Class``), in the groups
below. `load` is the one place where they are imported: it checks that what is registered has
everything that its group demands, and names the package where it does not. So a broken package
disables what it registers and nothing else.

Only what is asked for is imported. `summary` reads the first line of a docstring from the source,
for a list of commands that has to appear at once.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import importlib.metadata
import sys
import traceback
from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import FrameType
from typing import Any

from rig.core.errors import LONGEST_REASON, ConfigurationError, is_stop, shortened

PROCEDURES = "rig.procedures"
DRIVERS = "rig.drivers"
BENCHES = "rig.benches"
SIMULATORS = "rig.simulators"
DETECTORS = "rig.detectors"

KINDS = {
    PROCEDURES: "procedure",
    DRIVERS: "driver",
    BENCHES: "simulated bench",
    SIMULATORS: "simulator",
    DETECTORS: "detector",
}
"""Name of an entry point of each group in a message."""
DATA: dict[str, tuple[str, ...]] = {
    DRIVERS: ("ROLES", "Settings"),
    SIMULATORS: ("roles", "link"),
}
"""Members, not functions, that a module of each group must have."""
FUNCTIONS: dict[str, tuple[str, ...]] = {
    DRIVERS: ("connect", "make_safe"),
    BENCHES: ("start", "serve", "variants", "variant_for", "options_for"),
    SIMULATORS: ("bench_settings", "exchanges"),
}
"""Functions that a module of each group must have. The class of a procedure is checked by
`rig.run.load_procedure`."""

OWN_PACKAGE = "tactile-rig"
"""This package; another one that registers one of its names does not replace it."""
_MACHINERY = (__file__, importlib.__file__, importlib.metadata.__file__)
"""Files that appear in the traceback of every import."""


class BrokenPackageError(ConfigurationError):
    """Raised for an entry point that cannot be used; the message names the package and entry
    point."""

    def __init__(self, entry: EntryPoint, reason: str, hint: str | None = None):
        self.package = package(entry)
        self.reason = reason
        super().__init__(
            f"{KINDS[entry.group]} {entry.name!r} of the package {self.package} (entry point "
            f"{entry.name} = {entry.value} of the group {entry.group}) {reason}",
            hint or f"fix the package {self.package} or uninstall it",
        )


def names(group: str) -> tuple[str, ...]:
    """Return the names registered in a group, each once, in order; nothing is imported."""
    return tuple(sorted({entry.name for entry in _registered(group)}))


def find(group: str, name: str) -> EntryPoint | None:
    """Return the entry point of this name, or None; one of this package has priority over
    another's.

    Raises ConfigurationError if two other packages register the name.
    """
    found = [entry for entry in _registered(group) if entry.name == name]
    if len(found) > 1:
        found = [entry for entry in found if package(entry) == OWN_PACKAGE] or found
    if len(found) > 1:
        packages = " and ".join(package(entry) for entry in found)
        raise ConfigurationError(
            f"{KINDS[group]} {name!r} is registered by the packages {packages}",
            "uninstall all but one of them",
        )
    return found[0] if found else None


def packages_of(group: str, name: str) -> tuple[str, ...]:
    """Return the packages that register a name; where this one does, the others are left out."""
    return tuple(package(entry) for entry in _registered(group) if entry.name == name)


def load(group: str, name: str, find_fault: Callable[[Any], str | None] | None = None) -> Any:
    """Import what is registered under `name` and check that it has what its group demands.

    `find_fault` is a further check: given the module or class, it returns what is wrong with it, as
    the end of a sentence that begins with its name, or None. Raises ConfigurationError if nothing
    is registered under the name, BrokenPackageError where the import or a check fails. Whatever a
    foreign module raises is caught: making a bench safe must not depend on it. A stop that is
    requested meanwhile is raised as it is.
    """
    entry = find(group, name)
    if entry is None:
        raise ConfigurationError(
            f"{KINDS[group]} {shortened(name)!r} is unknown",
            f"choose a {KINDS[group]} among {', '.join(names(group))}",
        )
    if entry.pattern.match(entry.value) is None:
        raise BrokenPackageError(entry, "does not name a module")
    try:
        # What a module prints as it is imported must not mix with what a command prints.
        with contextlib.redirect_stdout(sys.stderr):
            loaded = entry.load()
    except (Exception, SystemExit) as error:
        if is_stop(error):  # a signal that came while the module was imported
            raise
        raise BrokenPackageError(
            entry, f"cannot be imported: {cause(error, entry)}", _remedy(entry, error)
        ) from error
    fault = _fault(entry, loaded)
    if fault is None and find_fault is not None:
        fault = find_fault(loaded)
    if fault is not None:
        raise BrokenPackageError(entry, fault)
    return loaded


def summary(group: str, name: str) -> str:
    """Return the first line of the docstring of a registered class or module, read from its source;
    "" if there is no source to read, or if the class is defined in another module.

    Neither the module nor a package around it is imported. Raises BrokenPackageError if there is no
    such module, or where its source or that of a package around it does not parse.
    """
    entry = find(group, name)
    if entry is None:
        return ""
    if entry.pattern.match(entry.value) is None:
        raise BrokenPackageError(entry, "does not name a module")
    try:
        docstring = _docstring(entry.module, entry.attr)
    except (SyntaxError, ModuleNotFoundError) as error:
        raise BrokenPackageError(entry, f"cannot be imported: {cause(error, entry)}") from error
    except Exception as error:
        if is_stop(error):
            raise
        return ""  # a finder of another package; `load` reports what is wrong
    return docstring.strip().split("\n", 1)[0]


def package(entry: EntryPoint) -> str:
    """Return the name of the package that registers an entry point, or where it is installed."""
    if entry.dist is None:
        return "without a name"
    return entry.dist.metadata["Name"] or f"without a name in {entry.dist.locate_file('')}"


def foreign_package(group: str, name: str) -> tuple[str, str] | None:
    """Return name and version of the package that registers `name`; None if it is this one, or if
    none does."""
    entry = find(group, name)
    if entry is None or package(entry) == OWN_PACKAGE:
        return None
    return package(entry), "" if entry.dist is None else entry.dist.version


@cache
def _registered(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group. Finding them takes milliseconds, so it is done once."""
    return tuple(entry_points(group=group))


def _fault(entry: EntryPoint, module: Any) -> str | None:
    """Return which members required by its group a module lacks; None if it lacks none."""
    data, functions = DATA.get(entry.group, ()), FUNCTIONS.get(entry.group, ())
    missing = [name for name in data if not hasattr(module, name)]
    missing += [name for name in functions if not callable(getattr(module, name, None))]
    if missing:
        return f"lacks {', '.join(missing)}"
    if "Settings" in data:
        # Imported here and not at the top: the module that is checked has imported it already.
        from rig.core.settings import Settings

        if not (isinstance(module.Settings, type) and issubclass(module.Settings, Settings)):
            return "has Settings that are not a subclass of rig.core.settings.Settings"
    if "ROLES" in data and not isinstance(module.ROLES, tuple):
        return "has ROLES that are not a tuple"
    return None


def _docstring(module: str, class_name: str) -> str:
    """Return the docstring of a module, or of the class in it if one is named. The module is found
    as an import would find it, but it is not imported."""
    tree, name, folders = ast.parse(""), "", None
    for part in module.split("."):
        name = f"{name}.{part}" if name else part
        found = (finder.find_spec(name, folders) for finder in sys.meta_path)
        spec = next((one for one in found if one is not None), None)
        if spec is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        get_source = getattr(spec.loader, "get_source", lambda _: None)
        tree = ast.parse(get_source(name) or "", spec.origin or name)
        folders = list(spec.submodule_search_locations or ())
    if not class_name:
        return ast.get_docstring(tree) or ""
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    return (ast.get_docstring(classes[class_name]) or "") if class_name in classes else ""


def cause(error: BaseException, entry: EntryPoint | None = None) -> str:
    """Return the exception of an import in one line, with file and line if they are known: the
    last in the package of `entry`, if it took part, else the last at all."""
    if isinstance(error, SyntaxError) and error.filename is not None:
        place, message = f"{error.filename} line {error.lineno}: ", error.msg
    else:
        frames = [
            (frame.f_code.co_filename, line, str(frame.f_globals.get("__name__")).split(".")[0])
            for frame, line in traceback.walk_tb(error.__traceback__)
            if frame.f_code.co_filename not in _MACHINERY
            and not frame.f_code.co_filename.startswith("<frozen")
        ]
        top = "" if entry is None else entry.module.split(".")[0]
        places = [one for one in frames if one[2] == top] or frames
        place = f"{places[-1][0]} line {places[-1][1]}: " if places else ""
        message = str(error)
    return shortened(f"{place}{type(error).__name__}: {' '.join(message.split())}", LONGEST_REASON)


def place_in(module: str, error: BaseException) -> str:
    """Return the last place in a module, or in a package with its modules, at which an exception
    was raised or passed through, as ``lab/creep.py line 11: `` relative to the folder in which the
    package is installed. Return "" if none of its code took part."""
    return _last_place(module, traceback.walk_tb(error.__traceback__))


def place_of_this_call(module: str) -> str:
    """Return from where in a module, or in a package with its modules, this was called, in the
    words of `place_in`."""
    return _last_place(module, reversed(list(traceback.walk_stack(None))))


def place_of(module: str, frame: FrameType) -> str:
    """Return where in a module, or in a package with its modules, a thread is whose innermost frame
    is `frame`, as ``lab/creep.py line 11``."""
    calls = reversed(list(traceback.walk_stack(frame)))
    return _last_place(module, calls).removesuffix(": ")


def _last_place(module: str, calls: Iterable[tuple[FrameType, int]]) -> str:
    places = [
        (Path(frame.f_code.co_filename), line)
        for frame, line in calls
        if f"{frame.f_globals.get('__name__')}.".startswith(f"{module}.")
    ]
    if not places:
        return ""
    path, line = places[-1]
    return place_of_line(module, path, line)


def place_of_line(module: str, file: str | Path, line: int) -> str:
    """Return a line of a file of a module, or of a package with its modules, in the words of
    `place_in`."""
    path = Path(file)
    top = getattr(sys.modules.get(module.split(".")[0]), "__file__", None)
    base = Path(top).parent if top else path.parent
    base = base.parent if top and Path(top).name == "__init__.py" else base
    return f"{path.relative_to(base) if path.is_relative_to(base) else path.name} line {line}: "


def _remedy(entry: EntryPoint, error: BaseException) -> str | None:
    """Return which module to install if an import misses one that is not part of the package."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return None
    if error.name.split(".")[0] == entry.module.split(".")[0]:
        return None
    return f"install {error.name}, which the package {package(entry)} needs, or uninstall it"
