"""Texts of options that are stored: one in another encoding is refused before anything begins."""

from __future__ import annotations

from rig.core.errors import ConfigurationError
from rig.core.text import printable


def as_utf8(option: str, text: str, what: str) -> str:
    """Return the text of an option that `what`, such as "a record", has to store.

    Raises ConfigurationError, which names the option, if the text has bytes that are not UTF-8.
    """
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise ConfigurationError(
            f"{option} {printable(text)}: this text is not UTF-8, so {what} cannot keep it",
            "set the terminal to UTF-8, or use ASCII characters only",
        ) from error
    return text
