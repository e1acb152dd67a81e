"""Notifies people of how a batch goes, without ever disturbing it.

Every message is delivered by one child process for each receiver: the user's command, and each
address that apprise serves (this module run as a program). A child that is not done in time is
killed, and the next one is started; what it writes is read up to a bound. Failures are lines in the
log and warnings to be collected; nothing is raised.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import resource
import shutil
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from rig.batch.plan.settings import NotifySettings, Occasion
from rig.core.child import Child
from rig.core.errors import ConfigurationError

LONGEST_S = 10.0
"""Time limit for one message to one receiver."""
MOST_WAITING = 100
"""Deliveries that may wait; there are more only where nothing is delivered."""
LONGEST = 4000
"""Characters of a title or text: a program's arguments are limited."""
LONGEST_REASON = 300
"""Characters of a receiver's complaint in a warning."""
MOST_MEMORY = 512 << 20
"""Bytes of memory of the process that reports to an address, which keeps all of the answer: an
endless one must not take the memory of a run."""
POLL_EVERY_S = 0.1
APPRISE_KINDS = {"start": "info", "failure": "failure", "hold": "warning", "end": "info"}
"""apprise's kind of notification by occasion."""

log = logging.getLogger("rig")


@dataclass(frozen=True)
class Notification:
    """A message to people about a batch."""

    occasion: Occasion
    title: str
    text: str
    time: str
    """ISO 8601, with time zone."""
    details: Mapping[str, Any]

    def as_json(self, **more: Any) -> str:
        """Return the message as one JSON object; a detail that JSON does not know becomes text."""
        return json.dumps({**vars(self), **more}, default=str)


@dataclass(frozen=True)
class _Delivery:
    """One message to one receiver."""

    receiver: str
    """Name of the address for messages: the address itself may contain a password."""
    program: tuple[str, ...]
    given: str
    """Text for the program's standard input."""
    title: str


def require_usable(settings: NotifySettings) -> None:
    """Raise ConfigurationError where a notification could never be delivered: the extra ``notify``
    or the command is missing, or an address is unknown to apprise. Nothing is sent."""
    if settings.command and shutil.which(settings.command[0]) is None:
        raise ConfigurationError(
            f"notify.command: {settings.command[0]!r} is not found, or is not a program",
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
                f"notify.urls: address {number} ({_scheme(url)}) is unknown to apprise",
                "see the addresses in apprise's documentation: SCHEME://...",
            )


class Notifier:
    """Delivers messages one after the other, in the order in which they were given.

    `poll` has to be called often; nothing but `close` waits.
    """

    def __init__(self, settings: NotifySettings, longest_s: float = LONGEST_S):
        self._settings, self._longest_s = settings, longest_s
        self._waiting: deque[_Delivery] = deque()
        self._under_way: tuple[_Delivery, Child] | None = None
        self._warnings: list[str] = []

    def notify(
        self, occasion: Occasion, title: str, text: str, details: Mapping[str, Any] | None = None
    ) -> None:
        """Send a message if the settings ask for this occasion. Returns without waiting for the
        delivery."""
        if occasion not in self._settings.on:
            return
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        message = Notification(occasion, _plain(title), _plain(text), now, dict(details or {}))
        try:
            deliveries = list(self._deliveries(message))
        except (TypeError, ValueError) as error:  # details that cannot be written as JSON
            self._warn(f"{message.title!r} was not sent: {error}")
            return
        for delivery in deliveries:
            if len(self._waiting) >= MOST_WAITING:
                self._fail(delivery, f"{MOST_WAITING} messages are waiting already")
            else:
                self._waiting.append(delivery)
        self._step()

    def poll(self) -> list[str]:
        """Continue the deliveries; returns what has gone wrong since the last call."""
        self._step()
        found, self._warnings = self._warnings, []
        return found

    def close(self, within_s: float = 3 * LONGEST_S) -> list[str]:
        """Wait until everything is delivered, at most `within_s`; returns what has gone wrong and
        what was given up."""
        deadline_s = time.monotonic() + within_s
        self._step()
        while self._under_way is not None and time.monotonic() < deadline_s:
            time.sleep(POLL_EVERY_S)
            self._step()
        if self._under_way is not None:
            delivery, child = self._under_way
            child.kill()
            for given_up in (delivery, *self._waiting):
                self._fail(given_up, f"given up after {within_s:g} s")
            self._under_way = None
            self._waiting.clear()
        return self.poll()

    def _deliveries(self, message: Notification) -> Iterator[_Delivery]:
        command = self._settings.command
        if command:
            program = (*command, message.title, message.text)
            yield _Delivery("notify.command", program, message.as_json(), message.title)
        for number, url in enumerate(self._settings.urls, 1):
            program = (sys.executable, "-P", "-m", "rig.batch.report.notify")
            given = message.as_json(url=url)
            yield _Delivery(f"notify.urls: address {number}", program, given, message.title)

    def _step(self) -> None:
        """Look after the delivery under way, and begin the next one when it has ended."""
        if self._under_way is not None:
            delivery, child = self._under_way
            ended = child.poll()
            if ended is None:
                return
            self._under_way = None
            if ended.failure:
                self._fail(delivery, ended.reason)
        while self._under_way is None and self._waiting:
            delivery = self._waiting.popleft()
            try:
                given = delivery.given.encode(errors="replace")
                child = Child(delivery.program, self._longest_s, given=given)
            except (OSError, ValueError) as error:
                self._fail(delivery, str(error))
            else:
                self._under_way = delivery, child

    def _fail(self, delivery: _Delivery, why: str) -> None:
        self._warn(f"{delivery.receiver}: {delivery.title!r} was not sent: {why[:LONGEST_REASON]}")

    def _warn(self, text: str) -> None:
        log.warning("%s", text)
        self._warnings.append(text)


def _plain(text: str) -> str:
    """Return a text that can be a program's argument."""
    text = text.replace("\0", " ")
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def _scheme(url: str) -> str:
    """Return the part of an address that may be shown."""
    scheme, found, _ = url.partition("://")
    return f"{scheme[:20]}://..." if found else "without a scheme"


def main() -> None:
    """Send the message on standard input, with its address as ``url``, by apprise.

    Exit code 1 where the address did not take it; standard error then says why, without the
    address, which may hold a password.
    """
    import apprise

    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    allowed = MOST_MEMORY if most == resource.RLIM_INFINITY else min(MOST_MEMORY, most)
    resource.setrlimit(resource.RLIMIT_DATA, (allowed, most))
    message = json.load(sys.stdin)
    sender = apprise.Apprise()
    with apprise.LogCapture(level=logging.WARNING, fmt="%(message)s") as captured:
        sent = sender.add(message["url"]) and sender.notify(
            body=message["text"],
            title=message["title"],
            notify_type=APPRISE_KINDS[message["occasion"]],
        )
        reasons = captured.getvalue().split("\n")
    if not sent:
        sys.exit(next((line for line in reasons if line), "not taken"))


if __name__ == "__main__":
    main()
