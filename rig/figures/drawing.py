"""Draw the registered figures of a file, in this or in a child process.

`draw` draws them; `DrawingProcess` has ``python -m rig.figures`` call it, so that a figure that
crashes or does not end cannot harm a finished run.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rig.core.errors import RigError, is_stop
from rig.core.file_entry_points import FIGURES, PROCESSED, strays
from rig.core.quiet_stdout import quiet_stdout
from rig.core.time_limit import time_limit
from rig.figures.registry import RegisteredFigure, figures_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TIMEOUT_S = 120.0
"""Longest time for all figures of a file; those of a sweep take two seconds of processor time."""
GRACE_S = 10.0
"""Time after which a process is ended that is still busy when the time for its figures is over: in
a library's C code nothing else ends it."""
SLOW_S = 3.0
"""Time after which the person who waits is informed."""


@dataclass(frozen=True)
class Drawn:
    """The figures drawn of a file, one sentence for each figure that could not be drawn, and the
    tracebacks of those that failed."""

    files: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    tracebacks: tuple[str, ...] = ()

    def as_line(self, drawing: str = "") -> str:
        """Return this as a line of JSON; `drawing` names the figure that is drawn next."""
        return json.dumps({**asdict(self), "drawing": drawing}, default=str) + "\n"


def draw(
    file: Path,
    folder: Path | None = None,
    pdf: bool = False,
    begins: Callable[[Drawn, str], None] = lambda drawn, figure: None,
) -> Drawn:
    """Draw all registered figures of a run file or processed file as PNG and SVG, and as PDF where
    that is asked for.

    They are written to `folder`, or next to the file. A run without a completed point has no
    figures. A figure that fails or takes too long, and a folder that cannot be written to, are
    warnings. `begins` is called before each figure with what has been drawn and the figure's name.
    Raises RunFileError if the file itself cannot be read.
    """
    with ExitStack() as stack:
        opened, kind, simulated = _open(file, stack)
        if not kind:
            return Drawn()
        drawing = _Drawing(file if folder is None else folder / file.name, simulated, pdf)
        drawing.warnings += strays(FIGURES, (kind,))
        try:
            for registered in figures_of(kind):
                begins(drawing.drawn, str(registered))
                drawing.add(registered, opened)
        except _NoPlaceError as error:
            drawing.warnings.append(error.message)
        return drawing.drawn


class DrawingProcess:
    """A child process that draws the figures of one file, or of none.

    It is started before its file exists, because importing matplotlib takes as long as drawing a
    figure: while a run takes its points, there is time for it. The process runs with low priority.
    Its only tie to this process is its standard input, so that it ends when this process does.
    """

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None
        self._why_not = ""
        command = [sys.executable, "-P", "-m", "rig.figures"]
        try:
            self._child = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,  # Ctrl-C at the terminal ends the run, not its figures
            )
        except OSError as error:
            self._why_not = f"{error.strerror}: {command[0]}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process if it was not asked to draw."""
        if self._child is not None and self._child.returncode is None:
            self._kill()
            self._child.communicate()

    def draw(self, file: Path, slow: Callable[[], None] = lambda: None) -> Drawn:
        """Draw all figures of a file; any failure of the process becomes a warning.

        `slow` is called once where it takes longer than `SLOW_S`. A `LeaveOutError`, which a
        signal's handler may raise, ends the drawing; what has been drawn is returned.
        """
        again = f"`rig show --figures {file}` draws them again"
        if self._child is None:
            return Drawn(warnings=(f"no figure was drawn: {self._why_not}; {again}",))
        why = ""
        try:
            try:
                answered, said = self._child.communicate(json.dumps(str(file)) + "\n", SLOW_S)
            except subprocess.TimeoutExpired:
                slow()
                answered, said = self._child.communicate(timeout=TIMEOUT_S + GRACE_S - SLOW_S)
        except subprocess.TimeoutExpired:
            why = f"it took longer than {TIMEOUT_S + GRACE_S:g} s"
        except LeaveOutError as error:
            why = error.message
        if why:
            self._kill()
            answered = said = ""
            with contextlib.suppress(subprocess.TimeoutExpired):  # what it has started may live on
                answered, said = self._child.communicate(timeout=GRACE_S)
        drawn, drawing, ended = _last_of(answered)
        if ended and not why:
            return drawn
        if not why:
            last = said.strip().splitlines()[-1:]
            code = self._child.returncode
            why = "the process that draws ended early "
            why += f"({last[0] if last else f'exit code {code}'})"
        what = f"{drawing} and those after it were not drawn" if drawing else "no figure was drawn"
        return replace(drawn, warnings=(*drawn.warnings, f"{what}: {why}; {again}"))

    def _kill(self) -> None:
        """End the process with all that a figure has started."""
        assert self._child is not None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._child.pid, signal.SIGKILL)


class LeaveOutError(RigError):
    """Raised by a signal's handler to end the wait for figures."""


def _last_of(answered: str) -> tuple[Drawn, str, bool]:
    """Return what a process has drawn, the figure that it was drawing, and whether it has come to
    its end, from the lines of its output, of which the last may be cut off."""
    for line in reversed(answered.splitlines()):
        with contextlib.suppress(ValueError, KeyError, TypeError):
            found = json.loads(line)
            texts = (tuple(found[name]) for name in ("warnings", "tracebacks"))
            drawn = Drawn(tuple(map(Path, found["files"])), *texts)
            return drawn, found["drawing"], not found["drawing"]
    return Drawn(), "", False


class _NoPlaceError(RigError):
    """Raised if the folder cannot be written to, so that no further figure is tried."""


class _Drawing:
    """The pictures of one file."""

    def __init__(self, place: Path, simulated: bool, pdf: bool):
        """Prepare the pictures, which are named after the file `place` and go to its folder; `pdf`
        is whether there is a PDF of each."""
        self.files: list[Path] = []
        self.warnings: list[str] = []
        self._tracebacks: list[str] = []
        self._until_s = time.monotonic() + TIMEOUT_S
        self._place, self._simulated, self._pdf = place, simulated, pdf
        self._suffixes: set[str] = set()

    @property
    def drawn(self) -> Drawn:
        """What has been drawn so far."""
        return Drawn(tuple(self.files), tuple(self.warnings), tuple(self._tracebacks))

    def add(self, registered: RegisteredFigure, opened: Any) -> None:
        """Draw one registered figure; an exception of it becomes a warning."""
        left_s = self._until_s - time.monotonic()
        if left_s <= 0:
            limit = f"the {TIMEOUT_S:g} s for all figures of a file were over"
            self._warn(f"{registered} was left out: {limit}")
            return
        try:
            with time_limit(left_s), quiet_stdout():
                self._add(registered, opened)
        except _NoPlaceError:
            raise
        # A package may raise anything, and call sys.exit() where it was meant as a program.
        except (Exception, SystemExit) as error:
            if is_stop(error):
                raise
            self._warn(f"{registered} could not be drawn: {registered.fault(error)}")
            self._tracebacks.append("".join(traceback.format_exception(error)))

    def _add(self, registered: RegisteredFigure, opened: Any) -> None:
        for suffix, figure in figures_by(registered, opened).items():
            if suffix in self._suffixes:
                self._warn(f"{registered} was left out: another figure has its file name")
            else:
                self._suffixes.add(suffix)
                self._save(figure, suffix)

    def _save(self, figure: Figure, suffix: str) -> None:
        from rig.figures.style import save

        place = self._place.with_stem(self._place.stem + suffix)
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            self.files += save(figure, place, self._simulated, self._pdf)
        except OSError as error:
            raise _NoPlaceError(
                f"no figure was drawn: {place.parent} cannot be written to "
                f"({error.strerror or error}); `rig show --figures-to FOLDER` draws them into "
                "another folder"
            ) from error

    def _warn(self, text: str) -> None:
        self.warnings.append(text)


def _open(file: Path, stack: ExitStack) -> tuple[Any, str, bool]:
    """Return the open file, the kind of its figures (empty if there is nothing to draw), and
    whether it comes from a simulated bench."""
    from rig.files.processed.reader import ProcessedFile, is_processed
    from rig.files.runfile.reader import RunFile

    if is_processed(file):
        processed = stack.enter_context(ProcessedFile.open(file))
        return processed, PROCESSED, bool(processed.source.simulated)
    run = stack.enter_context(RunFile.open(file))
    kind = run.header.procedure if run.point_ids() else ""
    return run, kind, bool(run.outcome.simulated)


def figures_by(registered: RegisteredFigure, opened: Any) -> dict[str, Figure]:
    """Return the figures that the registered function draws of an open file, or of several, by the
    suffix of each file name. Raises whatever the function raises, TypeError for what is not a
    figure, and ValueError for what is not a suffix."""
    from matplotlib.figure import Figure

    given = registered.load()(opened)
    figures = {}
    for suffix, figure in (given if isinstance(given, Mapping) else {"": given}).items():
        if not isinstance(figure, Figure):
            raise TypeError(f"it returned {type(figure).__name__} where a Figure is expected")
        if not isinstance(suffix, str) or Path(f"x{suffix}").name != f"x{suffix}":
            raise ValueError(f"{suffix!r} cannot be a part of a file name")
        figures[registered.suffix + suffix] = figure
    return figures
