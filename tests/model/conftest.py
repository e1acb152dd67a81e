"""Skins of the reference case, built once for all workers of a test run."""

from pathlib import Path

import pytest

from rig.cache import DiskCache
from rig.model.skin.condensed import CondensedSkin, build_skin
from rig.model.skin.settings import SkinSettings
from rig.model.trials import SlideSettings, Trial, slide


@pytest.fixture(scope="session")
def skin_cache(tmp_path_factory: pytest.TempPathFactory) -> DiskCache:
    """One cache for all workers; its content lives as long as the test run."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if base.name.startswith("popen-") else base
    return DiskCache(Path(shared) / "skin-cache")


@pytest.fixture(scope="session")
def skin6(skin_cache: DiskCache) -> CondensedSkin:
    """The reference skin at 6 elements a ridge."""
    return build_skin(SkinSettings(elements_per_ridge=6), skin_cache)


@pytest.fixture(scope="session")
def skin8(skin_cache: DiskCache) -> CondensedSkin:
    """The reference skin at 8 elements a ridge."""
    return build_skin(SkinSettings(), skin_cache)


@pytest.fixture(scope="session")
def reference_slide(skin8: CondensedSkin) -> Trial:
    """The reference slide with its contact forces."""
    return slide(skin8, SlideSettings(), keep_forces=True)
