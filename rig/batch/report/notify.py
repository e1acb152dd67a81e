"""Telling people how a batch goes, without ever disturbing it.

A thread of its own delivers one notification after the other, each by child processes that have a
deadline and are killed at it: the user's command, and one for the addresses that apprise serves.
What goes wrong is a line in the log and a warning to be collected; nothing is raised.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from rig.batch.plan.settings import Notify, Occasion
from rig.core.errors import ConfigurationError

PATIENCE_S = 10.0
"""How long a command, or all addresses together, may take for one notification."""
REAPED_S = 1.0
"""What is waited for a killed process to be gone."""
MOST_WAITING = 100
"""Notifications; more only come where nothing is delivered."""
LONGEST = 4000
"""Characters of a text: a program's arguments are limited, and so is a person's patience."""

log = logging.getLogger("rig")


@dataclass(frozen=True)
class Notification:
    """What is told."""

    occasion: Occasion
    title: str
    text: str
    time: str
    """ISO 8601, with time zone."""
    details: Mapping[str, Any]

    def as_json(self, **more: Any) -> str:
        """It as one JSON object; a detail that JSON does not know becomes text."""
        return json.dumps({**vars(self), **more}, default=str)


def require_usable(settings: Notify) -> None:
    """ConfigurationError where a notification could never be delivered: the extra ``notify`` or the
    command is missing, or an address is none that apprise knows. Nothing is sent."""
    if settings.command and shutil.which(settings.command[0]) is None:
        raise ConfigurationError(
            f"notify.command: {settings.command[0]!r} is not found, or no program",
            "give its whole path, and make it executable",
        )
    if not settings.urls:
        return
    if importlib.util.find_spec("apprise") is None:
        raise ConfigurationError(
            "notify.urls: apprise, which serves these addresses, is not installed",
            'install it with `uv pip install "tactile-rig[notify]"` or '
            '`pip install "tactile-rig[notify]"`, or give a notify.command',
        )
    import apprise

    for number, url in enumerate(settings.urls, 1):
        if apprise.Apprise.instantiate(url) is None:  # the address itself may hold a password
            raise ConfigurationError(
                f"notify.urls: address {number} ({_scheme(url)}) is none that apprise understands",
                "see the addresses in apprise's documentation: SCHEME://...",
            )


class Notifier:
    """Delivers notifications in the order in which they are told."""

    def __init__(self, settings: Notify, patience_s: float = PATIENCE_S):
        self._settings, self._patience_s = settings, patience_s
        self._waiting: queue.Queue[Notification | None] = queue.Queue(MOST_WAITING)
        self._warnings: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._deliver, name="notifier", daemon=True)
        if settings.urls or settings.command:
            self._thread.start()

    def tell(
        self, occasion: Occasion, title: str, text: str, details: Mapping[str, Any] | None = None
    ) -> None:
        """Have people told, if they want to be on this occasion; returns at once."""
        if occasion not in self._settings.on or not self._thread.is_alive():
            return
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        told = Notification(occasion, _plain(title), _plain(text), now, dict(details or {}))
        try:
            self._waiting.put_nowait(told)
        except queue.Full:
            self._warn(f"{told.title!r} was not told: {MOST_WAITING} are waiting already")

    def warnings(self) -> list[str]:
        """What has gone wrong since the last call."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._warnings.get_nowait())
        return found

    def close(self, within_s: float = 3 * PATIENCE_S) -> list[str]:
        """Wait until everything is delivered, so long at most; `warnings`, and what was given
        up."""
        if self._thread.is_alive():
            with contextlib.suppress(queue.Full):
                self._waiting.put(None, timeout=within_s)
            self._thread.join(within_s)
            if self._thread.is_alive():
                self._warn(f"what was still to be told was given up after {within_s:g} s")
        return self.warnings()

    def _deliver(self) -> None:
        while (told := self._waiting.get()) is not None:
            settings = self._settings
            if settings.command:
                self._run("notify.command", (*settings.command, told.title, told.text), told)
            if settings.urls:
                program = (sys.executable, "-P", "-m", "rig.batch.report.apprise_sender")
                self._run("notify.urls", program, told, urls=settings.urls)

    def _run(self, what: str, program: Sequence[str], told: Notification, **more: Any) -> None:
        try:
            failure = _failure_of(program, told.as_json(**more), self._patience_s)
        except (OSError, ValueError, TypeError) as error:
            failure = str(error)
        if failure:
            self._warn(f"{what}: {told.title!r} was not told: {failure}")

    def _warn(self, text: str) -> None:
        log.warning("%s", text)
        self._warnings.put(text)


def _failure_of(program: Sequence[str], given: str, patience_s: float) -> str:
    """Run a program with `given` on its standard input; what went wrong, "" if nothing did.

    It has a session of its own, so that no Ctrl-C ends it and what it has started can be ended with
    it.
    """
    process = subprocess.Popen(
        program,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    begun_s = time.monotonic()
    try:
        _, complaint = process.communicate(given, timeout=patience_s)
    except subprocess.TimeoutExpired:
        _end(process)
        return f"no end after {time.monotonic() - begun_s:.0f} s, killed"
    if process.returncode == 0:
        return ""
    said = complaint.strip().splitlines()[-1:]
    return ": ".join([f"exit code {process.returncode}", *said])


def _end(process: subprocess.Popen[str]) -> None:
    """Kill it and what it has started; whoever else holds its pipes is not waited for."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.communicate(timeout=REAPED_S)
    for pipe in (process.stdin, process.stderr):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


def _plain(text: str) -> str:
    """A text that can be a program's argument."""
    text = text.replace("\0", " ")
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def _scheme(url: str) -> str:
    """What of an address may be shown."""
    scheme, found, _ = url.partition("://")
    return f"{scheme[:20]}://..." if found else "without a scheme"
