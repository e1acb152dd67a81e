"""Text from files and names of files, for a terminal or another program."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path


def printable(text: str) -> str:
    """Return the text with control characters and unencodable characters escaped: a name or a title
    from a file must not control the terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shown_name(name: str) -> str:
    r"""Return the name of a file or folder as text that UTF-8 and JSON can hold: bytes of another
    encoding are written as ``\xNN``.

    >>> shown_name("M\udcfcller")
    'M\\xfcller'
    """
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def in_shell(path: str | Path) -> str:
    """Return a path as a command in a message names it: in quotes where a shell needs them.

    >>> in_shell("bench of May.toml")
    "'bench of May.toml'"
    """
    return shlex.quote(str(path))


def readable_time(time: str) -> str:
    """Return an ISO time to the second, with its zone: a clock may be set back in the night, and
    who reads it may be elsewhere.

    >>> readable_time("2026-11-21T22:00:00.250000+01:00")
    '2026-11-21 22:00:00+01:00'
    """
    return datetime.fromisoformat(time).isoformat(" ", "seconds")


def to_the_minute(time: str) -> str:
    """Return an ISO time to the minute, with its zone.

    >>> to_the_minute("2026-11-21T22:00:00.250000+01:00")
    '2026-11-21 22:00+01:00'
    """
    return datetime.fromisoformat(time).isoformat(" ", "minutes")


def listed(parts: Iterable[str]) -> str:
    """Return parts as a sentence lists them. Raises ValueError where there are none.

    >>> listed(["daq", "stage_z", "force_sensor"])
    'daq, stage_z and force_sensor'
    """
    *others, last = parts
    return f"{', '.join(others)} and {last}" if others else last


def one_edit_apart(one: str, other: str) -> bool:
    """Return whether one insertion, deletion, replacement or swap of neighbours turns `one` into
    `other`."""
    if abs(len(one) - len(other)) > 1 or one == other:
        return False
    same = next(
        (k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b),
        min(len(one), len(other)),
    )
    one, other = one[same:], other[same:]
    swapped = one[1::-1] + one[2:]
    return one[1:] == other or one == other[1:] or one[1:] == other[1:] or swapped == other
