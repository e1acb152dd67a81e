"""The judge of recorded rows: it finds nothing in a sound trial, and each kind of wrong row."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from forked_rig import server

from .attacks import OPTIONS
from .invariants import Ran, breaches
from .rows import rows_as_recorded
from .running import run
from .trials import Fault, Trial, world_of

pytestmark = pytest.mark.thorough


def slid(folder: Path, *faults: Fault) -> Ran:
    """A slip trial under these faults."""
    arguments = ("slip-trial", *OPTIONS["slip-trial"], "--seed", "3")
    return run(server(), Trial(3, arguments, world_of("slip-trial", faults), faults), folder)


def judged(ran: Ran, change: Any) -> list[str]:
    """What is found in the trial if the World's log is changed so."""
    log = deepcopy(ran.log)
    change(log)
    other = Ran(ran.trial, ran.code, ran.stdout, ran.stderr, ran.folder)
    other.__dict__["log"] = log
    return [one.reported for one in rows_as_recorded(other)]


def test_every_kind_of_wrong_row_is_found(tmp_path: Path) -> None:
    """The file is sound; each time the World says that it was otherwise."""
    ran = slid(tmp_path / "trial")
    assert breaches(ran) == []

    def values(log: list[dict[str, Any]], what: str) -> list[Any]:
        return [entry["value"] for entry in log if entry["what"] == what]

    def move_x(log: list[dict[str, Any]]) -> None:
        for one in values(log, "places"):
            if one["role"] == "stage_x":
                one["at"] = [at + 0.01 for at in one["at"]]

    def send_more(log: list[dict[str, Any]]) -> None:
        for frames in values(log, "frames"):
            frames.append(1)

    def send_others(log: list[dict[str, Any]]) -> None:
        for block in values(log, "block"):
            block["crc32"] ^= 1

    (reported,) = judged(ran, move_x)
    assert "shows stage_x 0.0101 from where it was" in reported
    (reported,) = judged(ran, send_more)
    assert "are no stretch of those that were sent" in reported
    (reported,) = judged(ran, send_others)
    assert "begins no block that the DAQ handed out" in reported


def test_a_flipped_bit_among_the_strips_samples_is_declared_and_no_other_change(
    tmp_path: Path,
) -> None:
    moment = {"command": "WAV:DATA", "move": 2, "of": "stage_x", "after_s": 0.1}
    ran = slid(tmp_path / "trial", {"device": "daq", "kind": "flip", **moment, "byte": -3})
    assert breaches(ran) == []
    (found,) = rows_as_recorded(ran)
    assert found.declared
    assert "a flipped bit in 1 block," in found.reported

    def other(log: list[dict[str, Any]]) -> None:
        for entry in log:
            if entry["what"] == "block":
                entry["value"]["crc32"] ^= 1

    assert len(judged(ran, other)) == 1
