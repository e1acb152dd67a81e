"""Work that is given up if it takes too long, as on a disk that does not answer."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from rig.batch.queue_file import QueueNotOpenedError
from rig.core.apart import GivenUpError, result_within
from rig.core.errors import ConfigurationError, RigError
from rig.run.locks.lock_holder import lives

PATIENCE_S = 60.0


def test_what_the_work_returns_is_returned() -> None:
    assert result_within(PATIENCE_S, lambda: {"path": Path("x"), "size": b"y" * 300_000}) == {
        "path": Path("x"),
        "size": b"y" * 300_000,
    }
    assert result_within(PATIENCE_S, os.getpid) != os.getpid()


def test_what_the_work_raises_is_raised_with_its_members_and_its_traceback() -> None:
    def refuse() -> None:
        raise QueueNotOpenedError("it is locked", Path("/a/queue.sqlite"), "SQLITE_BUSY")

    with pytest.raises(ConfigurationError) as refused:
        result_within(PATIENCE_S, refuse)
    assert type(refused.value) is QueueNotOpenedError
    assert refused.value.message == "/a/queue.sqlite cannot be opened: it is locked"
    assert "another program has it open" in refused.value.one_line()
    assert "in refuse" in refused.value.__notes__[0]
    with pytest.raises(FileNotFoundError) as missing:
        result_within(PATIENCE_S, lambda: Path("/no/such/file").read_bytes())
    assert missing.value.errno == errno.ENOENT


def test_work_without_end_is_given_up_and_its_process_killed(tmp_path: Path) -> None:
    number = tmp_path / "pid"

    def wait() -> None:
        number.with_suffix(".new").write_text(str(os.getpid()))
        number.with_suffix(".new").replace(number)
        threading.Event().wait()

    with pytest.raises(GivenUpError):
        result_within(3.0, wait)
    assert number.exists()
    deadline_s = time.monotonic() + PATIENCE_S
    while lives(int(number.read_text())):
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


class Unreadable:
    """Something that is pickled, but cannot be read again."""

    def __reduce__(self) -> tuple[type[int], tuple[str]]:
        return int, ("no number",)


def _fail_unreadably() -> None:
    error = ValueError("no disk")
    error.part = Unreadable()  # type: ignore[attr-defined]
    raise error


@pytest.mark.parametrize(
    ("work", "words"),
    [(_fail_unreadably, "ValueError: no disk"), (threading.Lock, "cannot pickle")],
)
def test_an_answer_that_cannot_be_sent_is_stated_in_words(work: Any, words: str) -> None:
    with pytest.raises(RigError, match=words):
        result_within(PATIENCE_S, work)


def test_a_process_that_dies_at_work_is_an_error() -> None:
    with pytest.raises(RigError, match="has died"):
        result_within(PATIENCE_S, lambda: os.kill(os.getpid(), signal.SIGKILL))


def test_where_no_process_can_be_made_the_work_is_done_in_this_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse() -> int:
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuse)
    assert result_within(PATIENCE_S, os.getpid) == os.getpid()


def test_an_answer_comes_also_where_the_ends_of_processes_are_not_kept() -> None:
    """Who starts a command may have it ignore SIGCHLD."""
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        assert result_within(PATIENCE_S, lambda: "done") == "done"
    finally:
        signal.signal(signal.SIGCHLD, before)
