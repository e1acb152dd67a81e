"""What became of many random trials: a file to which each is appended, and its figures by kind.

A series of some thousand trials takes days of processor time, so it is made in pieces. Each trial
is a JSON object in a line of the register as soon as it has ended, with the commit that was tried;
what is interrupted is continued with the first seed that the register does not have.

    python -m soak.register FILE...     # from tests/: the figures of all pieces together
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from .invariants import DONE, DONE_WITH_FAILURES, PRESSED_N, Ran, declared, said_unheard_s

PRESSING = ("pressed", "released")
"""What the World's monitor writes into the log."""


@dataclass(frozen=True)
class Entry:
    """What became of one trial."""

    series: str
    """``soak`` or ``attack``: a seed is another trial in each."""
    seed: int
    commit: str
    procedure: str
    stages: str
    kinds: tuple[str, ...]
    """Kinds of faults that took effect, each once, in order; empty where none was met."""
    code: int
    largest_N: float
    """Largest true force by which the stages pressed, in N."""
    over_limit_s: float
    """Longest time without a break over the force limit, in s of bench time."""
    pressed_s: float | None
    """Time from the first fault until nothing was pressed any more, in s of bench time; None where
    nothing was pressed after the fault, or to the end, or where the run did not end by it."""
    violations: tuple[str, ...] = ()
    in_words: str = ""
    """The trial in words."""
    cpu_s: float | None = field(default=None, compare=False)
    """Processor time of the trial with its judgement, in s."""
    left_N: float | None = None
    """Largest true force that was left pressed at the end of a World; None in earlier registers."""
    unheard_s: float | None = None
    """For how long z had not answered when it was said that it does not, with place and force, in s
    of bench time; None where that was not said."""
    declared: tuple[str, ...] = ()
    """Wrong rows that no program can notice, as docs/fault-plans.md declares."""


def entry_of(series: str, ran: Ran, violations: Sequence[str], cpu_s: float | None = None) -> Entry:
    """Return the entry of a trial that has ended."""
    ended_by_it = ran.code not in (DONE, DONE_WITH_FAILURES)
    return Entry(
        series,
        ran.trial.seed,
        commit(),
        ran.trial.procedure,
        ran.trial.stages,
        tuple(dict.fromkeys(kind for _, kind in ran.faults_met)),
        ran.code,
        round(ran.largest_N, 3),
        round(ran.over_limit_s, 4),
        pressed_after_s(ran) if ended_by_it else None,
        tuple(violations),
        ran.trial.in_words,
        None if cpu_s is None else round(cpu_s, 2),
        max(ran.values("last-force"), default=None),
        said_unheard_s(ran),
        tuple(declared(ran)),
    )


def pressed_after_s(ran: Ran) -> float | None:
    """Return how long something was pressed after the first fault, in s of bench time; None where
    nothing was, or where it was not released. A batch has a World for each attempt at a run: the
    longest time of them."""
    found = [_pressed_after_s(world) for world in ran.worlds]
    return max((one for one in found if one is not None), default=None)


def _pressed_after_s(world: Sequence[Mapping[str, Any]]) -> float | None:
    injected = [x["t_us"] for x in world if x["what"] == "injected"]
    changes = [(x["value"]["at_us"], x["what"]) for x in world if x["what"] in PRESSING]
    if not injected or not changes or changes[-1][1] == "pressed":
        return None
    released_us = changes[-1][0]
    return round((released_us - injected[0]) * 1e-6, 4) if released_us > injected[0] else None


def commit() -> str:
    """Return the commit that is tried, with a plus sign if files differ from it."""
    folder = Path(__file__).parent
    words = {"cwd": folder, "capture_output": True, "text": True, "check": True}
    head = subprocess.run(["git", "rev-parse", "--short=9", "HEAD"], **words).stdout.strip()  # type: ignore[call-overload]
    changed = subprocess.run(["git", "status", "--porcelain", "-uno"], **words).stdout  # type: ignore[call-overload]
    return head + ("+" if changed.strip() else "")


def append(file: Path, entry: Entry) -> None:
    """Write the entry to the end of the file and to the disk."""
    with file.open("a") as lines:
        lines.write(json.dumps(asdict(entry)) + "\n")
        lines.flush()
        os.fsync(lines.fileno())


def read(file: Path) -> list[Entry]:
    """Return the entries of a register; none where there is no file. A line that was cut off by a
    power failure is left out."""
    entries = []
    for line in file.read_text().splitlines() if file.exists() else ():
        try:
            keys = json.loads(line)
        except ValueError:
            continue
        if "told" in keys:  # the name in earlier versions
            keys["in_words"] = keys.pop("told")
        keys |= {name: tuple(keys.get(name, ())) for name in ("kinds", "violations", "declared")}
        entries.append(Entry(**keys))
    return entries


def figures(entries: Iterable[Entry]) -> str:
    """Return a table by kind: how many trials met it, how many of them broke an invariant, the
    largest true force of those that met it alone and the longest time over the limit, how many were
    pressed after the fault and the longest time until they were not, how many were left pressed,
    after how long at most z was said not to answer, and the exit codes."""
    entries = list(entries)
    by_kind: dict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        for kind in entry.kinds or ("nothing met",):
            by_kind[kind].append(entry)
    columns = (
        f"{'alone':>5s} {'largest/N':>9s} {'over/s':>7s} {'pressed':>7s} {'longest/s':>9s} "
        f"{'left':>4s} {'said/s':>6s}"
    )
    lines = [f"{'kind':16s} {'n':>5s} {'broke':>5s} {columns}  exit codes"]
    for kind, met in sorted(by_kind.items()):
        alone = [one for one in met if one.kinds in ((kind,), ())]
        pressed = [one.pressed_s for one in alone if one.pressed_s is not None]
        left = [one for one in alone if (one.left_N or 0.0) > PRESSED_N]
        said = [one.unheard_s for one in alone if one.unheard_s is not None]
        codes = Counter(one.code for one in met)
        shown = " ".join(f"{code}:{codes[code]}" for code in sorted(codes))
        lines.append(
            f"{kind:16s} {len(met):5d} {sum(bool(one.violations) for one in met):5d} "
            f"{len(alone):5d} {_largest(one.largest_N for one in alone):>9s} "
            f"{_largest((one.over_limit_s for one in alone), 3):>7s} "
            f"{len(pressed):7d} {_largest(pressed):>9s} {len(left):4d} {_largest(said):>6s}"
            f"  {shown}"
        )
    for what in ("procedure", "stages", "commit"):
        counted = Counter(getattr(one, what) for one in entries)
        lines.append(f"{what}: " + ", ".join(f"{name} {n}" for name, n in counted.most_common()))
    cpu_s = [one.cpu_s for one in entries if one.cpu_s is not None]
    if cpu_s:
        lines.append(f"processor time of a trial: mean {sum(cpu_s) / len(cpu_s):.2f} s")
    broken = [one for one in entries if one.violations]
    lines += [
        f"{one.series} {one.seed} ({one.commit}): {'; '.join(one.violations)}" for one in broken
    ]
    unseen = [one for one in entries if one.declared]
    lines += [
        f"{one.series} {one.seed} ({one.commit}), declared: {'; '.join(one.declared)}"
        for one in unseen
    ]
    lines.append(
        f"trials that broke an invariant: {len(broken)} of {len(entries)}; with wrong rows that "
        f"are declared as not to be noticed: {len(unseen)}"
    )
    return "\n".join(lines)


def _largest(values: Iterable[float], digits: int = 2) -> str:
    largest = max(values, default=None)
    return "-" if largest is None else f"{largest:.{digits}f}"


if __name__ == "__main__":
    print(figures(entry for name in sys.argv[1:] for entry in read(Path(name))))
