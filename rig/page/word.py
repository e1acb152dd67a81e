"""The state of a bench in one word, from what is known of it. Safe is shown only on evidence.

UNSAFE    a mark or a report says so, or a run died and its guard has not reported on the bench
unknown   the state cannot be known: a run gives no sign of life, no run is known to judge by, or
          only ``rig make-safe`` has made the bench safe, which lifts nothing
holding   the run has made the bench safe and waits, or has ended and its program still holds it
pressed   the object is under force
running   a run is at work
safe      the latest run ended, reported that it made the bench safe, and nothing holds the bench
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rig.bench.clear_of_contact import PRESSED_N

Word = Literal["running", "holding", "pressed", "safe", "UNSAFE", "unknown"]

SILENT_S = 3.0
"""Age of the newest sign of a living run from which its state is unknown, in s. A run synchronises
its journal every 0.25 s while it records."""
EXIT_UNSAFE = 7
MADE_SAFE = (
    "rig make-safe has stopped all motion and switched all outputs off since; it lifts nothing, so "
    "look whether something is still pressed"
)
"""Said of a bench that nothing but ``rig make-safe`` is known to have made safe. It is not green:
neither a run nor a guard has reported that nothing is pressed."""


@dataclass(frozen=True)
class Facts:
    """What is known of a bench and of the latest run on it."""

    run_lives: bool = False
    """The kernel says that a process holds the lock of the run's journal."""
    held_by_another: str = ""
    """Who else holds the bench, in words: a program that records no run here."""
    recorded: bool = False
    """There is a journal or a run file to judge by."""
    other_bench: bool = False
    """The journal or run file is of another bench than the one that is watched."""
    ended: bool = False
    """The journal's last record is an END."""
    exit: int = 0
    """The exit code in the END record; 0 if there is none."""
    holding: str = ""
    """Why the run that lives is on hold; empty if it is not."""
    off_failed: bool = False
    """An instrument of the run could not be switched off."""
    force_N: float | None = None
    silent_s: float = 0.0
    """Age of the newest sign of the run: the journal has grown."""
    recording: bool = False
    """Samples of the open point have come. Before them a point may be silent, while axes travel."""
    guarded: bool = False
    """The run's guard lives: it ends a run that gives no sign of life for its patience."""
    unsafe: str = ""
    """A mark in force, or the guard's report of a bench that it could not make safe."""
    pressed: str = ""
    """The guard's report of what is still pressed; empty for nothing."""
    unfinished: bool = False
    """The bench still has the mark of a run that has died."""
    guard_reported: bool = False
    """The guard of the run that died has finished, and has reported a bench that is stopped."""
    made_safe: bool = False
    """``rig make-safe`` has succeeded since the run's END and since the report of its guard."""
    problem: str = ""
    """Why the journal cannot be followed any further."""
    bench_problem: str = ""
    """Why the locks and marks of the bench cannot be read, or the run's files no longer exist."""


@dataclass(frozen=True)
class BenchWord:
    """The word, and the reason in a sentence."""

    word: Word
    reason: str


def bench_word(facts: Facts) -> BenchWord:
    """Return the state of the bench in one word, and why."""
    if facts.unsafe:
        return BenchWord("UNSAFE", facts.unsafe)
    failed = facts.off_failed or (facts.ended and facts.exit == EXIT_UNSAFE)
    if failed and not facts.made_safe:
        return BenchWord("UNSAFE", "the run could not switch everything off")
    if facts.problem:
        return BenchWord("unknown", facts.problem)
    if facts.run_lives and not facts.ended:
        return _of_a_run(facts)
    if facts.held_by_another:
        return BenchWord("unknown", f"in use by {facts.held_by_another}, which records no run here")
    if facts.unfinished and not facts.run_lives:
        return BenchWord(
            "UNSAFE", "the run died; its guard has not reported yet that it has finished"
        )
    if facts.bench_problem:
        return BenchWord("unknown", facts.bench_problem)
    if not facts.recorded:
        return BenchWord("unknown", "no run in this folder yet")
    if facts.pressed:
        return BenchWord("pressed", facts.pressed)
    if facts.other_bench:
        return BenchWord("unknown", "the latest run in this folder was on another bench")
    if facts.ended and facts.run_lives:
        # Its program saves the data, or begins the next run or attempt at any moment.
        return BenchWord(
            "holding", "the run has made the bench safe; its program still holds the bench"
        )
    if facts.made_safe and (failed or not (facts.ended or facts.guard_reported)):
        return BenchWord("unknown", MADE_SAFE)
    if facts.ended:
        return BenchWord("safe", "the latest run reported that it made the bench safe")
    if facts.guard_reported:
        return BenchWord("safe", "the run died; its guard reported that it made the bench safe")
    return BenchWord("UNSAFE", "the run died; its guard has not reported yet that it has finished")


def _of_a_run(facts: Facts) -> BenchWord:
    if facts.holding:
        return BenchWord("holding", facts.holding)
    if facts.silent_s >= SILENT_S and (facts.recording or not facts.guarded):
        no_guard = "" if facts.guarded else ", and its guard cannot be found"
        return BenchWord(
            "unknown", f"for {facts.silent_s:.0f} s: the run records nothing{no_guard}"
        )
    if facts.force_N is not None and abs(facts.force_N) > PRESSED_N:
        return BenchWord("pressed", f"{facts.force_N:.2f} N at the latest sample")
    quiet = f"nothing recorded for {facts.silent_s:.0f} s; its guard ends it if it hangs"
    return BenchWord("running", quiet if facts.silent_s >= SILENT_S else "")
