"""A package whose entry points cannot be read registers nothing."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoints
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from rig.core import unreadable_packages


@pytest.fixture
def backport(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Stands for ``importlib_metadata``, with one package of which nothing can be read."""

    class Distribution:
        _path = Path("lab_creep-1.0.dist-info")

        @property
        def entry_points(self) -> EntryPoints:
            raise ValueError("no = sign\nin line 2")

    module: Any = ModuleType("importlib_metadata")
    module.Distribution, module.EntryPoints = Distribution, EntryPoints
    monkeypatch.setitem(sys.modules, "importlib_metadata", module)
    monkeypatch.setattr(unreadable_packages, "_unreadable", {})
    return module


def test_the_backport_passes_over_an_unreadable_package_and_it_is_named(backport: Any) -> None:
    unreadable_packages.tolerate_in_backport()
    unreadable_packages.tolerate_in_backport()
    assert list(backport.Distribution().entry_points) == []
    (warning,) = unreadable_packages.warnings()
    assert "lab_creep-1.0.dist-info" in warning
    assert "ValueError: no = sign in line 2" in warning


def test_a_computer_without_the_backport_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "importlib_metadata", None)
    unreadable_packages.tolerate_in_backport()
