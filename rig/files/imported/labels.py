"""What is known of an imported recording's truth: when the motion began and the ridge slipped.

It comes from columns of the file that are 0 until something begins (``--channels slip=5``), or from
a list in CSV with a line for each file (``--labels``): columns ``file``, ``label``, ``motion_s``,
``node_slip_s``, ``ridge_slip_s``, ``gross_slip_s`` and ``lift_off_s``, in s of the record, empty
for never. These are the names in the list of `rig score --files`, which then needs the file's name
alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from rig.core.csv_lists import read_list
from rig.core.errors import ConfigurationError
from rig.files.errors import ForeignFileError
from rig.files.imported.series import Recording

LABELS = (
    "slip", "slip in a slide", "slip in a roll", "roll", "lift-off", "hold", "partial slip", "tap"
)  # fmt: skip
"""Labels of a trial, as `rig score` knows them."""
SLIPPED = LABELS[:3]
TIMES = ("motion_s", "node_slip_s", "ridge_slip_s", "gross_slip_s", "lift_off_s")
OF_COLUMN = {"motion": "motion_s", "slip": "ridge_slip_s", "lift_off": "lift_off_s"}
"""Time that a column of the file gives, by the channel that it is named as."""
MAX_LIST_BYTES = 4 << 20

Label = dict[str, str | float]
"""``label`` and the times that are known; empty if nothing is."""


def read_labels(path: Path) -> dict[str, dict[str, str]]:
    """Return the lines of a list of labels by the name of the file. Raises ConfigurationError for
    one that cannot be used."""
    heads, rows = read_list(path, "list of labels", MAX_LIST_BYTES, ("file", "label"))
    known = ("file", "label", *TIMES)
    if "file" not in heads or not set(heads) - {"file"}:
        raise ConfigurationError(
            f"--labels {path}: its first line must name the column 'file' and one of "
            f"{', '.join(known[1:])}"
        )
    if unknown := [name for name in heads if name not in known]:
        raise ConfigurationError(
            f"--labels {path}: unknown column {unknown[0]!r}", f"known are {', '.join(known)}"
        )
    found: dict[str, dict[str, str]] = {}
    for number, line in rows:
        if line["file"] in found:
            raise ConfigurationError(
                f"--labels {path}, line {number}: {line['file']} appears twice"
            )
        found[line["file"]] = line
    return found


def label_of(recording: Recording, line: Mapping[str, str] | None, name: str) -> Label:
    """Return what is known of a recording's truth; empty if nothing is.

    The label follows from the times where it is not stated: a slip is a ``slip``, a lift-off
    without one a ``lift-off``; and where the file has a column for slips that is 0 throughout, it
    is a ``hold``. The first node slips with the ridge where nothing else is stated. Raises
    ForeignFileError for times outside the record, contradictions, and where the motion's begin is
    missing.
    """
    line = line or {}
    if not line and not recording.labels_s:
        return {}
    times: dict[str, float] = {}
    for channel, at_s in recording.labels_s.items():
        if at_s is not None:
            times[OF_COLUMN[channel]] = at_s
    for column in TIMES:
        if cell := line.get(column, ""):
            times[column] = _time(cell, column, recording, name)
    label = line.get("label") or _label_from(times, recording)
    if label not in LABELS:
        raise ForeignFileError(name, f"label {label!r} is not one of {', '.join(LABELS)}")
    if (label in SLIPPED) != ("ridge_slip_s" in times) and label != "lift-off":
        raise ForeignFileError(
            name,
            f"label {label!r} "
            + ("without" if label in SLIPPED else "with")
            + " the time ridge_slip_s of a slip of the whole ridge",
            "correct one of them in --labels",
        )
    if "motion_s" not in times:
        raise ForeignFileError(
            name,
            "it has a label, but not when the motion began, which separates alarms before it",
            "add motion_s to --labels, or motion=COLUMN to --channels",
        )
    early = [column for column in TIMES[1:] if times.get(column, math.inf) < times["motion_s"]]
    if early:
        raise ForeignFileError(
            name,
            f"{early[0]} {times[early[0]]:g} s is before motion_s {times['motion_s']:g} s",
            "correct the labels: all times are in s from the first sample",
        )
    if label in SLIPPED:  # who knows no more than the slip itself
        times.setdefault("node_slip_s", times["ridge_slip_s"])
    return {"label": label, **times}


def _label_from(times: Mapping[str, float], recording: Recording) -> str:
    if "ridge_slip_s" in times:
        return "slip"
    if "lift_off_s" in times:
        return "lift-off"
    return "hold" if "slip" in recording.labels_s else ""


def _time(cell: str, column: str, recording: Recording, name: str) -> float:
    length_s = recording.rows / recording.rate_Hz
    try:
        at_s = float(cell)
    except ValueError:
        raise ForeignFileError(name, f"{column} {cell!r} in --labels is not a number") from None
    if not 0 <= at_s <= length_s:
        raise ForeignFileError(
            name, f"{column} {cell} s in --labels: the record is from 0 to {length_s:g} s"
        )
    return at_s
