"""The entries of docs/safety-contract.md: what happens, and the tests that show what follows."""

from __future__ import annotations

import re
from itertools import pairwise

NAMED = re.compile(r"`(tests/[\w/]+\.py|test_\w+\.py)(?:::(\w+))?`")
FOLDER = "tests/safety_contract/"
"""Folder of tests that are named without one."""


def named_in(text: str) -> list[tuple[str, str]]:
    """Return the files and functions that a text names; "" for a file as a whole."""
    return [(path if "/" in path else FOLDER + path, name) for path, name in NAMED.findall(text)]


def entries_of(page: str, chapter: str) -> dict[str, str]:
    """Return the entries of a chapter, by what they are about: those of its lists, and the rows of
    its tables, of which the page of earlier commits consists."""
    text = re.search(rf"^## {chapter}.*?(?=^## |\Z)", page, re.M | re.S)
    if text is None:
        return {}
    lines = text[0].splitlines()
    rows = {
        line.split("|")[1].strip(): line
        for before, line in pairwise(lines)
        if before.startswith("|") and line.startswith("| ")
    }
    listed = re.findall(r"^- \*\*(.*?)\*\*:\s(.*?)(?=^- \*\*|^#|\Z)", text[0], re.M | re.S)
    return rows | {" ".join(what.split()): what + follows for what, follows in listed}
