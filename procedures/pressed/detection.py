"""The detector of incipient slip in a trial under way: signals in, detections out.

The same code judges run files (`rig detect`): it gets the same rows, so it finds the same events to
the bit. It runs where the strips' blocks are read, in real time in the thread of the DAQ's link: no
tick of the servo waits for it. What a detector raises ends the detection and nothing else.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from rig.analysis.trial.decimation import RATE_Hz
from rig.detector.registered import chosen_detector
from rig.files.journal.detections import (
    EVENT_CODES,
    NO_DETECTOR,
    SILENT_CODE,
    Detection,
    detection_of,
)

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.pressed.reading import TrialRecord
    from rig.core.clock import Clock
    from rig.detector.contract import Detector
    from rig.detector.events import SlipEvent
    from rig.run.context import Run


def live_detector(name: str, rate_Hz: float) -> Detector | None:
    """Return the detector of this name, ready for rows at this rate; None for ``none``."""
    if name == NO_DETECTOR:
        return None
    return chosen_detector(name).make(rate_Hz)


def compile_detector(name: str) -> None:
    """Have the detector judge a row, so that nothing of it is compiled later."""
    if (detector := live_detector(name, RATE_Hz)) is not None:
        detector.add(np.zeros((1, 2)))


class LiveDetection:
    """The detector of one trial.

    `judge` and `finish` are called where the strips' blocks are read, everything else by the
    procedure's thread.
    """

    def __init__(self, name: str, rate_Hz: float, clock: Clock):
        self.name, self._clock = name, clock
        self._detector = live_detector(name, rate_Hz)
        self._rows = 0
        self._found: deque[tuple[SlipEvent, float]] = deque()
        """Events that `news` has not returned, and when on the run's clock each was known."""
        self.woken = threading.Event()
        """Set while `news` has something to return."""
        self._failure: Exception | None = None

    def judge(self, volts: npt.NDArray[np.float64]) -> None:
        """Judge the next rows (n, 2) of v_1 and v_2 in V. Raises nothing."""
        first, self._rows = self._rows, self._rows + len(volts)
        if self._detector is None or not len(volts):
            return
        try:
            self._note(self._detector.add(volts, first_sample=first))
        except Exception as failure:  # noqa: BLE001 - a detector must not end a trial
            self._end(failure)

    def finish(self) -> None:
        """Take what the detector reports at the end of a record. Raises nothing."""
        if self._detector is None:
            return
        try:
            self._note(self._detector.finish())
        except Exception as failure:  # noqa: BLE001 - as above
            self._end(failure)

    def news(self) -> list[tuple[SlipEvent, float]]:
        """Return the events since the last call, each with the time on the run's clock at which it
        was known."""
        self.woken.clear()
        events = []
        while self._found:
            events.append(self._found.popleft())
        return events

    def failure(self) -> Exception | None:
        """Return, once, what the detector has raised."""
        failure, self._failure = self._failure, None
        return failure

    def _note(self, events: list[SlipEvent]) -> None:
        if events:
            now_s = self._clock.now()
            self._found.extend((event, now_s) for event in events)
            self.woken.set()

    def _end(self, failure: Exception) -> None:
        self._detector, self._failure = None, failure
        self.woken.set()


class DetectionRecord:
    """Puts what a detector finds in a trial into the journal and the trial's record."""

    def __init__(self, run: Run, record: TrialRecord, detection: LiveDetection):
        self._run, self._record, self._detection = run, record, detection

    def take(self) -> list[Detection]:
        """Record what was found since the last call, and return it."""
        detection, record, run = self._detection, self._record, self._run
        if not detection.woken.is_set():
            return []
        found = [
            detection_of(event, known_s - record.begun_s) for event, known_s in detection.news()
        ]
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
                f"trial {record.number}: the detector {detection.name} failed "
                f"({type(failure).__name__}: {failure}): no slip is detected in the rest of this "
                "trial; the trial continues",
            )
        return found
