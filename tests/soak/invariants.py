"""What has to be true after any trial, whatever went wrong in it: each breach is one sentence.

Everything is taken from outside: the World's log, the files, stderr and the exit code.
"""

from __future__ import annotations

import json
import re
import shutil
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from drivers.simulated.faults.plan import CLOCK, DISK, FORCE_STREAM
from rig.core.errors import RigError
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

from .trials import TALLER, UNNOTICED, Trial

DONE, DONE_WITH_FAILURES, UNSAFE = 0, 5, 7
RUNAWAY = "runaway"
PRESSED_N = 0.5
"""A force after the end that nobody may leave unsaid."""
NOT_KNOWN = "it is not known whether"
"""What a warning says where the force sensor is silent after the way up."""
CODES = {"disk": (0, 1), "else": (0, 3, 4, 5, 7)}
NAMES = {
    FORCE_STREAM: ("force",),
    "force_sensor": ("force",),
    "generator": ("generator", "load"),
    CLOCK: ("stage_", "force", "daq", "generator", "clock"),
    DISK: (".rigj", ".h5", "results", "journal", "disk"),
    "object": ("force", "stage_z", "contact", "pressed"),
}
"""By which words a sentence names a device; the others by their own names. A clock that jumps has
no name of its own: whoever missed the time is named."""


@dataclass(frozen=True)
class Ran:
    """A trial that has ended, and what it left."""

    trial: Trial
    code: int
    stdout: str
    stderr: str
    folder: Path

    @cached_property
    def log(self) -> list[dict[str, Any]]:
        """The World's."""
        path = self.folder / "world.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    @property
    def errors(self) -> list[str]:
        """The lines that report errors."""
        return [line for line in self.stderr.splitlines() if line.startswith("error: ")]

    @property
    def faults_met(self) -> list[tuple[str, str]]:
        """Device and kind of what was really done, in order; a disk's faults as planned, for they
        stand in no World's log."""
        done = [(x["device"], x["kind"]) for x in self.trial.faults if x["device"] == DISK]
        taller = [] if self.trial.contact_mm is None else [("object", TALLER)]
        return [
            *((x["device"], x["value"]) for x in self.log if x["what"] == "injected"),
            *done,
            *taller,
        ]

    @property
    def largest_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Largest true force by which the stages have pressed."""
        return max(self.values("largest-force"), default=0.0)

    @property
    def over_limit_s(self) -> float:
        """Longest time without a break for which that was over the limit."""
        return max(self.values("longest-over-limit"), default=0.0)

    def values(self, what: str) -> list[Any]:
        """All that the World's log has of something."""
        return [x["value"] for x in self.log if x["what"] == what]

    def files(self, pattern: str) -> list[Path]:
        """What lies below the folder of results."""
        return sorted((self.folder / "results").rglob(pattern))


def breaches(ran: Ran) -> list[str]:
    """Every invariant that does not hold after the trial."""
    return [
        *_ending(ran),
        *_telling(ran),
        *_at_rest(ran),
        *_files(ran),
        *_samples(ran),
    ]


def _ending(ran: Ran) -> Iterator[str]:
    disk = any(fault["device"] == DISK for fault in ran.trial.faults)
    allowed = {*CODES["else"], *(CODES["disk"] if disk else ())}
    if ran.code not in allowed:
        yield f"exit code {ran.code}"
    if "Traceback" in ran.stderr or "internal error" in ran.stderr.lower():
        yield "an internal error"
    if not ran.faults_met and ran.code != DONE:
        yield f"exit code {ran.code} although nothing was injected"
    if not ran.log or ran.log[-1]["what"] != "end":
        yield "the World did not end by itself"


def _telling(ran: Ran) -> Iterator[str]:
    """Every failure has a sentence that names what was injected, and a remedy."""
    if ran.code in (DONE, DONE_WITH_FAILURES):
        return
    if not ran.errors:
        yield f"exit code {ran.code} without a sentence"
        return
    for line in ran.errors:
        if "; " not in line and not line.startswith("error: NOT SAFE"):
            yield f"no remedy: {line}"
    injected = {device for device, _ in ran.faults_met}
    words = {word for device in injected for word in NAMES.get(device, (device,))}
    if {kind for _, kind in ran.faults_met} & {*UNNOTICED}:
        words.add("torque limit")  # which alone bounds the force then, as docs/safety.md declares
    if RUNAWAY in {kind for _, kind in ran.faults_met}:
        words.add("force along")  # an axis that presses on is the force's to tell
    if not any(word in line for word in words for line in ran.errors):
        yield f"no sentence names {', '.join(sorted(injected))}: {ran.errors[0]}"


def _at_rest(ran: Ran) -> Iterator[str]:
    """The World's own watch; what could not be made safe has been told with exit code 7."""
    for violation in ran.values("violation"):
        told_unsafe = ran.code == UNSAFE and "NOT SAFE" in ran.stderr
        if not (told_unsafe and "no run is active" in violation):
            yield f"the World: {violation}"
    for last_N in ran.values("last-force"):
        fine = ran.code in (DONE, DONE_WITH_FAILURES)
        told = ran.code == UNSAFE or (not fine and NOT_KNOWN in ran.stderr)
        if last_N > (PRESSED_N if fine else ran.trial.limit_N) and not told:
            yield f"{last_N:.3g} N are still pressed, and exit code {ran.code} does not tell so"


def _files(ran: Ran) -> Iterator[str]:
    """Every run file and every journal is sound and holds the points that were told."""
    stays = any(fault["kind"] == "read-only" for fault in ran.trial.faults)  # nothing is removed
    if (left := [path.name for path in ran.files(".*.part")]) and not stays:
        yield f"left behind: {', '.join(left)}"
    told = re.findall(r"^\d+/\d+ (\S+)$", ran.stderr, re.MULTILINE)
    kept: list[str] = []
    for path in ran.files("*.h5"):
        yield from (f"{path.name}: {finding}" for finding in verify(path))
        with RunFile.open(path) as run:
            kept += run.point_ids()
    if not ran.files("*.h5"):
        for journal in ran.files("*.rigj"):
            copy = ran.folder / "recovered" / journal.name
            copy.parent.mkdir(exist_ok=True)
            shutil.copy(journal, copy)
            try:
                file = compile_run(copy)
            except RigError as error:
                if not (stays and "no usable header" in error.message and not told):
                    yield f"{journal.name} cannot be recovered: {error.one_line()}"
                continue
            yield from (f"{file.name}: {finding}" for finding in verify(file))
            with RunFile.open(file) as run:
                kept += run.point_ids()
    disk = any(fault["device"] == DISK for fault in ran.trial.faults)
    if sorted(kept) != sorted(told) and not (disk and set(kept) <= set(told)):
        yield f"points told {told}, kept {kept}"


def _samples(ran: Ran) -> Iterator[str]:
    """Every row in the file is one that was sent, in its order, once."""
    blocks = [x["value"] for x in ran.log if x["what"] == "block"]
    frames = [crc for x in ran.log if x["what"] == "frames" for crc in x["value"]]
    used: set[int] = set()
    for path in ran.files("*.h5"):
        with RunFile.open(path) as run:
            for status in ("kept", "discarded", "unfinished"):
                for waveform in run.waveforms(status=status):
                    rows = np.stack(list(waveform.counts.values()), axis=1)
                    if waveform.stream in ("waveform", "strips"):
                        yield from _blocks(waveform.path, rows, blocks, used)
                    elif waveform.stream == "bridges":
                        yield from _frames(waveform.path, rows, frames)


def _blocks(
    name: str, rows: np.ndarray, blocks: list[dict[str, Any]], used: set[int]
) -> Iterator[str]:
    """The rows are blocks of the DAQ, one after the other, none of them used before."""
    at, expected = 0, None
    while at < len(rows):
        candidates = range(len(blocks)) if expected is None else (expected,)
        fitting = (n for n in candidates if n not in used and _is_block(rows[at:], blocks, n))
        found = next(fitting, None)
        if found is None:
            yield f"{name}: row {at} begins no block that the DAQ handed out, or one used before"
            return
        used.add(found)
        at += blocks[found]["rows"]
        expected = found + 1


def _is_block(rows: np.ndarray, blocks: list[dict[str, Any]], number: int) -> bool:
    if number >= len(blocks) or len(rows) < blocks[number]["rows"]:
        return False
    block = np.ascontiguousarray(rows[: blocks[number]["rows"]], "<i2")
    return zlib.crc32(block.tobytes()) == blocks[number]["crc32"]


def _frames(name: str, rows: np.ndarray, frames: list[int]) -> Iterator[str]:
    """The rows are a gapless stretch of the frames that the sensor sent."""
    recorded = [zlib.crc32(row.tobytes()) for row in rows.astype(">f4")]
    if not recorded:
        return
    starts = [at for at, crc in enumerate(frames) if crc == recorded[0]]
    if not any(frames[at : at + len(recorded)] == recorded for at in starts):
        yield f"{name}: {len(recorded)} frames are no stretch of those that were sent"
