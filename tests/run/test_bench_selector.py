"""Which bench a command works on."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.core.errors import ConfigurationError
from rig.run.bench_selector import existing_bench_file


def test_who_only_watches_is_not_offered_a_simulated_bench(tmp_path: Path) -> None:
    """`rig monitor` and `rig page` start none."""
    with pytest.raises(ConfigurationError) as caught:
        existing_bench_file(tmp_path / "none.toml")
    assert caught.value.hint is not None
    assert "simulated" not in caught.value.hint
    assert "--bench" in caught.value.hint
