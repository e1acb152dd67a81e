"""On which line of a TOML text each of its values stands.

`tomllib` says what a text means, and nothing of where; tree-sitter says where. A text is parsed by
both: what the first refuses never comes here, and what only the second refuses has no lines.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator

import tree_sitter_toml
from tree_sitter import Language, Node, Parser

from rig.batch.plan.findings import Where


def lines_of(text: str) -> dict[Where, int]:
    """Line, from 1, of every table, key and entry of a list in a valid TOML text."""
    root = Parser(Language(tree_sitter_toml.language())).parse(text.encode()).root_node
    if root.has_error:
        return {}
    lines: dict[Where, int] = {}
    entries: dict[Where, int] = {}
    """Latest entry of each list of tables."""
    for node in root.named_children:
        where: Where = ()
        pairs = [node]
        if node.type in ("table", "table_array_element"):
            key, *pairs = _without_comments(node)
            *outer, last = _names(key)
            where = (*_within(entries, (), outer), last)
            if node.type == "table_array_element":
                lines.setdefault(where, _line(node))
                entries[where] = entries.get(where, -1) + 1
                where = (*where, entries[where])
            lines[where] = _line(node)
        for pair in pairs:
            for part, line in _of_pair(pair, where):
                lines.setdefault(part, line)
    return lines


def _of_pair(pair: Node, where: Where) -> Iterator[tuple[Where, int]]:
    if pair.type != "pair":
        return
    key, value = _without_comments(pair)[:2]
    for name in _names(key):
        where = (*where, name)
        yield where, _line(pair)
    yield from _of_value(value, where)


def _of_value(value: Node, where: Where) -> Iterator[tuple[Where, int]]:
    if value.type == "array":
        for number, entry in enumerate(_without_comments(value)):
            yield (*where, number), _line(entry)
            yield from _of_value(entry, (*where, number))
    elif value.type == "inline_table":
        for pair in _without_comments(value):
            yield from _of_pair(pair, where)


def _within(entries: dict[Where, int], where: Where, names: list[str]) -> Where:
    """Where names lead to: a list of tables stands for its latest entry."""
    for name in names:
        where = (*where, name)
        if where in entries:
            where = (*where, entries[where])
    return where


def _without_comments(node: Node) -> list[Node]:
    return [child for child in node.named_children if child.type != "comment"]


def _names(key: Node) -> list[str]:
    """The names of a key as it is written: bare, quoted, dotted."""
    assert key.text is not None, "it was parsed from bytes"
    text = key.text.decode()
    if key.type == "bare_key":
        return [text]
    names, table = [], tomllib.loads(f"{text} = 0")
    while isinstance(table, dict):
        ((name, table),) = table.items()
        names.append(name)
    return names


def _line(node: Node) -> int:
    return node.start_point.row + 1
