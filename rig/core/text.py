"""Text from files, for a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    """Return the text with control characters and unencodable characters escaped: a name or a title
    from a file must not control the terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
