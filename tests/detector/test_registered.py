"""What is known of a detector that another package registers."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from rig.detector import registered


def test_the_code_of_a_package_without_an_init_file_is_its_own_and_not_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "site/lab_bare"
    package.mkdir(parents=True)
    (package / "level.py").write_text("class Level: pass\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    kind = import_module("lab_bare.level").Level
    digest = registered._digest_of.__wrapped__
    before = digest(kind)
    (tmp_path / "results").mkdir()
    (tmp_path / "results/run.h5").write_text("data")
    monkeypatch.chdir(tmp_path / "results")
    assert digest(kind) == before
    (package / "level.py").write_text("class Level: version = '2'\n")
    assert digest(kind) != before
