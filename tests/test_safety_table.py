"""docs/safety.md and docs/safety-contract.md name their tests: each is there."""

from __future__ import annotations

import ast
import re
from itertools import pairwise
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
SAFETY = (REPOSITORY / "docs" / "safety.md").read_text()
CONTRACT = (REPOSITORY / "docs" / "safety-contract.md").read_text()
NAMED = re.compile(r"`(tests/[\w/]+\.py)(?:::(\w+))?`")


def functions_of(path: Path) -> set[str]:
    return {
        node.name
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_every_test_that_the_table_names_exists() -> None:
    named = NAMED.findall(SAFETY + CONTRACT)
    missing = [
        f"{path}::{name}"
        for path, name in named
        if not (file := REPOSITORY / path).exists() or (name and name not in functions_of(file))
    ]
    assert missing == []


def rows_of(chapter: str) -> list[str]:
    """The rows of all tables of a chapter, without their headings."""
    (text,) = re.findall(rf"^## {chapter}.*?(?=^## |\Z)", CONTRACT, re.M | re.S)
    lines = text.splitlines()
    return [
        line for before, line in pairwise(lines) if before.startswith("|") and line.startswith("| ")
    ]


def test_every_row_of_contract_and_limits_names_one() -> None:
    for chapter in ("The contract", "Limits", "Hand control"):
        rows = rows_of(chapter)
        assert len(rows) >= 7
        assert [row for row in rows if not NAMED.search(row)] == []


def test_every_row_of_the_contract_has_a_test_in_the_default_tier() -> None:
    rows = rows_of("The contract")
    assert len(rows) >= 40
    named = [{f"{path}::{name}" for path, name in NAMED.findall(row)} for row in rows]
    thorough = {
        f"{path}::{node.name}"
        for path in {name.partition("::")[0] for names in named for name in names}
        for node in ast.parse((REPOSITORY / path).read_text()).body
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(one) == "pytest.mark.thorough" for one in node.decorator_list)
    }
    assert thorough
    assert [row for row, tests in zip(rows, named, strict=True) if tests <= thorough] == []


def test_every_place_that_contents_and_links_name_is_there() -> None:
    pages = {"safety.md": SAFETY, "safety-contract.md": CONTRACT}
    anchors = {
        page: {
            re.sub(r"[^a-z0-9_ -]", "", heading.lower()).replace(" ", "-")
            for heading in re.findall(r"^#+ (.*)$", text, re.M)
        }
        for page, text in pages.items()
    }
    broken = [
        f"{page}: {target or page}#{anchor}"
        for page, text in pages.items()
        for target, anchor in re.findall(r"\]\((safety[\w-]*\.md)?#([\w-]+)\)", text)
        if anchor not in anchors[target or page]
    ]
    assert broken == []
