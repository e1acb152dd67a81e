"""Plan, run and watch many runs from one file, usually overnight."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from rig.cli.commands import batch_plan
from rig.cli.options.shared import RESULTS, AsJson, BatchBench, BatchPath, Debug
from rig.cli.outcome import print_json, reported, say, start_log
from rig.core.errors import ConfigurationError, RigError
from rig.core.text import in_shell

if TYPE_CHECKING:
    from rig.batch.folder import BatchFolder
    from rig.batch.queue import Queue
    from rig.batch.queue_records import RunState
    from rig.batch.report.status import BatchStatus


app = typer.Typer(
    name="batch",
    help=(__doc__ or "").split("\n", 1)[0],
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Folder = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of the batch.  [default: the one running in the results, otherwise the "
        "latest]",
        metavar="FOLDER",
    ),
]
FolderToResume = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of the batch.  [default: the latest in the results, unless a different one is "
        "running]",
        metavar="FOLDER",
    ),
]
FolderToRebuild = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of the batch.  [default: the latest in the results that is not running]",
        metavar="FOLDER",
    ),
]
Results = Annotated[
    Path, typer.Option(help="Folder of results that contains the batch.", metavar="FOLDER")
]
WATCH_S = 1.0
UNHEARD_S, UNHEARD_NOW_S, HEARD_CHECK_S = 5.0, 1.0, 0.05
"""Time in s after which a supervisor, which looks for requests every 0.1 s, is taken to be stopped
or to hang; the same for a stop at once, which does no harm if it comes twice; and the interval at
which it is checked whether it has taken them."""
ANSWER_S = 10.0
"""Longest time in s that a command waits for the folder of a batch."""

_Found = TypeVar("_Found")


app.command()(batch_plan.plan)
app.command()(batch_plan.schema)


@app.command()
def run(
    file: BatchPath, bench: BatchBench = None, as_json: AsJson = False, debug: Debug = False
) -> None:
    """Run a batch. Ctrl-C stops it safely."""
    with reported(debug, as_json):
        from datetime import datetime

        from rig.batch.execute.prepare import prepare
        from rig.batch.execute.start import begin
        from rig.core.units import counted, time_span

        now = datetime.now().astimezone()
        prepared = prepare(file, bench, now, say)
        folder = begin(file, prepared, datetime.now().astimezone())
        forecast = prepared.forecast
        takes = f"about {time_span(forecast.duration_s)} ± {time_span(forecast.spread_s)}"
        if prepared.bench is None:
            takes += " of virtual time"
        else:
            takes += f", until {forecast.ends.astimezone():%Y-%m-%d %H:%M:%S} local time"
        say(f"batch {folder.path}: {counted(len(prepared.plan.runs), 'run')}, {takes}")
        _supervise(folder, as_json)


@app.command()
def resume(
    folder: FolderToResume = None,
    results: Results = RESULTS,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Queue failed and left-out runs again.")
    ] = False,
    despite_changes: Annotated[
        bool,
        typer.Option("--despite-changes", help="Continue although files or program changed."),
    ] = False,
    unattended: Annotated[
        bool,
        typer.Option(
            "--unattended",
            help="For a service: a batch that was paused or held keeps waiting for a person.",
        ),
    ] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Continue a batch.

    It may have been stopped, interrupted, paused or held.
    """
    with reported(debug, as_json):
        from rig.batch.execute.batch_clock import renew_window
        from rig.batch.execute.start import refuse_changes, refuse_missing
        from rig.batch.folder import folder_to_resume
        from rig.batch.plan.settings import BatchFile
        from rig.batch.queue import Queue
        from rig.batch.queue_records import WAITS_FOR_A_PERSON
        from rig.batch.report.status import status_of
        from rig.batch.running import require_own
        from rig.core.units import counted

        found = folder_to_resume(folder, results)
        with Queue.open(found.queue) as queue:
            if found.is_held("supervisor"):
                require_own(found)
                if unattended:
                    raise ConfigurationError(
                        f"batch {found.path} is running already",
                        "leave it to the terminal or service that runs it, or stop it first",
                    )
                if retry_failed or despite_changes:
                    raise ConfigurationError(
                        f"batch {found.path} is running: --retry-failed and --despite-changes are "
                        "for a batch that has ended",
                        f"stop it first: rig batch stop {in_shell(found.path)}",
                    )
                status = status_of(found, running=True)
                state = status.state
                queue.add_request("go")
                if as_json:
                    print_json(status.as_object())
                if state.startswith(("paus", "held")):
                    say(f"batch {found.path}: resumed")
                else:
                    say(
                        f"batch {found.path} is neither paused nor held ({state}); it continues, "
                        "and a stop that was requested is not withdrawn"
                    )
                return
            if despite_changes:
                queue.set_meta("despite changes", "yes")
            else:
                refuse_changes(queue, BatchFile.model_validate_json(queue.meta("file")))
                lost: tuple[RunState, ...] = ("failed", "set-aside") if retry_failed else ()
                refuse_missing(queue, ("queued", "running", *lost))
            if retry_failed:
                say(f"{counted(queue.put_back(), 'run')} queued again")
            if not unattended:
                queue.set_meta(WAITS_FOR_A_PERSON, "")
            renew_window(queue)
        _supervise(found, as_json)


@app.command()
def rebuild(
    folder: FolderToRebuild = None,
    file: Annotated[
        Path | None,
        typer.Option(help="Batch file, if it was moved.", metavar="FILE"),
    ] = None,
    bench: BatchBench = None,
    results: Results = RESULTS,
    debug: Debug = False,
) -> None:
    """Rebuild the queue of a batch.

    Where the queue is damaged, it is made from the batch file and the files of the runs.
    """
    with reported(debug):
        from datetime import datetime

        from rig.batch.execute.rebuild import rebuild as make_again
        from rig.batch.folder import folder_to_rebuild
        from rig.batch.report.status import status_of

        found = folder_to_rebuild(folder, results)
        counts = make_again(found, file, bench, datetime.now().astimezone(), say)
        states = ", ".join(f"{n} {state}" for state, n in counts.items() if n)
        say(f"the queue of {found.path} was rebuilt: {states}")
        for line in status_of(found).to_continue():
            say(line)


@app.command()
def pause(folder: Folder = None, results: Results = RESULTS, debug: Debug = False) -> None:
    """Make the bench safe and wait.

    `rig batch resume` continues, and measures the interrupted point again.
    """
    _request("pause", "pausing", folder, results, debug)


@app.command()
def stop(
    folder: Folder = None,
    results: Results = RESULTS,
    now: Annotated[
        bool, typer.Option("--now", help="Stop at once; the point under way is discarded.")
    ] = False,
    after_run: Annotated[
        bool,
        typer.Option(
            "--after-run", help="Stop after the run under way instead of after its point."
        ),
    ] = False,
    this_run: Annotated[
        bool,
        typer.Option("--this-run", help="End the run under way at once; the batch continues."),
    ] = False,
    debug: Debug = False,
) -> None:
    """Stop safely after the current point.

    `rig batch resume` continues the batch.
    """
    if now + after_run + this_run > 1:
        raise typer.BadParameter("--now, --after-run and --this-run exclude each other")
    if this_run:
        _request("stop-run", "stopping this run only", folder, results, debug)
        return
    when = "now" if now else "after-run" if after_run else "after-point"
    shown = {"now": "now", "after-run": "after this run", "after-point": "after this point"}[when]
    _request(f"stop-{when}", f"stopping {shown}", folder, results, debug)


@app.command()
def status(
    folder: Folder = None,
    results: Results = RESULTS,
    watch: Annotated[
        bool, typer.Option("--watch", help="Refresh every second until Ctrl-C.")
    ] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Show the progress of a batch, from any terminal."""
    with reported(debug, as_json):
        found = folder
        while True:
            try:
                shown = _answered(folder, results, partial(_status, found, results))
            except FolderSilentError as silent:
                if not watch:
                    raise
                say(f"warning: {silent.message}")  # disks spin up, and shares come back
                continue
            _show(shown, as_json, watch)
            if not watch:
                return
            found = shown.folder.path
            time.sleep(WATCH_S)


def _status(folder: Path | None, results: Path) -> BatchStatus:
    from rig.batch.folder import find_folder
    from rig.batch.report.status import status_of

    return status_of(find_folder(folder, results))


def _show(status: BatchStatus, as_json: bool, again: bool) -> None:
    if as_json:
        print_json(status.as_object())
        return
    import sys

    if again and sys.stdout.isatty():
        print("\033[H\033[2J", end="")  # noqa: T201 - a terminal begins again
    print("\n".join(status.lines()), flush=True)  # noqa: T201 - stdout carries data


def _request(command: str, shown: str, folder: Path | None, results: Path, debug: bool) -> None:
    with reported(debug):
        from rig.batch.queue_file import QueueWriteError

        now = command == "stop-now"
        within_s = UNHEARD_NOW_S if now else UNHEARD_S
        try:
            found, heard, error = _answered(
                folder, results, partial(_leave, command, folder, results, within_s), within_s
            )
        except (FolderSilentError, OSError) as silent:
            if not now:
                raise
            found = _stop_without_the_disk(folder or results, silent)
        else:
            if error is None:
                if not heard:
                    _ask_the_worker(found, command, within_s)
            elif now:
                _stop_by_signal(found, error)
            else:
                full = isinstance(error, QueueWriteError)
                hint = "free some disk space and ask again" if full else error.hint or "ask again"
                without = "rig batch stop --now works without the queue"
                raise RigError(error.message, f"{hint}; {without}", error.code) from error
        say(f"batch {found.path}: {shown}")


def _leave(
    command: str, folder: Path | None, results: Path, within_s: float
) -> tuple[BatchFolder, bool, RigError | None]:
    """Leave a request for the supervisor of a batch. Return the batch, whether its supervisor has
    taken the request within a time, and the error of a queue that takes none."""
    from rig.batch.folder import find_folder
    from rig.batch.queue import Queue
    from rig.batch.queue_file import QueueWriteError
    from rig.batch.report.status import status_of
    from rig.batch.running import require_own

    found = find_folder(folder, results)
    if not found.is_held("supervisor"):
        status = status_of(found, running=False)
        raise ConfigurationError(
            f"batch {found.path} is not running ({status.state})",
            "; ".join(status.to_continue()) or "it has ended",
        )
    require_own(found)
    try:
        with Queue.open(found.queue) as queue:
            queue.add_request(command)
            return found, _is_heard(found, queue, within_s), None
    except (QueueWriteError, ConfigurationError) as error:  # a full disk; a damaged queue
        return found, False, error


class FolderSilentError(RigError):
    """Raised where the folder of a batch, or of results, does not answer."""


def _answered(
    folder: Path | None, results: Path, work: Callable[[], _Found], more_s: float = 0.0
) -> _Found:
    """Return the result of work in the folder of a batch or of results; it may take `ANSWER_S`, and
    `more_s` for what it waits for there. Raises FolderSilentError after that: no signal reaches a
    process that waits for a disk that has stalled, or for a network share that is away."""
    from rig.core.apart import GivenUpError, result_within

    try:
        return result_within(ANSWER_S + more_s, work)
    except GivenUpError:
        later = "; the request may still be carried out once it answers" if more_s else ""
        raise FolderSilentError(
            f"{folder or results} did not answer for {ANSWER_S + more_s:g} s: its disk has "
            f"stalled, or its network share is away{later}",
            "what works without it: Ctrl-C in the terminal of the batch, rig batch stop --now, "
            "rig make-safe",
        ) from None


def _stop_without_the_disk(place: Path, silent: FolderSilentError | OSError) -> BatchFolder:
    """Stop a batch at once whose folder does not answer, or with an error only; return it."""
    from rig.batch.folder import QUEUE
    from rig.batch.running import stop_without_the_disk
    from rig.run.locks.lock_holder import NotStoppedError

    trouble = silent.message if isinstance(silent, FolderSilentError) else f"{place}: {silent}"
    try:
        found = stop_without_the_disk(place.parent if place.name == QUEUE else place)
    except NotStoppedError as error:
        raise RigError(f"{trouble}; not stopped: {error.message}", error.hint) from error
    say(f"warning: {trouble}; the process that runs the batch was asked directly")
    return found


def _is_heard(folder: BatchFolder, queue: Queue, within_s: float) -> bool:
    """Return whether the supervisor of a batch has taken the requests, or has ended instead, within
    a time. One that is stopped (Ctrl-Z) takes none, while its worker still takes the run under
    way."""
    give_up_s = time.monotonic() + within_s
    while queue.has_requests() and folder.is_held("supervisor"):
        if time.monotonic() > give_up_s:
            return False
        time.sleep(HEARD_CHECK_S)
    return True


def _ask_the_worker(folder: BatchFolder, command: str, within_s: float) -> None:
    """Stop the worker of a batch at once whose supervisor has taken no request within a time.
    Raises RigError for any other request: it is the supervisor's to pass on."""
    from rig.run.locks.lock_holder import NotStoppedError, ask_to_stop

    why = f"its supervisor took no request for {within_s:g} s: it is stopped (Ctrl-Z) or hangs"
    let_go = "let it continue, for example by fg in its terminal: it then takes the request"
    if command != "stop-now":
        raise RigError(
            f"batch {folder.path}: {why}", f"{let_go}; rig batch stop --now does not need it"
        )
    try:
        ask_to_stop(folder.worker_lock)
    except NotStoppedError as error:
        raise RigError(f"batch {folder.path}: {why}; {error.message}", let_go) from error
    say(f"warning: {why}; the process that has the bench was asked to stop instead")


def _stop_by_signal(folder: BatchFolder, why: RigError) -> None:
    """Stop a batch at once whose queue does not take the request, for the reason `why`."""
    from rig.run.locks.lock_holder import NotStoppedError, ask_to_stop

    try:
        ask_to_stop(folder.supervisor_lock)
    except NotStoppedError as error:
        raise ConfigurationError(
            f"batch {folder.path} could not be asked to stop: {why.message}",
            "give the command on the computer and as the user that runs the batch",
        ) from error


def _supervise(folder: BatchFolder, as_json: bool) -> None:
    """Run a batch to its end, report it, and end with its exit code."""
    import sqlite3

    from rig.batch.execute.supervisor import Supervisor
    from rig.batch.report.status import status_of
    from rig.cli.streams import LinesInTurn, say_at_once
    from rig.run.stopping import StopFlag

    with ExitStack() as stack:
        stop = stack.enter_context(StopFlag(say_at_once))
        start_log(folder.path)
        supervisor = Supervisor(folder, stop, stack.enter_context(LinesInTurn(say)).say)
        code = supervisor.run()
    shown: dict[str, object] = {"folder": str(folder.path)}
    try:
        ended = status_of(folder)
    except (RigError, sqlite3.Error) as error:  # the bench and the exit code are known all the same
        why = error.one_line() if isinstance(error, RigError) else f"{folder.queue}: {error}"
        lines = [f"warning: the status of the batch cannot be read: {why}"]
        lines += [supervisor.bench] if supervisor.bench else []
    else:
        shown, lines = ended.as_object(), ended.closing_lines(supervisor.bench)
    if as_json:
        print_json(shown | {"exit": int(code)})
    for line in lines:
        say(line)
    raise typer.Exit(int(code))
