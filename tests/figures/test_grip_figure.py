"""The figures of a grip that answers alarms, of two weights on the same simulated bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

WEIGHT = (
    "slip-trial", "--json", "--no-figures",
    "--loading", "ramp", "--hold-at", "3N", "--ramp", "6N/s",
    "--speed", "2mm/s", "--distance", "2mm", "--rest", "100ms",
    "--force-error-peak", "1000", "--force-error-rms", "1000",
)  # fmt: skip


@pytest.mark.thorough
def test_weights_with_and_without_a_grip_are_drawn_and_beside_each_other(rig: Any) -> None:
    names = []
    for given in ((), ("--regrip",)):
        done = rig.run(*WEIGHT, *given)
        assert done.code in (0, 5), done.stderr
        names.append(Path(done.object["file"]))
    shown = rig.run("show", *map(str, names), "--figures")
    assert shown.code == 0, shown.stderr
    alone = [name.with_name(f"{name.stem}-grip.svg") for name in names]
    for drawn, gripped in zip(alone, (False, True), strict=True):
        said = (rig.folder / drawn).read_text("utf-8")
        assert ("squeeze" in said) == gripped
        assert ("outcome: averted" in said) == gripped
        assert ("outcome: lost" in said) == (not gripped)
    beside = names[0].with_name(f"{names[0].stem}-beside.svg")
    assert str(beside) in shown.stdout
    said = (rig.folder / beside).read_text("utf-8")
    assert "A weight without and with re-grip" in said
    assert "outcome: lost" in said
    assert "outcome: averted" in said
