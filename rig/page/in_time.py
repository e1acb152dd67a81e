"""Looks at a disk that may not answer, given up after a while."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

Result = TypeVar("Result")


class NotInTimeError(Exception):
    """Raised where there was no answer in time."""


def in_time(seconds: float, look: Callable[[], Result]) -> Result:
    """Return what `look` returns, or raise what it raises. Raises NotInTimeError after `seconds`.

    It is done in a thread of its own. Nothing can end one that waits for a disk, so `look` is still
    carried out when the disk answers again: it must do no harm then. A process could be ended, but
    one that is forked while another thread reads a queue would believe in locks that it lacks.
    """
    answer: Future[Result] = Future()

    def carry_out() -> None:
        try:
            answer.set_result(look())
        except Exception as error:  # noqa: BLE001 - it is raised in the thread that waits
            answer.set_exception(error)

    try:
        threading.Thread(target=carry_out, name="look", daemon=True).start()
    except RuntimeError as error:
        raise NotInTimeError from error
    try:
        answer.exception(seconds)
    except TimeoutError as error:
        raise NotInTimeError from error
    return answer.result()
