"""Latches under every name of the instrument that reads the contact."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.bench.plan import BenchPlan, parse_bench
from rig.run.interlocks.store import InterlockStore

BENCH = """
name = "b"
[fixture]
mounted = "film-clamp"
[daq]
driver = "keysight-u2300a"
channels = {{ load_cell = 101, film = 103 }}
resource = "{resource}"
[[interlock]]
name = "door"
input = "daq.501.0"
class = "person"
"""


def plan(host: str) -> BenchPlan:
    return parse_bench(BENCH.format(resource=f"TCPIP0::{host}::5025::SOCKET"), "bench.toml")


def test_a_latch_holds_for_every_name_of_its_instrument(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))
    by_name = InterlockStore(plan("localhost"), lasting=True)
    by_number = InterlockStore(plan("127.0.0.1"), lasting=True)
    by_name.check_writable()
    by_number.latch("door", "it was opened")
    assert by_name.get("door").why == "it was opened"
    by_name.reset("door")
    assert by_number.get("door").opened is None
