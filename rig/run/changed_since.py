"""What has changed between the beginning of a run and its resume, in words."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

from rig.core.errors import shortened
from rig.core.units import counted

SHOWN = 5
"""Largest number of changes that a message lists."""
LONGEST_VALUE = 60
_MISSING = object()


def changes(
    begun: Mapping[str, Any], now: Mapping[str, Any], begun_toml: str, now_toml: str
) -> str:
    """Return which settings of the procedure, and which values of the bench file, differ from those
    at the beginning of a run, such as ``[stage_z] port (5020 then, 5024 now)``.

    Where no value differs, the texts of the bench files do, as by a comment.
    """
    found = [
        *_of(_leaves(begun), _leaves(now), "{}"),
        *_of(_values(begun_toml), _values(now_toml), "{} of the bench file"),
    ]
    if not found:
        return "the text of the bench file (a comment, or the order of its lines)"
    more = len(found) - SHOWN
    rest = [f"{counted(more, 'further value')}"] if more > 0 else []
    return "; ".join([*found[:SHOWN], *rest])


def _of(begun: Mapping[str, Any], now: Mapping[str, Any], named: str) -> Iterator[str]:
    for name in dict.fromkeys([*begun, *now]):
        was, has = begun.get(name, _MISSING), now.get(name, _MISSING)
        if was != has:
            yield f"{named.format(name)} ({_shown(was)} then, {_shown(has)} now)"


def _shown(value: Any) -> str:
    return "not given" if value is _MISSING else shortened(str(value), LONGEST_VALUE)


def _values(toml: str) -> dict[str, Any]:
    """Return the values of a bench file, named as ``[stage_z] port``."""
    found: dict[str, Any] = {}
    for name, value in tomllib.loads(toml).items():
        if isinstance(value, dict):
            found |= {f"[{name}] {key}": one for key, one in _leaves(value).items()}
        else:
            found[name] = value
    return found


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found |= _leaves(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found
