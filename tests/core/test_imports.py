"""Importing without the garbage collector."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from rig.core.imports import importing


@pytest.fixture(autouse=True)
def collecting() -> Iterator[None]:
    """The collector on, and nothing kept from it afterwards."""
    gc.enable()
    yield
    gc.unfreeze()
    gc.enable()


def test_nothing_is_collected_meanwhile_and_what_is_there_then_never_will_be() -> None:
    frozen = gc.get_freeze_count()
    with importing():
        assert not gc.isenabled()
        kept: list[list[int]] = [[] for _ in range(1000)]
    assert gc.isenabled()
    assert gc.get_freeze_count() >= frozen + len(kept)


def test_the_collector_is_on_again_after_an_import_that_failed() -> None:
    with pytest.raises(ImportError), importing():
        raise ImportError("no such module")
    assert gc.isenabled()


def test_an_import_within_an_import_leaves_the_collector_off() -> None:
    with importing():
        with importing():
            pass
        assert not gc.isenabled()
