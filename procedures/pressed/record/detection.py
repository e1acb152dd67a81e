"""The detector of incipient slip during the trials of a run: signals in, detections out.

The same code judges run files (`rig detect`): it gets the same rows, so it finds the same events to
the bit. A detector of this project runs where the strips' blocks are read, in real time in the
thread of the DAQ's link; one of another package in a process of its own (`rig.processing.live`). No
tick of the servo waits for either. One that fails ends the detection and nothing else.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from rig.analysis.trial.decimation import DECIMATED_Hz
from rig.core.threads import start_thread
from rig.core.units import counted
from rig.detector.events import unjudged_s
from rig.detector.notices import CutOff
from rig.detector.registered import chosen_detector, is_own
from rig.files.journal.detections import (
    EVENT_CODES,
    NO_DETECTOR,
    SILENT_CODE,
    SLIP,
    Detection,
    detection_of,
)
from rig.processing.live import LiveDetector, start

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.pressed.record.trial_record import TrialRecord
    from rig.core.clock import Clock
    from rig.detector.events import SlipEvent
    from rig.detector.notices import Notice
    from rig.run.context import Run

SHOWN_SLIPS = 10
"""Largest number of slips of a trial that are shown one by one; the file has all of them."""
JOIN_S = 0.1
"""Interval of the signs of life while a detector starts."""


@cache
def try_detector(name: str) -> None:
    """Try a detector before it is needed. One of this project judges a row, so that nothing of it
    has to be compiled later. One of another package is started once in a separate process, because
    code of other packages is not imported here. Raises RigError if it cannot be used."""
    if name == NO_DETECTOR:
        return
    if is_own(name):
        chosen_detector(name).make(DECIMATED_Hz).add(np.zeros((1, 2)))
    else:
        start(name, DECIMATED_Hz, patient=True, woken=lambda: None).close()


class LiveDetection:
    """The detector that runs during the trials of a run.

    `begin`, `judge` and `finish` are called where the strips' blocks are read, one at a time;
    everything else by the procedure's thread.
    """

    def __init__(self, name: str, clock: Clock):
        """Start the detector, which may take seconds. Raises RigError if it cannot be used."""
        self.name = name
        self.woken = threading.Event()
        """Set while `news` or `failure` has something to return."""
        self._commands: list[Notice] = []
        self._cut_offs: list[CutOff] = []
        self._waiting: deque[Notice] = deque()
        """Known, and not given to the detector yet."""
        self._rows = 0
        self._live: LiveDetector | None = None
        if name != NO_DETECTOR:
            patient = clock.is_virtual
            self._live = start(
                name, DECIMATED_Hz, patient=patient, woken=self.woken.set, beat=clock.beat
            )

    @property
    def has_ended(self) -> bool:
        """Whether there was a detector and it is not used any more."""
        return self._live is not None and not self._live.in_use

    def begin(self) -> None:
        """Begin a record: the rows count from 0 again."""
        self._rows, self._commands, self._cut_offs = 0, [], []
        self._waiting.clear()
        if self._live is not None:
            self._live.begin()
            self._live.take()  # what came too late for the record before

    def judge(self, volts: npt.NDArray[np.float64]) -> None:
        """Judge the next rows (n, 2) of v_1 and v_2 in V. Raises nothing."""
        self._give_notices()
        first, self._rows = self._rows, self._rows + len(volts)
        if self._live is not None and len(volts):
            self._live.add(volts, first)

    def notice(self, given: Notice) -> None:
        """Say what was commanded or cut off, before the rows that show it. Raises nothing and waits
        for nothing: the detector knows of it with the next block."""
        self._waiting.append(given)

    @property
    def notices(self) -> list[Notice]:
        """What the bench knew in this record, from the rows on from which the detector knew it."""
        return [*self._commands, *self._cut_offs]

    def _give_notices(self) -> None:
        """Give the detector the notices since the last block, from its next row on where an
        earlier one was meant. They are stored as they were given, so that a file is judged like the
        trial."""
        for _ in range(len(self._waiting)):
            one = self._waiting.popleft()
            one = replace(one, sample=max(one.sample, self._rows))
            self._store(one)
            if self._live is not None:
                self._live.notice(one)

    def _store(self, one: Notice) -> None:
        """Store a notice. One that continues the cut-off before becomes part of it: a strip that
        stays outside the range is noticed with every block."""
        if not isinstance(one, CutOff):
            self._commands.append(one)
        elif self._cut_offs and one.sample <= self._cut_offs[-1].until:
            self._cut_offs[-1] = replace(self._cut_offs[-1], until=one.until)
        else:
            self._cut_offs.append(one)

    def finish(self) -> None:
        """End the record: what the detector reports at its end follows. Raises nothing."""
        self._give_notices()
        if self._live is not None:
            self._live.finish()

    def news(self) -> list[SlipEvent]:
        """Return the events since the last call."""
        self.woken.clear()
        return [] if self._live is None else [one.event for one in self._live.take()]

    def failure(self) -> str | None:
        """Return, once, why the detector is not used any more; None while it is."""
        return None if self._live is None else self._live.dropped()


def start_detection(run: Run) -> LiveDetection:
    """Start the detector of a run's settings, with signs of life meanwhile. Raises RigError if it
    cannot be used."""
    found: list[LiveDetection] = []
    failed: list[BaseException] = []

    def begin() -> None:
        try:
            found.append(LiveDetection(run.settings.detector, run.clock))
        except BaseException as failure:  # noqa: BLE001 - raised below
            failed.append(failure)

    _with_signs_of_life(begin, run.check_stop)
    if failed:
        raise failed[0]
    return found[0]


def _with_signs_of_life(work: Callable[[], None], beat: Callable[[], None]) -> None:
    """Do the work in a thread of its own, and call `beat` until it is done."""
    thread = threading.Thread(target=work, name="start of the detector", daemon=True)
    start_thread(thread)
    while thread.is_alive():
        thread.join(JOIN_S)
        beat()


class DetectionRecord:
    """Puts what a detector finds in a trial into the journal and the trial's record."""

    def __init__(self, run: Run, record: TrialRecord, detection: LiveDetection):
        self._run, self._record, self._detection = run, record, detection

    def take(self) -> list[Detection]:
        """Record what was found since the last call, and return it."""
        detection, record, run = self._detection, self._record, self._run
        if not detection.woken.is_set():
            return []
        known_s = run.clock.now() - record.begun_s
        found = [detection_of(event, known_s) for event in detection.news()]
        for one in found:
            run.event(
                "info",
                EVENT_CODES[one.kind],
                one.in_words(record.point, detection.name),
                record.begun_s + one.time_s,
            )
        record.detections += found
        if (failure := detection.failure()) is not None:
            run.event(
                "warning",
                SILENT_CODE,
                f"{record.point}: {failure}: no slip is detected from here on; the trial continues",
            )
        return found


def slips_in_words(record: TrialRecord, detector: str) -> list[str]:
    """Return a line for each of a detector's first alarms in a trial, and one for the number of
    further ones."""
    slips = [one for one in record.detections if one.kind == SLIP]
    lines = [
        f"{record.point}: incipient slip at {one.time_s:.3f} s ({detector})"
        for one in slips[:SHOWN_SLIPS]
    ]
    if more := len(slips) - len(lines):
        further = counted(more, "further alarm", "further alarms")
        lines.append(f"{record.point}: and {further} of incipient slip ({detector})")
    return lines


def unjudged_motion_in_words(record: TrialRecord, detector: str) -> str:
    """Return a sentence on the part of a trial's motion that its detector could not judge, with the
    reasons; empty where it could judge all of it."""
    from_s, to_s = record.motion_from_s, record.motion_to_s
    events = [one.as_event() for one in record.detections]
    cannot = [event for event in events if event.kind == "cannot judge"]
    seconds, reasons = 0.0, list[str]()
    for begin_s, end_s in unjudged_s(events, record_s=math.inf):
        if (missed_s := min(to_s, end_s) - max(from_s, begin_s)) > 0:
            seconds += missed_s
            within = (event.reason for event in cannot if begin_s <= event.time_s <= end_s)
            why = next(within, "for a reason that it does not state")
            reasons += [why] * (why not in reasons)
    if not seconds:
        return ""
    return (
        f"{record.point}: the detector {detector} could not judge {seconds:.2f} s of the "
        f"{to_s - from_s:.2f} s of motion ({'; '.join(reasons)}): a slip there has no alarm"
    )
