"""The rows of a trial's file against the World's own log: samples and frames against what was sent,
positions against where the carriages really were."""

from __future__ import annotations

import json
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import DAQ
from rig.core.units import counted
from rig.files.runfile.reader import RunFile, Waveform

if TYPE_CHECKING:
    from .invariants import Ran

FLIP = "flip"
LOST = "frames of the force sensor were lost"
"""What an invalid trial says of a gap in its frames."""
AROUND_us, AROUND_IN_REAL_TIME_us = 3000, 60_000
"""A look may be older or newer than its time in the file by this: the answer's way on the link. In
real time an answer may be as late as a valid trial allows."""
SEARCHED_us = (20_000, 1000)
"""Steps in which the World's time of a record is searched for in real time."""
OFF = 0.005
"""Largest distance in mm or deg from every place at which the carriage was around the time of the
look."""
AXES = {"position": {"z": "stage_z", "x": "stage_x"}, "rotation": {"angle": "rotary"}}
"""Columns of positions, by stream, and the World's name of what they show."""


@dataclass(frozen=True)
class WrongRow:
    """A row that is not what was sent, or where the carriage was."""

    reported: str
    declared: bool = False
    """True for one flipped bit in an answer whose protocol has no check of its own: samples of a
    strip, a stage's register on Modbus TCP. It is an answer like any other; USB and TCP let none
    through (docs/fault-plans.md). A sweep's record is not among them: it is taken again."""


def rows_as_recorded(ran: Ran) -> Iterator[WrongRow]:
    """Every row of samples and frames that is not one that was sent, in its order, once; and every
    position of a valid trial at which the carriage was not."""
    blocks = [x["value"] for x in ran.log if x["what"] == "block"]
    frames = [crc for x in ran.log if x["what"] == "frames" for crc in x["value"]]
    flipped = {one["device"] for one in ran.trial.faults if one["kind"] == FLIP}
    places = _Places(ran.log)
    used: set[int] = set()
    for path in ran.files("*.h5"):
        with RunFile.open(path) as run:
            readings = dict(zip(run.point_ids(), run.readings(), strict=True))
            for status in ("kept", "discarded", "unfinished"):
                for waveform in run.waveforms(status=status):
                    rows = np.stack(list(waveform.counts.values()), axis=1)
                    if waveform.stream in ("waveform", "strips"):
                        unseen = DAQ in flipped and waveform.stream == "strips"
                        yield from _blocks(waveform.path, rows, blocks, used, unseen)
                    elif waveform.stream == "bridges":
                        said = readings.get(waveform.point or "", {}).get("invalid") or ""
                        gapless = status == "kept" and LOST not in said
                        yield from _frames(waveform.path, rows, frames, gapless)
            for point, reading in readings.items():
                if not reading.get("invalid"):
                    streams = {one.stream: one for one in run.waveforms(point)}
                    for reported, role in _positions(streams, reading, places):
                        yield WrongRow(f"{point}: {reported}", role in flipped)


def _blocks(
    name: str, rows: np.ndarray, blocks: list[dict[str, Any]], used: set[int], flipped: bool
) -> Iterator[WrongRow]:
    """The rows are blocks of the DAQ, one after the other, none of them used before."""
    at, expected, with_a_flip = 0, None, []
    while at < len(rows):
        candidates = range(len(blocks)) if expected is None else (expected,)
        left = [n for n in candidates if n not in used]
        found = next((n for n in left if _is_block(rows[at:], blocks, n)), None)
        if found is None and flipped:
            found = next((n for n in left if _is_block(rows[at:], blocks, n, but_a_bit=True)), None)
            with_a_flip.append(at)
        if found is None:
            yield WrongRow(
                f"{name}: row {at} begins no block that the DAQ handed out, or one used before"
            )
            return
        used.add(found)
        at += blocks[found]["rows"]
        expected = found + 1
    if with_a_flip:
        of = f"{counted(len(with_a_flip), 'block')}, the first from row {with_a_flip[0]}"
        yield WrongRow(f"{name}: a flipped bit in {of}", declared=True)


def _is_block(
    rows: np.ndarray, blocks: list[dict[str, Any]], number: int, but_a_bit: bool = False
) -> bool:
    """Whether the rows begin with a block that was handed out, or one that differs in one bit."""
    if number >= len(blocks) or len(rows) < blocks[number]["rows"]:
        return False
    sent = blocks[number]["crc32"]
    block = np.ascontiguousarray(rows[: blocks[number]["rows"]], "<i2").tobytes()
    if not but_a_bit:
        return bool(zlib.crc32(block) == sent)
    changed = bytearray(block)
    for at in range(8 * len(changed)):
        changed[at // 8] ^= 1 << at % 8
        if zlib.crc32(changed) == sent:
            return True
        changed[at // 8] ^= 1 << at % 8
    return False


def _frames(name: str, rows: np.ndarray, frames: list[int], gapless: bool) -> Iterator[WrongRow]:
    """The rows are frames that the sensor sent, in their order: a gapless stretch of them where the
    record is kept and its trial does not say that frames were lost."""
    recorded = [zlib.crc32(row.tobytes()) for row in rows.astype(">f4")]
    if not recorded:
        return
    if not gapless:
        later = iter(frames)
        if not all(crc in later for crc in recorded):  # each is looked for after the one before
            yield WrongRow(f"{name}: {len(recorded)} frames are not all sent, or not in this order")
        return
    starts = [at for at, crc in enumerate(frames) if crc == recorded[0]]
    if not any(frames[at : at + len(recorded)] == recorded for at in starts):
        yield WrongRow(f"{name}: {len(recorded)} frames are no stretch of those that were sent")


def _positions(
    streams: Mapping[str, Waveform], reading: Mapping[str, Any], places: _Places
) -> Iterator[tuple[str, str]]:
    """Every axis of which a position is not where its carriage was at its time, which is the row's
    less the age that the row states, and the axis's role. An angle counts from upright, so that a
    constant difference is none."""
    begun_us = json.loads(str(reading.get("simulated_truth") or "{}")).get("record_begun_us")
    around_us = AROUND_us
    if begun_us is None and "position" in streams:
        begun_us, around_us = _searched_begin_us(streams, places), AROUND_IN_REAL_TIME_us
    for stream, columns in AXES.items():
        if stream not in streams or begun_us is None:
            continue
        for column, role in columns.items():
            times_us = begun_us + _looked_us(streams, column)
            shown = streams[stream].values(column)
            if stream == "rotation":
                shown = shown - places.offset(role, times_us, shown)
            off = places.off(role, times_us, shown, around_us)
            if off.max() > OFF:
                row = int(np.argmax(off))
                yield f"row {row} shows {role} {off[row]:.3g} from where it was", role


def _looked_us(streams: Mapping[str, Waveform], column: str) -> npt.NDArray[np.float64]:
    """Time of each look since the record began, (n,)."""
    return 1e6 * (streams["ticks"].values("elapsed") - streams["ages"].values(column))


def _searched_begin_us(streams: Mapping[str, Waveform], places: _Places) -> float:
    """World time at which the record began, where the run does not know it: at which most rows of x
    and z are where the carriages were."""
    found_us, reach_us = places.end_us / 2, places.end_us / 2
    for step_us in SEARCHED_us:
        candidates = np.arange(found_us - reach_us, found_us + reach_us, step_us)
        misses = [
            sum(
                np.median(
                    places.off(
                        role,
                        begin_us + _looked_us(streams, column),
                        streams["position"].values(column),
                        0,
                    )
                )
                for column, role in AXES["position"].items()
            )
            for begin_us in candidates
        ]
        found_us, reach_us = candidates[int(np.argmin(misses))], 2 * step_us
    return float(found_us)


class _Places:
    """Where the carriages of one World were, from its log; of several, the last one's."""

    def __init__(self, log: list[dict[str, Any]]):
        stretches: dict[str, list[tuple[npt.NDArray[np.float64], ...]]] = defaultdict(list)
        ended = False
        for entry in log:
            if entry["what"] == "end":
                ended = True
            elif entry["what"] == "places":
                if ended:
                    stretches.clear()
                    ended = False
                one = entry["value"]
                at = np.array(one["at"])
                times_us = one["from_us"] + one["every_us"] * np.arange(len(at))
                stretches[one["role"]].append((times_us.astype(np.float64), at))
        self._known = {
            role: tuple(np.concatenate(parts) for parts in zip(*found, strict=True))
            for role, found in stretches.items()
        }

    @property
    def end_us(self) -> float:
        """When something was seen to move for the last time."""
        return float(max(times_us[-1] for times_us, _ in self._known.values()))

    def off(
        self,
        role: str,
        times_us: npt.NDArray[np.float64],
        shown: npt.NDArray[np.float64],
        around_us: float = AROUND_us,
    ) -> npt.NDArray[np.float64]:
        """How far each position is from all places of the carriage around its time, (n,)."""
        around = times_us[:, None] + np.linspace(-around_us, around_us, 7)
        places = np.interp(around, *self._known[role])
        lowest, highest = places.min(axis=1), places.max(axis=1)
        off: npt.NDArray[np.float64] = np.maximum(lowest - shown, shown - highest).clip(min=0)
        return off

    def offset(
        self, role: str, times_us: npt.NDArray[np.float64], shown: npt.NDArray[np.float64]
    ) -> float:
        """Median difference of the positions from the carriage's."""
        return float(np.median(shown - np.interp(times_us, *self._known[role])))
