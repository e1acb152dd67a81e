"""The command ``rig show``, which summarises a file of this program and draws its figures again."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rig.cli.options.shared import AnyFiles, Debug
from rig.cli.outcome import of_the_computer, print_json, report, reported, say, say_all
from rig.cli.show.words import contents_in_words, value_lines, with_results_in_words
from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.text import printable

if TYPE_CHECKING:
    from rig.figures.drawing import Drawn
    from rig.files.journal.values import Results, RunHeader
    from rig.files.model_file import ModelFile
    from rig.files.processed.reader import ProcessedFile
    from rig.files.runfile.reader import RecordedOutcome, RunFile
    from rig.processing.analyses import Analyses
    from rig.run.points import Reading

_How = Literal["brief", "all", "json"]
"""What `rig show` prints: what fits a screen, everything, or one object."""


def show(
    files: AnyFiles,
    all_settings: Annotated[
        bool,
        typer.Option(
            "--all", help="Show everything: sentences, tables, all settings, all warnings."
        ),
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures of the files again.")] = False,
    figures_to: Annotated[
        Path | None,
        typer.Option(
            help="Draw the figures again, into this folder.  [default: that of the run file]",
            metavar="FOLDER",
        ),
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Draw the figures again, as PDF as well.")
    ] = False,
    overlay: Annotated[
        bool, typer.Option("--overlay", help="Draw several runs of one kind in one figure.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object per file on stdout, with all settings.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Summarise a run file, processed file, journal or file of rig skin on one screen."""
    with reported(debug, as_json):
        if overlay:
            from rig.figures.overlay import draw_overlay

            beside = draw_overlay(files, figures_to, pdf)
            _report_drawn(beside, say if as_json else _print, debug)
            if as_json:
                print_json({"files": _texts(files), "figures": _texts(beside.files)})
            return
        draws = figures or pdf or figures_to is not None
        how: _How = "json" if as_json else "all" if all_settings else "brief"
        not_drawn: list[str] = []
        only_warnings = False
        failures: list[RigError] = []
        for path in files:
            try:
                drawable, why_nothing = _show_file(path, how, debug)
                if not draws:
                    continue
                shown = say if as_json else _print
                if not why_nothing:
                    say(f"{path}: the figures of rig skin are drawn only when it computes the file")
                    continue
                drawn = _draw(path, figures_to, pdf, shown, debug) if drawable else None
                if drawn is None or not (drawn.files or drawn.warnings):
                    not_drawn.append(f"{path}: {why_nothing}")
                elif not drawn.files:
                    only_warnings = True
            except (RigError, OSError) as error:
                if len(files) == 1:
                    raise
                failures.append(error if isinstance(error, RigError) else of_the_computer(error))
                report(failures[-1], debug, as_json, path)
        if draws and len(files) == 2 and not failures:
            _draw_beside(files, figures_to, pdf, say if as_json else _print)
        for line in not_drawn:
            say(f"no figure was drawn: {line}")
        if failures:
            raise typer.Exit(int(failures[0].code))
        if not_drawn or only_warnings:
            raise typer.Exit(int(ExitCode.FINISHED_WITH_FAILURES))


def _show_file(path: Path, how: _How, debug: bool) -> tuple[bool, str]:
    """Show a file. Return whether its kind can be drawn, and why there may be no figure all the
    same; the latter is empty for a file of rig skin, which has figures beside it. Raises
    RigError if the file cannot be read."""
    from rig.files.checksum import checksum_findings
    from rig.files.describe import describe_contents, ending_of
    from rig.files.file_kind import kind_of, require_hdf5
    from rig.files.journal.reader import read_journal
    from rig.files.model_file import ModelFile, is_model
    from rig.files.processed.reader import ProcessedFile, is_processed
    from rig.files.runfile.reader import RunFile
    from rig.processing.analyses import Analyses
    from rig.processing.analyses import analyse as analyse_run

    if kind_of(path) == "journal":
        contents = read_journal(path)
        readings = [kept.reading for kept in contents.kept()]
        outcome, nothing = ending_of(contents), Analyses()
        holds = describe_contents(contents.header, contents.sampling())
        _show_run(
            path, contents.header, outcome, readings, contents.results, nothing, holds, how, debug
        )
        return False, "a journal has no figures, its run file has"
    require_hdf5(path)
    doubts = [f"warning: {path.name}: {found}" for found in checksum_findings(path)]
    if is_model(path):
        with ModelFile.open(path) as model:
            _say_all(doubts)
            _show_model(model, how)
        return False, ""
    if is_processed(path):
        with ProcessedFile.open(path) as processed:
            _say_all(doubts)
            _show_processed(processed, how)
        return True, "it has nothing to draw"
    with RunFile.open(path) as run:
        _say_all(doubts)
        found = analyse_run(run)
        readings = run.readings()
        holds = describe_contents(run.header, run.sampling())
        why_nothing = _why_nothing_is_drawn(run)
        _show_run(path, run.header, run.outcome, readings, run.results, found, holds, how, debug)
    return True, why_nothing


def _why_nothing_is_drawn(run: RunFile) -> str:
    """Return why there may be no figure of a run file."""
    from rig.cli.show.digest import installed_procedure, not_usable
    from rig.figures.registry import figures_of

    header = run.header
    if not run.point_ids():
        return "the run has no completed point"
    if header.origin is None and installed_procedure(header) is None:
        return f"procedure {not_usable(header)}"
    if not figures_of(header.procedure):
        return f"no figure of a run of {header.procedure} is installed"
    return "nothing in this file can be drawn"


def _show_run(
    path: Path,
    header: RunHeader,
    outcome: RecordedOutcome,
    readings: Sequence[Reading],
    stored: Results | None,
    analyses: Analyses,
    holds: Mapping[str, Mapping[str, Mapping[str, Any]]],
    how: _How,
    debug: bool,
) -> None:
    """Show a run, and what this program finds otherwise than is stored."""
    from rig.cli.show.digest import of_run
    from rig.cli.show.results import (
        analysed,
        compared,
        compared_in_words,
        computed_by,
        computed_now,
        recomputed,
    )
    from rig.files.describe import describe

    said = describe(path, header, outcome)
    now = recomputed(header, readings)
    if how == "brief":
        values = analysed(analyses, debug)
        _print_all(of_run(said, header, stored or now, computed_by(stored, now), values))
        return
    if stored is not None:
        said |= (compared if how == "json" else compared_in_words)(stored, now)
    elif now is not None:
        said |= computed_now(now, how == "json")
    said |= analysed(analyses, debug)
    said |= holds if how == "json" else contents_in_words(holds)
    (print_json if how == "json" else _print_values)(said)


def _show_processed(file: ProcessedFile, how: _How) -> None:
    """Show the events of a detector."""
    from rig.cli.show.digest import of_processed
    from rig.detector.registered import chosen_detector
    from rig.files.describe import describe_processed

    said = describe_processed(file)
    if how == "brief":
        usual: dict[str, Any] = {}
        with contextlib.suppress(ConfigurationError):  # The detector is not installed.
            usual = chosen_detector(file.detector.name).settings.model_dump()
        _print_all(of_processed(said, usual))
    else:
        (print_json if how == "json" else _print_values)(said)


def _show_model(file: ModelFile, how: _How) -> None:
    """Show what was computed with the skin model."""
    from rig.cli.show.digest import of_model
    from rig.files.describe import describe_model

    said = describe_model(file, all_settings=how != "brief")
    if how == "json":
        print_json(said)
    elif how == "all":
        _print_values(with_results_in_words(said))
    else:
        _print_all(of_model(with_results_in_words(said)))


def _draw_beside(
    files: list[Path], folder: Path | None, pdf: bool, shown: Callable[[str], None]
) -> None:
    """Draw two slip trials with a grip or a weight beside each other, where they are that."""
    from rig.figures.grip import draw_pair
    from rig.files.file_kind import kind_of
    from rig.files.model_file import is_model
    from rig.files.processed.reader import is_processed

    if files[0].resolve() == files[1].resolve():
        return
    if any(kind_of(path) == "journal" or is_processed(path) or is_model(path) for path in files):
        return
    for drawn in draw_pair(files, folder, pdf):
        shown(f"figure: {drawn}")


def _draw(
    file: Path, folder: Path | None, pdf: bool, shown: Callable[[str], None], debug: bool
) -> Drawn:
    """Draw the figures of a file, and report where they are and which one has failed."""
    from rig.figures.drawing import draw

    drawn = draw(file, folder, pdf)
    _report_drawn(drawn, shown, debug)
    return drawn


def _report_drawn(drawn: Drawn, shown: Callable[[str], None], debug: bool) -> None:
    """Report where figures are, and what could not be drawn, with tracebacks for `debug`."""
    for picture in drawn.files:
        shown(f"figure: {picture}")
    for warning in drawn.warnings:
        say(f"warning: {warning}")
    for trace in drawn.tracebacks if debug else ():
        say_all(trace)


def _texts(paths: Sequence[Path]) -> list[str]:
    return [str(path) for path in paths]


def _say_all(lines: Sequence[str]) -> None:
    for line in lines:
        say(line)


def _print_all(lines: Sequence[str]) -> None:
    for line in lines:
        _print(line)


def _print(line: str) -> None:
    print(line)  # noqa: T201 - stdout carries data


def _print_values(values: Mapping[str, Any]) -> None:
    """Print names and values, one per line, and tables indented below their names."""
    for line in value_lines(values):
        _print(printable(line))
