"""Several runs of one kind in one figure, distinguished by what differs between them.

Sweeps are drawn over the frequency, slip and path trials over the time since the slip, or since the
motion begins where not all of them slipped by the same account, and rolls over the angle. What
draws the runs of a procedure is an entry point of the group ``rig.overlays``, named as figures are
(`rig.core.file_entry_points`): a function of the open run files.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from rig.core.errors import ConfigurationError, OutputError, is_stop
from rig.core.file_entry_points import OVERLAYS, entries_of, strays
from rig.core.quiet_stdout import quiet_stdout
from rig.core.settings import name_without_unit, unit_of
from rig.core.time_limit import time_limit
from rig.figures.circumstances import film_of, in_one_line, statements
from rig.figures.drawing import TIMEOUT_S, Drawn, figures_by
from rig.figures.pressed import scale_to, seconds
from rig.figures.slip_instants import SlipInstants, detections_of, instants_of
from rig.figures.style import (
    GREY,
    PALETTE,
    STYLE,
    column_figure,
    decades,
    legend_above,
    letter,
    literal,
    save,
    set_heading,
    set_margins,
)
from rig.files.processed.reader import is_processed
from rig.files.runfile.reader import RunFile

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rig.figures.slip_instants import Detections

Reals = NDArray[np.float64]

BEFORE_MOTION_S, AFTER_S = 0.05, 0.25
"""Time shown before the motion begins and after the instant at which trials are aligned."""
MOST_NAMED = 2
"""Settings that a legend names; more of them are replaced by the file's name."""
LONGEST_NAME = 40
"""Number of characters for which a legend of one column has room."""
SEEN = frozenset({"trials", "load_N", "loads_N", "frequencies_Hz"})
"""Settings that no legend names: the number of trials does not distinguish trials, each load has
its own curve, and frequencies are on the axis."""
FILES_NAMED = 4
"""Files that the heading names."""
DASHES = ("-", "--", "-.", ":")
"""Dashes of the curves of one run, or of runs beyond the colours."""
SAME_FREQUENCY = 1e-6
"""Relative difference of frequencies that are the same."""


def draw_overlay(files: Sequence[Path], folder: Path | None = None, pdf: bool = False) -> Drawn:
    """Draw several run files of one kind in one figure, beside the first file or in `folder`,
    under a name that is not taken. An overlay of another package that fails is a warning.

    Raises ConfigurationError for fewer than two files, for one that is named twice, for files of
    several kinds or of one that has no such figure, for files without a completed point, and if
    every overlay fails; RunFileError for one that cannot be read; OutputError where the figure
    cannot be written.
    """
    if len(files) < 2:
        raise ConfigurationError("--overlay draws several runs in one figure", "name two or more")
    places = [path.resolve() for path in files]
    for n, path in enumerate(files):
        if places[n] in places[:n]:
            raise ConfigurationError(
                f"{path} is named twice, and --overlay shows how runs differ", "name each run once"
            )
    with ExitStack() as stack:
        runs = [_opened(path, stack) for path in files]
        figures, warnings, tracebacks = _figures_of(runs)
        if not figures:
            raise ConfigurationError(f"no overlay was drawn: {'; '.join(warnings)}")
        simulated = any(run.outcome.simulated for run in runs)
        place = _free_place(files[0] if folder is None else folder / files[0].name, list(figures))
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            saved = [
                picture
                for suffix, figure in figures.items()
                for picture in save(figure, _ending(place, suffix), simulated, pdf)
            ]
            return Drawn(tuple(saved), tuple(warnings), tuple(tracebacks))
        except OSError as error:
            raise OutputError(
                f"{place.parent} cannot be written to ({error.strerror or error})",
                "name another folder with --figures-to",
            ) from error


def _opened(path: Path, stack: ExitStack) -> RunFile:
    if is_processed(path):
        raise ConfigurationError(
            f"{path}: a processed file, and --overlay draws run files", "name its run file"
        )
    run = stack.enter_context(RunFile.open(path))
    if not run.point_ids():
        raise ConfigurationError(
            f"{path}: no point was completed ({run.outcome.extent()})", "leave this file out"
        )
    return run


def _kind_of(runs: Sequence[RunFile]) -> str:
    """Return the procedure of all runs. Raises ConfigurationError where there are several."""
    kinds = {run.header.procedure: run.path.name for run in runs}
    if len(kinds) > 1:
        each = ", ".join(f"{name} is a {kind}" for kind, name in kinds.items())
        raise ConfigurationError(
            f"--overlay draws runs of one kind: {each}", "name files of one procedure"
        )
    (kind,) = kinds
    return kind


def _figures_of(runs: Sequence[RunFile]) -> tuple[dict[str, Figure], list[str], list[str]]:
    """Return the overlays of the runs, by the suffix of each file name, a sentence for each one
    that could not be drawn, and the tracebacks."""
    kind = _kind_of(runs)
    if not (registered := entries_of(OVERLAYS, kind)):
        raise ConfigurationError(
            f"--overlay does not know how to draw a {kind}",
            "a package can add what draws it: docs/add-a-figure.md",
        )
    figures: dict[str, Figure] = {}
    warnings, tracebacks = list(strays(OVERLAYS, (kind,))), list[str]()
    for one in registered:
        try:
            with time_limit(TIMEOUT_S), quiet_stdout():
                drawn = figures_by(one, runs)
                for figure in drawn.values():  # a text that is not a formula fails only here
                    figure.draw_without_rendering()
            for suffix, figure in drawn.items():
                if suffix in figures:
                    warnings.append(f"{one} was left out: another figure has its file name")
                else:
                    figures[suffix] = figure
        # A package may raise anything, and call sys.exit() where it was meant as a program.
        except (Exception, SystemExit) as error:
            if is_stop(error):
                raise
            warnings.append(f"{one} could not be drawn: {one.fault(error)}")
            tracebacks.append("".join(traceback.format_exception(error)))
    return figures, warnings, tracebacks


def _free_place(file: Path, suffixes: Sequence[str]) -> Path:
    """Return the file's name with the first ending with which no picture has its name yet."""
    number = 1
    while True:
        place = _ending(file, "-overlay" if number == 1 else f"-overlay-{number}")
        pictures = [
            _ending(place, suffix).with_suffix(kind)
            for suffix in suffixes
            for kind in (".png", ".svg", ".pdf")
        ]
        if not any(picture.exists() for picture in pictures):
            return place
        number += 1


def _ending(place: Path, suffix: str) -> Path:
    return place.with_stem(place.stem + suffix)


def names_of(runs: Sequence[RunFile]) -> list[str]:
    """Return what distinguishes each run from the others: sample, film or settings that differ
    between them, with units; its file where that is nothing, too much, or the same for two of
    them. They are labels: dollar signs in them are escaped."""
    return [literal(name) for name in _distinguishing(runs)]


def _distinguishing(runs: Sequence[RunFile]) -> list[str]:
    stated = [_stated(run) for run in runs]
    # Only what all of them state: a file of another version may lack a setting.
    known = [key for key in stated[0] if all(key in each for each in stated)]
    differing = [key for key in known if len({repr(each[key]) for each in stated}) > 1]
    named = [", ".join(_in_words(key, each[key]) for key in differing) for each in stated]
    too_much = len(differing) > MOST_NAMED or max(map(len, named)) > LONGEST_NAME
    if too_much or not differing or len(set(named)) < len(named):
        files = _file_names([run.path for run in runs])
        joined = [", ".join(filter(None, both)) for both in zip(named, files, strict=True)]
        return files if too_much or max(map(len, joined)) > LONGEST_NAME else joined
    return named


def _file_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of files without their endings; where files of several folders have one
    name, behind that of the folder."""
    folders: dict[str, set[str]] = {}
    for path in paths:
        folders.setdefault(path.stem, set()).add(path.absolute().parent.name)
    return [
        f"{path.absolute().parent.name}/{path.stem}" if len(folders[path.stem]) > 1 else path.stem
        for path in paths
    ]


def _stated(run: RunFile) -> dict[str, Any]:
    """Return what a run states that a legend could name: sample, film and settings."""
    settings = {key: value for key, value in run.settings.items() if key not in SEEN}
    return {"sample": run.header.sample.name, "film": film_of(run), **settings}


def _in_words(key: str, value: Any) -> str:
    if key in ("sample", "film"):
        return str(value) if key in str(value) else f"{key} {value or 'not named'}"
    name = name_without_unit(key).replace("_", " ")
    if isinstance(value, bool):
        return f"{'with' if value else 'without'} {name}"
    several = value if isinstance(value, list | tuple) else [value]
    numbers = [f"{one:g}" if isinstance(one, int | float) else str(one) for one in several]
    if value is None or not numbers:
        return f"{name} none"
    return f"{name} {', '.join(numbers)} {unit_of(key) or ''}".rstrip()


def _headed(
    figure: Figure, runs: Sequence[RunFile], what: str, panels: Sequence[Axes], legend: float
) -> None:
    """Write the heading with what all runs state, place the panels, and name them."""
    common = [each for each in statements(runs[0]) if all(each in statements(r) for r in runs)]
    files = [run.path.name for run in runs[:FILES_NAMED]]
    more = [f"{len(runs) - FILES_NAMED} more"] if len(runs) > FILES_NAMED else []
    letter(panels)
    title = runs[0].header.marked(f"{len(runs)} {what}")
    top = set_heading(figure, title, in_one_line(common), ", ".join([*files, *more]))
    set_margins(figure, top=top + legend, gap_mm=4.0)
    figure.align_ylabels(panels)


def trials_in_words(runs: Sequence[RunFile]) -> str:
    """Return how many trials runs have, and how many of them are invalid: they are drawn too."""
    trials = sum(len(run.point_ids()) for run in runs)
    invalid = sum(
        bool(str(doubt))
        for run in runs
        if "invalid" in run.columns()
        for doubt in run.column("invalid")
    )
    return f"{trials} trials" + (f", {invalid} of them invalid" if invalid else "")


def draw_sweeps(runs: Sequence[RunFile]) -> Figure:
    """Draw the gains of sweeps, a curve for each load, and by how much they differ from the first
    curve at the frequencies that they share."""
    curves = [
        (", ".join(part for part in (name, load) if part), frequency, gain)
        for name, run in zip(names_of(runs), runs, strict=True)
        for load, frequency, gain in _curves(run)
    ]
    with mpl.rc_context(STYLE):
        figure = column_figure(84 + 5 * len(curves))
        gains, differences = figure.subplots(
            2, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1.0]}
        )
        _, first, reference = curves[0]
        for number, (label, frequency, gain) in enumerate(curves):
            look = _look(number)
            gains.plot(frequency, gain, marker=".", markersize=2, label=label, **look)
            same, here, there = _shared(frequency, first)
            differences.plot(same, gain[here] - reference[there], linewidth=0.7, **look)
        gains.set_ylabel("Gain (dB re 1 V/N)")
        differences.set_ylabel("Δ to first (dB)")
        every = np.concatenate([frequency for _, frequency, _ in curves])
        decades(differences, float(every.min()), float(every.max()))
        legend = legend_above(gains, columns=1)
        _headed(figure, runs, "sweeps: gain over frequency", (gains, differences), legend)
    return figure


def _curves(run: RunFile) -> list[tuple[str, Reals, Reals]]:
    """Return load, frequencies in Hz and gains in dB of each curve, in the order of frequency."""
    frequency, gain, load = (run.column(name) for name in ("frequency", "gain", "load_set"))
    found = []
    for level in np.unique(load):
        at = np.flatnonzero(load == level)
        at = at[np.argsort(frequency[at])]
        found.append((f"{level:g} N peak", frequency[at], gain[at]))
    return found


def _shared(frequency: Reals, first: Reals) -> tuple[Reals, NDArray[np.int64], NDArray[np.int64]]:
    """Return the frequencies that are in both, and where they are in each."""
    there = np.clip(np.searchsorted(first, frequency * (1 - SAME_FREQUENCY)), 0, first.size - 1)
    here = np.flatnonzero(np.abs(first[there] / frequency - 1) < SAME_FREQUENCY)
    return frequency[here], here, there[here]


def draw_slips(runs: Sequence[RunFile]) -> Figure:
    """Draw v_d and the forces of the trials of several runs, aligned at the slip by an account that
    all of them have, else at the beginning of the motion."""
    trials = [_aligned(run) for run in runs]
    account, aligned_at = _account([one for of_run in trials for _, _, one in of_run])
    with mpl.rc_context(STYLE):
        figure = column_figure(108 + 5 * len(runs))
        panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": [1.6, 1.2, 1.0]})
        difference, tangential, normal = panels
        begins_s, shown, pressing = [], [], []
        for number, (name, of_run) in enumerate(zip(names_of(runs), trials, strict=True)):
            for trial, (series, begin_s, instants) in enumerate(of_run):
                at_s = account(instants)
                zero_s = begin_s if at_s is None else at_s
                look = {**_look(number), "linewidth": 0.7, "label": None if trial else name}
                signals, force = series["signals"], series["force"]
                t, v_d = seconds(signals) - zero_s, 1e3 * signals.values("v_d")
                difference.plot(t, v_d, **look)
                begins_s.append(begin_s - zero_s - BEFORE_MOTION_S)
                shown.append(v_d[(t >= begins_s[-1]) & (t <= AFTER_S)])
                t = seconds(force) - zero_s
                window = (t >= begins_s[-1]) & (t <= AFTER_S)
                for axes, channel in ((tangential, "F_t"), (normal, "F_n")):
                    axes.plot(t, force.values(channel), **look)
                pressing.append(force.values("F_n")[window])
        for axes in panels:
            axes.axvline(0, color=GREY, linewidth=0.6, linestyle=":")
        scale_to(difference, shown)
        scale_to(normal, [*pressing, np.zeros(1)])
        difference.set_ylabel("$v_d$ (mV)")
        tangential.set_ylabel("$F_t$ (N)")
        normal.set_ylabel("$F_n$ (N)")
        normal.set_xlim(min(begins_s), AFTER_S)
        normal.set_xlabel(f"Time since {aligned_at} (s)")
        kind = runs[0].header.procedure.removesuffix("-trial")
        legend = legend_above(difference, columns=1)
        _headed(figure, runs, f"{kind} runs, {trials_in_words(runs)}", panels, legend)
    return figure


Trial = tuple[dict[str, Any], float, SlipInstants]
"""Streams of a trial by name, begin of its motion in s, and when it slipped."""


def _aligned(run: RunFile) -> list[Trial]:
    """Return the trials of a run."""
    found: dict[str, Detections] = detections_of(run)
    slides = {"slide_from", "slide_to"} <= set(run.columns())
    begins, ends = (
        run.column(f"{'slide' if slides else 'motion'}_{edge}") for edge in ("from", "to")
    )
    trials = []
    for number, point in enumerate(run.point_ids()):
        series = {wave.stream: wave for wave in run.waveforms(point)}
        motion = float(begins[number]), float(ends[number])
        instants = instants_of(run, number, series, found[point], *([motion] if slides else []))
        trials.append((series, motion[0], instants))
    return trials


def _account(
    every: Sequence[SlipInstants],
) -> tuple[Callable[[SlipInstants], float | None], str]:
    """Return the first account of the slip that all trials have, and what it says."""
    accounts: tuple[tuple[Callable[[SlipInstants], float | None], str], ...] = (
        (
            lambda one: None if one.true is None else one.true.whole_s,
            "the whole ridge slipped (true)",
        ),
        (lambda one: one.detected.slip_s, "the slip was detected"),
        (lambda one: one.measured_s, "$F_t/F_n$ was largest"),
    )
    for account, words in accounts:
        if all(account(one) is not None for one in every):
            return account, words
    return (lambda _: None), "the motion began"


def draw_rolls(runs: Sequence[RunFile]) -> Figure:
    """Draw v_d and the tangential force of rolls over the angle: there as a line, back dashed."""
    with mpl.rc_context(STYLE):
        figure = column_figure(92 + 5 * len(runs))
        panels = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.6, 1.0]})
        difference, tangential = panels
        for number, (name, run) in enumerate(zip(names_of(runs), runs, strict=True)):
            for trial, point in enumerate(run.point_ids()):
                label = None if trial else name
                _roll(run, trial, point, panels, PALETTE[number % len(PALETTE)], label)
        difference.set_ylabel("$v_d$ (mV)")
        tangential.set_ylabel("$F_t$ (N)")
        tangential.set_xlabel("Angle from upright (deg); line: there, dashed: back")
        legend = legend_above(difference, columns=1)
        _headed(figure, runs, f"roll runs, {trials_in_words(runs)}", panels, legend)
    return figure


def _roll(
    run: RunFile, trial: int, point: str, panels: Sequence[Axes], colour: str, label: str | None
) -> None:
    """Draw one roll over its angle."""
    series = {wave.stream: wave for wave in run.waveforms(point)}
    begin_s, end_s = (float(run.column(name)[trial]) for name in ("roll_from", "roll_to"))
    ticks_s, angle = series["ticks"].values("elapsed"), series["rotation"].values("angle")
    turned = ticks_s[(ticks_s >= begin_s) & (ticks_s <= end_s)]
    middle_s = turned[np.abs(np.interp(turned, ticks_s, angle)).argmax()]
    for axes, stream, channel, factor in (
        (panels[0], "signals", "v_d", 1e3),
        (panels[1], "force", "F_t", 1.0),
    ):
        t = seconds(series[stream])
        values = factor * series[stream].values(channel)
        for first_s, last_s, dashes in ((begin_s, middle_s, "-"), (middle_s, end_s, "--")):
            on = (t >= first_s) & (t <= last_s)
            axes.plot(
                np.interp(t[on], ticks_s, angle), values[on], dashes, color=colour, linewidth=0.7,
                label=label if dashes == "-" else None,
            )  # fmt: skip


def _look(number: int) -> dict[str, Any]:
    """Return colour and dashes of the curve with that number."""
    return {
        "color": PALETTE[number % len(PALETTE)],
        "linestyle": DASHES[number // len(PALETTE) % len(DASHES)],
    }
