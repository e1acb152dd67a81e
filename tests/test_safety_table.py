"""docs/safety.md names its tests: each is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
TABLE = (REPOSITORY / "docs" / "safety.md").read_text()
NAMED = re.compile(r"`(tests/[\w/]+\.py)(?:::(\w+))?`")


def functions_of(path: Path) -> set[str]:
    return {
        node.name
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_every_test_that_the_table_names_exists() -> None:
    named = NAMED.findall(TABLE)
    missing = [
        f"{path}::{name}"
        for path, name in named
        if not (file := REPOSITORY / path).exists() or (name and name not in functions_of(file))
    ]
    assert missing == []


def test_every_row_of_contract_and_limits_names_one() -> None:
    contract, limits = re.findall(r"## (?:The contract|Limits).*?\n\n(?=[^|\n]|\Z)", TABLE, re.S)
    for table in (contract, limits):
        rows = [line for line in table.splitlines() if line.startswith("| ")][1:]
        assert len(rows) >= 7
        assert [row for row in rows if not NAMED.search(row)] == []


def test_every_row_of_the_contract_has_a_test_in_the_default_tier() -> None:
    (contract,) = re.findall(r"## The contract.*?\n\n(?=[^|\n]|\Z)", TABLE, re.S)
    rows = [line for line in contract.splitlines() if line.startswith("| ")][1:]
    thorough = {
        f"{path}::{node.name}"
        for path, _ in NAMED.findall(contract)
        for node in ast.parse((REPOSITORY / path).read_text()).body
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(one) == "pytest.mark.thorough" for one in node.decorator_list)
    }
    assert thorough
    named = [{f"{path}::{name}" for path, name in NAMED.findall(row)} for row in rows]
    assert [row for row, tests in zip(rows, named, strict=True) if tests <= thorough] == []
