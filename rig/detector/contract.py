"""What a detector of incipient slip is: rows of v_1 and v_2 in, events out.

Every detector derives from `Detector`, those of this project and those of other packages, which
register their class in the entry-point group ``rig.detectors`` (docs/add-a-detector.md). Files, the
page, scores and trials use a detector through this class alone.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core import settings as core_settings
from rig.detector.events import UNJUDGED, EventKind, SlipEvent
from rig.detector.fir import StreamingFir
from rig.detector.low_pass import LowPass, LowPassSettings, design_low_pass
from rig.detector.notices import CutOff, HeldForce, Notice

if TYPE_CHECKING:
    from collections.abc import Mapping

Reals = NDArray[np.float64]

SLOWEST_Hz, FASTEST_Hz = 500.0, 4000.0
"""Sampling rates in Hz that a detector accepts unless it says otherwise."""
DESIGN_RATE_Hz = 1000.0
"""Rate in Hz to which other recordings are resampled unless a detector says otherwise."""


class Detector(ABC):
    """A causal, streaming detector of incipient slip. One instance judges one recording.

    A subclass has a docstring, whose first line `rig detectors` shows, its `Settings`, its
    `version`, and the methods `reset` and `judge`. Its events must depend on the rows alone, to the
    last bit, and not on how they were cut into blocks; an instance shares no state with another.
    Where it cannot judge, it reports ``cannot judge`` with a reason, and ``judges again`` when that
    is over: files, figures and scores count the time between them.
    """

    Settings: ClassVar[type[core_settings.Settings]] = core_settings.Settings
    """Class of the parameters. They are stored with every result, so that JSON must hold them."""
    version: ClassVar[str] = ""
    """Version of the detector. It is raised with every change of the events that the same
    parameters find in the same rows."""
    slowest_Hz: ClassVar[float] = SLOWEST_Hz
    """Lowest sampling rate at which it judges rows as they are."""
    fastest_Hz: ClassVar[float] = FASTEST_Hz
    """Highest sampling rate at which it judges rows as they are."""
    design_rate_Hz: ClassVar[float] = DESIGN_RATE_Hz
    """Rate to which recordings at other rates are resampled for it."""
    saturation_V: float = math.inf
    """Voltage at which a channel is saturated, so that resampling leaves such a row as it is. A
    detector whose settings state it sets it when it is made."""

    def __init__(self, settings: core_settings.Settings, rate_Hz: float):
        """Raise ValueError for a rate at which this detector does not judge rows."""
        if not self.accepts(rate_Hz):
            raise ValueError(
                f"rate {rate_Hz:g} Hz must be between {self.slowest_Hz:g} and "
                f"{self.fastest_Hz:g} Hz for this detector: resample the recording to "
                f"{self.design_rate_Hz:g} Hz"
            )
        self.settings, self.rate_Hz = settings, rate_Hz
        self._rows = 0
        self._begun = False
        self._x_mm_s: float | None = None
        """Commanded speed of x; None before the first command."""
        self._speeds: deque[tuple[int, float]] = deque()
        """Rows at which the speed of x changes, with the new speed in mm/s."""
        self._force_N: float | None = None
        """Commanded normal force; None before the first command."""
        self._forces: deque[tuple[int, float]] = deque()
        """Rows at which the normal force changes, with the new force in N."""
        self._cut_offs: deque[tuple[int, float]] = deque()
        """Rows from which on a strip is cut off (1) or none is (0)."""
        self._is_cut_off = False
        self._changes = self._speeds, self._forces, self._cut_offs

    @classmethod
    def accepts(cls, rate_Hz: float) -> bool:
        """Return whether it judges rows at this rate as they are."""
        return bool(cls.slowest_Hz <= rate_Hz <= cls.fastest_Hz)

    @classmethod
    def default_settings(cls) -> core_settings.Settings:
        """Return the parameters that are used where none are given."""
        return cls.Settings()

    @classmethod
    def seeds_seen(
        cls, settings: core_settings.Settings
    ) -> tuple[int, int] | list[tuple[int, int]] | None:
        """Return the first and the last seed of the simulated trials on which these parameters
        were chosen, which scoring refuses, or a list of several such pairs; None where there are
        none."""
        return None

    @classmethod
    def with_threshold(
        cls, settings: core_settings.Settings, factor: float
    ) -> core_settings.Settings:
        """Return the parameters with `factor` times the threshold of a slip, for the ROC of
        `rig score`; unchanged, if the detector has no such threshold."""
        return settings

    @abstractmethod
    def reset(self) -> None:
        """Forget all rows. Called before the first rows, and again after rows that are missing."""

    @abstractmethod
    def judge(self, volts: Reals) -> list[SlipEvent]:
        """Return the events (see `event`) decided in further rows (n, 2) of v_1 and v_2 in V. All
        values are finite; n may be any number, also 0. Do not keep or change the array."""

    def commanded(  # noqa: B027 - a hook
        self, before_mm_s: float, after_mm_s: float
    ) -> None:
        """Take note that the commanded speed of x changes at the next row. Optional; does nothing.

        It is called in trials of which the commands are known, before the row of each change, and
        after `reset` with the present speed as both, once x has had a command.
        """

    def commanded_force(  # noqa: B027 - a hook
        self, before_N: float | None, after_N: float
    ) -> None:
        """Take note that another normal force is to be held from the next row on. Optional; does
        nothing.

        It is called in trials of which the commands are known; `before_N` is None at the first
        force. After `reset` it is called with the present force as both, as `commanded` is.
        """

    def cut_off(self, now: bool) -> None:  # noqa: B027 - a hook
        """Take note that from the next row on a strip's voltage is cut off by the range of the DAQ
        (True), or that it is within the range again (False). Optional; does nothing.

        It is called in trials, whose rows are filtered and do not show it. After `reset` it is
        called if the strip is cut off. A detector should say that it cannot judge such rows.
        """

    def end(self) -> list[SlipEvent]:
        """Return the events due at the end of a recording. `row` of `event` must then be -1."""
        return []

    def event(
        self,
        kind: EventKind,
        row: int,
        confidence: float,
        reason: str = "",
        features: Mapping[str, float] | None = None,
    ) -> SlipEvent:
        """Return an event that was decided in row `row` of the rows that are being judged, counted
        from 0."""
        sample = self._rows + int(row)
        shown = {} if features is None else dict(features)
        return SlipEvent(kind, sample, sample / self.rate_Hz, float(confidence), reason, shown)

    @property
    def rows(self) -> int:
        """Number of rows so far, including those missing in gaps."""
        return self._rows

    @property
    def touch_seen(self) -> bool | None:
        """True once the strips' signals have shown a touch; None if the detector looks for none."""
        return None

    @property
    def low_pass(self) -> LowPass:
        """The low-pass filter of the predictive signal that is stored and drawn with the events."""
        return design_low_pass(LowPassSettings(), self.rate_Hz)

    def predictive(self, v_d: Reals) -> Reals:
        """Return v_d (n,) behind `low_pass`, for files and figures. The rows are consecutive."""
        return StreamingFir(self.low_pass.taps, 1).add(v_d[:, None])[:, 0]

    def add(self, volts: ArrayLike, first_sample: int | None = None) -> list[SlipEvent]:
        """Take further rows (n, 2) of v_1 and v_2 in V and return the events found in them.

        `first_sample` is the index of the first of these rows, if it is known. Missing rows are
        reported as time that was not judged, and the detector begins again after them.

        Raises ValueError for rows of another shape, rows that were given before, and values that
        are not finite.
        """
        rows = self.checked(volts)
        events = [] if first_sample is None else self._step_over_gap(first_sample)
        if not self._begun:
            self.reset()
            self._begun = True
            if self._x_mm_s is not None:  # rows are missing, not commands
                self.commanded(self._x_mm_s, self._x_mm_s)
            if self._force_N is not None:
                self.commanded_force(self._force_N, self._force_N)
            if self._is_cut_off:
                self.cut_off(True)
        # Cut where what the bench knows changes: a detector's events do not depend on cuts.
        first, end = self._rows, self._rows + len(rows)
        while changes := self._next_changes(end):
            sample, value = changes.popleft()
            sample = max(sample, self._rows)  # behind a gap it may be past
            events += self._judged(rows[self._rows - first : sample - first])
            self._rows = sample
            if changes is self._forces:
                self.commanded_force(self._force_N, value)
                self._force_N = value
            elif changes is self._cut_offs:
                if bool(value) != self._is_cut_off:
                    self._is_cut_off = bool(value)
                    self.cut_off(self._is_cut_off)
            else:
                self.commanded(self._x_mm_s or 0.0, value)
                self._x_mm_s = value
        events += self._judged(rows[self._rows - first :])
        self._rows = end
        return events

    def _judged(self, volts: Reals) -> list[SlipEvent]:
        """Return what `judge` does. Raises TypeError where that is None: it lacks a return."""
        found = self.judge(volts)
        if found is None:
            raise TypeError("judge returned None where a list of events is expected")
        return found

    def _next_changes(self, end: int) -> deque[tuple[int, float]] | None:
        """Return the changes of which the first is the next one before a row; None without one."""
        known = [one for one in self._changes if one and one[0][0] < end]
        return min(known, key=lambda one: one[0][0], default=None)

    def notice(self, given: Notice) -> None:
        """Take what the bench knows of the rows to come, in the order in which it came about. It
        begins at the next row at the earliest, and takes the place of what earlier notices of its
        kind say of later rows."""
        sample = max(given.sample, self._rows)
        if isinstance(given, HeldForce):
            _replace_from(sample, self._forces, (sample, given.force_N))
        elif isinstance(given, CutOff):
            end = (max(given.until, sample + 1), 0.0)
            _replace_from(sample, self._cut_offs, (sample, 1.0), end)
        elif given.speed_mm_s:
            end = (max(given.until, sample + 1), 0.0)
            _replace_from(sample, self._speeds, (sample, given.speed_mm_s), end)
        else:
            _replace_from(sample, self._speeds, (sample, 0.0))

    def finish(self) -> list[SlipEvent]:
        """Return the events due at the end of a recording."""
        return self.end() if self._begun else []

    def checked(self, volts: ArrayLike) -> Reals:
        """Return rows as an array (n, 2) of floats. Raises ValueError where they are no such
        rows, or not finite."""
        rows = np.ascontiguousarray(volts, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise ValueError(f"volts of shape {rows.shape} must be (n, 2): v_1 and v_2")
        if not np.isfinite(rows).all():
            row, channel = np.argwhere(~np.isfinite(rows))[0]
            raise ValueError(
                f"v_{channel + 1} is {rows[row, channel]} V at sample {self.rows + row}: every "
                "sample must be finite; cut the recording there, or repair it"
            )
        return rows

    def _step_over_gap(self, first_sample: int) -> list[SlipEvent]:
        expected = self._rows
        if first_sample == expected:
            return []
        if first_sample < expected:
            raise ValueError(
                f"first_sample {first_sample} must be at least {expected}: rows came twice"
            )
        self._rows = first_sample
        begun, self._begun = self._begun, False
        if not begun:
            return []
        missing = first_sample - expected
        reason = f"gap of {missing} samples: offset and noise are determined again"
        unjudged = {UNJUDGED: 1e3 * missing / self.rate_Hz}
        return [
            self.event(kind, 0, 0.0, reason, unjudged) for kind in ("cannot judge", "judges again")
        ]


def _replace_from(
    sample: int, changes: deque[tuple[int, float]], *later: tuple[int, float]
) -> None:
    """Put other changes in the place of those from row `sample` on."""
    while changes and changes[-1][0] >= sample:
        changes.pop()
    changes.extend(later)
