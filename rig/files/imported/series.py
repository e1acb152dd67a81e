"""Make channels over time from the columns of a file: find the column, rate and unit of each
channel.

Pure: takes a source and what the user stated about it, returns arrays.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rig.core.units import counted
from rig.files.errors import ForeignFileError
from rig.files.imported.source import ImportSource

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

STRIPS, FORCES = ("v_1", "v_2"), ("F_n", "F_t")
TIME = "time"
LABEL_CHANNELS = ("motion", "slip", "lift_off")
"""Columns that are 0 until something begins: the motion, the slip of the whole ridge that holds the
strips, and its lift-off."""
UNIT = {"v_1": "V", "v_2": "V", "F_n": "N", "F_t": "N", TIME: "s"}
"""Units of the values that are made from a column."""

_OF_A_VARIABLE = re.compile(r"(?:(\w+):)?([0-9]{1,9})", re.ASCII)
"""Column of a variable of a MATLAB or npz file, or of its only one."""

STEP_TOLERANCE = 0.5
"""Largest deviation of a time step from the period, as a share of the period: times are printed
with few digits."""
LINE_TOLERANCE = 0.25
"""Largest deviation of a row from the even spacing, as a share of the period."""
RATE_TOLERANCE = 1e-3
"""Relative difference allowed between the stated rate and the file's."""
ROUND_TOLERANCE = 0.01
"""Largest shift of the last row when a measured rate is rounded, as a share of the period; more
where the times are less even than that."""
STEP_RESOLUTION = 1e-6
"""Error of the computer's own with which a shift of times is compared with their smallest step, as
a share of that."""
LOWEST_RATE_Hz, HIGHEST_RATE_Hz = 1.0, 1e7
STATED_RATE = "--rate is"
"""How a message names the rate of the option, as opposed to one of the file's."""
SLOW_Hz = 500.0
"""Rate below which no detector of this project judges a recording: what is faster than half of it
is lost, and the impulse of a slip lies between 100 and 400 Hz."""
FAST_Hz = 50e3
"""Rate above which no detector of this project judges a recording."""
LEAST_ROWS = 2
LARGEST = {"V": 1e3, "N": 1e4}
"""Beyond, a column holds no such signal, or it holds counts whose scale was not stated."""
LATEST_S = 1e11
"""Since any of the years from which clocks count."""


@dataclass(frozen=True)
class ChannelMap:
    """The user's statements about a file's columns. Keys are v_1, v_2, F_n, F_t, time and those of
    `LABEL_CHANNELS`."""

    columns: Mapping[str, str]
    """What each channel is made of, as `combination_of` takes it."""
    scale: Mapping[str, float]
    """V, N or s for one unit of the file; 1 where none is stated."""
    rate_Hz: float | None = None


@dataclass(frozen=True)
class Combination:
    """What a channel is made of: a signed sum of terms. A term is one column, or the columns that
    hold consecutive samples of a row."""

    terms: tuple[tuple[float, tuple[int, ...]], ...]
    """Sign and columns of each term."""

    @property
    def samples(self) -> int:
        """Number of samples in a row of the file."""
        return len(self.terms[0][1])

    @property
    def columns(self) -> tuple[int, ...]:
        """All columns that are needed."""
        return tuple(column for _, columns in self.terms for column in columns)

    def name(self, source: ImportSource) -> str:
        """Return it as the user finds it: ``column 2 (B) - column 3 (C)``."""
        words = ""
        for sign, columns in self.terms:
            term = source.name(columns[0])
            if len(columns) > 1:
                term += f" to {source.name(columns[-1])}"
            words += f" {'-' if sign < 0 else '+'} {term}"
        return words.removeprefix(" + ").lstrip()

    def values(self, table: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return its samples (rows x samples,) in the unit of the file, from columns by their
        index."""
        import numpy as np

        total = sum(
            sign * np.column_stack([table[c] for c in columns]) for sign, columns in self.terms
        )
        samples: NDArray[np.float64] = np.ascontiguousarray(total).reshape(-1)
        return samples


def combination_of(text: str, source: ImportSource, name: str) -> Combination:
    """Return what a channel is made of: a column, ``2..11`` for consecutive samples of a row, and
    sums or differences of these with blanks around the sign, as in ``left - right``.

    A column whose name is the whole text has priority. Raises ForeignFileError where a column is
    missing, or terms have different numbers of samples.
    """
    try:
        return Combination(((1.0, (source.column(text),)),))
    except ForeignFileError:
        if not re.search(r"\s[-+]\s|^-|\.\.", text):
            raise
    terms = []
    for sign, part in re.findall(r"(?:^|\s)([-+]?)\s*(?=\S)(.+?)(?=\s[-+]\s|$)", text):
        terms.append((-1.0 if sign == "-" else 1.0, _columns_of(part.strip(), source, name)))
    counts = {len(columns) for _, columns in terms}
    if len(counts) > 1:
        raise ForeignFileError(
            name,
            f"{text}: its terms have {' and '.join(map(str, sorted(counts)))} samples per row",
            "give the same number of columns for each",
        )
    return Combination(tuple(terms))


def _columns_of(text: str, source: ImportSource, name: str) -> tuple[int, ...]:
    first, dots, last = text.partition("..")
    if not dots:
        return (source.column(text),)
    ends = first.strip(), last.strip()
    if source.format in ("text", "LVM"):
        begin, end = map(source.column, ends)
        if end < begin:
            earlier, later = source.name(end), source.name(begin)
            raise ForeignFileError(name, f"{text}: {earlier} comes before {later}", "exchange them")
        return tuple(range(begin, end + 1))
    # Columns of a variable are numbered by when they were asked for, so their own numbers count.
    found = [match for end in ends if (match := _OF_A_VARIABLE.fullmatch(end))]
    variables = {match[1] for match in found if match[1]}
    if len(found) < len(ends) or len(variables) > 1:
        raise ForeignFileError(
            name,
            f"{text}: a range must be of the columns of one variable",
            "write it like M:1..M:3; columns of several variables cannot be samples of a row",
        )
    begin, end = (int(match[2]) for match in found)
    if end < begin:
        raise ForeignFileError(
            name, f"{text}: column {end} comes before column {begin}", "exchange them"
        )
    variable = "".join(f"{one}:" for one in variables)
    return tuple(source.column(f"{variable}{k}") for k in range(begin, end + 1))


@dataclass(frozen=True)
class Recording:
    """Channels over time at a constant rate.

    ``raw`` maps a channel to its numbers in the file, float64 of shape (rows,); ``scale`` to what
    makes V or N of them; ``columns`` to the column that they are from.
    """

    rate_Hz: float
    raw: dict[str, NDArray[np.float64]]
    scale: dict[str, float]
    columns: dict[str, str]
    warnings: tuple[str, ...]
    labels_s: Mapping[str, float | None] = field(default_factory=dict)
    """Time of each label of which the file has a column, in s of the record; None for never."""

    @property
    def rows(self) -> int:
        """Return the number of samples of each channel."""
        return len(self.raw["v_1"])

    def values(self, channel: str) -> NDArray[np.float64]:
        """Return a channel in V or N, float64 of shape (rows,)."""
        return self.raw[channel] * self.scale[channel]


def recording_of(source: ImportSource, stated: ChannelMap, name: str) -> Recording:
    """Return the channels that the user named, read and checked.

    Raises ForeignFileError if a column is missing or named twice, is labelled in another unit while
    no scale is stated, or holds something that is not a number; and if the rate is unknown, uneven
    or contradicted.
    """
    import numpy as np

    wanted = dict(stated.columns)
    if TIME not in wanted and source.time is not None:
        wanted[TIME] = source.time
    if TIME in stated.scale and TIME not in wanted:
        raise ForeignFileError(name, "a scale of times without times", "give their --time column")
    made = {channel: combination_of(text, source, name) for channel, text in wanted.items()}
    for channel, one in made.items():
        twin = next(other for other, its in made.items() if its == one)
        if twin != channel:
            raise ForeignFileError(
                name, f"{twin} and {channel} are both {one.name(source)}", "see --channels"
            )
        if channel not in LABEL_CHANNELS:
            for column in one.columns:
                _check_unit(source, channel, column, stated, name)
    samples = _samples_a_row(made, name)
    times_a_row = _times_a_row(made, samples, name)
    scale = {name: stated.scale.get(name, 1.0) for name in made if name not in LABEL_CHANNELS}
    needed = list(dict.fromkeys(column for one in made.values() for column in one.columns))
    table = source.values(needed)
    if len(table) * samples < LEAST_ROWS:
        found = counted(len(table), "row")
        raise ForeignFileError(name, f"{found}; at least {LEAST_ROWS} are needed")
    by_column = dict(zip(needed, np.ascontiguousarray(table.T), strict=True))
    raw = {channel: one.values(by_column) for channel, one in made.items()}
    times = raw.pop(TIME, None)
    times_s = None if times is None else times * scale.pop(TIME)
    remedy = "leave out --time and give --rate"
    if times_s is not None and TIME not in stated.columns:  # the file's own times
        row_Hz = source.rate_Hz or (stated.rate_Hz and stated.rate_Hz / samples)
        remedy = "give --rate"
        if row_Hz:
            remedy = f"they are not those of {row_Hz:g} Hz: correct what is wrong"
            if _are_rounded(times_s, row_Hz):
                times_s = None
    rate_Hz = _common_rate(source, stated, times_s, (samples, times_a_row), remedy, name)
    labels_s = {
        channel: _first_set(raw.pop(channel), rate_Hz * made[channel].samples / samples)
        for channel in LABEL_CHANNELS
        if channel in raw
    }
    recording = Recording(
        rate_Hz,
        raw,
        scale,
        {channel: made[channel].name(source) for channel in raw},
        (
            *(
                f"{channel} is dead: {made[channel].name(source)} is {numbers[0]:g} in every row"
                for channel, numbers in raw.items()
                if (numbers == numbers[0]).all()
            ),
            *_not_judged(rate_Hz, times is not None),
        ),
        labels_s,
    )
    for channel in raw:
        _check_size(source, recording, channel, len(table), name)
    return recording


def _not_judged(rate_Hz: float, by_times: bool) -> list[str]:
    """Return a warning about a rate at which no slip can be found, and what may be its cause."""
    if rate_Hz > FAST_Hz:
        return [
            f"{rate_Hz:.7g} Hz: slips are not found in recordings above {FAST_Hz:g} Hz; import it "
            "thinned out behind a low-pass filter"
        ]
    if rate_Hz >= SLOW_Hz:
        return []
    in_ms = by_times and 1e3 * rate_Hz >= SLOW_Hz
    maybe = "; if the times are in ms, import it again with --scale time=1ms" if in_ms else ""
    return [f"{rate_Hz:g} Hz: slips are not found in recordings below {SLOW_Hz:g} Hz{maybe}"]


def _samples_a_row(made: Mapping[str, Combination], name: str) -> int:
    """Return how many samples a row of the file holds of each signal. Raises ForeignFileError
    where that differs."""
    counts = {
        channel: one.samples
        for channel, one in made.items()
        if channel != TIME and channel not in LABEL_CHANNELS
    }
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{channel} {count}" for channel, count in counts.items())
        raise ForeignFileError(
            name,
            f"samples per row: {listed}; all channels need the same number",
            "leave out a channel that was sampled slower, or resample it",
        )
    return next(iter(counts.values()))


def _times_a_row(made: Mapping[str, Combination], samples: int, name: str) -> int:
    """Return how many times a row of the file holds, 1 without any. Raises ForeignFileError where
    they do not divide its samples of each signal evenly."""
    times = made[TIME].samples if TIME in made else 1
    if samples % times:
        raise ForeignFileError(
            name,
            f"times per row: {times}, samples of each channel per row: {samples}",
            "give one --time column, or one for each sample",
        )
    return times


def _first_set(values: NDArray[np.float64], rate_Hz: float) -> float | None:
    """Return the time in s of the first value that is not 0; None if there is none."""
    return float((values != 0).argmax()) / rate_Hz if (values != 0).any() else None


def _check_size(
    source: ImportSource, recording: Recording, channel: str, rows: int, name: str
) -> None:
    """Raise ForeignFileError for a value that no such signal has; the file has this many rows."""
    unit = UNIT[channel]
    limit = LARGEST[unit] / abs(recording.scale[channel])
    sizes = abs(recording.raw[channel])
    if sizes.max() > limit:
        row = int(sizes.argmax())
        raise ForeignFileError(
            name,
            f"{recording.columns[channel]}: {recording.raw[channel][row]:g} times "
            f"{recording.scale[channel]:g} {unit} is too large for {channel}: "
            f"at most {LARGEST[unit]:g} {unit} are allowed",
            f"say what one unit of the file is, such as --scale {channel}=1m{unit}",
            source.place(row * rows // recording.rows),
        )


def _check_unit(
    source: ImportSource, channel: str, column: int, stated: ChannelMap, name: str
) -> None:
    if source.is_mask(column):
        raise ForeignFileError(
            name,
            f"{source.name(column)} is logical, {channel} is read in {UNIT[channel]}",
            "it can be motion, slip or lift_off; save it as double if it is a signal",
        )
    labelled, unit = source.unit(column), UNIT[channel]
    if labelled not in (None, unit) and channel not in stated.scale:
        raise ForeignFileError(
            name,
            f"{source.name(column)} is labelled {labelled}, {channel} is read in {unit}",
            f"say what one unit of the file is, such as --scale {channel}=1m{unit}",
        )


def _common_rate(
    source: ImportSource,
    stated: ChannelMap,
    times_s: NDArray[np.float64] | None,
    a_row: tuple[int, int],
    remedy: str,
    name: str,
) -> float:
    """Return the stated rate of the samples or the file's own; they have to agree. The header of a
    file is about its rows, each of which holds so many samples and times (`a_row`). `remedy` is for
    rounded times."""
    samples, times = a_row
    own_Hz = None if source.rate_Hz is None else source.rate_Hz * samples
    known = [(STATED_RATE, stated.rate_Hz), ("the header says", own_Hz)]
    if times_s is not None:
        of_times_Hz = uniform_rate(times_s, source, name, remedy, times)
        known.append(("the times say", of_times_Hz * (samples // times)))
    rates = [(whose, rate) for whose, rate in known if rate is not None]
    if not rates:
        raise ForeignFileError(name, "sampling rate unknown", "give --rate, or --time COLUMN")
    first, rate_Hz = rates[0]
    for whose, other in rates[1:]:
        if abs(other / rate_Hz - 1) > RATE_TOLERANCE:
            raise ForeignFileError(
                name,
                f"{first} {rate_Hz:g} Hz and {whose} {other:g} Hz: they may differ by "
                f"{100 * RATE_TOLERANCE:g} %",
                "correct what is wrong, --rate or --scale time=...",
            )
    _check_rate(first, rate_Hz, name)
    return rate_Hz


def _check_rate(whose: str, rate_Hz: float, name: str) -> None:
    if not LOWEST_RATE_Hz <= rate_Hz <= HIGHEST_RATE_Hz:
        raise ForeignFileError(
            name,
            f"{whose} {rate_Hz:g} Hz: must be {LOWEST_RATE_Hz:g} to {HIGHEST_RATE_Hz:g} Hz",
            "correct --rate"
            if whose == STATED_RATE
            else "where times are not in s, say so with --scale time=1ms",
        )


def _are_rounded(times_s: NDArray[np.float64], rate_Hz: float) -> bool:
    """Return whether times (n,) are those of this rate, rounded or cut to a number of digits.

    They then stay within the smallest step between two of them, and reach it only where that is
    several periods; a missing row shifts those behind it by a period.
    """
    import numpy as np

    steps = np.diff(times_s)
    smallest_s = float(steps[steps > 0].min()) if (steps > 0).any() else LATEST_S
    sign = 1 if smallest_s * rate_Hz > 1 + STEP_TOLERANCE else -1
    off_s = times_s - times_s[0] - np.arange(len(times_s)) / rate_Hz
    allowed_s = smallest_s * (1 + sign * STEP_RESOLUTION)
    return bool((steps >= 0).all()) and float(np.ptp(off_s)) < allowed_s


def uniform_rate(
    times_s: NDArray[np.float64], source: ImportSource, name: str, remedy: str, a_row: int = 1
) -> float:
    """Return the rate in 1/s of evenly spaced times (n,), the roundest that agrees with them. A row
    of the file holds `a_row` of them; `remedy` is for times that are only rounded.

    Raises ForeignFileError where they are less even than STEP_TOLERANCE and LINE_TOLERANCE allow,
    and names the row.
    """
    import numpy as np

    def refuse(row: int, reason: str) -> ForeignFileError:
        hint = "cut the file there, or resample it; a gap cannot be imported"
        if row and times_s[row] == times_s[row - 1]:
            hint += f"; if its times are only rounded, {remedy}"
        return ForeignFileError(name, reason, hint, source.place(row // a_row))

    if np.abs(times_s).max() > LATEST_S:
        row = int(np.abs(times_s).argmax())
        raise refuse(row, f"{times_s[row]:g} s is not a time: at most {LATEST_S:g} s are allowed")
    steps = np.diff(times_s)
    usual = float(np.median(steps))
    if not usual > 0:
        raise refuse(int(np.argmax(steps <= 0)) + 1, "its time is not behind that of the row above")
    _check_rate("the times say", 1 / max(usual, 1 / LATEST_S**2), name)
    uneven = np.abs(steps / usual - 1) > STEP_TOLERANCE
    if uneven.any():
        row = int(np.argmax(uneven))
        raise refuse(
            row + 1,
            f"{steps[row]:.6g} s after the row above, {usual:.6g} s is usual: "
            f"{STEP_TOLERANCE:g} of that is allowed",
        )
    count = len(steps)
    rate_Hz = float(count / (times_s[-1] - times_s[0]))
    off = np.abs((times_s - times_s[0]) * rate_Hz - np.arange(count + 1))
    if off.max() > LINE_TOLERANCE:
        row = int(off.argmax())
        raise refuse(
            row,
            f"its time is {off[row]:.2g} periods off even spacing, {LINE_TOLERANCE:g} are allowed",
        )
    allowed = max(ROUND_TOLERANCE, float(off.max()))
    rounded = (float(f"{rate_Hz:.{digits}g}") for digits in range(1, 18))
    return next(r for r in rounded if count * abs(r / rate_Hz - 1) <= allowed)
