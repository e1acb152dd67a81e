"""Makes the files of a finished run: the compiled run file, the detector's results, the figures.

A batch gives each run to a process of its own, one at a time, of low priority:

    python -m rig.batch.execute.postprocess JOURNAL [--no-detect] [--no-figures]

It ends with a line of JSON on its standard output:

    {"journal": PATH, "file": PATH, "processed": PATH, "figures": [PATH, ...], "warnings": [],
     "error": ""}

Before each figure it writes such a line of what there is by then, with the figure's name as
"drawing": where a figure ends the process, or keeps it busy beyond the time for figures
(`rig.figures.drawing`), only the figures that are missing are lost.

`PostprocessQueue` is the batch's side: runs wait in it until the batch has time for them. A process
that dies or takes too long costs the files of its run, not those of the others. Every file appears
under its name when it is whole, and a run that is given again does no harm.

The batch imports this module, so the heavy libraries are imported where they are used.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

from rig.core.child import Child, ChildResult
from rig.core.errors import RigError

LONGEST_S = 1800.0
"""Time limit for the files of one run. A run of 20 s takes about 3 s, half of it for imports."""
NICENESS = 19
ONE_THREAD = dict.fromkeys(
    (
        *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
        *("VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS"),
    ),
    "1",
)
"""Linear algebra in one thread: another processor may be the tick loop's."""
POLL_EVERY_S = 0.1
LONGEST_QUOTE = 300
"""Characters of a process's last words in a message."""


@dataclass(frozen=True)
class PostprocessJob:
    """A finished run whose run file, detector's results and figures are to be made."""

    journal: Path
    """Journal of the run; if it has been compiled, the path that it had."""
    figures: bool = True
    detect: bool = True


@dataclass(frozen=True)
class PostprocessResult:
    """The files that were made of a run, and what went wrong with them."""

    journal: Path
    file: Path | None = None
    """The run file."""
    processed: Path | None = None
    """The processed file; None for a run without strips."""
    figures: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    """Warnings of figures and results that are missing or doubtful."""
    error: str = ""
    """The reason why there is no run file; empty if there is one."""

    def as_line(self, drawing: str = "") -> str:
        """Return this result as a line of JSON; `drawing` names the figure that is drawn next."""
        more = {"drawing": drawing} if drawing else {}
        return json.dumps(asdict(self) | more, default=str) + "\n"


def result_from(fields: Mapping[str, Any]) -> PostprocessResult:
    """Return a result from its JSON object."""
    file, processed = fields["file"], fields["processed"]
    return PostprocessResult(
        journal=Path(fields["journal"]),
        file=None if file is None else Path(file),
        processed=None if processed is None else Path(processed),
        figures=tuple(Path(figure) for figure in fields["figures"]),
        warnings=tuple(fields["warnings"]),
        error=fields["error"],
    )


# --- the batch's side -------------------------------------------------------------------------


class PostprocessQueue:
    """The runs whose files are still to be made, one of them perhaps under way.

    Where several wait, all are compiled before any figure is drawn: a figure may take long.
    """

    def __init__(self, log: IO[bytes], inherited: Sequence[int] = (), longest_s: float = LONGEST_S):
        """`log` gets what a process writes on its standard error; `inherited` are file descriptors
        that it keeps open: the batch's lock, so that a process that outlives its batch is not
        joined by another one over the same files."""
        self._log, self._inherited, self._longest_s = log, inherited, longest_s
        self._jobs: deque[PostprocessJob] = deque()
        self._child: Child | None = None
        self._under_way: PostprocessJob | None = None
        """What the process at work was asked for."""
        self._undrawn: dict[Path, PostprocessResult] = {}
        """Results of the runs that wait for their figures only, by journal."""

    def __len__(self) -> int:
        """Return the number of runs that are without their files."""
        return len(self._jobs)

    @property
    def pid(self) -> int | None:
        """Process id of the process at work; None while none works."""
        return None if self._child is None else self._child.pid

    def add(self, job: PostprocessJob) -> None:
        """Queue a run, whose files are made after those of the runs before it."""
        self._jobs.append(job)

    def poll(self, *, start: bool) -> PostprocessResult | None:
        """Return the next result, or None if there is none yet. Returns without waiting. The files
        of another run are begun only where `start` is true; those under way are continued in any
        case."""
        if self._child is None:
            return self._begin() if start and self._jobs else None
        ended = self._child.poll()
        if ended is None:
            return None
        assert self._under_way is not None
        asked, self._child = self._under_way, None
        result = _result_of(asked, ended)
        job = next(job for job in self._jobs if job.journal == asked.journal)
        if job.figures and not asked.figures and not result.error:
            self._undrawn[job.journal] = result
            return None
        self._jobs.remove(job)
        if (before := self._undrawn.pop(job.journal, None)) is None:
            return result
        if result.error:
            return replace(before, warnings=(*before.warnings, result.error))
        warnings = (*before.warnings, *result.warnings)
        return replace(before, figures=result.figures, warnings=warnings)

    def close(self, within_s: float) -> PostprocessResult | None:
        """Begin nothing more, and wait for the files under way; a process that takes longer than
        `within_s` is killed. Its result, if it came to one."""
        deadline_s = time.monotonic() + within_s
        while self._child is not None and time.monotonic() < deadline_s:
            if (result := self.poll(start=False)) is not None:
                return result
            time.sleep(POLL_EVERY_S)
        if self._child is not None:
            self._child.kill()
            self._child.poll()
            self._child = None
        return None

    def _begin(self) -> PostprocessResult | None:
        """Begin with the first run that is not compiled yet, else with the first one's figures."""
        uncompiled = [job for job in self._jobs if job.journal not in self._undrawn]
        if not uncompiled:
            job = replace(self._jobs[0], detect=False)
        else:
            job = uncompiled[0]
            if len(uncompiled) > 1:
                job = replace(job, figures=False)
        self._under_way = job
        program = [sys.executable, "-P", "-m", "rig.batch.execute.postprocess", str(job.journal)]
        program += [] if job.detect else ["--no-detect"]
        program += [] if job.figures else ["--no-figures"]
        try:
            self._child = Child(
                program,
                self._longest_s,
                stderr=self._log,
                environment=ONE_THREAD,
                inherited=self._inherited,
            )
        except OSError as error:  # no memory, too many processes
            self._jobs = deque(one for one in self._jobs if one.journal != job.journal)
            self._undrawn.pop(job.journal, None)
            return PostprocessResult(job.journal, error=f"{job.journal}: not begun: {error}")
        return None


def _result_of(job: PostprocessJob, ended: ChildResult) -> PostprocessResult:
    """Return the result that a process reported, without the figures that are missing if it died
    or was killed while it drew; an error if it reported nothing."""
    output = ended.output.decode(errors="replace").strip()
    with contextlib.suppress(ValueError, LookupError, TypeError):
        fields = json.loads(output.splitlines()[-1])
        result = replace(result_from(fields), journal=job.journal)
        if not ended.failure:
            return result
        if result.file is not None:
            lost = f"the process that makes its files ended early ({ended.failure})"
            if drawing := fields.get("drawing"):
                lost = (
                    f"{drawing} and those after it were not drawn: {lost}; "
                    f"`rig show --figures {result.file}` draws them again"
                )
            lost = f"{result.file.name}: {lost}"
            return replace(result, warnings=(*result.warnings, lost))
    why = ended.failure or f"no result: {output[-LONGEST_QUOTE:]!r}"
    return PostprocessResult(
        job.journal, error=f"{job.journal}: the process that makes its files failed: {why}"
    )


# --- the process that makes the files ----------------------------------------------------------


def make_files(
    job: PostprocessJob,
    begins: Callable[[PostprocessResult, str], None] = lambda made, figure: None,
) -> PostprocessResult:
    """Compile a run's journal if it is still there, then detect and draw what was asked for.

    A step that fails is reported in the result and does not stop the next one. `begins` is called
    before each figure with what has been made and the figure's name. Never raises.
    """
    try:
        file = _run_file(job.journal)
    except Exception as error:  # noqa: BLE001 - a defect is reported like any other failure
        return PostprocessResult(job.journal, error=_reason(error))
    warnings: list[str] = []
    processed: Path | None = None
    with _reporting(warnings, f"{file.name}: not drawn"):
        has_points, has_strips = _kind_of(file)
        if job.detect and has_points and has_strips:
            with _reporting(warnings, f"{file.name}: not judged by the detector"):
                processed, said = _detect(file)
                warnings += said
        if job.figures and has_points:
            from rig.figures.drawing import Drawn, draw

            def made(drawn: Drawn) -> PostprocessResult:
                said = [*warnings, *(f"{file.name}: {warning}" for warning in drawn.warnings)]
                return PostprocessResult(job.journal, file, processed, drawn.files, tuple(said))

            drawn = draw(file, begins=lambda drawn, figure: begins(made(drawn), figure))
            for trace in drawn.tracebacks:
                sys.stderr.write(trace)
            return made(drawn)
    return PostprocessResult(job.journal, file, processed, (), tuple(warnings))


@contextlib.contextmanager
def _reporting(warnings: list[str], what: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # noqa: BLE001 - a defect costs its step
        warnings.append(f"{what}: {_reason(error)}")


def _run_file(journal: Path) -> Path:
    """Return the run's file, compiled if its journal still exists."""
    from rig.files.naming import RUN_SUFFIX
    from rig.files.runfile.compile import compile_run

    file = journal.with_suffix(RUN_SUFFIX)
    if file.exists() and not journal.exists():
        return file
    return compile_run(journal, retire=True)


def _kind_of(file: Path) -> tuple[bool, bool]:
    """Return whether a run file has points, and whether it has the strips' signals."""
    from rig.files.journal.strips import stream_of_strips
    from rig.files.runfile.reader import RunFile

    with RunFile.open(file) as run:
        return bool(run.point_ids()), stream_of_strips(run.header.layout) is not None


def _detect(file: Path) -> tuple[Path | None, list[str]]:
    """Return the processed file of a run file, as `rig detect` makes it, and its warnings."""
    from rig.detector import DEFAULT_DETECTOR
    from rig.detector.registered import chosen_detector
    from rig.processing import detection

    found = detection.detect_file(detection.DetectionJob(file, chosen_detector(DEFAULT_DETECTOR)))
    if isinstance(found, detection.DetectionFailure):
        return None, [found.error().one_line()]
    return found.file, list(found.warnings)


def _reason(error: Exception) -> str:
    return error.one_line() if isinstance(error, RigError) else f"{type(error).__name__}: {error}"


def main(arguments: Sequence[str]) -> None:
    """Make the files of the run that the arguments name, and report on standard output."""
    import argparse
    import faulthandler

    from rig.figures.drawing import GRACE_S, TIMEOUT_S

    parser = argparse.ArgumentParser("python -m rig.batch.execute.postprocess")
    parser.add_argument("journal", type=Path)
    parser.add_argument("--no-detect", action="store_true")
    parser.add_argument("--no-figures", action="store_true")
    given = parser.parse_args(arguments)
    signal.alarm(round(LONGEST_S))  # ends it also where the batch that would has died
    os.nice(NICENESS)
    report = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is not the report
    job = PostprocessJob(given.journal, not given.no_figures, not given.no_detect)
    figures: list[str] = []

    def begins(made: PostprocessResult, figure: str) -> None:
        if not figures:  # ends it also where a library is busy in C, with the traceback in the log
            faulthandler.dump_traceback_later(TIMEOUT_S + GRACE_S, exit=True)
        figures.append(figure)
        report.write(made.as_line(figure))
        report.flush()

    report.write(make_files(job, begins).as_line())
    report.close()


if __name__ == "__main__":
    main(sys.argv[1:])
    sys.stderr.flush()
    os._exit(0)  # without the threads that a figure, analysis or detector has left
