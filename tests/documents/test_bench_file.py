"""The bench files of docs/bench-file.md pass a dry run."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "bench-file.md").read_text()
RUNS = {
    "## A film in its clamp": ("sweep", "--frequencies", "200"),
    "## The skin above a plate": ("slip-trial", "--distance", "0.3", "--rest", "100ms"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("heading", RUNS)
def test_a_bench_file_of_the_page_passes_a_dry_run(rig: Any, heading: str) -> None:
    section = PAGE[PAGE.index(heading) :].split("\n## ", 1)[0]
    block = section[section.index("    name =") :].split("\n\n", 1)[0]
    (rig.folder / "bench.toml").write_text(dedent(block))
    done = rig.run(*RUNS[heading], "--no-figures", "--dry-run")
    assert done.code == 0, done.stderr
