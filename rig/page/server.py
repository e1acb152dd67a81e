"""The server of the page: what a browser may ask for, and what it gets.

    /                     the page; /static/NAME its parts. They hold no data and need no token
    GET  /api/live        server-sent events: a frame at most `rate_Hz` times a second
    GET  /api/night       the latest batch, and the age of this answer
    GET  /api/runs        the runs of the folder; /api/runs/ID one of them, /api/runs/ID/NAME a file
    POST /api/stop        {"what": "run", "run": UUID}, {"what": "night"}, {} without a choice, or
                          {"what": "again"} for a further press while a stop is under way
    POST /api/make-safe

Whatever changes something is a POST with the token that may stop. No part of a request becomes a
path of the file system: files are looked up among those of a run that was indexed.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rig.batch.folder import BatchFolder
from rig.batch.queue import Queue  # noqa: F401 - else the first STOP waits for its import
from rig.batch.running import ask_batch, batch_of, is_running
from rig.core.errors import RigError
from rig.core.json_text import finite, json_text
from rig.core.threads import start_thread
from rig.page.access import HEADERS, Access, AccessRefusedError
from rig.page.frames import Cursor, as_event, next_frame
from rig.page.history import RunIndex
from rig.page.in_time import NotInTimeError, in_time
from rig.page.night import night, running_batch
from rig.page.slips import SlipFollower
from rig.page.watch import DISK_S, BenchWatch, Stop
from rig.run.locks.lock_holder import (
    LockHolder,
    NotStoppedError,
    ask_to_stop,
    holder_by_path,
    holders_by_path,
)

log = logging.getLogger("rig")

STATIC = Path(__file__).with_name("static")
PARTS = {
    "page.js": "text/javascript; charset=utf-8",
    "page.css": "text/css; charset=utf-8",
    "uplot.js": "text/javascript; charset=utf-8",
    "uplot.css": "text/css; charset=utf-8",
    "uplot.LICENSE": "text/plain; charset=utf-8",
    "icon.svg": "image/svg+xml",
}
MOST_VIEWERS = 32
POLL_EVERY_S = 0.1
SLIPS_EVERY_S = 0.2
INDEX_EVERY_S = 2.0
LONGEST_LOOK_S = 5.0
"""Longest wait at the end for a look that is under way."""
NIGHT_EVERY_S = 4.0
"""Age in s up to which an answer about the batch is given to further viewers."""
STUCK_S = 60.0
"""Time after which a viewer that takes nothing is dropped."""
MOST_BODY_BYTES = 1024
MAKE_SAFE_S = 180.0
LONGEST_TURN_S = 10.0
"""Time after which what was asked for is not done any more: who asked has given up long before."""
LOOKS_FOR_END_EVERY_S = 0.1
ENDS_WITHIN_S = 0.5
"""Time for the last message to a viewer when the server ends."""
NICENESS = 10
"""Below a run: the page must not cost it ticks."""


@dataclass
class PageState:
    """What the server serves."""

    watch: BenchWatch
    index: RunIndex
    access: Access
    rate_Hz: float = 5.0
    viewers: int = 0
    polled_s: float = field(default_factory=time.monotonic)
    making_safe: threading.Lock = field(default_factory=threading.Lock)
    changes: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(4, "change"))
    """Threads for STOP alone: no reader of a slow disk keeps it waiting."""
    makes_safe: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(2, "make safe")
    )
    """Threads for making safe, one of which can always refuse: no STOP keeps it waiting."""
    night: dict[str, Any] | None = None
    """The latest answer about the batch, for all viewers."""
    night_s: float = -math.inf
    reading_night: threading.Lock = field(default_factory=threading.Lock)
    ending: Callable[[], bool] = lambda: False
    """Returns whether the server is to end: answers without an end then end as well."""


def application(state: PageState) -> ASGIApp:
    """Return the application, with the checks around it."""

    async def live(request: Request) -> Response:
        if state.viewers >= MOST_VIEWERS:
            return PlainTextResponse(f"{MOST_VIEWERS} viewers are watching already", 503)
        return _Live(state, request.scope["rig.right"] == "stop")

    async def night_of(_: Request) -> Response:
        found = await asyncio.to_thread(_night, state)
        return _json(found | {"age_s": round(time.monotonic() - state.night_s, 1)})

    async def runs(request: Request) -> Response:
        query = request.query_params
        names = ("procedure", "sample", "outcome")
        procedure, sample, outcome = (query.get(name, "")[:200] for name in names)
        found = await asyncio.to_thread(state.index.rows, procedure, sample, outcome)
        return _json(found)

    async def run(request: Request) -> Response:
        found = await asyncio.to_thread(state.index.detail, request.path_params["run"])
        if found is None:
            return PlainTextResponse("no run of this name in the results folder", 404)
        return _json(found)

    async def file(request: Request) -> Response:
        wanted = request.path_params
        found = await asyncio.to_thread(state.index.file, wanted["run"], wanted["name"])
        if found is None:
            return PlainTextResponse("the run has no such file", 404)
        return FileResponse(found[0], media_type=found[1], filename=wanted["name"])

    routes = [
        Route("/", _page),
        Route("/static/{name}", _part),
        Route("/api/live", live),
        Route("/api/night", night_of),
        Route("/api/runs", runs),
        Route("/api/runs/{run}", run),
        Route("/api/runs/{run}/{name}", file),
        Route("/api/stop", _changing(state, _stop, state.changes), methods=["POST"]),
        Route("/api/make-safe", _changing(state, _make_safe, state.makes_safe), methods=["POST"]),
    ]
    return _Checked(Starlette(routes=routes), state.access)


class _Checked:
    """Refuses what `Access` refuses, and adds the headers to every answer."""

    def __init__(self, app: ASGIApp, access: Access):
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = {name.lower().encode() for name in HEADERS}
                kept = [pair for pair in message["headers"] if pair[0].lower() not in own]
                added = [(name.lower().encode(), text.encode()) for name, text in HEADERS.items()]
                message["headers"] = kept + added
            await send(message)

        headers = {
            name.decode("latin-1"): text.decode("latin-1") for name, text in scope["headers"]
        }
        try:
            right = self._access.check(scope["method"], scope["path"], headers)
        except AccessRefusedError as refused:
            answer = PlainTextResponse(refused.reason, refused.status)
            await answer(scope, receive, send_with_headers)
            return
        scope["rig.right"] = right
        await self._app(scope, receive, send_with_headers)


class _Live(Response):
    """An endless answer of server-sent events. A frame is made when the one before was taken."""

    def __init__(self, state: PageState, may_stop: bool):
        super().__init__(media_type="text/event-stream")
        self._state, self._may_stop = state, may_stop
        del self.headers["content-length"]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        start = {"type": "http.response.start", "status": 200, "headers": self.raw_headers}
        await send(start)
        self._state.viewers += 1
        sending = asyncio.ensure_future(self._send_all(send))
        leaving = asyncio.ensure_future(_left(receive))
        ending = asyncio.ensure_future(self._ended())
        try:
            await asyncio.wait((sending, leaving, ending), return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._state.viewers -= 1
            for task in (sending, leaving, ending):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, TimeoutError, OSError):
                    await task
        if self._state.ending():  # else the server would cancel the answer, with a traceback
            with contextlib.suppress(TimeoutError, OSError):
                await asyncio.wait_for(send({"type": "http.response.body"}), ENDS_WITHIN_S)

    async def _ended(self) -> None:
        while not self._state.ending():
            await asyncio.sleep(LOOKS_FOR_END_EVERY_S)

    async def _send_all(self, send: Send) -> None:
        async for event in self._events():
            message = {"type": "http.response.body", "body": event, "more_body": True}
            await asyncio.wait_for(send(message), STUCK_S)

    async def _events(self) -> AsyncIterator[bytes]:
        cursor, state = Cursor(), self._state
        while True:
            frame = next_frame(
                state.watch, cursor, may_stop=self._may_stop, polled_s=state.polled_s
            )
            yield as_event(frame)
            await asyncio.sleep(1 / state.rate_Hz)


def _night(state: PageState) -> dict[str, Any]:
    """Return what is shown of the latest batch, read at most once in `NIGHT_EVERY_S` whatever the
    number of viewers."""
    if state.reading_night.acquire(blocking=state.night is None):
        try:
            if state.night is None or time.monotonic() - state.night_s >= NIGHT_EVERY_S:
                state.night = finite(night(state.watch.results))
                state.night_s = time.monotonic()
        finally:
            state.reading_night.release()
    return state.night or {}


def _json(content: Any, status: int = 200) -> Response:
    """Return an answer in JSON. It is ASCII, so that a message with a path that is not UTF-8 can be
    sent as well."""
    return Response(json_text(content), status, media_type="application/json")


async def _left(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


async def _page(_: Request) -> Response:
    return FileResponse(STATIC / "page.html", media_type="text/html; charset=utf-8")


async def _part(request: Request) -> Response:
    name = request.path_params["name"]
    if name not in PARTS:
        return PlainTextResponse("the page has no such address", 404)
    return FileResponse(STATIC / name, media_type=PARTS[name])


# --- what changes something ---------------------------------------------------------------------

Change = Callable[[PageState, dict[str, Any]], tuple[int, dict[str, Any]]]


def _changing(
    state: PageState, change: Change, threads: ThreadPoolExecutor
) -> Callable[[Request], Any]:
    """Return an endpoint that carries out a change for those who may, in one of the threads."""

    async def endpoint(request: Request) -> Response:
        if request.scope["rig.right"] != "stop":
            return _json({"problem": "This link is view-only."}, 403)
        body = b""
        async for chunk in request.stream():
            body += chunk
            if len(body) > MOST_BODY_BYTES:
                return _json({"problem": "the request is too long"}, 413)
        try:
            wanted = json.loads(body or b"{}")
        except (ValueError, RecursionError):
            wanted = None
        if not isinstance(wanted, dict):
            return _json({"problem": "the request is not a JSON object"}, 400)
        asked_s = time.monotonic()

        def in_turn() -> tuple[int, dict[str, Any]]:
            waited_s = time.monotonic() - asked_s
            if waited_s > LONGEST_TURN_S:  # what is at work now may be another run
                return 503, {
                    "problem": f"nothing was done: this request waited for {waited_s:.0f} s, since "
                    "earlier ones hang; press again, or end the run at its terminal"
                }
            return change(state, wanted)

        loop = asyncio.get_running_loop()
        status, answer = await loop.run_in_executor(threads, in_turn)
        return _json(answer, status)

    return endpoint


OVER = (
    "the run that was being stopped has ended, so this press stopped nothing; press again to stop "
    "what is at work now: in a batch its next run, or the whole of it"
)
"""Answer to a further press that came when the stop was over."""


def _stop(state: PageState, wanted: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """Stop the run or the night. A page that may not know of the batch yet makes no choice: where
    the run is one of a batch, that is the night, since otherwise the next run would follow. While a
    stop is under way a press without a choice only counts: it never widens what was chosen. A press
    that was meant for a stop under way stops nothing else where that is over by now."""
    what = wanted.get("what")
    if what not in (None, "run", "night", "again"):
        return 400, {"problem": f"stop what: run, night or again, not {what!r}"}
    watch = state.watch
    if what in (None, "again") and (stop := watch.press_again()) is not None:
        return 200, {"text": "it is stopping already", "presses": stop.presses}
    if what == "again":
        return 409, {"problem": OVER}
    journal = watch.path
    recording = journal is not None and watch.run_holder(journal) is not None
    own = _batch_of(watch, journal) if journal is not None and recording else None
    if what is None:
        what = "run" if recording and own is None else "night"
    if what == "night":
        return _stop_the_night(watch, own)
    header = watch.view.header
    if not recording and _a_batch_runs(watch):
        return 409, {
            "problem": "no run is under way: stop the whole batch, or wait for the next run"
        }
    if "run" in wanted and (header is None or wanted["run"] != header.run_uuid):
        return 409, {"problem": "that run has ended; another run is shown now"}

    def ask_for_this_run(path: Path) -> LockHolder:
        """Have the batch end its run: it has to know that it continues. Between the look above and
        this one the run may have ended: the bench's lock is then held for the next."""
        holder = watch.run_holder(path) if path == journal else None
        if holder is None or own is None:
            raise NotStoppedError("the run has ended already")
        request = "stop-run" if header is None else f"stop-run {header.run_number}"
        try:
            in_time(DISK_S, lambda: ask_batch(own, request))
        except NotInTimeError as error:
            raise NotStoppedError(
                f"it is not known whether the batch ends its run: {SILENT}",
                "stop the whole batch; the request may still be carried out",
            ) from error
        return holder

    try:
        stop = watch.ask_to_stop() if own is None else watch.ask_to_stop(ask_for_this_run)
    except RigError as error:
        return 409, {"problem": error.one_line()}
    return 200, _answer(stop)


SILENT = f"the disk of the results gave no answer within {DISK_S:g} s"


def _batch_of(watch: BenchWatch, journal: Path) -> BatchFolder | None:
    """Return the batch that takes a run under way. Of a run of this user the kernel knows it, and
    the disk is not asked."""
    real = watch.real(journal)
    if holder_by_path(real) is not None:
        batch = BatchFolder(real.parent.parent)
        return None if holder_by_path(batch.supervisor_lock) is None else batch
    try:
        return in_time(DISK_S, lambda: batch_of(journal))
    except NotInTimeError:
        return None


def _a_batch_runs(watch: BenchWatch) -> bool:
    try:
        return in_time(DISK_S, lambda: running_batch(watch.results)) is not None
    except NotInTimeError:
        return bool(_batches_by_path(watch.real(watch.results)))


def _batches_by_path(place: Path) -> list[BatchFolder]:
    """Return the batches of this user that run in a folder of results, or in their own folder,
    without the disk. `place` is a path without links."""
    locks = holders_by_path(BatchFolder(place).supervisor_lock.name)
    return [
        BatchFolder(lock.parent) for lock in locks if place in (lock.parent, lock.parent.parent)
    ]


def _ask_to_end(
    results: Path, own: BatchFolder | None, signalled: bool
) -> tuple[str | None, str | None]:
    """Ask the batch to end, `own` or the one that runs in the folder; return its name if it was
    asked, and why it could not be. `signalled` says that its process was asked already.

    Late it does no harm: a batch forgets the requests that were made to it before it began.
    """
    batch = own or running_batch(results)
    if batch is None:
        return None, None
    try:
        return ask_batch(batch, "stop-now"), None
    except (RigError, OSError, sqlite3.Error) as error:
        if signalled and not is_running(batch):  # it has ended, as it should
            return None, None
        why = error.one_line() if isinstance(error, RigError) else str(error)
        return None, f"the batch could not be asked to end: {why}"


def _signal_to_end(place: Path) -> tuple[str | None, str | None]:
    """Send SIGTERM to the supervisor of the batch in a folder whose disk does not answer; return as
    `_ask_to_end` does."""
    batches = _batches_by_path(place)
    if not batches:
        return None, None
    if len(batches) > 1:
        names = ", ".join(batch.path.name for batch in batches)
        return None, f"{SILENT}, and several batches run there: {names}; press Ctrl-C in theirs"
    try:
        ask_to_stop(batches[0].supervisor_lock, by_path=True)
    except NotStoppedError as error:
        return None, f"the batch could not be asked to end: {error.one_line()}"
    return batches[0].path.name, None


def _stop_the_night(watch: BenchWatch, own: BatchFolder | None) -> tuple[int, dict[str, Any]]:
    """Send the signal to the process that holds the bench, then ask the batch to end, `own` or the
    one that runs in the folder. Neither waits for the other to succeed: the queue of a batch may be
    damaged, its disk full or silent."""
    stop, problems = None, []
    try:
        stop = watch.ask_to_stop()
    except RigError as error:
        problems.append(error.one_line())
    signalled = stop is not None
    try:
        asked, problem = in_time(DISK_S, lambda: _ask_to_end(watch.results, own, signalled))
    except NotInTimeError:
        place = watch.real(watch.results) if own is None else own.path
        asked, problem = _signal_to_end(place)
    if problem is not None:
        problems.append(problem)
    if stop is None and asked is not None:  # it rests or waits, and holds no bench
        return 200, {"text": f"batch {asked} was asked to stop"}
    if stop is None:
        return 409, {"problem": "; ".join(problems)}
    return 200, _answer(stop) | ({"problem": "; ".join(problems)} if problems else {})


def _answer(stop: Stop) -> dict[str, Any]:
    again = stop.presses > 1
    text = "it is stopping already" if again else f"process {stop.holder.pid} was asked to stop"
    return {"text": text, "presses": stop.presses}


NOT_KNOWN_SAFE = "the bench is not known to be safe; switch it off by hand"


def _make_safe(state: PageState, _: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    watch, bench = state.watch, state.watch.signs.bench_file
    if bench is None:
        return 409, {"problem": "no bench file; start the page with --bench FILE"}
    if watch.holder is not None or watch.signs.holder is not None:
        return 409, {"problem": "a program holds the bench: stop it first"}
    if not state.making_safe.acquire(blocking=False):
        return 409, {"problem": "the bench is being made safe already"}
    try:
        done = subprocess.run(
            [
                *(sys.executable, "-c", "from rig.cli import main; main()"),
                *("make-safe", "--bench", str(bench)),
            ],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=MAKE_SAFE_S,
            start_new_session=True,  # Ctrl-C at the page's terminal is not meant for it
            check=False,
        )
    except subprocess.TimeoutExpired:
        text = f"make-safe of {bench} did not end within {MAKE_SAFE_S:g} s and was killed"
        return 500, {"problem": f"{text}: {NOT_KNOWN_SAFE}", "exit": None}
    except OSError as error:
        text = f"make-safe of {bench} could not be started: {error}"
        return 500, {"problem": f"{text}; {NOT_KNOWN_SAFE}", "exit": None}
    finally:
        state.making_safe.release()
    return 200, {"exit": done.returncode, "text": done.stderr[-2000:]}


# --- running it ---------------------------------------------------------------------------------


def serve(state: PageState, port: int, ready: Callable[[str], None]) -> None:
    """Serve until a signal comes. `ready` is given ``http://127.0.0.1:PORT/`` once it listens.

    Raises RigError if the port is not free.
    """
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(("127.0.0.1", port))
        listening.listen(128)
    except OSError as error:
        listening.close()
        raise RigError(
            f"--port {port}: cannot listen on 127.0.0.1:{port}: {error.strerror}",
            "another page may run; choose another port, or --port 0 for any free port",
        ) from error
    over = threading.Event()
    threads = [
        threading.Thread(target=work, args=(state, over), name=name, daemon=True)
        for name, work in (("watch", _watch), ("index", _index), ("slips", _slips))
    ]
    for thread in threads:
        start_thread(thread)
    server = uvicorn.Server(
        uvicorn.Config(
            application(state),
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=2,
            ws="none",
        )
    )
    state.ending = lambda: server.should_exit
    # A page that a script starts in the background inherits that Ctrl-C is ignored. The server ends
    # by it all the same, and then the page has to say so by its exit code.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    ready(f"http://127.0.0.1:{listening.getsockname()[1]}/")
    try:
        server.run(sockets=[listening])
    finally:
        over.set()
        listening.close()
        # Python would end them wherever they are: one that is reading a run file then would keep
        # h5py's lock for ever, and the page would hang instead of ending.
        for thread in threads:
            thread.join(LONGEST_LOOK_S)


def _watch(state: PageState, over: threading.Event) -> None:
    """Poll the watch. A fault of it is logged; the page then says that the state is unknown, since
    `polled_s` grows old."""
    while not over.wait(0.0 if state.watch.behind else POLL_EVERY_S):
        try:
            state.watch.poll()
            state.polled_s = time.monotonic()
        except Exception:
            log.exception("the page could not look at the bench")
            over.wait(1.0)


def _slips(state: PageState, over: threading.Event) -> None:
    follower, more = SlipFollower(state.watch), False
    while not over.wait(0.0 if more else SLIPS_EVERY_S):
        more = follower.look()
    follower.close()


def _index(state: PageState, over: threading.Event) -> None:
    more = True
    while not over.wait(0.05 if more else INDEX_EVERY_S):
        try:
            more = state.index.update()
        except Exception:
            log.exception("the runs cannot be listed")
            more = False
