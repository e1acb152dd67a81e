"""docs/safety.md and docs/safety-contract.md name their tests: each is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from contract_page import entries_of, named_in

REPOSITORY = Path(__file__).parents[1]
SAFETY = (REPOSITORY / "docs" / "safety.md").read_text()
CONTRACT = (REPOSITORY / "docs" / "safety-contract.md").read_text()


def functions_of(path: Path) -> set[str]:
    return {
        node.name
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_every_test_that_the_table_names_exists() -> None:
    named = named_in(SAFETY + CONTRACT)
    missing = [
        f"{path}::{name}"
        for path, name in named
        if not (file := REPOSITORY / path).exists() or (name and name not in functions_of(file))
    ]
    assert missing == []


def test_every_entry_of_contract_and_limits_names_one() -> None:
    for chapter in ("The contract", "Limits", "Hand control"):
        entries = entries_of(CONTRACT, chapter).values()
        assert len(entries) >= 7
        assert [entry for entry in entries if not named_in(entry)] == []


def is_left_out(decorator: ast.expr) -> bool:
    """Whether a test with this decorator is in no case in the default tier."""
    if ast.unparse(decorator) in ("pytest.mark.thorough", "pytest.mark.nightly"):
        return True
    return any(
        isinstance(call, ast.Call)
        and ast.unparse(call.func) == "mostly_nightly"
        and len(call.args) + len(call.keywords) < 3  # the third is what is in the default tier
        for call in ast.walk(decorator)
    )


def test_every_entry_of_the_contract_has_a_test_in_the_default_tier() -> None:
    entries = entries_of(CONTRACT, "The contract").values()
    (chapter,) = re.findall(r"^## The contract.*?(?=^## )", CONTRACT, re.M | re.S)
    assert len(entries) == len(re.findall(r"^- ", chapter, re.M)) >= 70
    named = [{f"{path}::{name}" for path, name in named_in(entry)} for entry in entries]
    later = {
        f"{path}::{node.name}"
        for path in {name.partition("::")[0] for names in named for name in names}
        for node in ast.parse((REPOSITORY / path).read_text()).body
        if isinstance(node, ast.FunctionDef) and any(map(is_left_out, node.decorator_list))
    }
    assert later
    assert [entry for entry, tests in zip(entries, named, strict=True) if tests <= later] == []


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
