"""A detector of another package, distrusted: what it returns is checked, what it raises is named.

This protects the results: an event of the future, a kind that does not exist or a confidence of 7
never reach a file. It cannot stop code that never returns or ends the process; a running trial has
such a detector in a process of its own (`rig.processing.live`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.core.entry_points import DETECTORS, find, place_in
from rig.core.errors import LONGEST_REASON, ExitCode, RigError, is_stop, shortened
from rig.core.quiet_stdout import quiet_stdout
from rig.core.settings import Settings
from rig.detector.contract import Detector
from rig.detector.events import EVENT_KINDS, SlipEvent

if TYPE_CHECKING:
    from rig.detector.low_pass import LowPass
    from rig.detector.notices import Notice

Reals = NDArray[np.float64]
Given = TypeVar("Given")

LARGEST = float(np.finfo(np.float64).max)
"""Largest number that a file holds; a larger int compares with it exactly."""
MOST_EVENTS_A_ROW = 16
"""Maximum number of events decided in one row: a detector that returns more is broken."""


class DetectorError(RigError):
    """Raised where a detector of another package fails or returns something else than an event.

    The message names the detector and its package."""

    code = ExitCode.INTERNAL

    def __init__(self, name: str, package: str, reason: str):
        self.reason = reason
        super().__init__(
            f"detector {name!r} of the package {package} {reason}",
            f"fix the package {package}, or choose another detector (rig detectors)",
        )


class CheckedDetector(Detector):
    """Another detector, each of whose answers is checked."""

    slowest_Hz: ClassVar[float] = 0.0
    fastest_Hz: ClassVar[float] = math.inf

    def __init__(
        self,
        make: Callable[[float], Detector],
        name: str,
        package: str,
        settings: Settings,
        rate_Hz: float,
    ):
        """Make the detector with `make`. Raises ValueError for a rate that it does not judge,
        DetectorError for anything else that it raises."""
        super().__init__(settings, rate_Hz)
        self._name, self._package = name, package
        self._inner: Detector = self._ask("making it", make, rate_Hz, refusals=ValueError)

    @property
    def low_pass(self) -> LowPass:
        """The filter of the predictive signal. Raises DetectorError where the detector fails to
        give it."""
        return self._ask("low_pass", lambda: self._inner.low_pass)

    def predictive(self, v_d: Reals) -> Reals:
        """Return v_d (n,) behind `low_pass`. Raises DetectorError where that is not one number a
        row."""
        found = np.asarray(self._ask("predictive", self._inner.predictive, v_d.copy()))
        if found.shape != v_d.shape or not np.isfinite(found).all():
            raise self._error("returned a predictive signal that is not one number for each row")
        return found.astype(np.float64)

    def reset(self) -> None:
        """Do nothing: the other detector resets itself at a gap."""

    def judge(self, volts: Reals) -> list[SlipEvent]:
        """Return the checked events of further rows (n, 2) in V."""
        first = self.rows
        found = self._ask("judging", self._inner.add, volts.copy(), first)
        return self._checked_events(found, first, first + len(volts))

    def notice(self, given: Notice) -> None:
        """Pass a notice on to the other detector."""
        self._ask("a notice of the bench", self._inner.notice, given)

    def end(self) -> list[SlipEvent]:
        """Return the checked events due at the end of a recording."""
        found = self._ask("its end", self._inner.finish)
        return self._checked_events(found, 0, self.rows)

    def _step_over_gap(self, first_sample: int) -> list[SlipEvent]:
        super()._step_over_gap(first_sample)
        return []  # the other detector reports it

    def _ask(
        self,
        what: str,
        function: Callable[..., Given],
        *arguments: Any,
        refusals: type[Exception] | tuple[()] = (),
    ) -> Given:
        return asked(self._name, self._package, what, function, *arguments, refusals=refusals)

    def _checked_events(self, found: Any, first: int, end: int) -> list[SlipEvent]:
        if not isinstance(found, list):
            raise self._error(f"returned {type(found).__name__} where a list of events is expected")
        if len(found) > MOST_EVENTS_A_ROW * max(1, end - first):
            raise self._error(f"returned {len(found)} events for {end - first} rows")
        for event in found:
            fault = event_fault(event, first, end, self.rate_Hz)
            if fault is not None:
                raise self._error(f"returned {fault}")
        # In the order of their rows, so that the first alarm of a file or score is the first.
        return sorted(map(_plain, found), key=lambda event: event.sample)

    def _error(self, reason: str) -> DetectorError:
        return DetectorError(self._name, self._package, reason)


def asked(
    name: str,
    package: str,
    what: str,
    function: Callable[..., Given],
    *arguments: Any,
    refusals: type[Exception] | tuple[()] = (),
) -> Given:
    """Return what a function of a package's detector returns; what it prints goes to stderr.

    Raises DetectorError, which says at `what` it failed, for all that it raises but `refusals`.
    """
    try:
        with quiet_stdout():
            return function(*arguments)
    except refusals:
        raise
    except (Exception, SystemExit) as error:
        if is_stop(error):
            raise
        place = ""
        with contextlib.suppress(RigError):  # registered twice
            if (entry := find(DETECTORS, name)) is not None:
                place = place_in(entry.module.split(".")[0], error)
        words = f"{place}{type(error).__name__}: {' '.join(str(error).split())}"
        reason = f"failed at {what}: {shortened(words, LONGEST_REASON)}"
        raise DetectorError(name, package, reason) from error


def event_fault(event: Any, first: int, end: int, rate_Hz: float) -> str | None:
    """Return what is wrong with an event that was decided in rows `first` to `end` (excluded) at a
    rate, as the end of "the detector returned ..."; None if nothing is."""
    if not isinstance(event, SlipEvent):
        return f"{type(event).__name__} where an event is expected"
    if event.kind not in EVENT_KINDS:
        return (
            f"an event of the kind {shortened(str(event.kind))!r}: it must be one of "
            f"{', '.join(EVENT_KINDS)}"
        )
    if not isinstance(event.sample, int | np.integer) or not (
        first <= event.sample < max(end, first + 1)
    ):
        return (
            f"an event in row {shortened(str(event.sample))}, but rows {first} to {end - 1} were "
            "judged: an event lies in the row in which it was decided"
        )
    if event.time_s != event.sample / rate_Hz:
        return f"an event whose time {event.time_s!r} s is not that of its row {event.sample}"
    if not isinstance(event.confidence, int | float) or not 0 <= event.confidence <= 1:
        return f"an event with the confidence {event.confidence!r}: it must be from 0 to 1"
    if not isinstance(event.reason, str):
        return "an event whose reason is not a text"
    if not _storable(event.reason):
        return f"an event whose reason a file cannot hold: {shortened(event.reason)!a}"
    if not isinstance(event.features, dict):
        return "an event whose features are not a dict of numbers by name"
    for name, value in event.features.items():
        number = isinstance(value, int | float | np.number) and np.isrealobj(value)
        if not isinstance(name, str) or not number or not -LARGEST <= value <= LARGEST:
            return f"an event whose feature {shortened(str(name))!r} is not a finite number"
        if not _storable(name):
            return f"an event with a feature whose name a file cannot hold: {shortened(name)!a}"
    return None


def _storable(text: str) -> bool:
    """Return whether HDF5 gives a text back as it is: UTF-8, without the character 0."""
    return "\0" not in text and text == text.encode(errors="ignore").decode()


def _plain(event: SlipEvent) -> SlipEvent:
    """Return an event with plain Python numbers, as files and JSON need them."""
    return SlipEvent(
        event.kind,
        int(event.sample),
        float(event.time_s),
        float(event.confidence),
        event.reason,
        {name: float(value) for name, value in event.features.items()},
    )
