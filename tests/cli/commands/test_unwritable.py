"""A result that cannot be written ends every command with exit code 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rig.cli.commands.score_report import write
from rig.cli.commands.simulate import _write_bench_file
from rig.cli.commands.skin_files import Model, save_model
from rig.core.errors import ExitCode, OutputError

WRITERS: dict[str, Callable[[Path], object]] = {
    "rig skin": lambda folder: save_model(Model("skin-slide", "", {}, {}), {}, folder),
    "rig score": lambda folder: write(folder / "score.json", ""),
    "rig simulate": lambda folder: _write_bench_file(folder / "bench.toml", ""),
}


@pytest.mark.parametrize("command", WRITERS)
def test_what_cannot_be_written_is_not_an_error_of_usage(tmp_path: Path, command: str) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(OutputError, match="cannot be written") as caught:
        WRITERS[command](tmp_path / "taken")
    assert caught.value.code == ExitCode.INTERNAL


@pytest.mark.parametrize("command", [["filter"], ["skin", "slide"], ["skin", "map"]])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_computed(
    rig: Any, command: list[str]
) -> None:
    """Computing a slide or a map takes minutes."""
    (rig.folder / "taken").write_text("")
    done = rig.run(*command, "--results", "taken/out")
    assert done.code == 2
    (error,) = done.errors
    assert error.startswith("error: --results taken/out: nothing can be written to it: Not a dir")
