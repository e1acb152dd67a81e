"""``rig detect``: parses the command, calls `rig.processing.detection`, prints the results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from rig.cli.options.numbers import whole_number
from rig.cli.options.shared import AsJson, Debug, ProcessedFolder
from rig.cli.outcome import print_json, reported, say, say_failure
from rig.core.errors import ExitCode, RigError
from rig.core.text import printable
from rig.core.units import counted
from rig.detector import DEFAULT_DETECTOR

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from rig.detector.events import EventKind
    from rig.detector.registered import ChosenDetector
    from rig.processing.detection import DetectionFailure, DetectionJob, DetectionResult

    Answer = DetectionResult | RigError


def detect(
    files: Annotated[
        list[Path], typer.Argument(help="Run files (.h5) with the strips' signals.", metavar="FILE")
    ],
    detector: Annotated[
        str,
        typer.Option(
            help="Detector to use; `rig detectors` lists them. On the simulated bench paper-hp "
            "misses 5 slips of 10. rig misses 1 of 8 where the commands of x and of the held "
            "force are known, as in this program's trials, and 1 of 7 without them: in holds and "
            "re-grips, when the force falls, in strong noise and where friction hardly falls. All "
            "alarm falsely when the object is released (rig in 1 of 5); in other trials impulse "
            "does so most often. rig repeats its alarm while a slip lasts. "
            "A grip needs 95 % in time; none is shown to reach it, so the "
            "default is the published detector, paper-hp.",
            metavar="NAME",
        ),
    ] = DEFAULT_DETECTOR,
    settings: Annotated[
        Path | None,
        typer.Option(help="TOML file that overrides parameters of the detector.", metavar="FILE"),
    ] = None,
    to: ProcessedFolder = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            help="Number of files processed at once.  [default: one per processor]",
            parser=whole_number(1),
            metavar="COUNT",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of a Dask cluster to run on; it needs the same program and file paths.",
            metavar="ADDRESS",
        ),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Find incipient slips in run files and write the results to processed files."""
    with reported(debug, as_json):
        from rig.cli.options.detector import detector_with_settings
        from rig.processing.parallel import completed, processors

        wanted = detector_with_settings(detector, settings)

        from rig.processing.detection import DetectionJob, detect_file, prepare
        from rig.processing.identity import detection_digest

        if scheduler is None:
            work = [DetectionJob(file, wanted, to) for file in files]
            prepare(wanted)
        else:  # workers are in folders of their own
            there = None if to is None else to.absolute()
            digest = detection_digest(wanted)
            work = [DetectionJob(file.absolute(), wanted, there, digest, True) for file in files]
        answers: dict[int, Answer] = {}
        next_file = 0

        def answered(number: int, result: DetectionResult | DetectionFailure | RigError) -> None:
            """Keep an answer; report those whose turn in the order of the files has come."""
            nonlocal next_file
            answers[number] = _answer(result, work[number], files[number])
            while next_file in answers:
                _report(files[next_file], answers[next_file], as_json, debug)
                next_file += 1

        # A file that is not there is refused at once, not as 1/1 behind others' hours of work.
        there_is = [k for k, file in enumerate(files) if scheduler is not None or file.exists()]
        for number in range(len(files)):
            if number not in there_is:
                answered(number, detect_file(work[number]))
        with _DetectionProgress(len(there_is)) as progress:
            present = [work[number] for number in there_is]
            # A package may end its process, and this one would end with code 0 and no word.
            results = completed(
                detect_file, present, jobs or processors(), scheduler, apart=not wanted.is_own
            )
            for done, (number, result) in enumerate(results, 1):
                progress.done(done, files[there_is[number]])
                answered(there_is[number], result)
        remark = literal_remark(wanted, list(answers.values()))
        if remark is not None:
            say(remark)
        code = _code(list(answers.values()))
        if as_json:
            ordered = [answers[number] for number in range(len(files))]
            print_json(_as_object(files, ordered, code))
        if code is not ExitCode.DONE:
            raise typer.Exit(int(code))


def literal_remark(wanted: ChosenDetector, answers: Sequence[Answer]) -> str | None:
    """Return why the paper's literal logic found nothing where it was armed; None where it did, or
    for another logic."""
    from rig.detector.settings import DetectorSettings

    settings = wanted.settings
    if not isinstance(settings, DetectorSettings) or settings.logic != "paper-literal":
        return None
    missed = sum(
        answer.events.get("predictive", 0) > 0 and not answer.events.get("incipient slip", 0)
        for answer in answers
        if not isinstance(answer, RigError)
    )
    if not missed:
        return None
    return (
        f"note: in {counted(missed, 'file')} a motion under load began and v_d stayed below "
        f"{settings.fire_mV:g} mV. The paper states no threshold; 30 mV is the lowest that alarms "
        "in at most 2 % of simulated rolls, and the default simulated slide reaches 28.7 mV. So "
        "v_d itself does not separate slips from rolls here, which DISAGREES with the paper's "
        "4.3 read literally: its high-frequency part does (--detector paper-hp). Another "
        "threshold: fire_mV in a file for --settings."
    )


def _answer(
    result: DetectionResult | DetectionFailure | RigError, job: DetectionJob, file: Path
) -> Answer:
    from rig.processing.detection import DetectionFailure, other_code
    from rig.processing.parallel import WorkerDiedError

    if isinstance(result, WorkerDiedError) and not job.detector.is_own:
        name, package = job.detector.name, job.detector.package
        return WorkerDiedError(
            f"{file}: {result.message} while detector {name!r} of the package {package} judged",
            f"fix the package {package}, or choose another detector (rig detectors)",
        )
    if isinstance(result, DetectionFailure):
        return result.error()
    if isinstance(result, RigError):
        named = RigError(f"{file}: {result.message}", result.hint, result.code)
        named.__cause__ = result.__cause__
        return named
    if job.made_by not in ("", result.made_by):  # by code that is too old to compare by itself
        return other_code(file)
    return result


def _code(answers: Sequence[Answer]) -> ExitCode:
    """Return the exit code: that of the first file if all failed, 5 if only some failed."""
    failed = [answer for answer in answers if isinstance(answer, RigError)]
    if not failed:
        return ExitCode.DONE
    return ExitCode.FINISHED_WITH_FAILURES if len(failed) < len(answers) else failed[0].code


def _report(file: Path, answer: Answer, as_json: bool, debug: bool) -> None:
    if isinstance(answer, RigError):
        say_failure(answer, debug)
        return
    for warning in answer.warnings:
        say(f"warning: {warning}")
    if not as_json:
        print(printable(f"{file}: {_in_words(answer)}"))  # noqa: T201 - stdout carries data


def _in_words(found: DetectionResult) -> str:
    """Return the result as one line, ``1 trial: 1 alarm of incipient slip (first at 6.384 s of
    trial-001), 2 motions under load begun. Saved FILE; draw with: rig show --figures FILE``."""
    from rig.detector.events import counted_events

    parts = []
    if slips := found.events.get("incipient slip", 0):
        assert found.first_slip is not None
        trial, time_s = found.first_slip
        first = f"first at {time_s:.3f} s of {trial}"
        parts.append(f"{counted_events('incipient slip', slips)} ({first})")
    kinds: tuple[EventKind, ...] = ("predictive", "roll", "rejected")
    parts += [counted_events(kind, n) for kind in kinds if (n := found.events.get(kind, 0))]
    parts += [f"cannot judge {seconds:.3f} s ({why})" for why, seconds in found.unjudged_s.items()]
    if count := found.without_touch:
        parts.append(f"cannot judge {counted(count, 'trial')} (no touch was seen)")
    saved = "Saved before as" if found.kept else "Saved"
    return (
        f"{counted(found.trials, 'trial')}: {', '.join(parts) or 'nothing found'}. "
        f"{saved} {found.file}; draw with: rig show --figures {found.file}"
    )


def _as_object(files: Sequence[Path], answers: Sequence[Answer], code: ExitCode) -> dict[str, Any]:
    results = [
        {"run": str(file), **_result(answer)} for file, answer in zip(files, answers, strict=True)
    ]
    found = [answer for answer in answers if not isinstance(answer, RigError)]
    simulated = {answer.simulated for answer in found}
    return {
        "file": results[0]["file"] if len(results) == 1 else None,
        "outcome": "complete" if code is ExitCode.DONE else "failed",
        "exit": int(code),
        "simulated": simulated.pop() if len(simulated) == 1 else None,
        "summary": {
            "files": len(results),
            "failed": len(results) - len(found),
            "kept": sum(answer.kept for answer in found),
        },
        "results": results,
        "errors": [answer.one_line() for answer in answers if isinstance(answer, RigError)],
    }


def _result(answer: Answer) -> dict[str, Any]:
    if isinstance(answer, RigError):
        return {"file": None, "exit": int(answer.code), "error": answer.one_line()}
    trial, time_s = answer.first_slip or (None, None)
    return {
        "file": str(answer.file),
        "exit": 0,
        "kept": answer.kept,
        "simulated": answer.simulated,
        "trials": answer.trials,
        "events": answer.events,
        "unjudged_s": answer.unjudged_s,
        "trials_without_touch": answer.without_touch,
        "first_slip_trial": trial,
        "first_slip_s": time_s,
        "warnings": list(answer.warnings),
    }


class _DetectionProgress:
    """Shows progress on stderr: a bar with the time left on a terminal, else one line per file."""

    def __init__(self, files: int):
        from rich.console import Console

        self._console = Console(stderr=True)
        self._files = files
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def done(self, number: int, file: Path) -> None:
        """Show that `number` files are done, the latest of which is `file`.

        The bar, which is a thread, begins here: by then every process has been forked.
        """
        if not self._console.is_terminal or self._console.is_dumb_terminal:
            say(f"{number}/{self._files} {file.name}")
            return
        if self._bar is None:
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            columns = (TextColumn("{task.completed}/{task.total}"), BarColumn())
            self._bar = Progress(
                *columns, TextColumn("left"), TimeRemainingColumn(),
                console=self._console, transient=True,
            )  # fmt: skip
            self._task = self._bar.add_task("files", total=self._files)
            self._bar.start()
        assert self._task is not None
        self._bar.update(self._task, completed=number)
