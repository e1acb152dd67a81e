"""docs/architecture.md has every thread and process that the source starts."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SECTION = re.compile(r"^## Threads and processes\n(.*?)^Why: ", re.MULTILINE | re.DOTALL)
STARTS = {"Thread", "Timer", "Process", "Popen", "ThreadPoolExecutor", "ProcessPoolExecutor"}
STARTS_OF = {("os", "fork"), ("subprocess", "run"), ("threading", "Timer")}
OWN = {"Child", "run_module", "StreamReader"}
"""Classes and functions of the program that start a thread or process for their caller."""
NO_PROCESS = {"rig/evaluation/scoring/ideal.py"}
"""Modules in which `Process` is a stochastic one."""
SHOWN_BY_CALLERS = {
    "rig/run/streams/force_monitor.py", "rig/run/streams/scales.py", "rig/files/verify.py",
    "rig/files/imported/matlab_variables.py",
}  # fmt: skip
"""Modules whose threads and processes are on the page under the module that makes them."""


def starts() -> Iterator[tuple[str, ast.Call]]:
    """Yield every call that starts a thread or process, with its module's path."""
    for package in ("rig", "procedures", "drivers"):
        for path in sorted((ROOT / package).rglob("*.py")):
            module = str(path.relative_to(ROOT))
            for node in ast.walk(ast.parse(path.read_text())):
                if module not in NO_PROCESS and isinstance(node, ast.Call) and is_start(node):
                    yield module, node


def is_start(call: ast.Call) -> bool:
    name = call.func
    if isinstance(name, ast.Attribute):
        owner = name.value.id if isinstance(name.value, ast.Name) else ""
        return name.attr in STARTS or (owner, name.attr) in STARTS_OF
    return isinstance(name, ast.Name) and name.id in STARTS | OWN


def literal_names(call: ast.Call) -> Iterator[str]:
    """Yield the name that a thread is given, up to what is filled in."""
    given = [word.value for word in call.keywords if word.arg in ("name", "thread_name_prefix")]
    if isinstance(call.func, ast.Name) and call.func.id in ("StreamReader", "ThreadPoolExecutor"):
        given += call.args[:2]
    for value in given:
        first = value.values[0] if isinstance(value, ast.JoinedStr) else value
        if isinstance(first, ast.Constant) and isinstance(first.value, str):
            yield first.value


def test_the_page_names_every_thread_and_process_that_the_source_starts() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    section = SECTION.search(page)
    assert section is not None
    found = list(starts())
    assert len(found) > 20, "the search finds what is started"
    modules = {module for module, _ in found} - SHOWN_BY_CALLERS
    assert [module for module in sorted(modules) if f"`{module}`" not in section[1]] == []
    names = {name for _, call in found for name in literal_names(call)}
    assert {"observers", "still pressed", "force reader", "link ", "change"} <= names
    assert [name for name in sorted(names) if f"`{name}" not in section[1]] == []
