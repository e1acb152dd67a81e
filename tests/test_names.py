"""Names: one class, one name, in all of the program."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EACH_MODULE_HAS_ITS_OWN = {"Settings"}
"""Named so by what registers the module: the settings of a driver."""


def test_no_two_public_classes_have_the_same_name() -> None:
    places = defaultdict[str, list[str]](list)
    for package in ("rig", "procedures", "drivers"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.parse(path.read_text("utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert len(places) > 700
    double = {name: found for name, found in places.items() if len(found) > 1}
    assert double.keys() <= EACH_MODULE_HAS_ITS_OWN, double
