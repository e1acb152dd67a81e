"""What has to be true after any trial, whatever went wrong in it: each breach is one sentence.

Everything is taken from outside: the World's log, the files, stderr and the exit code.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from drivers.simulated.faults.plan import CLOCK, DISK, FORCE_STREAM
from rig.core.errors import RigError
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

from .rows import rows_as_recorded
from .trials import TALLER, UNNOTICED, Trial

DONE, LIMIT, DONE_WITH_FAILURES, UNSAFE = 0, 4, 5, 7
RUNAWAY = "runaway"
PRESSED_N = 0.5
"""A force after the end that nobody may leave unsaid."""
NOT_KNOWN = "it is not known whether"
"""What a warning says where the force sensor is silent after the way up."""
AZ_PRESSES = ("az", "az-festo")
SAID_S = 2.0
"""Longest time after the last answer of z until it is said that it is not reached."""
LAST_KNOWN = re.compile(
    r"stage_z has not answered for ([0-9.]+) s and was last seen at [0-9.]+ mm, [0-9.]+ s ago, and "
    r"(?:force_sensor reads [0-9.e-]+ N|the force is not known)"
)
"""What a run says of a stage that it does not reach; its guard may know more."""
PLACE_AND_FORCE = re.compile(r" mm\b.*(?: N\b|not known)")
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
    def worlds(self) -> list[list[dict[str, Any]]]:
        """Its Worlds' logs: one."""
        return [self.log]

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
        *_reporting(ran),
        *at_rest(ran),
        *files_are_sound(ran),
        *(one.reported for one in rows_as_recorded(ran) if not one.declared),
    ]


def declared(ran: Ran) -> list[str]:
    """What of it docs/fault-plans.md declares that no program can notice."""
    return [one.reported for one in rows_as_recorded(ran) if one.declared]


def said_unheard_s(ran: Ran) -> float | None:
    """For how long z had not answered, at most, when it was said that it is not reached; None where
    that was not said."""
    said = re.findall(f"not safe yet: .*?{LAST_KNOWN.pattern}", ran.stderr)
    return max(map(float, said), default=None)


def _ending(ran: Ran) -> Iterator[str]:
    disk = any(fault["device"] == DISK for fault in ran.trial.faults)
    allowed = {*CODES["else"], *(CODES["disk"] if disk else ())}
    if ran.code not in allowed:
        yield f"exit code {ran.code}"
    if "Traceback" in ran.stderr or "internal error" in ran.stderr.lower():
        yield "an internal error"
    if not ran.faults_met and ran.code != DONE and not holds_worse(ran):
        yield f"exit code {ran.code} although nothing was injected"
    if not ran.log or ran.log[-1]["what"] != "end":
        yield "the World did not end by itself"


def _reporting(ran: Ran) -> Iterator[str]:
    """Every failure has a sentence that names what was injected, and a remedy."""
    if ran.code in (DONE, DONE_WITH_FAILURES):
        return
    if not ran.errors:
        yield f"exit code {ran.code} without a sentence"
        return
    yield from reported_about(ran, ran.errors)


def reported_about(ran: Ran, errors: Sequence[str]) -> Iterator[str]:
    """The `errors` of a trial that failed name what was injected, and a remedy."""
    for line in errors:
        if "; " not in line and not line.startswith("error: NOT SAFE"):
            yield f"no remedy: {line}"
    injected = {device for device, _ in ran.faults_met}
    words = {word for device in injected for word in NAMES.get(device, (device,))}
    if {kind for _, kind in ran.faults_met} & {*UNNOTICED}:
        words.add("torque limit")  # which alone bounds the force then, as docs/safety.md declares
    if RUNAWAY in {kind for _, kind in ran.faults_met}:
        words.add("force along")  # an axis that presses on is shown by the force
    if not any(word in line for word in words for line in errors):
        yield f"no sentence names {', '.join(sorted(injected))}: {errors[0]}"


def at_rest(ran: Ran) -> Iterator[str]:
    """The World's own watch; what could not be made safe has been reported with exit code 7."""
    for violation in ran.values("violation"):
        reported_unsafe = ran.code == UNSAFE and "NOT SAFE" in ran.stderr
        if not (reported_unsafe and "no run is active" in violation):
            yield f"the World: {violation}"
    for last_N in ran.values("last-force"):
        fine = ran.code in (DONE, DONE_WITH_FAILURES)
        reported = ran.code == UNSAFE or (not fine and NOT_KNOWN in ran.stderr)
        if last_N > (PRESSED_N if fine else ran.trial.limit_N) and not reported:
            yield f"{last_N:.3g} N are still pressed, and exit code {ran.code} does not say so"


def holds_worse(ran: Ran) -> bool:
    """Whether a trial without a fault is invalid only because the force was not held well enough,
    and says so: with an AZ as z that depends on what the seed draws (docs/safety.md, what differs
    by stage)."""
    if ran.code != DONE_WITH_FAILURES or ran.trial.stages not in AZ_PRESSES:
        return False
    why: list[str] = []
    for path in ran.files("*.h5"):
        with RunFile.open(path) as run:
            why += [one["invalid"] for one in run.readings() if one.get("invalid")]
    parts = [part for one in why for part in one.split("; ")]
    return bool(parts) and all(part.startswith("force error") for part in parts)


def left_unsaid(ran: Ran) -> Iterator[str]:
    """What is left pressed is said as not safe, with place and force, and where z is not reached
    within `SAID_S`."""
    if not any(last_N > PRESSED_N for last_N in ran.values("last-force")):
        return
    reported = ("NOT SAFE", "not safe", "pressed")
    lines = [line for line in ran.stderr.splitlines() if any(word in line for word in reported)]
    if ran.code != UNSAFE or not any(PLACE_AND_FORCE.search(line) for line in lines):
        yield "what is left pressed is not said with place and force"
    unheard_s = said_unheard_s(ran)
    if unheard_s is not None and unheard_s > SAID_S:
        yield f"that z does not answer is said {unheard_s:g} s after its last answer"


def files_are_sound(ran: Ran) -> Iterator[str]:
    """Every run file and every journal is sound and holds the points that were reported."""
    stays = any(fault["kind"] == "read-only" for fault in ran.trial.faults)  # nothing is removed
    if (left := [path.name for path in ran.files(".*.part")]) and not stays:
        yield f"left behind: {', '.join(left)}"
    reported = re.findall(r"^\d+/\d+ (\S+)$", ran.stderr, re.MULTILINE)
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
                if not (stays and "no usable header" in error.message and not reported):
                    yield f"{journal.name} cannot be recovered: {error.one_line()}"
                continue
            yield from (f"{file.name}: {finding}" for finding in verify(file))
            with RunFile.open(file) as run:
                kept += run.point_ids()
    disk = any(fault["device"] == DISK for fault in ran.trial.faults)
    if sorted(kept) != sorted(reported) and not (disk and set(kept) <= set(reported)):
        yield f"points reported {reported}, kept {kept}"
