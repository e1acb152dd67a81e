"""Load an installed procedure; its class is checked completely before it is used.

A fault is reported when the class is loaded, as one line that names the package, and not in the
middle of a run.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from types import FunctionType
from typing import Any, get_args, get_origin

from rig.bench.settings import Fixture
from rig.core.entry_points import PROCEDURES, load
from rig.core.errors import finding
from rig.core.settings import Settings, option_name
from rig.core.text import one_edit_apart
from rig.core.units import is_unit
from rig.files.journal.layout import Column, Layout
from rig.files.journal.values import Stream
from rig.run.procedure import Procedure, StreamPlan

BASE = f"{Procedure.__module__}.{Procedure.__qualname__}"
HOOKS = {
    name: tuple(inspect.signature(member).parameters)[1:]
    for name, member in vars(Procedure).items()
    if isinstance(member, FunctionType) and not name.startswith("_")
}
"""Hooks of a procedure, with the names of their arguments."""
PROGRAM = ("rig", "procedures")
"""The packages of this program whose base classes declare hooks."""
ATTRIBUTES = tuple(name for name in Procedure.__annotations__ if name != "settings")
COMMON_OPTIONS = frozenset(
    {
        *("--bench", "--results", "--seed", "--dry-run", "--json", "--user", "--sample", "--notes"),
        *("--figures", "--no-figures", "--allow-expired", "--stages", "--world", "--fault"),
        *("--world-log", "--debug", "--help", "--accept"),
    }
)
"""Options that the command of every procedure has."""


def load_procedure(name: str) -> type[Procedure]:
    """Import and check the procedure registered under `name`; return its class.

    Raises ConfigurationError if no procedure is registered under the name; BrokenPackageError,
    which names the package, where its class cannot be used.
    """

    def find_fault(found: Any) -> str | None:
        return fault_of(found, name)

    procedure: type[Procedure] = load(PROCEDURES, name, find_fault)
    return procedure


def fault_of(procedure: Any, entry_point: str) -> str | None:
    """Return why a class cannot be the procedure of an entry point, as the end of a sentence that
    begins with the procedure's name; None if it can."""
    return next(_faults(procedure, entry_point), None)


def _faults(procedure: Any, entry_point: str) -> Iterator[str]:
    if inspect.ismodule(procedure):
        yield (
            f"names a module; it must name the procedure's class, a subclass of {BASE}: "
            f"{entry_point} = {procedure.__name__}:ClassName"
        )
        return
    if not (isinstance(procedure, type) and issubclass(procedure, Procedure)):
        yield f"is not a subclass of {BASE}"
        return
    yield from _misspelt(procedure)
    missing = [name for name in ATTRIBUTES if not hasattr(procedure, name)]
    if missing := [*missing, *sorted(procedure.__abstractmethods__)]:
        yield f"lacks {', '.join(missing)}"
        return
    yield from _doing_nothing(procedure)
    for hook, arguments in HOOKS.items():
        yield from _wrong_signature(procedure, hook, arguments)
    try:
        inspect.signature(procedure).bind(None)
    except TypeError:
        yield "has an __init__() that does not take the settings as its only argument"
    if procedure.name != entry_point:
        yield f"has the name {procedure.name!r}, which must be that of the entry point"
    yield from _wrong_attributes(procedure)
    yield from _wrong_layout(procedure.layout, procedure.streams)
    yield from _ambiguous_options(procedure.Settings)
    yield from _no_options(procedure.Settings)
    yield from _wrong_defaults(procedure.Settings)


def _misspelt(procedure: type[Procedure]) -> Iterator[str]:
    """Yield a fault for each public name that differs by one letter from a hook or attribute of a
    base class: `Procedure`, or one of another package in between."""
    top = procedure.__module__.split(".")[0]
    bases = [cls for cls in procedure.__mro__ if issubclass(cls, Procedure)]
    own = [cls for cls in bases if cls is not Procedure and cls.__module__.split(".")[0] == top]
    inherited = (name for cls in bases if cls not in own for name in vars(cls))
    known = dict.fromkeys((*HOOKS, *ATTRIBUTES, "settings", *inherited))
    for name in dict.fromkeys(name for cls in own for name in vars(cls)):
        if name.startswith("_") or name in known:
            continue
        public = (one for one in known if not one.startswith("_"))
        meant = next((one for one in public if one_edit_apart(name, one)), None)
        if meant is not None:
            yield (
                f"has {name!r}, which is not a hook; did you mean {meant!r}? (A name of your own "
                "that is so similar must begin with an underscore.)"
            )


def _doing_nothing(procedure: type[Procedure]) -> Iterator[str]:
    """Yield a fault for each method in place of a plain one of this program whose call would do
    nothing but return a generator or coroutine: a trial would look complete although nothing was
    done. A generator of numbers is as good as a tuple of them."""
    program = [cls for cls in procedure.__mro__ if cls.__module__.split(".")[0] in PROGRAM]
    for name in dict.fromkeys(name for cls in program for name in vars(cls)):
        if name.startswith("_"):
            continue
        own = inspect.getattr_static(procedure, name)
        plain = next(vars(cls)[name] for cls in reversed(program) if name in vars(cls))
        if not _is_deferred(own) or _is_deferred(plain):
            continue
        generator = inspect.isgeneratorfunction(own)
        if not (generator and _returns_numbers(plain)):
            word = "yield" if generator else "async"
            yield f"has {name!r} with {word!r}, so that its lines would not be run; leave that out"


def _returns_numbers(member: Any) -> bool:
    """Return whether a method is declared to return several numbers, which are then iterated."""
    declared = str(getattr(member, "__annotations__", {}).get("return", ""))
    return declared.startswith(("tuple[float,", "Sequence[float]"))


def _is_deferred(member: Any) -> bool:
    """Return whether a call of a method only returns something that would do it."""
    return (
        inspect.isgeneratorfunction(member)
        or inspect.iscoroutinefunction(member)
        or inspect.isasyncgenfunction(member)
    )


def _wrong_signature(
    procedure: type[Procedure], hook: str, arguments: tuple[str, ...]
) -> Iterator[str]:
    member = inspect.getattr_static(procedure, hook)
    expected = f"{hook}({', '.join(('self', *arguments))})"
    if not isinstance(member, FunctionType):
        yield f"has {hook!r} that is not a plain method {expected}"
        return
    signature = inspect.signature(member)
    try:
        signature.bind(None, *arguments)
    except TypeError:
        yield f"has {hook}{signature}, which must be {expected}"


def _wrong_attributes(procedure: type[Procedure]) -> Iterator[str]:
    if not (isinstance(procedure.Settings, type) and issubclass(procedure.Settings, Settings)):
        yield "has Settings that are not a subclass of rig.core.settings.Settings"
    known = get_args(Fixture)
    if not isinstance(procedure.fixtures, tuple) or not procedure.fixtures:
        yield f"has fixtures that are not a tuple with at least one of {', '.join(known)}"
    elif strangers := [name for name in procedure.fixtures if name not in known]:
        yield f"has the fixture {strangers[0]!r}; known are {', '.join(known)}"
    if not isinstance(procedure.layout, Layout):
        yield "has a layout that is not a rig.files.journal.layout.Layout"
    streams = procedure.streams
    if not (isinstance(streams, tuple) and all(isinstance(one, StreamPlan) for one in streams)):
        yield "has streams that are not a tuple of rig.run.procedure.StreamPlan"
    if not isinstance(procedure.drift, Mapping):
        yield "has a drift that is not a mapping of names to rig.run.procedure.DriftFigure"
    labels = procedure.summary_labels
    if not isinstance(labels, Mapping) or not all(isinstance(one, str) for one in labels.values()):
        yield "has summary_labels that are not a mapping of names to texts"
    axes = procedure.force_axes
    if not (isinstance(axes, str) and set(axes) <= set("xyz")):
        yield "has force_axes that are not a text of x, y and z, such as 'xz'"
    words = procedure.point_name
    if not (isinstance(words, tuple) and list(map(type, words)) == [str, str]):
        yield 'has a point_name that is not a pair of words such as ("trial", "trials")'


def _wrong_layout(layout: Layout, streams: tuple[StreamPlan, ...]) -> Iterator[str]:
    from pydantic import ValidationError

    columns: tuple[Column, ...] = layout.columns
    for key, count in Counter(column.key for column in columns).items():
        if count > 1:
            names = " and ".join(repr(one.name) for one in columns if one.key == key)
            yield f"has a layout whose columns {names} show the same key {key!r} of a reading"
    for column in columns:
        if not is_unit(column.units):
            yield f"has a layout whose column {column.name!r} has the unknown unit {column.units!r}"
    for name, count in Counter(stream.name for stream in streams).items():
        if count > 1:
            yield f"has two streams of the name {name!r}"
    for stream in streams:
        try:
            Stream(
                name=stream.name,
                device=stream.device,
                channels=stream.channels,
                dtype=stream.dtype,
                row_shape=(len(stream.channels),),
                units=stream.units,
                long_name=stream.long_name,
            )
        except ValidationError as error:
            reasons = "; ".join(map(finding, error.errors()))
            yield f"has a stream {stream.name!r} that cannot be recorded: {reasons}"
    channels = {stream.name: stream.channels for stream in streams}
    for stream in streams:
        if stream.times and len(channels.get(stream.times, ())) != 1:
            yield (
                f"has a stream {stream.name!r} whose times are the stream {stream.times!r}, which "
                "is not one of its streams of one channel"
            )
    for trace in layout.traces:
        if trace.stream not in channels:
            yield (
                f"has a layout whose trace {trace.group!r} shows the stream {trace.stream!r}, "
                "which is not one of its streams"
            )
        elif unknown := [one for one in trace.channels() if one not in channels[trace.stream]]:
            yield (
                f"has a layout whose trace {trace.group!r} shows the channel {unknown[0]!r}, "
                f"which the stream {trace.stream!r} does not have"
            )


def _no_options(model: type[Settings]) -> Iterator[str]:
    """Yield a fault for each setting of a type that no option can give a value to."""
    collections = (list, set, frozenset, dict, Sequence)
    for field, info in model.model_fields.items():
        kind = info.annotation
        if kind in collections or get_origin(kind) in collections:
            yield (
                f"has the setting {field!r} of a type that {option_name(field)} cannot give; "
                "several numbers are tuple[float, ...]"
            )


def _wrong_defaults(model: type[Settings]) -> Iterator[str]:
    """Yield a fault for each setting whose default its own type and bounds refuse: whoever runs the
    procedure has not given it. What a validator refuses, and None or "", may be meant to be
    given."""
    from pydantic import ValidationError

    try:
        model()
    except ValidationError as error:
        for item in error.errors():
            by_validator = item["type"] in ("missing", "value_error", "assertion_error")
            if item["loc"] and not by_validator and item["input"] not in (None, ""):
                yield f"has a setting with a default that it refuses: {finding(item)}"
    except Exception:  # noqa: BLE001 - a validator: reported with the settings that it fails for
        return


def _ambiguous_options(model: type[Settings]) -> Iterator[str]:
    """Yield a fault for each setting whose option exists already."""
    by_option: dict[str, str] = {}
    letters: dict[str, str] = {}
    for field, info in model.model_fields.items():
        option = option_name(field)
        off = f"--no-{option.removeprefix('--')}" if info.default is True else option
        if option in COMMON_OPTIONS:
            yield (
                f"has the setting {field!r}, whose option {option} every procedure has already; "
                "rename the setting"
            )
        for one in sorted({option, off} & by_option.keys()):
            yield (
                f"has the settings {by_option[one]!r} and {field!r}, which would both be the "
                f"option {one}; rename one of them"
            )
        by_option[option] = by_option[off] = field
        extra = info.json_schema_extra
        letter = str(extra.get("short", "")) if isinstance(extra, dict) else ""
        if letter and letter in letters:
            yield f"has the settings {letters[letter]!r} and {field!r} with one letter {letter}"
        letters[letter] = field
