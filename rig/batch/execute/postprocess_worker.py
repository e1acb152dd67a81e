"""The worker behind `rig.batch.execute.postprocess`: one run after the other.

``python -m rig.batch.execute.postprocess_worker`` takes the steward's jobs on its standard input
and answers each on its standard output. It ends with its input. Priority and threads are what the
steward gives it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

from rig.batch.execute.postprocess import Answer, Job, job_of
from rig.core.errors import RigError


def work_on(job: Job) -> Answer:
    """Compile a run's journal where there still is one, then draw and detect what was asked for.

    What can be done without the rest is done; what could not is in the answer. Nothing raises.
    """
    try:
        file = _run_file(job.journal)
    except Exception as error:  # noqa: BLE001 - a bug costs one file, not the others
        return Answer(job.journal, error=_told(error))
    warnings: list[str] = []
    figures: tuple[Path, ...] = ()
    processed: Path | None = None
    with _telling(warnings, f"{file.name}: not drawn"):
        has_points, has_strips = _kind_of(file)
        if job.detect and has_points and has_strips:
            with _telling(warnings, f"{file.name}: not judged by the detector"):
                processed, told = _detect(file)
                warnings += told
        if job.figures and has_points:
            from rig.figures.drawing import draw

            drawn = draw(file)
            figures = drawn.files
            warnings += [f"{file.name}: {warning}" for warning in drawn.warnings]
    return Answer(job.journal, file, processed, figures, tuple(warnings))


@contextlib.contextmanager
def _telling(warnings: list[str], what: str) -> Iterator[None]:
    """A step that fails is told and does not stop the next one."""
    try:
        yield
    except Exception as error:  # noqa: BLE001 - a bug costs its step
        warnings.append(f"{what}: {_told(error)}")


def _run_file(journal: Path) -> Path:
    """The run's file, compiled if its journal is still there."""
    from rig.files.naming import RUN_SUFFIX
    from rig.files.runfile.compile import compile_run

    file = journal.with_suffix(RUN_SUFFIX)
    if file.exists() and not journal.exists():
        return file
    return compile_run(journal, retire=True)


def _kind_of(file: Path) -> tuple[bool, bool]:
    """Whether a run file has points, and whether it has the strips' signals."""
    from rig.files.runfile.reader import RunFile
    from rig.processing.detection import stream_of_strips

    with RunFile.open(file) as run:
        return bool(run.point_ids()), stream_of_strips(run.header.layout) is not None


def _detect(file: Path) -> tuple[Path | None, list[str]]:
    """The processed file beside a run file, as ``rig detect`` makes it, and what is to be told."""
    from rig.detector import DEFAULT_DETECTOR
    from rig.detector.settings import named_detectors
    from rig.processing import detection

    found = detection.detect_file(detection.Job(file, named_detectors()[DEFAULT_DETECTOR]))
    if isinstance(found, detection.Failure):
        return None, [found.error().one_line()]
    return found.file, list(found.warnings)


def _told(error: Exception) -> str:
    return error.one_line() if isinstance(error, RigError) else f"{type(error).__name__}: {error}"


def main() -> None:
    """Serve jobs until there are no more."""
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever a library prints is no answer
    for line in sys.stdin:
        answers.write(work_on(job_of(line)).as_line())
        with contextlib.suppress(BrokenPipeError):  # the steward was killed: the input ends, too
            answers.flush()
        gc.collect()  # figures hold each other


if __name__ == "__main__":
    main()
