"""The vibrator line under a generator: a history of excitations, evaluated at any past instant.

Between two changes of the excitation the drive is one sinusoid, for which the linear line has an
exact solution. The history is therefore a short list of segments, each with its drive and the
line's state at its start; a sample taken late, in blocks or twice is the same number to rounding.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from drivers.simulated.ports import Excitation
from rig.physics.modal import Complexes, DrivenOutputs, ModalSystem, SineDrive

SEGMENTS_KEPT = 4096
"""Number of recorded changes: far more than happen within any acquisition."""


@dataclass(frozen=True)
class ExcitationSegment:
    """A stretch of constant excitation from `start_us` on."""

    start_us: int
    drive: SineDrive
    state: Complexes
    driven: dict[int, DrivenOutputs] = field(default_factory=dict, compare=False)
    """Signal of each output in this segment, computed when it is first needed."""


class DrivenLine:
    """A modal system with the history of what drove it."""

    def __init__(self, line: ModalSystem):
        self._line = line
        self._segments = [ExcitationSegment(0, SineDrive(), line.rest())]
        self._starts_s = [0.0]

    @property
    def frequency_Hz(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Frequency of the present drive; 0 if there is none."""
        drive = self._segments[-1].drive
        return drive.frequency_Hz if drive.amplitude else 0.0

    def excite(self, now_us: int, excitation: Excitation) -> None:
        """Change the drive from `now_us` on.

        Direct digital synthesis keeps its phase across a change of frequency or amplitude, and
        its accumulator runs on while the output is off.
        """
        last = self._segments[-1]
        elapsed_s = (now_us - last.start_us) * 1e-6
        state = self._line.advance(last.state, last.drive, elapsed_s)
        running = last.drive.after(elapsed_s)
        drive = SineDrive(frequency_Hz=excitation.frequency_Hz, phase_rad=running.phase_rad)
        if excitation.on and excitation.function == "SIN":
            drive = replace(drive, amplitude=excitation.amplitude_V)
        if excitation.on and excitation.function in ("SIN", "DC"):
            drive = replace(drive, offset=excitation.offset_V)
        self._segments.append(ExcitationSegment(now_us, drive, state))
        self._starts_s.append(now_us * 1e-6)
        del self._segments[:-SEGMENTS_KEPT], self._starts_s[:-SEGMENTS_KEPT]

    def output(self, column: int, times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return one output at ascending World times; shape of `times_s`.

        Times before the recorded history see its first segment's start.
        """
        result = np.empty(len(times_s))
        for segment, within in self._segments_of(times_s):
            since = np.maximum(times_s[within] - segment.start_us * 1e-6, 0.0)
            result[within] = self._driven(segment, column).at(since)[:, 0]
        return result

    def amplitude(self, column: int, times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the amplitude that one output has in the steady state of each segment, at
        ascending World times; shape of `times_s`."""
        result = np.empty(len(times_s))
        for segment, within in self._segments_of(times_s):
            result[within] = abs(self._driven(segment, column).steady[0])
        return result

    def _segments_of(
        self, times_s: npt.NDArray[np.float64]
    ) -> Iterator[tuple[ExcitationSegment, slice]]:
        """Yield each segment that some of these ascending times lie in, and which of them do."""
        if not len(times_s):
            return
        first = max(bisect_right(self._starts_s, float(times_s[0])) - 1, 0)
        last = max(bisect_right(self._starts_s, float(times_s[-1])), first + 1)
        edges = np.searchsorted(times_s, self._starts_s[first + 1 : last], side="left")
        bounds = [0, *edges.tolist(), len(times_s)]
        segments = self._segments[first:last]
        for segment, begin, end in zip(segments, bounds[:-1], bounds[1:], strict=True):
            if end > begin:
                yield segment, slice(begin, end)

    def _driven(self, segment: ExcitationSegment, column: int) -> DrivenOutputs:
        if column not in segment.driven:
            segment.driven[column] = self._line.driven(segment.state, segment.drive, [column])
        return segment.driven[column]
