"""Every test of the contract runs on one of the combinations of stages and DAQ."""

from __future__ import annotations

import pytest
from benches import BENCHES, Bench, bench_for


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Bench:
    """The combination that this test runs on; one marked `stages` has a meaning on these only."""
    marked = request.node.get_closest_marker("stages")
    if marked is None:
        return bench_for(request.node.name)
    able = [bench for bench in BENCHES if bench.stages in marked.args]
    chosen = bench_for(request.node.name, able)
    if chosen not in able:
        pytest.skip(f"not on {chosen.stages}: {marked.kwargs['because']}")
    return chosen
