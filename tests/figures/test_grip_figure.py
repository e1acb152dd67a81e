"""The figures of a grip that answers alarms, of two weights on the same simulated bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

WEIGHT = (
    "slip-trial", "--json", "--loading", "ramp", "--hold-at", "3N", "--ramp", "6N/s",
    "--speed", "2mm/s", "--distance", "2mm", "--rest", "100ms",
    "--force-error-peak", "1000", "--force-error-rms", "1000",
)  # fmt: skip


@pytest.mark.thorough
def test_weights_with_and_without_a_grip_are_drawn_and_beside_each_other(rig: Any) -> None:
    names = []
    for given in ((), ("--regrip",)):
        done = rig.run(*WEIGHT, *given)
        assert done.code in (0, 5), done.stderr
        names.append(done.object["file"])
        (drawn,) = [name for name in done.object["figures"] if name.endswith("-grip.svg")]
        said = (rig.folder / drawn).read_text("utf-8")
        assert ("squeeze" in said) == bool(given)
        assert ("outcome: averted" in said) == bool(given)
        assert "outcome: lost" in said or given
    shown = rig.run("show", *names, "--figures")
    assert shown.code == 0, shown.stderr
    beside = Path(names[0]).with_suffix("").as_posix() + "-beside.svg"
    assert beside in shown.stdout
    said = (rig.folder / beside).read_text("utf-8")
    assert "A weight without and with re-grip" in said
    assert "outcome: lost" in said
    assert "outcome: averted" in said
