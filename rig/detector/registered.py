"""The detectors that installed packages register: entry-point group ``rig.detectors``.

    [project.entry-points."rig.detectors"]
    lab-cusum = "lab_cusum.detector:Cusum"

The value is a class that derives from `rig.detector.contract.Detector`. A package that is broken
disables its own detector alone; the message names the package.
"""

from __future__ import annotations

import hashlib
import inspect
import re
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any

from pydantic import ValidationError

from rig.core.entry_points import (
    DETECTORS,
    OWN_PACKAGE,
    find,
    load,
    names,
    package,
    packages_of,
)
from rig.core.errors import ConfigurationError, finding, is_stop
from rig.core.quiet_stdout import quiet_stdout
from rig.core.settings import Settings
from rig.core.text import one_edit_apart
from rig.detector.checking import CheckedDetector, DetectorError, asked
from rig.detector.contract import Detector
from rig.detector.resampling import ResampledDetector

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""Form of a detector's name and version: both are part of the names of files."""
_VERSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]*")


@dataclass(frozen=True)
class ChosenDetector:
    """A registered detector and its parameters: what a command chooses and a file states."""

    name: str
    """Name of its entry point."""
    settings: Settings
    """Parameters of the detector."""

    @cached_property
    def kind(self) -> type[Detector]:
        """Class of the detector. Raises ConfigurationError where it is not installed or cannot be
        used."""
        return detector_class(self.name)

    @property
    def version(self) -> str:
        """Version that the detector's class states; ConfigurationError as for `kind`."""
        return self.kind.version

    @property
    def is_own(self) -> bool:
        """True for a detector of this project."""
        return is_own(self.name)

    @property
    def package(self) -> str:
        """Name of the package that registers it."""
        return _package_of(self.name)[0]

    @property
    def package_version(self) -> str:
        """Version of that package."""
        return _package_of(self.name)[1]

    @property
    def code_digest(self) -> str:
        """SHA-256 of the code of another package's detector; empty for one of this project."""
        return "" if self.is_own else _digest_of(self.kind)

    def seeds_seen(self) -> list[tuple[int, int]]:
        """Return the first and last seed of each range of simulated trials on which its parameters
        were chosen; an empty list where there are none. Raises DetectorError where its package
        fails."""
        found = asked(self.name, self.package, "seeds_seen", self.kind.seeds_seen, self.settings)
        ranges = [] if found is None else found if isinstance(found, list) else [found]
        if not all(
            isinstance(one, tuple) and len(one) == 2 and all(type(n) is int for n in one)
            for one in ranges
        ):
            raise DetectorError(self.name, self.package, f"has seen the seeds {found!r}, no range")
        return ranges

    def at_threshold(self, factor: float) -> ChosenDetector:
        """Return it with `factor` times its threshold, or as it is where it has none. Raises
        DetectorError where its package fails."""
        changed = asked(
            self.name, self.package, "with_threshold",
            self.kind.with_threshold, self.settings, factor,
        )  # fmt: skip
        if type(changed) is not type(self.settings):
            reason = f"returned {type(changed).__name__} as its parameters at another threshold"
            raise DetectorError(self.name, self.package, reason)
        return replace(self, settings=changed)

    def make(self, rate_Hz: float) -> Detector:
        """Return a new detector for a recording at a rate, which is resampled where it must be.

        What another package's detector returns is checked; what it raises becomes a DetectorError,
        which names the package. Raises ValueError for a rate that no detector judges.
        """
        if self.is_own:
            return self._made(rate_Hz)
        return CheckedDetector(self._made, self.name, self.package, self.settings, rate_Hz)

    def _made(self, rate_Hz: float) -> Detector:
        if self.kind.accepts(rate_Hz):
            return self.kind(self.settings, rate_Hz)
        return ResampledDetector(self.kind, self.settings, rate_Hz)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle names and numbers only: who unpickles it may have another version, or none."""
        return chosen_detector, (self.name, self.settings.model_dump_json())


def chosen_detector(name: str, settings_json: str = "") -> ChosenDetector:
    """Return a detector with parameters given as JSON, or with its own. Raises ConfigurationError
    where it is unknown, its package cannot be used, or the parameters are not its."""
    kind = detector_class(name)
    if not settings_json:
        return ChosenDetector(name, kind.default_settings())
    try:
        return ChosenDetector(name, kind.Settings.model_validate_json(settings_json))
    except ValidationError as error:
        raise ConfigurationError.from_validation(error, f"detector {name!r} here") from error


def is_own(name: str) -> bool:
    """Return whether a detector is one of this project; nothing is imported."""
    return OWN_PACKAGE in packages_of(DETECTORS, name)


def detector_names() -> tuple[str, ...]:
    """Return the names of all registered detectors, this project's first; nothing is imported."""
    return tuple(sorted(names(DETECTORS), key=lambda name: (not is_own(name), name)))


@cache
def detector_class(name: str) -> type[Detector]:
    """Return the class of a registered detector. Raises ConfigurationError where it is unknown, or
    its package cannot be used."""
    with quiet_stdout():
        found: type[Detector] = load(DETECTORS, name, lambda value: _fault(name, value))
    return found


def _fault(name: str, value: Any) -> str | None:
    """Return what is wrong with a registered class, as the end of a sentence; None if nothing."""
    if _NAME.fullmatch(name) is None:
        return "has a name that is not of letters, digits, - and _, which file names need"
    if not (isinstance(value, type) and issubclass(value, Detector)):
        return "is not a class that derives from rig.detector.contract.Detector"
    if (misspelt := _misspelt(value)) is not None:
        name, meant = misspelt
        return (
            f"has {name!r}, which is not a method of a detector; did you mean {meant!r}? (A name "
            "of your own that is so similar must begin with an underscore.)"
        )
    if inspect.isabstract(value):
        return f"lacks {', '.join(sorted(value.__abstractmethods__))}"
    if not (isinstance(value.version, str) and _VERSION.fullmatch(value.version)):
        return 'lacks a version such as "1", of letters, digits, +, - and _'
    rates = (value.slowest_Hz, value.design_rate_Hz, value.fastest_Hz)
    if not all(isinstance(rate, int | float) for rate in rates) or sorted(rates) != list(rates):
        return "has slowest_Hz, design_rate_Hz and fastest_Hz that do not ascend"
    if not (isinstance(value.Settings, type) and issubclass(value.Settings, Settings)):
        return "has Settings that are not a subclass of rig.core.settings.Settings"
    try:
        settings = value.default_settings()
        again = value.Settings.model_validate_json(settings.model_dump_json())
    except (Exception, SystemExit) as error:
        if is_stop(error):
            raise
        words = str(error)
        if isinstance(error, ValidationError):
            words = "; ".join(map(finding, error.errors()))
        return f"has Settings without usable defaults: {' '.join(words.split())}"
    return None if again == settings else "has Settings that JSON does not hold"


def _misspelt(kind: type[Detector]) -> tuple[str, str] | None:
    """Return the first public method whose name differs by one letter from one of `Detector`, and
    that one: it would never be called. None if there is none."""
    known = [name for name in _methods(Detector) if not name.startswith("_")]
    for own in (cls for cls in kind.__mro__ if cls is not Detector and issubclass(cls, Detector)):
        for name in _methods(own):
            if name.startswith("_") or name in known:
                continue
            for meant in known:
                if one_edit_apart(name, meant):
                    return name, meant
    return None


def _methods(kind: type) -> list[str]:
    """Return the names of the methods that a class itself defines."""
    methods = (FunctionType, classmethod, staticmethod)
    return [name for name, member in vars(kind).items() if isinstance(member, methods)]


@cache
def _package_of(name: str) -> tuple[str, str]:
    """Return name and version of the package that registers a detector."""
    entry = find(DETECTORS, name)
    if entry is None:
        return "", ""
    return package(entry), "" if entry.dist is None else entry.dist.version


@cache
def _digest_of(kind: type[Detector]) -> str:
    """Return the SHA-256 of every file of the package around a class, or of its only module: a
    version that is kept by hand does not distinguish two states of the code."""
    top = import_module(kind.__module__.partition(".")[0])
    # A package without __init__.py has no file, and may lie in several folders.
    folders = [Path(folder) for folder in getattr(top, "__path__", ())]
    files = [(one, path) for one in folders for path in sorted(one.rglob("*"))]
    if not folders:
        assert top.__file__ is not None, "the class was imported from it"
        files = [(Path(top.__file__).parent, Path(top.__file__))]
    hashed = hashlib.sha256()
    for folder, path in files:
        if path.is_file() and "__pycache__" not in path.parts:
            content = path.read_bytes()
            name = path.relative_to(folder).as_posix()
            hashed.update(f"{name} {len(content)}\n".encode() + content)
    return hashed.hexdigest()
