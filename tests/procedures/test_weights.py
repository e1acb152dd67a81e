"""Weights on the simulated bench: what becomes of them."""

from __future__ import annotations

from typing import Any

import pytest

from rig.files.runfile.reader import RunFile


@pytest.mark.thorough
@pytest.mark.parametrize(("load", "outcome"), [("4N", "lost"), ("1.5N", "held")])
@pytest.mark.usefixtures("quick_ways")
def test_a_weight_is_lost_where_the_contact_cannot_hold_it_also_if_it_comes_fast(
    rig: Any, load: str, outcome: str
) -> None:
    """4 N of normal force hold about 2.9 N."""
    done = rig.run(
        "slip-trial", "--json", "--no-figures", "--loading", "ramp", "--ramp", "20N/s",
        "--hold-at", load, "--speed", "2mm/s", "--distance", "3mm", "--rest", "100ms",
        "--force-error-peak", "1000", "--force-error-rms", "1000",
    )  # fmt: skip
    assert done.code in (0, 5), done.stderr
    with RunFile.open(rig.folder / done.object["file"]) as run:
        (reading,) = run.readings()
    assert reading["outcome"] == outcome
    assert (reading["slid_mm"] > 0.5) == (outcome == "lost")
    assert f"{outcome} 1" in " ".join(done.object["summary"]["grip"])
