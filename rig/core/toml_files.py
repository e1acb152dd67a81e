"""Read settings files, whose size and nesting are limited, into plain values.

A file that is too large, nested too deeply, or not a regular file is refused before its content is
parsed. The settings classes define what the values mean.
"""

from __future__ import annotations

import json
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from rig.core.errors import ConfigurationError, shortened

MAX_TOML_BYTES = 64 << 10
"""Largest size of a TOML file; a bench file has two thousand bytes."""
MAX_TOML_LINE = 8 << 10
"""Longest line in characters: the time that `tomllib` takes for a dotted name grows with the cube
of its length (two minutes for 64 KiB), and such a name cannot leave its line."""
MAX_JSON_BYTES = 1 << 20
"""Largest size of a JSON file; a calibration record has ten thousand bytes."""
MAX_DEPTH = 32
"""Deepest nesting of tables and lists."""
MAX_KEYS = 10_000
"""Largest number of keys in all tables of a document."""

_GIVEN_TWICE = re.compile(r"Cannot overwrite a value \(at line (\d+), column \d+\)")


def read_text(
    path: Path, what: str, most_bytes: int, hint: str | None = None, *, with_mark: bool = False
) -> str:
    """Return the text of a file, without the byte order mark that some editors put in front unless
    `with_mark`; `what` names it in messages ("bench file").

    Raises ConfigurationError if it cannot be read, is not a regular file (a pipe could block), is
    longer than `most_bytes` or is not UTF-8.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ConfigurationError(f"cannot read the {what} {path}: not a regular file", hint)
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
    except OSError as error:
        raise ConfigurationError(
            f"cannot read the {what} {path}: {error.strerror or error}", hint
        ) from error
    except ValueError as error:  # a NUL in the path
        raise ConfigurationError(f"cannot read the {what} {str(path)!r}: {error}", hint) from error
    if len(content) > most_bytes:
        raise ConfigurationError(f"{path} is not a {what}: larger than {most_bytes} bytes", hint)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"{path} is not a {what}: not UTF-8 text: byte {error.start} is not part of one", hint
        ) from error
    return text if with_mark else text.removeprefix("\ufeff")


def read_toml(path: Path, what: str, hint: str | None = None) -> dict[str, Any]:
    """Return the tables of a TOML file. Raises ConfigurationError as `read_text` and `parse_toml`
    do."""
    return parse_toml(read_text(path, what, MAX_TOML_BYTES, hint), str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Return the tables of a TOML text. Raises ConfigurationError for a text that is not TOML or
    exceeds the limits."""
    if len(text) > MAX_TOML_BYTES:
        raise ConfigurationError(f"{source}: longer than {MAX_TOML_BYTES} characters")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > MAX_TOML_LINE:
            raise ConfigurationError(
                f"{source}: line {number} has {len(line)} characters, {MAX_TOML_LINE} are allowed",
                "break it inside its list",
            )
    try:
        tables = tomllib.loads(text)
        check_nesting(tables)
    except RecursionError:
        raise ConfigurationError(f"{source}: nested deeper than {MAX_DEPTH}") from None
    except ValueError as error:
        fault, hint = _in_words(error, text)
        raise ConfigurationError(f"{source}: {fault}", hint) from error
    return tables


def _in_words(error: ValueError, text: str) -> tuple[str, str]:
    """Return what is wrong with a TOML text and what helps. `tomllib` does not name a key that is
    given twice, only its line."""
    found = _GIVEN_TWICE.match(str(error))
    key, equals, _ = text.split("\n")[int(found[1]) - 1].partition("=") if found else ("", "", "")
    if found and equals:
        return f"line {found[1]}: {shortened(key.strip())} is given twice", "remove one of the two"
    return str(error), "correct the TOML syntax"


def check_nesting(value: Any) -> None:
    """Raise ValueError if tables and lists are nested deeper than MAX_DEPTH or have more than
    MAX_KEYS keys in all. No settings do, and code that walks such a document would take too long.
    """
    level = [value] if isinstance(value, (dict, list, tuple)) else []
    keys = 0
    for _ in range(MAX_DEPTH + 1):
        keys += sum(len(item) for item in level if isinstance(item, dict))
        if keys > MAX_KEYS:
            raise ValueError(f"more than {MAX_KEYS} keys")
        level = [
            inner
            for item in level
            for inner in (item.values() if isinstance(item, dict) else item)
            if isinstance(inner, (dict, list, tuple))
        ]
        if not level:
            return
    raise ValueError(f"nested deeper than {MAX_DEPTH}")


def toml_value(value: Any) -> str:
    """Return a plain value as TOML on one line, which equals JSON except for tables."""
    if isinstance(value, dict):
        inside = ", ".join(f"{json.dumps(key)} = {toml_value(own)}" for key, own in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(toml_value(own) for own in value)}]"
    return json.dumps(value)
