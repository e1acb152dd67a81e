"""What a page shows of a run, from its journal's records alone: no file, no clock, no process.

`RunView.take` is given the records in order. Everything that it keeps is bounded, whatever a
journal holds: the last minutes of at most `MOST_CHANNELS` channels, the latest events, the curve of
the recorded points.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.files.journal.detections import SHOWN_CODES, UNSHOWN_CODES
from rig.files.journal.format import Block, JournalRecord, PointBegin, PointDiscard, PointKeep
from rig.files.journal.values import End, JournalEvent, Results, RunHeader, Stream, StreamState
from rig.page.ring import Ring

MOST_CHANNELS = 16
MOST_EVENTS = 200
"""Latest events that are kept, and as many slips: many slips push no hold out."""
MOST_CURVE_POINTS = 4000
SPECTRUM_SAMPLES = 1024
LONGEST_ROW_S = 1.0
"""Longest time over which rows without a rate are spread: a longer gap is a pause."""
SERVO_ERROR = "servo_error"
INVALID = "invalid"
"""Key of the column that says why a reading is invalid."""
CHANGING = ("regrip", "force_shares")
"""Settings under which a trial's set point changes: an error against the one in the settings would
be wrong, so none is shown."""
STOPS = frozenset({"StopRequestedError", "TimeOverError"})
"""Names of the classes that end a run as it was asked for."""
SHOWN_FIRST = ("signals", "force", "position", "waveform", "load_rate")
"""Streams of the procedures of this program, in the order in which channels are given to them."""
LEFT_OUT = frozenset({"strips", "bridges", "ticks", "ages"})
"""Streams that say nothing to a person who watches, or whose values another one shows."""


@dataclass
class PointTimes:
    """The times that points have taken, and what is expected of those to come."""

    begun_s: float = 0.0
    expected_s: float | None = None
    """Expected time of the latest point; None in journals that do not say it."""
    ahead_s: float = 0.0
    """Expected time of the points behind it, of which there are `points_ahead`."""
    points_ahead: int = 0
    kept: bool = False
    """True if the latest point was recorded; a discarded one may be retaken."""
    taken_s: deque[float] = field(default_factory=lambda: deque(maxlen=20))
    excess_s: deque[float] = field(default_factory=lambda: deque(maxlen=20))
    """Times of the latest points beyond what was expected of them."""

    def begin(self, now_s: float, fields: Mapping[str, Any]) -> None:
        """Begin a point, with the time that its record expects."""
        self.begun_s, self.kept = now_s, False
        self.expected_s = _seconds(fields.get("expected_s"))
        self.ahead_s = _seconds(fields.get("ahead_s")) or 0.0
        self.points_ahead = _count(fields.get("points_ahead"))

    def keep(self, now_s: float) -> None:
        """Record that the point was recorded, and the time that it took."""
        taken_s = max(0.0, now_s - self.begun_s)
        self.kept = True
        self.taken_s.append(taken_s)
        self.excess_s.append(taken_s - (self.expected_s or 0.0))

    def left_s(self, points: int, now_s: float) -> float | None:
        """Return the time that is left for so many points, None where nothing is known of it yet.

        Where the records say what is expected, it is that, with the mean excess of the latest
        points for each; else each is expected to take the mean time of the latest.
        """
        if self.expected_s is None or (self.expected_s == self.ahead_s == 0.0):
            return points * sum(self.taken_s) / len(self.taken_s) if self.taken_s else None
        excess_s = sum(self.excess_s) / len(self.excess_s) if self.excess_s else 0.0
        left_s = self.ahead_s + self.points_ahead * excess_s
        if not self.kept:
            left_s += max(0.0, self.expected_s + excess_s - (now_s - self.begun_s))
        return max(0.0, left_s)


class RunView:
    """What is known of one run."""

    def __init__(self) -> None:
        self.header: RunHeader | None = None
        self.end: End | None = None
        self.last_s = 0.0
        """Latest time in the journal, in s since the run's start."""
        self.point: str | None = None
        """Id of the open point."""
        self.recording = False
        """True if samples have come since the open point began."""
        self.done = 0
        self.planned = 0
        self.holding = ""
        """Reason of the hold that is in force; empty before the bench is safe and from the moment
        at which the run arms it again."""
        self.off_failed = False
        """True if it was recorded that something could not be switched off."""
        self.discards = 0
        self.events: deque[dict[str, Any]] = deque(maxlen=MOST_EVENTS)
        self.slips: deque[dict[str, Any]] = deque(maxlen=MOST_EVENTS)
        """Slips that the run has recorded or, of a run without a detector, that the page's own
        detector has found (`rig.page.slips`), as events."""
        self.event_count = 0
        self.rings: dict[str, Ring] = {}
        self.curve: list[tuple[float, float, bool]] = []
        """Axis and signal of each recorded point, and whether its reading is invalid."""
        self.ticks = 0
        self.late_ticks = 0
        self.invalid = 0
        """Recorded points whose reading says why it is invalid."""
        self._kept: set[str] = set()
        self._times = PointTimes()
        self._states: dict[int, StreamState] = {}
        self._before: dict[int, float] = {}
        self._tail: NDArray[np.float64] = np.empty(0)
        self._tail_rate = 0.0
        self._tail_name = ""

    # --- taking records -------------------------------------------------------------------------

    def take(self, record: JournalRecord) -> None:
        """Take the next record of the journal."""
        if isinstance(record, Results):
            return
        if self.end is not None and not isinstance(record, End):
            # Another attempt records behind the end of the one before. It may press again long
            # before its first point, and a bench that was left unsafe would have refused it.
            self.end, self.off_failed = None, False
        if isinstance(record, Block):
            self.recording = self.point is not None
            self._take_block(record)
        elif isinstance(record, RunHeader):
            self._begin(record)
        elif isinstance(record, StreamState):
            self._states[record.stream] = record
            self._name_units(record)
        elif isinstance(record, JournalEvent):
            self._take_event(record)
        elif isinstance(record, PointBegin):
            self._begin_point(record)
        elif isinstance(record, PointKeep):
            self._keep(record)
        elif isinstance(record, PointDiscard):
            self.point = None
            self._times.begun_s = self.last_s
            self.discards += 1
            self.note("info", "discarded", f"{record.id}: {record.reason}")
        else:
            self.end, self.point = record, None
            self.last_s = max(self.last_s, record.duration_s)
            self.note("info", "end", f"{record.status}, exit {record.exit}")

    def _begin(self, header: RunHeader) -> None:
        self.header = header
        self.planned = len(header.points)
        left = MOST_CHANNELS
        for number in _in_order(header.streams):
            stream = header.streams[number]
            channels = stream.channels[:left]
            left -= len(channels)
            if channels:
                self.rings[stream.name] = Ring(channels, stream.units)
        held = self.set_point_N is not None and not self.set_point_changes
        if held and "force" in self.rings:
            self.rings[SERVO_ERROR] = Ring((SERVO_ERROR,), "N")

    def _name_units(self, state: StreamState) -> None:
        assert self.header is not None
        if (ring := self.rings.get(self.header.streams[state.stream].name)) is not None:
            ring.units = state.units or ring.units

    @property
    def set_point_N(self) -> float | None:  # noqa: N802 - the unit keeps its capital
        """The force that the servo holds; None where the run has none."""
        value = None if self.header is None else self.header.settings.get("normal_force_N")
        return float(value) if isinstance(value, (int, float)) else None

    @property
    def set_point_changes(self) -> bool:
        """True if the set point of the settings is not held throughout a trial."""
        settings = {} if self.header is None else self.header.settings
        return any(settings.get(name) for name in CHANGING)

    def _take_event(self, event: JournalEvent) -> None:
        self.last_s = max(self.last_s, event.time)
        if event.code == "on-hold":
            self.holding = event.message
        if event.code == "hold-over":
            self.holding = ""
        if event.code == "off-failed":
            self.off_failed = True
        if event.code in SHOWN_CODES:
            self.note_slip(event.time, SHOWN_CODES[event.code], event.message)
        elif event.code not in UNSHOWN_CODES:
            self.note(event.level, _in_words(event), event.message, event.time)

    def note(self, level: str, code: str, text: str, time_s: float | None = None) -> None:
        """Add an event, at the latest time of the journal unless another is given."""
        time_s = self.last_s if time_s is None else time_s
        self.events.append(self._event(level, code, text, time_s))

    def note_slip(self, time_s: float, what: str, text: str) -> None:
        """Add a slip, or another event of the detector that is shown."""
        self.slips.append(self._event("slip", what, text, time_s))

    def _event(self, level: str, code: str, text: str, time_s: float) -> dict[str, Any]:
        self.event_count += 1
        return {
            "n": self.event_count,
            "t": time_s,
            "level": level[:20],
            "code": code[:60],
            "text": text[:500],
        }

    def _begin_point(self, record: PointBegin) -> None:
        self.point, self.holding = record.id, ""
        self.recording = False
        time = record.fields.get("time")
        if isinstance(time, (int, float)) and math.isfinite(time):
            self.last_s = max(self.last_s, float(time))
        self.planned = max(self.planned, _count(record.fields.get("of")))
        self._times.begin(self.last_s, record.fields)

    def _keep(self, record: PointKeep) -> None:
        self.point = None
        if record.id in self._kept:
            return
        self._kept.add(record.id)
        self.done += 1
        self.invalid += bool(record.reading.get(INVALID))
        self.planned = max(self.planned, self.done)
        self._times.keep(self.last_s)
        self.ticks += _count(record.reading.get("ticks"))
        self.late_ticks += _count(record.reading.get("late_ticks"))
        self._add_to_curve(record.reading)

    def _add_to_curve(self, reading: dict[str, Any]) -> None:
        names = self.curve_columns()
        if names is None or len(self.curve) >= MOST_CURVE_POINTS:
            return
        x, y = (reading.get(column.key) for column in names)
        if isinstance(x, (int, float)) and isinstance(y, (int, float)):
            self.curve.append((float(x), float(y), bool(reading.get(INVALID))))

    def curve_columns(self) -> tuple[Any, Any] | None:
        """Return the columns of axis and signal of the plot that is shown as the curve, or None."""
        if self.header is None or not self.header.layout.plots:
            return None
        layout = self.header.layout
        shown = [plot for plot in layout.plots if plot.group == layout.default] or layout.plots
        plot = shown[0]
        return layout.column(plot.axes[0]), layout.column(plot.signal)

    def _take_block(self, block: Block) -> None:
        assert self.header is not None
        stream = self.header.streams[block.stream]
        self.last_s = max(self.last_s, block.host_time)
        before = self._before.get(block.stream, block.host_time - LONGEST_ROW_S)
        self._before[block.stream] = block.host_time
        ring = self.rings.get(stream.name)
        if ring is None:
            return
        rows = np.frombuffer(block.data, stream.dtype).reshape(-1, len(stream.channels))
        state = self._states.get(block.stream)
        values = rows.astype(np.float64)
        if state is not None:
            values = values * np.array(state.scale) + np.array(state.offset)
        values = values[:, : len(ring.channels)]
        times = _times(len(values), block.host_time, before, state)
        ring.add(times, values)
        if stream.name == "force" and SERVO_ERROR in self.rings and self.set_point_N is not None:
            self.rings[SERVO_ERROR].add(times, values[:, :1] - self.set_point_N)
        if state is not None and state.rate_Hz and stream.name in ("signals", "waveform"):
            self._keep_tail(stream, values, state.rate_Hz)

    def _keep_tail(self, stream: Stream, values: NDArray[np.float64], rate_Hz: float) -> None:
        """Keep the newest samples of v_d, or of a sweep's last channel, for the spectrum."""
        channel = 0 if stream.name == "signals" else values.shape[1] - 1
        tail = values[-SPECTRUM_SAMPLES:, channel]
        if rate_Hz == self._tail_rate:
            tail = np.concatenate((self._tail, tail))[-SPECTRUM_SAMPLES:]
        self._tail, self._tail_rate, self._tail_name = tail, rate_Hz, stream.channels[channel]

    # --- showing --------------------------------------------------------------------------------

    @property
    def force_N(self) -> float | None:  # noqa: N802 - the unit keeps its capital
        """The latest normal force, None if none was recorded."""
        force = self.rings.get("force")
        return force.latest[0] if force is not None and force.latest else None

    def left_s(self) -> float | None:
        """Return the expected time of the points that are left, None where it is not known yet."""
        if self.end is not None:
            return 0.0
        return self._times.left_s(max(0, self.planned - self.done), self.last_s)

    def _valid(self) -> int | None:
        """Return how many of the recorded points are valid, None for a procedure that does not
        judge them."""
        judged = self.header and any(one.key == INVALID for one in self.header.layout.columns)
        return self.done - self.invalid if judged else None

    def spectrum(self) -> dict[str, Any] | None:
        """Return the amplitude spectrum of the newest samples: ``x`` in Hz, ``y`` in the unit of
        the signal (peak), Hann window. None before there are enough."""
        if len(self._tail) < 64 or not np.isfinite(self._tail).all():
            return None
        window = np.hanning(len(self._tail))
        centred = (self._tail - self._tail.mean()) * window
        amplitude = np.abs(np.fft.rfft(centred)) * 2 / window.sum()
        frequency = np.fft.rfftfreq(len(self._tail), 1 / self._tail_rate)
        return {
            "channel": self._tail_name,
            "x": [float(f"{x:.5g}") for x in frequency[1:]],
            "y": [float(f"{y:.4g}") for y in amplitude[1:]],
        }

    def summary(self) -> dict[str, Any]:
        """Return what a page shows besides the traces, ready for JSON."""
        header = self.header
        if header is None:
            return {}
        columns = self.curve_columns()
        return {
            "procedure": header.procedure,
            "title": header.title[:200],
            "mark": header.mark,
            "sample": header.sample.name[:200],
            "user": header.user.name[:200],
            "bench_file": header.bench_file[:200],
            "start": header.start_time,
            "uuid": header.run_uuid,
            "point": self.point,
            "n": min(self.done + (self.point is not None), self.planned),
            "done": self.done,
            "planned": self.planned,
            "discarded": self.discards,
            "valid": self._valid(),
            "left_s": self.left_s(),
            "last_s": self.last_s,
            "set_point_N": self.set_point_N,
            "set_point_changes": self.set_point_changes,
            "ticks": self.ticks,
            "late_ticks": self.late_ticks,
            "end": None if self.end is None else self.end.model_dump(mode="json"),
            "streams": {
                name: {
                    "channels": ring.channels,
                    "units": ring.units,
                    "latest": [_finite(v) for v in ring.latest],
                    "age_s": _finite(self.last_s - ring.latest_s),
                }
                for name, ring in self.rings.items()
            },
            "curve": None
            if columns is None
            else {
                "x": columns[0].long_name,
                "y": columns[1].long_name,
                "log": _is_log(header, columns[0].name),
                "points": len(self.curve),
            },
        }


def _in_words(event: JournalEvent) -> str:
    """Return what an event is called. The failure that has ended a run has the name of its class in
    the journal, which says nothing to a person who watches."""
    if event.code in STOPS:
        return "stop"
    return "failure" if event.code.endswith("Error") else event.code


def _in_order(streams: tuple[Stream, ...]) -> list[int]:
    """Return the numbers of the streams to show, the best known first."""

    def place(number: int) -> tuple[int, int]:
        name = streams[number].name
        return (SHOWN_FIRST.index(name) if name in SHOWN_FIRST else len(SHOWN_FIRST), number)

    shown = [number for number, stream in enumerate(streams) if stream.name not in LEFT_OUT]
    return sorted(shown, key=place)


def _times(
    rows: int, host_s: float, before_s: float, state: StreamState | None
) -> NDArray[np.float64]:
    """Return the times of a block's rows, the last of which came when the block was recorded."""
    if state is not None and state.rate_Hz:
        step_s = 1 / state.rate_Hz
    else:
        step_s = min(max(host_s - before_s, 0.0), LONGEST_ROW_S) / rows
    times: NDArray[np.float64] = host_s - step_s * np.arange(rows - 1, -1, -1, dtype=np.float64)
    return times


def _seconds(value: Any) -> float | None:
    known = isinstance(value, (int, float)) and math.isfinite(value) and value >= 0
    return float(value) if known else None


def _count(value: Any) -> int:
    return int(value) if isinstance(value, (int, float)) and math.isfinite(value) else 0


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _is_log(header: RunHeader, axis: str) -> bool:
    return any(axis in plot.log_axes for plot in header.layout.plots)
