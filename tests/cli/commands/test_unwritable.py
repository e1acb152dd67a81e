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


def test_a_filter_that_cannot_be_written_ends_with_1(rig: Any) -> None:
    (rig.folder / "taken").write_text("")
    done = rig.run("filter", "--results", "taken/out")
    assert done.code == 1
    (error,) = done.errors
    assert "cannot be written to taken/out" in error
