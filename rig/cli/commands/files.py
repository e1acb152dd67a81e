"""Commands about run files: resume, show, verify, recover."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rig.cli.outcome import of_the_computer, print_json, reported, say, say_all, say_failure
from rig.cli.show.words import in_words
from rig.core.errors import (
    ConfigurationError,
    ExitCode,
    FoundWrongError,
    RigError,
    finding,
    is_stop,
)
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
LONGEST_LINE = 80
"""Length in characters of several texts from which each is shown in a line of its own."""

Files = Annotated[
    list[Path],
    typer.Argument(
        help="Run files, processed files, files of rig skin (.h5) or journals (.rigj).",
        metavar="FILE",
    ),
]
ToRecover = Annotated[
    list[Path],
    typer.Argument(help="Journals (.rigj), or run files of interrupted runs.", metavar="FILE"),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


def resume(
    file: Annotated[
        Path, typer.Argument(help="Journal or run file of the interrupted run.", metavar="FILE")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figure of the run.")] = True,
    world_log: Annotated[
        Path | None, typer.Option(help="File for a simulated bench's own log.", metavar="FILE")
    ] = None,
    debug: Debug = False,
) -> None:
    """Resume an interrupted run at the point where it was interrupted."""
    with reported(debug, as_json):
        from pydantic import ValidationError

        from rig.cli.commands.procedures import ProcedureRequest, perform
        from rig.cli.show.digest import not_usable
        from rig.core.entry_points import PROCEDURES, names
        from rig.files.naming import results_of
        from rig.files.runfile.recover import interrupted
        from rig.run.load_procedure import load_procedure

        contents = interrupted(file)
        header = contents.header
        if header.procedure not in names(PROCEDURES):
            version = f" {header.procedure_version}" if header.procedure_version else ""
            raise ConfigurationError(
                f"{file}: procedure {not_usable(header)}",
                f"install {header.procedure_package or 'the package that has it'}{version}",
            )
        try:
            procedure = load_procedure(header.procedure)
        except ConfigurationError as error:
            raise ConfigurationError(f"{file}: {error.message}", error.hint) from error
        try:
            settings = procedure.Settings.model_validate_json(json.dumps(header.settings))
        except ValidationError as error:
            found = "; ".join(map(finding, error.errors()))
            raise ConfigurationError(
                f"{file}: procedure {header.procedure} does not take the settings of this run "
                f"here: {found}",
                "install what is missing, or restore the version that began the run",
            ) from error
        with _world_of(header.bench_toml, str(file)) as (world, stages):
            bench_file = None if world is not None else Path(header.bench_file)
            request = ProcedureRequest(
                bench=bench_file,
                results=results_of(contents.path),
                seed=header.seed,
                as_json=as_json,
                figures=figures,
                stages=stages,
                world=world,
                world_log=world_log,
                debug=debug,
            )
            perform(procedure(settings), request, resume=contents)


def show(
    files: Files,
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
    with reported(debug):
        if overlay:
            from rig.figures.overlay import draw_overlay

            drawn = draw_overlay(files, figures_to, pdf)
            _report_drawn(drawn, say if as_json else _print, debug)
            return
        draws = figures or pdf or figures_to is not None
        how: _How = "json" if as_json else "all" if all_settings else "brief"
        not_drawn: list[str] = []
        failures: list[RigError] = []
        for path in files:
            try:
                drawable, why_nothing = _show_file(path, how, debug)
                if not draws:
                    continue
                report = say if as_json else _print
                if not why_nothing:
                    say(f"{path}: its figures were drawn when it was computed, beside it")
                elif not drawable or not _draw(path, figures_to, pdf, report, debug):
                    not_drawn.append(f"{path}: {why_nothing}")
            except (RigError, OSError) as error:
                if len(files) == 1:
                    raise
                failures.append(error if isinstance(error, RigError) else of_the_computer(error))
                say_failure(failures[-1], debug)
        if draws and len(files) == 2 and not failures:
            _draw_beside(files, figures_to, pdf, say if as_json else _print)
        for line in not_drawn:
            say(f"no figure was drawn: {line}")
        if failures:
            raise typer.Exit(int(failures[0].code))
        if not_drawn:
            raise typer.Exit(int(ExitCode.FINISHED_WITH_FAILURES))


def _show_file(path: Path, how: _How, debug: bool) -> tuple[bool, str]:
    """Show a file. Return whether its kind can be drawn, and why there may be no figure all the
    same; the latter is empty for a file of rig skin, which has figures beside it. RigError if the
    file cannot be read."""
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
    from rig.cli.show.results import compared, compared_in_words, computed_by, computed_now
    from rig.files.describe import describe

    said = describe(path, header, outcome)
    now = _recomputed(header, readings)
    if how == "brief":
        values = _analysed(analyses, debug)
        _say_all_of(of_run(said, header, stored or now, computed_by(stored, now), values))
        return
    if stored is not None:
        said |= (compared if how == "json" else compared_in_words)(stored, now)
    elif now is not None:
        said |= computed_now(now, how == "json")
    said |= _analysed(analyses, debug)
    said |= holds if how == "json" else _holds_in_words(holds)
    (print_json if how == "json" else _print_values)(said)


def _holds_in_words(
    holds: Mapping[str, Mapping[str, Mapping[str, Any]]],
) -> dict[str, dict[str, str]]:
    """Return a line for each column and stream, such as ``Travel of z during the hold (um)`` and
    ``F_n, F_t, F_y in N, 1000 Hz (…)``."""

    def column(one: Mapping[str, Any]) -> str:
        return f"{one['meaning']} ({one['unit']})" if one["unit"] else one["meaning"]

    def stream(one: Mapping[str, Any]) -> str:
        said = ", ".join(one["channels"]) + (f" in {one['unit']}" if one["unit"] else "")
        if not one["recorded"]:
            said += ", not recorded"
        elif one["rate_Hz"] is not None:
            said += f", {in_words(one['rate_Hz'])} Hz"
        elif one["times"]:
            said += f", at the times of {one['times']}"
        return f"{said} ({one['meaning']})" if one["meaning"] else said

    return {
        "columns": {name: column(one) for name, one in holds["columns"].items()},
        "streams": {name: stream(one) for name, one in holds["streams"].items()},
    }


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
        _say_all_of(of_processed(said, usual))
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
        _print_values(_with_results_in_words(said))
    else:
        _say_all_of(of_model(_with_results_in_words(said)))


def _with_results_in_words(said: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a model's file with a line for each result, such as
    ``8501 time: -0.4 to 4.01 N (normal force)``."""

    def line(one: Mapping[str, Any]) -> str:
        if "shape" in one:
            value = f"{one['shape']}: {in_words(one['lowest'])} to {in_words(one['highest'])}"
        else:
            values = one["value"] if "value" in one else one["values"]
            value = "; ".join(map(in_words, values if isinstance(values, list) else [values]))
        return f"{value} {one.get('unit', '')}".rstrip() + f" ({one['meaning']})"

    return said | {"results": {name: line(one) for name, one in said["results"].items()}}


def _draw_beside(
    files: list[Path], folder: Path | None, pdf: bool, shown: Callable[[str], None]
) -> None:
    """Draw two slip trials with a grip or a weight beside each other, where they are that."""
    from rig.figures.grip import draw_pair
    from rig.files.file_kind import kind_of
    from rig.files.model_file import is_model
    from rig.files.processed.reader import is_processed

    if any(kind_of(path) == "journal" or is_processed(path) or is_model(path) for path in files):
        return
    for drawn in draw_pair(files, folder, pdf):
        shown(f"figure: {drawn}")


def verify(files: Files, debug: Debug = False) -> None:
    """Check run files, processed files and journals; exit 8 if something is wrong.

    Checks checksums, structure and completeness.
    """
    with reported(debug):
        from rig.cli.show.digest import noun_of
        from rig.files.verify import safe_verdict

        wrong = 0
        for path in files:
            found = safe_verdict(path, noun_of)
            wrong += not found.sound
            print(printable(f"{path}: {found}"))  # noqa: T201 - stdout carries data
        if wrong:
            of = f"{len(files)} files" if len(files) > 1 else "1 file"
            raise FoundWrongError(f"{wrong} of {of} failed verification")


def recover(files: ToRecover, debug: Debug = False) -> None:
    """Rebuild the run file of a crashed run from its journal."""
    with reported(debug):
        from rig.files.runfile.recover import recover as rebuild

        failed: RigError | None = None
        for path in files:
            try:
                print(rebuild(path))  # noqa: T201 - stdout carries data
            except RigError as error:
                say(f"error: {error.one_line()}")
                failed = failed or error
        if failed is not None:
            raise typer.Exit(int(failed.code or ExitCode.INTERNAL))


def _recomputed(header: RunHeader, readings: Sequence[Reading]) -> Results | None:
    """Return what the procedure computes from the readings now, where it is installed and still
    takes them; one that is broken costs a line, not the command."""
    from pydantic import ValidationError

    from rig.core.entry_points import PROCEDURES, names
    from rig.core.validated import stored_settings
    from rig.run.checked_procedure import internal
    from rig.run.load_procedure import load_procedure
    from rig.run.results import results_of

    if header.procedure not in names(PROCEDURES) or not readings:
        return None
    try:
        procedure = load_procedure(header.procedure)
    except ConfigurationError as error:
        say(f"warning: no summary: {error.one_line()}")
        return None
    try:
        settings = stored_settings(procedure.Settings, header.settings)
    except ValidationError:  # written by another version of the procedure
        return None
    try:
        return results_of(procedure(settings), readings, bool(header.simulated))
    except RigError as error:
        if not isinstance(error.__cause__, KeyError):  # then another version has written the file
            say(f"warning: no summary: {error.one_line()}")
    except Exception as error:
        if is_stop(error):
            raise
        say(f"warning: no summary: {internal(error).one_line()}")
    return None


def analyse(
    files: Annotated[list[Path], typer.Argument(help="Run files (.h5).", metavar="FILE")],
    to: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results.  [default: processed/ next to each file]",
            metavar="FOLDER",
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Compute the values of the installed analyses and save them.

    `rig show` computes and shows the same values, and saves nothing.
    """
    with reported(debug):
        from rig.files.errors import RunFileError
        from rig.files.runfile.reader import RunFile
        from rig.processing.analyses import analyse as compute
        from rig.processing.analyses import keep

        nothing_of: list[str] = []
        hint = None
        unusable: list[RunFileError] = []
        for path in files:
            try:
                opened = RunFile.open(path)
            except RunFileError as error:  # those behind it are analysed all the same
                if len(files) == 1:
                    raise
                say_failure(error, debug)
                unusable.append(error)
                continue
            with opened as run:
                analyses = compute(run)
                _print_values(_analysed(analyses, debug))
                if analyses.found:
                    print(printable(f"saved {keep(run, analyses, to)}"))  # noqa: T201 - data
                    continue
                named = f"{path} (a {run.header.procedure})"
                if analyses.tracebacks:
                    nothing_of.append(f"{named}: its analysis failed (see above)")
                    hint = hint or "correct the package that is named above; --debug shows more"
                elif not run.point_ids():
                    nothing_of.append(f"{named}: no point was completed")
                else:
                    nothing_of.append(named)
                    hint = "install a package with an analysis for it: see docs/add-an-analysis.md"
        if nothing_of:
            raise ConfigurationError(f"nothing was computed for {', '.join(nothing_of)}", hint)
        if unusable:
            some = len(unusable) < len(files)
            raise typer.Exit(int(ExitCode.FINISHED_WITH_FAILURES if some else unusable[0].code))


def _analysed(analyses: Analyses, debug: bool) -> dict[str, Any]:
    """Return the values of a run file's analyses by what computed them; one that has failed costs
    a line, not the command. `debug` shows its traceback."""
    for warning in analyses.warnings:
        say(f"warning: {warning}")
    for trace in analyses.tracebacks if debug else ():
        say_all(trace)
    return {
        f"{one.name} ({one.package} {one.package_version})": one.values for one in analyses.found
    }


def _draw(
    file: Path, folder: Path | None, pdf: bool, report: Callable[[str], None], debug: bool
) -> bool:
    """Draw the figures of a file and report where they are and which one has failed; return whether
    there is any, or a warning of what has failed."""
    from rig.figures.drawing import draw

    drawn = draw(file, folder, pdf)
    _report_drawn(drawn, report, debug)
    return bool(drawn.files or drawn.warnings)


def _report_drawn(drawn: Drawn, report: Callable[[str], None], debug: bool) -> None:
    """Report where figures are, and what could not be drawn, with tracebacks for `debug`."""
    for picture in drawn.files:
        report(f"figure: {picture}")
    for warning in drawn.warnings:
        say(f"warning: {warning}")
    for trace in drawn.tracebacks if debug else ():
        say_all(trace)


def _say_all(lines: Sequence[str]) -> None:
    for line in lines:
        say(line)


def _say_all_of(lines: Sequence[str]) -> None:
    for line in lines:
        _print(line)


def _print(line: str) -> None:
    print(line)  # noqa: T201 - stdout carries data


def _print_values(values: Mapping[str, Any], indent: str = "") -> None:
    """Print names and values, one per line, and tables indented below their names."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            print(printable(f"{indent}{name}:"))  # noqa: T201 - stdout carries data
            _print_values(value, indent + "  ")
        elif _is_text_list(value):
            print(printable(f"{indent}{name}:"))  # noqa: T201 - stdout carries data
            for line in value:
                print(printable(f"{indent}  {line}"))  # noqa: T201 - stdout carries data
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            for number, one in enumerate(value, 1):
                print(printable(f"{indent}{name} {number}:"))  # noqa: T201 - stdout carries data
                _print_values(one, indent + "  ")
        else:
            print(printable(f"{indent}{name}: {in_words(value)}"))  # noqa: T201 - stdout carries data


def _is_text_list(value: Any) -> bool:
    """Return whether the value is several texts, of which each gets a line of its own."""
    return (
        isinstance(value, list | tuple)
        and len(value) > 1
        and all(isinstance(one, str) for one in value)
        and sum(map(len, value)) > LONGEST_LINE
    )


@contextlib.contextmanager
def _world_of(bench_toml: str, source: str) -> Iterator[tuple[Path | None, str | None]]:
    """Write the World settings of a run to a file again; yield the file and the stages.

    This is for a bench that the run's command had started. Yield None for any other bench, whose
    file is read from where it was.
    """
    from rig.bench.plan import parse_bench
    from rig.core.toml_files import toml_value

    plan = parse_bench(bench_toml, f"{source}: its bench file")
    simulation = dict(plan.settings.simulation or {})
    if not simulation or ("::0::" not in bench_toml and ",0::" not in bench_toml):
        yield None, None
        return
    simulation.pop("seed", None)
    simulation.pop("world", None)
    stages = simulation.pop("stages", None)
    with tempfile.NamedTemporaryFile("w", suffix=".toml", encoding="utf-8") as file:
        file.write("".join(f"{key} = {toml_value(value)}\n" for key, value in simulation.items()))
        file.flush()
        yield Path(file.name), stages
