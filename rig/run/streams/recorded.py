"""Records the samples of a run's streams, each stretch with how its numbers become values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rig.files.journal.recorder import Recorder
from rig.files.journal.writer import UnrecordableError
from rig.instruments.roles import Record, Scaling

if TYPE_CHECKING:
    import numpy.typing as npt


class RecordedStreams:
    """The streams of a procedure, which it gives its samples to be recorded.

    How numbers become values is recorded before the first of them, and again where it has changed.
    The data are on the disk within 0.25 s. Rows whose shape or type is not the one that the
    procedure has declared are a ValueError.
    """

    def __init__(
        self, recorder: Recorder, indices: Mapping[str, int], elapsed_s: Callable[[], float]
    ):
        """Record streams with these `indices`, the number of each in the journal by its name.
        `elapsed_s` returns the bench time since the run's start in seconds."""
        self._recorder, self._indices, self._elapsed_s = recorder, indices, elapsed_s
        self._scalings: dict[str, Scaling] = {}
        self._states: dict[str, dict[str, Any]] = {}

    def record_raw(self, stream: str, record: Record) -> None:
        """Record raw samples of a converter, as the DAQ returned them: counts with their
        scaling."""
        index = self._indices[stream]
        scaling = record.scaling
        if self._scalings.get(stream) != scaling:
            self._put(
                self._recorder.put_stream,
                {
                    "stream": index,
                    "rate_Hz": scaling.rate_S_s,
                    "scale": scaling.volts_per_count,
                    "offset": scaling.offset_V,
                    "units": "V",
                    "delay_s": scaling.delay_s,
                    "range": scaling.range_V,
                },
            )
            self._scalings[stream] = scaling
        self._put(
            self._recorder.put_block, index, record.first_index, self._elapsed_s(), record.counts
        )

    def record_rows(
        self,
        stream: str,
        first_index: int,
        rows: npt.NDArray[Any],
        rate_Hz: float | None,
        scale: Sequence[float] | None = None,
        units: str = "",
    ) -> None:
        """Record rows of numbers that are not a converter's raw samples: forces, positions.

        `rows` is an array (n, channels) of the stream's dtype; values = `scale` times `rows`, in
        `units`. `first_index` is the number of the stream's rows before these in the same point.
        `rate_Hz` is None if the rows are not equally spaced in time.
        """
        index = self._indices[stream]
        if rows.ndim != 2:
            raise ValueError(
                f"stream {stream}: an array of the shape {rows.shape}, expected (n, channels)"
            )
        channels = rows.shape[1]
        state = {
            "stream": index,
            "rate_Hz": rate_Hz,
            "scale": [1.0] * channels if scale is None else list(scale),
            "offset": [0.0] * channels,
            "units": units,
        }
        if self._states.get(stream) != state:
            self._put(self._recorder.put_stream, state)
            self._states[stream] = state
        self._put(self._recorder.put_block, index, first_index, self._elapsed_s(), rows)

    def _put(self, put: Callable[..., None], *given: object) -> None:
        """Record what is given. Values that do not fit the stream are the fault of the procedure,
        and not of the file: as a ValueError they are reported with its package, file and line."""
        try:
            put(*given)
        except UnrecordableError as error:
            raise ValueError(error.reason) from error
