"""When a trial slipped, by the three accounts that there are of it.

    true       the World of a simulated bench: for the ridge with the strips and its neighbours the
               slip of the first node and of the whole ridge, and gross slip
    measured   the largest F_t/F_n, from which the static friction coefficient is computed
    detected   the events of a detector: those of a processed file beside the run file, else those
               that the run recorded, else what the default detector finds in the file

They are never mixed: each has a colour and a row of its own, and a real bench has no true ones.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.analysis.trial.friction import FrictionError, friction
from rig.core.errors import RigError
from rig.detector import DEFAULT_DETECTOR
from rig.detector.events import SlipEvent, unjudged_s
from rig.figures.style import BLACK, GREEN, GREY, SMALLEST_PT, VERMILLION, literal
from rig.files.journal.detections import NO_DETECTOR, from_text
from rig.files.journal.layout import TRUTH

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes

    from rig.files.runfile.reader import RunFile, Waveform

TRUE, MEASURED, DETECTED = GREEN, BLACK, VERMILLION
"""Colours of the three accounts."""
MARKS = {"predictive": "none", "incipient slip": "full"}
"""Filling of the triangles of the events that are shown. Rejections and rolls are in the processed
file."""
EVENTS = "△ motion, ▲ slip"
"""How the events of a detector are drawn."""
UNLOADED = 0.05
"""F_t at the beginning of a stroke, relative to its largest, up to which it begins unloaded."""
SAME_SLIP_S = 1e-4
"""Difference up to which two accounts of the World have the same begin of a slip."""
ROWS_LEFT = 0.66
"""Left margin in inches of a figure with rows of accounts, with room for their names."""
BANDS = {"true": (0.88, 1.0), "measured": (0.76, 0.88), "detected": (0.0, 0.12)}
"""Parts of a panel's height in which several slips of a record are marked, by account: as lines
through the panel those of two accounts, some ms apart, would hide each other and the signal."""
OVER_MARKS = {"facecolor": "white", "edgecolor": "none", "pad": 0.4}
"""Ground of what is written in a row, which a bar would strike through."""
ROOM_FOR_A_TIME = 0.25
"""Share of the time axis that a time needs when it is written."""


@dataclass(frozen=True)
class RidgeSlip:
    """Times in s of the record at which a ridge slipped, None for never. Ridges count from 1."""

    ridge: int
    first_node_s: float | None
    whole_s: float | None


@dataclass(frozen=True)
class TrueSlips:
    """When the ridges slipped in a simulated trial, as the World states it; times in s of the
    record."""

    watched: int
    """Number of the ridge with the strips."""
    ridges: tuple[RidgeSlip, ...]
    """The watched ridge and its neighbours, in the order of their numbers."""
    gross_s: float | None
    later: tuple[tuple[float, float], ...] = ()
    """Begin and end in s of each further slip of the whole ridge with the strips."""

    @property
    def whole_s(self) -> float | None:
        """Time at which the whole ridge with the strips slipped, which incipient slip means."""
        return next(one.whole_s for one in self.ridges if one.ridge == self.watched)


@dataclass(frozen=True)
class Detections:
    """What a detector found in a trial."""

    detector: str = ""
    """Name of the detector and where its events come from; empty if none has judged the trial."""
    events: tuple[SlipEvent, ...] = ()
    why_not: str = ""
    """Why no detector has judged the trial."""

    @property
    def slips_s(self) -> tuple[float, ...]:
        """Times of the detected slips, ascending."""
        return tuple(sorted(e.time_s for e in self.events if e.kind == "incipient slip"))

    @property
    def slip_s(self) -> float | None:
        """Time of the first detected slip in s; None if none was detected."""
        return min(self.slips_s, default=None)


@dataclass(frozen=True)
class SlipInstants:
    """All accounts of one trial; times in s since the start of its record."""

    true: TrueSlips | None = None
    measured_s: float | None = None
    detected: Detections = field(default_factory=Detections)
    measurable: bool = True
    """Whether the forces of such a trial show when it slips; those of a roll do not."""
    later_measured_s: tuple[float, ...] = ()
    """Times of the further slips that the forces show, one for each stroke of x."""
    why_not_measured: str = ""
    """Why the forces do not determine a slip, where `measured_s` is None."""

    def slips_s(self) -> dict[str, tuple[float, ...]]:
        """Return the times of all slips by account, without those of neighbouring ridges."""
        true = self.true
        whole_s = None if true is None else true.whole_s
        later = () if true is None else tuple(begin_s for begin_s, _ in true.later)
        return {
            "true": later if whole_s is None else (whole_s, *later),
            "measured": ()
            if self.measured_s is None
            else (self.measured_s, *self.later_measured_s),
            "detected": self.detected.slips_s,
        }

    def anchor_s(self, otherwise_s: float) -> float:
        """Return the time around which the slip is shown enlarged: that of the best account that
        has one, or `otherwise_s`."""
        known = (None if self.true is None else self.true.whole_s, self.detected.slip_s)
        return next((at_s for at_s in known if at_s is not None), otherwise_s)


def true_slips(reading: Mapping[str, Any], record_s: float) -> TrueSlips | None:
    """Return the World's account in a trial's reading, without what happened outside of its record,
    which is `record_s` long; None on a real bench."""
    account = reading.get(TRUTH)
    if not account:
        return None
    known = json.loads(account)
    watched, begun_us = int(known["ridge"]), known["record_begun_us"]

    def seconds(us: float | None) -> float | None:
        at_s = None if us is None else 1e-6 * (us - begun_us)
        return at_s if at_s is not None and 0 <= at_s <= record_s else None

    first, whole = known["first_slip_us"], known["whole_slip_us"]
    near = range(max(1, watched - 1), min(len(whole), watched + 1) + 1)
    slips = [RidgeSlip(n, seconds(first[n - 1]), seconds(whole[n - 1])) for n in near]
    whole_s = seconds(whole[watched - 1])
    later = () if whole_s is None else later_slips(known, record_s, whole_s)
    return TrueSlips(watched, tuple(slips), seconds(known["gross_slip_us"]), later)


def later_slips(
    known: Mapping[str, Any], record_s: float, after_s: float
) -> tuple[tuple[float, float], ...]:
    """Return begin and end in s of each slip of the whole ridge with the strips that begins later
    than `after_s`; one that lasts beyond the record, which is `record_s` long, ends with it."""
    begun_us = known["record_begun_us"]
    begins = [1e-6 * (us - begun_us) for us in known.get("ridge_slip_begins_us", ())]
    ends = [1e-6 * (us - begun_us) for us in known.get("ridge_slip_ends_us", ())]
    slips = zip_longest(begins, ends, fillvalue=record_s)
    return tuple(
        (begin_s, min(end_s, record_s))
        for begin_s, end_s in slips
        if after_s + SAME_SLIP_S < begin_s < record_s
    )


def measured_slip(series: Mapping[str, Waveform], begin_s: float, end_s: float) -> float:
    """Return the time in s at which F_t/F_n is largest in a motion of x in one direction, from
    `begin_s` to `end_s`. `series` are the streams of the trial by their names. Raises FrictionError
    with the reason where the motion does not determine it."""
    force, position, ticks = (series.get(name) for name in ("force", "position", "ticks"))
    if force is None or position is None or ticks is None:
        raise FrictionError("force or position is not in the record")
    rate_Hz = force.rate_Hz or 1.0
    t = np.arange(len(force.values("F_n"))) / rate_Hz
    held = (t >= begin_s) & (t <= end_s)
    x_mm = np.interp(t[held], ticks.values("elapsed"), position.values("x"))
    dragging = force.values("F_t")[held]
    if not dragging.size:
        raise FrictionError("the record ends before the motion")
    dragging = np.sign(np.median(dragging[dragging.size // 2 :])) * dragging
    if dragging[0] < -UNLOADED * dragging.max():
        # After a turn F_t still has the sign of the stroke before: loading begins where it is zero.
        held[np.flatnonzero(held)[: np.argmax(dragging >= 0)]] = False
        dragging, x_mm = dragging[-held.sum() :], x_mm[-held.sum() :]
    found = friction(
        force.values("F_n")[held],
        dragging,
        np.abs(x_mm - x_mm[:1]),
        rate_Hz=rate_Hz,
    )
    return float(t[held][found.peak])


def detections_of(run: RunFile) -> dict[str, Detections]:
    """Return what a detector found in each trial of a run, by trial: from a processed file of the
    run, with that of the default detector first; otherwise what the run recorded; otherwise what
    the default detector finds in the file now. A trial that cannot be judged says why."""
    return _of_processed_files(run) or _of_the_run(run) or _of_default_detector(run)


def _of_processed_files(run: RunFile) -> dict[str, Detections]:
    from rig.files.processed.reader import ProcessedFile
    from rig.files.processed.values import FOLDER

    beside = run.path.parent / FOLDER
    by_default = sorted(
        beside.glob(f"{run.path.stem}.*.h5"),
        key=lambda path: (f".{DEFAULT_DETECTOR}-" not in path.name, path.name),
    )
    for path in by_default:
        try:
            with ProcessedFile.open(path) as processed:
                if processed.source.run_uuid != run.header.run_uuid:
                    continue
                name = f"{processed.detector.name} {processed.version} (processed)"
                found = {trial.id: Detections(name, trial.events) for trial in processed.trials()}
        except RigError:
            continue  # `rig verify` says what is wrong with it
        # A run that has gone on since has trials that this file does not know.
        if set(run.point_ids()) <= set(found):
            return found
    return {}


def _of_the_run(run: RunFile) -> dict[str, Detections]:
    """Return what the run itself recorded; nothing for a run without a detector, or of a version
    that had none in a trial."""
    if not {"detector", "detections"} <= set(run.columns()):
        return {}
    found = {}
    names, texts = run.column("detector"), run.column("detections")
    for point, name, text in zip(run.point_ids(), names, texts, strict=True):
        if not name or name == NO_DETECTOR:
            return {}
        events = tuple(
            SlipEvent(one.kind, one.sample, one.time_s, one.confidence)
            for one in from_text(str(text))
        )
        found[point] = Detections(f"{name} (live)", events)
    return found


def _of_default_detector(run: RunFile) -> dict[str, Detections]:
    from rig.detector.registered import chosen_detector
    from rig.processing.detection import detect_trials

    detector = chosen_detector(DEFAULT_DETECTOR)
    try:
        trials = detect_trials(run, detector)
    except RigError as error:
        return dict.fromkeys(run.point_ids(), Detections(why_not=error.message))
    name = f"{detector.name} {detector.version} (default)"
    return {trial.id: Detections(name, trial.events) for trial in trials}


def instants_of(
    run: RunFile,
    number: int,
    series: Mapping[str, Waveform],
    detected: Detections,
    *strokes: tuple[float, float],
) -> SlipInstants:
    """Return all accounts of a trial of a run, given its streams and what a detector found. Only
    `strokes`, motions of x in one direction from and to these times in s, have forces that show
    when it slips."""
    signals = series["signals"]
    record_s = (len(next(iter(signals.counts.values()))) - 1) / (signals.rate_Hz or 1.0)
    true = true_slips(run.readings()[number], record_s)
    if not strokes:
        return SlipInstants(true, None, detected, measurable=False)
    known_s, why_not = [], ""
    for stroke in strokes:
        try:
            known_s.append(measured_slip(series, *stroke))
        except FrictionError as error:
            why_not = why_not or error.message
    first_s = known_s[0] if known_s else None
    return SlipInstants(
        true, first_s, detected, later_measured_s=tuple(known_s[1:]), why_not_measured=why_not
    )


def mark(panels: tuple[Axes, ...], instants: SlipInstants, top: float = 1.0) -> None:
    """Draw a line through the panels, up to this share of their height, for the slip of the whole
    ridge, for the measured slip and for the detected one. Several slips of a record have short
    lines at the edges of the panels, each account in a band of its own."""
    slips = instants.slips_s()
    several = max(map(len, slips.values())) > 1
    for account, colour, line in (
        ("true", TRUE, (0, (4, 2))),
        ("measured", MEASURED, (0, (1, 1.5))),
        ("detected", DETECTED, "solid"),
    ):
        low, high = BANDS[account] if several else (0.0, 1.0)
        style = {"color": colour, "linestyle": "solid" if several else line}
        for axes in panels:
            for at_s in slips[account]:
                axes.axvline(at_s, low * top, high * top, linewidth=0.7, **style)


def draw_rows(axes: Axes, instants: SlipInstants, seen: tuple[float, float]) -> None:
    """Draw the accounts as rows of marks over the times `seen`, each with its time in s, and say
    above what they rest on. What lies outside is written at the edge."""
    detected, slips = instants.detected, instants.slips_s()
    rows: list[tuple[str, str]] = []
    axes.set_xlim(*seen)
    if instants.true is not None:
        for slip in instants.true.ridges:
            rows.append((f"true, ridge {slip.ridge}", TRUE))
            later = instants.true.later if slip.ridge == instants.true.watched else ()
            _ridge(axes, len(rows) - 1, slip, seen, later)
        rows.append(("true, gross", TRUE))
        _instant(axes, len(rows) - 1, instants.true.gross_s, "D", TRUE, seen)
    if instants.measurable:
        rows.append(("measured", MEASURED))
        row, count = len(rows) - 1, len(slips["measured"])
        if count > 1:
            axes.plot(slips["measured"], [row] * count, "v", color=MEASURED, markersize=3.5)
            _write_count(axes, row, count, MEASURED)
        else:
            # Not "none": a motion of which this cannot be computed may have slipped all the same.
            # A row has no room for more than the first clause of the reason.
            reason = instants.why_not_measured.partition(", ")[0]
            symbols = reason.replace("F_t/F_n", "$F_t/F_n$")
            never = ": ".join(filter(None, ("not evaluated", symbols)))
            _instant(axes, row, instants.measured_s, "v", MEASURED, seen, never)
    rows.append(("detected", DETECTED))
    last = len(rows) - 1
    for kind, filling in MARKS.items():
        times = [event.time_s for event in detected.events if event.kind == kind]
        axes.plot(
            times, [last] * len(times), "^", fillstyle=filling, color=DETECTED,
            markersize=3.5, markeredgewidth=0.7, clip_on=True,
        )  # fmt: skip
    for begin_s, end_s in unjudged_s(detected.events, seen[1]):
        axes.plot([begin_s, end_s], [last, last], color=GREY, linewidth=3, alpha=0.5)
    if len(slips["detected"]) > 1:
        _write_count(axes, last, len(slips["detected"]), DETECTED)
    elif detected.detector:
        _write_time(axes, last, detected.slip_s, DETECTED, seen)
    axes.set_title(_legend(instants), loc="left", linespacing=1.1)
    axes.set_yticks(range(len(rows)), [name for name, _ in rows])
    for label, (_, colour) in zip(axes.get_yticklabels(), rows, strict=True):
        label.set_color(colour)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)


def _legend(instants: SlipInstants) -> str:
    """Return what the accounts rest on, and how events are drawn."""
    true = "" if instants.true is None else "true: first node to whole ridge"
    measured = "measured: largest $F_t/F_n$" if instants.measurable else ""
    found = instants.detected
    grey = ", grey: cannot judge" if any(e.kind == "cannot judge" for e in found.events) else ""
    by = f"{EVENTS}{grey}, by {literal(found.detector)}" if found.detector else ""
    by = by or literal(found.why_not) or "not looked for"
    first = ", ".join(text for text in (true, measured) if text)
    return f"{first}\ndetected: {by}" if first else f"detected: {by}"


def _ridge(
    axes: Axes, row: int, slip: RidgeSlip, seen: tuple[float, float],
    later: Sequence[tuple[float, float]] = (),
) -> None:  # fmt: skip
    """Draw a bar from the slip of the first node to that of the whole ridge; of `later` slips each
    has a circle at its beginning and a broad bar while it lasts, and no time is written."""
    if slip.first_node_s is not None:
        end = seen[1] if slip.whole_s is None else slip.whole_s
        axes.plot([slip.first_node_s, end], [row, row], color=TRUE, linewidth=1.2)
        axes.plot(slip.first_node_s, row, "|", color=TRUE, markersize=5)
    for begin_s, end_s in later:
        axes.plot([begin_s, end_s], [row, row], color=TRUE, linewidth=3, alpha=0.3)
        axes.plot(begin_s, row, "o", color=TRUE, markersize=2.5)
    if later:
        _write_count(axes, row, 1 + len(later), TRUE)
        if slip.whole_s is not None:
            axes.plot(slip.whole_s, row, "o", color=TRUE, markersize=3.5)
        return
    never = "none" if slip.first_node_s is None else "never whole"
    _instant(axes, row, slip.whole_s, "o", TRUE, seen, never)


def _instant(
    axes: Axes, row: int, at_s: float | None, marker: str, colour: str, seen: tuple[float, float],
    never: str = "none",
) -> None:  # fmt: skip
    if at_s is not None:
        axes.plot(at_s, row, marker, color=colour, markersize=3.5)
    _write_time(axes, row, at_s, colour, seen, never)


def _write_count(axes: Axes, row: int, count: int, colour: str) -> None:
    """Write how many slips a row has at its left edge: their times would hide their marks."""
    axes.annotate(
        f"{count} ×", (0, row), (2, 0), xycoords=("axes fraction", "data"),
        textcoords="offset points", ha="left", va="center", color=colour, fontsize=SMALLEST_PT,
        bbox=OVER_MARKS,
    )  # fmt: skip


def _write_time(
    axes: Axes, row: int, at_s: float | None, colour: str, seen: tuple[float, float],
    never: str = "none",
) -> None:  # fmt: skip
    """Write a time beside its mark, or at the edge beyond which it lies; `never` for None."""
    first, last = seen
    text = never if at_s is None else f"{at_s:.3f} s"
    at, side = last, "right"
    if at_s is not None and at_s > last:
        text = f"{text} →"
    elif at_s is not None and at_s < first:
        at, side, text = first, "left", f"← {text}"
    elif at_s is not None:
        beside = (at_s - first) / (last - first) < 1 - ROOM_FOR_A_TIME
        at, side = at_s, "left" if beside else "right"
    axes.annotate(
        text, (at, row), (4 if side == "left" else -4, 0), textcoords="offset points",
        ha=side, va="center", color=colour, fontsize=SMALLEST_PT,
        bbox=OVER_MARKS,
    )  # fmt: skip
