"""The course of a stop, from the press to the end: what is said of it, as rules without a process.

    asked          the signal was sent; nothing has been seen of it yet
    switching off  the run has given up its point, or recorded that it stops
    ended          its END record is there: the bench is safe, or the run says that it is not
    guard          the run's process has ended without an END: its guard acts, or has finished
    hanging        nothing has been seen for longer than a run that works needs

Red until `ended` or the guard's last report.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

StopPhase = Literal["asked", "switching off", "ended", "guard", "hanging"]

REACTS_WITHIN_S = 2.0
"""Time within which a run that works is seen to react: it notices a signal within 20 ms and
synchronises its journal every 0.25 s."""


@dataclass(frozen=True)
class StopSigns:
    """What has been seen of a run since STOP was pressed on the page."""

    since_s: float
    """Time since the press."""
    presses: int
    pid: int
    process_lives: bool
    reacted: bool
    """A point was given up since, or the run makes the bench safe, or the END is there."""
    ended: bool
    after_end: bool = False
    """The process had recorded its END before the press, and nothing since."""
    exit: int = 0
    status: str = ""
    guard_pid: int | None = None
    heartbeat_timeout_s: float = 0.0
    """After so long without a sign of life the guard kills the run; 0 if not known."""
    guard_report: str = ""
    """What the guard has reported of this run; empty before."""
    guard_done: bool = False
    """It was the guard's last report: before that it measures, lifts z and compiles the data."""
    guard_safe: bool = False
    recording: bool = True
    """The process was recording a run, or has begun one since."""
    bench_safe: bool = False
    """The state of the bench is "safe"."""
    made_safe: bool = False
    """``rig make-safe`` has succeeded since the run's END and since the report of its guard."""
    pressed: str = ""
    """What is reported to be still pressed; empty for nothing."""


@dataclass(frozen=True)
class StopCourse:
    """What a page says of a stop: how far it has come, and whether the bench is safe."""

    phase: StopPhase
    text: str
    over: bool
    """True if nothing more is to be expected."""
    safe: bool
    """True if the bench was reported to be safe. Until then the page is red."""


def stop_course(signs: StopSigns) -> StopCourse:
    """Return how far a stop has come, and what to say of it."""
    again = (
        f" Pressed {signs.presses} times: the run is stopping already, a further press changes "
        "nothing."
        if signs.presses > 1
        else ""
    )
    if signs.made_safe and not signs.process_lives:
        text = "rig make-safe has succeeded since. The state above says how the bench is."
        return StopCourse("ended", text, True, signs.bench_safe)
    if signs.ended:
        if signs.exit == 7:
            text = "The run ended but could not switch everything off: the bench is UNSAFE."
            return StopCourse("ended", text, True, False)
        if signs.pressed:
            return StopCourse("ended", f"The run has ended, but: {signs.pressed}", True, False)
        return StopCourse("ended", f"The run has made the bench safe: {signs.status}.", True, True)
    if not signs.process_lives:
        if signs.guard_report:
            return _by_the_guard(signs)
        # A batch that rested has no END. The END of a run was perhaps read before it could be taken
        # for this one's: while a long journal was still read, or before the press.
        if signs.bench_safe or (signs.guard_pid is None and not signs.recording):
            text = f"Process {signs.pid} has ended. The state above says how it left the bench."
            return StopCourse("ended", text, True, signs.bench_safe)
        text = "The run's process has ended. Its guard is making the bench safe; no report yet."
        return StopCourse("guard", text, False, False)
    if signs.reacted:
        return StopCourse(
            "switching off", f"The run is making the bench safe.{again}", False, False
        )
    if signs.after_end:
        text = (
            f"The run had ended before the press. Process {signs.pid} still holds the bench: it "
            f"saves its data, or begins the run again.{again}"
        )
        return StopCourse("asked", text, False, False)
    if signs.since_s >= REACTS_WITHIN_S:
        return StopCourse("hanging", _hanging(signs) + again, False, False)
    return StopCourse("asked", f"Process {signs.pid} was asked to stop.{again}", False, False)


def _by_the_guard(signs: StopSigns) -> StopCourse:
    """Return what to say once the guard has reported: it reports first that everything stands, and
    only then measures what is pressed and lifts z off it."""
    text = signs.guard_report
    if not signs.guard_safe:
        text += "; it could not make the bench safe"
    if signs.pressed:
        text += f"; but: {signs.pressed}"
    if not signs.guard_done:
        text += ". It still measures what is pressed, lifts z off it, or saves the data."
    safe = signs.guard_done and signs.guard_safe and not signs.pressed
    return StopCourse("guard", text, signs.guard_done, safe)


def _hanging(signs: StopSigns) -> str:
    begin = f"Process {signs.pid} has shown no reaction for {signs.since_s:.0f} s. "
    if signs.guard_pid is None:
        return begin + "Its guard cannot be found: switch the bench off by hand."
    if not signs.heartbeat_timeout_s:
        return begin + f"If it hangs, its guard (process {signs.guard_pid}) kills it."
    return begin + (
        f"If it hangs, its guard (process {signs.guard_pid}) kills it after "
        f"{signs.heartbeat_timeout_s:g} s without a sign of life and makes the bench safe; if it "
        "only waits for an instrument, it makes the bench safe itself."
    )
