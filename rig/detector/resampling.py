"""Recordings at other rates than a detector judges: a streaming, linear-phase polyphase resampler.

Output k is what ``scipy.signal.upfirdn`` gives after input row ``k * down // up``: it is computed
as soon as that row has come, and from no later one. Each output is one dot product, always summed
in the same order, so that it does not depend on how the rows were cut into blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rig.core.settings import Settings
from rig.detector.contract import Detector
from rig.detector.events import SlipEvent
from rig.detector.fir import kaiser_low_pass
from rig.detector.low_pass import LowPass
from rig.detector.notices import CutOff, HeldForce, Notice, XMove

Reals = NDArray[np.float64]

LOWEST_Hz, HIGHEST_Hz = 500.0, 50_000.0
"""Sampling rates in Hz of recordings that are resampled."""
RATE_ERROR = 2e-4
"""Largest relative error of the rate that is judged against the one that is wanted: a tenth of a
millisecond in half a second. It keeps the ratio's terms small where a rate was measured."""
LARGEST_TERM = 10_000
PASS_SHARE, STOP_SHARE = 0.7, 1.3
"""Edges of the anti-alias filter as shares of half of the lower rate. For 1000 Hz the pass band
ends at 350 Hz, which holds most of an impulse (100 to 400 Hz); what folds back lies above it."""
STOP_dB = 40.0
"""Attenuation of the stop band. Each further 10 dB would delay every decision by 1.2 ms."""

DELAY_FEATURE = "resampling delay (ms)"
"""Feature of an event: by how much what was decided on lies before the decision."""


@dataclass(frozen=True)
class Ratio:
    """Rows out for rows in: `up` for each `down`."""

    up: int
    down: int

    @property
    def factor(self) -> float:
        """Ratio of the rate out to the rate in."""
        return self.up / self.down

    def row_of(self, output: int) -> int:
        """Return the latest input row on which an output depends."""
        return output * self.down // self.up

    def outputs_before(self, row: int) -> int:
        """Return how many outputs depend on no input row from `row` on."""
        return -(-row * self.up // self.down)


def ratio_of(rate_Hz: float, wanted_Hz: float) -> Ratio:
    """Return the ratio with the smallest terms that is right to `RATE_ERROR`. Raises ValueError
    where `up` would have to be `LARGEST_TERM` or more.

    >>> ratio_of(25_600.0, 1000.0), ratio_of(44_100.0, 1000.0)
    (Ratio(up=5, down=128), Ratio(up=10, down=441))
    """
    for up in range(1, LARGEST_TERM):
        down = round(up * rate_Hz / wanted_Hz)
        if down and abs(down * wanted_Hz / (up * rate_Hz) - 1) <= RATE_ERROR:
            return Ratio(up, down)
    raise ValueError(f"rate {rate_Hz:g} Hz has no ratio to {wanted_Hz:g} Hz")


class StreamingResampler:
    """Resamples `channels` channels alike, block by block.

    The first output comes once all rows that it depends on have come: to begin with rows that were
    never recorded, such as the first one held, would be a step of the noise of a fast recording,
    which a detector takes for unrest.

    While a row at or beyond `saturation_V` is among those of an output, the output is that
    row: a filtered value would hide the saturation.
    """

    def __init__(
        self, rate_Hz: float, wanted_Hz: float, channels: int, saturation_V: float = math.inf
    ):
        self.ratio = ratio_of(rate_Hz, wanted_Hz)
        self.rate_Hz = rate_Hz * self.ratio.factor
        """Rate of the outputs."""
        self._phases, self.delay_s = _phases(self.ratio, rate_Hz)
        self._channels, self._saturation_V = channels, saturation_V
        self._latest: Reals | None = None
        self.rows = 0
        """Number of rows taken so far, with those missing in gaps."""
        self.outputs = self._first_after(0)
        """Index of the next output."""

    def start_at(self, row: int) -> None:
        """Begin again with input row `row`, behind missing rows. At least one output is missing,
        too, so that whoever takes the outputs sees the gap."""
        missing = int(self._latest is not None)
        self._latest = None
        self.rows = row
        self.outputs = max(self.outputs + missing, self._first_after(row))

    def _first_after(self, row: int) -> int:
        """Return the first output that depends on no row before this one."""
        return self.ratio.outputs_before(row + self._phases.shape[1] - 1)

    def add(self, samples: Reals) -> Reals:
        """Take further rows (n, channels) and return the outputs due, (m, channels)."""
        end = self.rows + len(samples)
        due = range(self.outputs, self.ratio.outputs_before(end))
        out = np.empty((len(due), self._channels))
        if not len(samples):
            return out
        length = self._phases.shape[1]
        if self._latest is None:
            self._latest = np.zeros((self._channels, length - 1))  # no output depends on them
        seen = np.concatenate([self._latest, samples.T], axis=1)
        starts = [self.ratio.row_of(k) - self.rows for k in due]
        taps = [self._phases[k * self.ratio.down % self.ratio.up] for k in due]
        for channel, row in enumerate(seen):
            pairs = zip(starts, taps, strict=True)
            out[:, channel] = [row[at : at + length].dot(phase) for at, phase in pairs]
            if np.abs(row).max() >= self._saturation_V:
                self._keep_saturation(row, starts, length, out[:, channel])
        self.rows, self.outputs = end, max(self.outputs, due.stop)
        self._latest = seen[:, seen.shape[1] - (length - 1) :].copy()
        return out

    def _keep_saturation(self, row: Reals, starts: list[int], length: int, out: Reals) -> None:
        for number, at in enumerate(starts):
            window = row[at : at + length]
            beyond = np.flatnonzero(np.abs(window) >= self._saturation_V)
            if beyond.size:
                out[number] = window[beyond[-1]]


def check_rate(rate_Hz: float) -> None:
    """Raise ValueError for the rate of a recording that is not resampled."""
    if not LOWEST_Hz <= rate_Hz <= HIGHEST_Hz:
        raise ValueError(
            f"rate {rate_Hz:g} Hz must be between {LOWEST_Hz:g} and {HIGHEST_Hz:g} Hz: the impulse "
            "of a slip lies between 100 and 400 Hz, and a faster recording has to be thinned out "
            "behind a low-pass filter before it is imported"
        )


class ResampledDetector(Detector):
    """A detector that judges a recording at another rate, resampled to its own.

    `sample` and `time_s` of its events are the row of the recording at which the decision could be
    made live. What it decided on lies the filter's delay before that; the feature
    `DELAY_FEATURE` states it.
    """

    slowest_Hz: ClassVar[float] = LOWEST_Hz
    fastest_Hz: ClassVar[float] = HIGHEST_Hz

    def __init__(self, kind: type[Detector], settings: Settings, rate_Hz: float):
        """Raise ValueError for a rate outside `LOWEST_Hz` to `HIGHEST_Hz`, and where `kind` cannot
        be used with these settings."""
        check_rate(rate_Hz)
        wanted_Hz = kind.design_rate_Hz
        self._inner = kind(settings, rate_Hz * ratio_of(rate_Hz, wanted_Hz).factor)
        super().__init__(settings, rate_Hz)
        self._resampler = StreamingResampler(rate_Hz, wanted_Hz, 2, self._inner.saturation_V)

    @property
    def touch_seen(self) -> bool | None:
        """True once the judged rows have shown a touch; None if the detector looks for none."""
        return self._inner.touch_seen

    @property
    def low_pass(self) -> LowPass:
        """The filter of the predictive signal, at the rate at which rows are judged."""
        return self._inner.low_pass

    def predictive(self, v_d: Reals) -> Reals:
        """Return v_d (n,) behind `low_pass`: between two judged rows, the earlier one's value; v_d
        itself before the first."""
        resampler = StreamingResampler(self.rate_Hz, self._inner.design_rate_Hz, 1)
        resampled = resampler.add(v_d[:, None])[:, 0]
        if not len(resampled):
            return v_d
        judged = self._inner.predictive(resampled)
        ends = range(resampler.outputs - len(judged), resampler.outputs)
        rows = [resampler.ratio.row_of(k) for k in ends]
        latest = np.searchsorted(rows, np.arange(len(v_d)), side="right") - 1
        return np.where(latest < 0, v_d, judged[latest])

    def reset(self) -> None:
        """Do nothing at the beginning; behind missing rows the filter begins again, and so does the
        detector, which is given the number of the next row that it judges."""
        self._resampler.start_at(self.rows)

    def judge(self, volts: Reals) -> list[SlipEvent]:
        """Return the events decided in further rows (n, 2) of v_1 and v_2 in V."""
        first = self._resampler.outputs
        rows = self._resampler.add(volts)
        return [] if not len(rows) else self._at_rows(self._inner.add(rows, first_sample=first))

    def notice(self, given: Notice) -> None:
        """Pass a notice on, at the judged rows that come next."""
        sample = max(given.sample, self.rows)
        due: Notice
        if isinstance(given, HeldForce):
            due = HeldForce(sample, given.force_N)
        elif isinstance(given, CutOff):
            due = CutOff(sample, max(given.until, sample))
        else:
            due = XMove(sample, given.speed_mm_s, max(given.until, sample))
        self._inner.notice(due.at_rows(self._resampler.ratio.outputs_before))

    def end(self) -> list[SlipEvent]:
        """Return the events due at the end of a recording."""
        return self._at_rows(self._inner.finish())

    def _step_over_gap(self, first_sample: int) -> list[SlipEvent]:
        super()._step_over_gap(first_sample)
        return []  # the judged detector reports it, at the first row that it judges

    def _at_rows(self, events: list[SlipEvent]) -> list[SlipEvent]:
        """Return events of the judged rows as events of the recording's."""
        return [self._at_row(event) for event in events]

    def _at_row(self, event: SlipEvent) -> SlipEvent:
        sample = self._resampler.ratio.row_of(event.sample)
        features = {**event.features, DELAY_FEATURE: 1e3 * self._resampler.delay_s}
        return replace(event, sample=sample, time_s=sample / self.rate_Hz, features=features)


@lru_cache(maxsize=8)
def _phases(ratio: Ratio, rate_Hz: float) -> tuple[Reals, float]:
    """Return the taps of each phase (up, length), the latest row's last, and the delay in s.

    Each phase has gain 1 at 0 Hz: else an offset would become a tone.
    """
    half_Hz = rate_Hz * min(1.0, ratio.factor) / 2
    fine_Hz = rate_Hz * ratio.up
    taps = kaiser_low_pass(PASS_SHARE * half_Hz, STOP_SHARE * half_Hz, STOP_dB, fine_Hz)
    delay_s = (taps.size // 2) / fine_Hz
    filled = np.concatenate([taps, np.zeros(-taps.size % ratio.up)])
    phases = filled.reshape(-1, ratio.up).T[:, ::-1]
    return np.ascontiguousarray(phases / phases.sum(axis=1, keepdims=True)), delay_s
