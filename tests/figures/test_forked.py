"""Pictures that are drawn side by side: what they give, and what goes wrong with one."""

from __future__ import annotations

import subprocess
import sys

import pytest

TASKS = """
import os, sys
from rig.core.errors import ConfigurationError
from rig.figures.forked import side_by_side

def refused(): raise ConfigurationError("no such place", "name another")
def full(): raise OSError(28, "No space left on device")
def dies(): os._exit(3)
def done(): print("done", file=sys.stderr, flush=True); return os.getpid()
try:
    given = side_by_side([done, {}, done])
    print(len(given), given[0] == os.getpid(), len(set(given)))
except Exception as error:
    print(type(error).__name__, error)
"""


def carried_out(second: str) -> tuple[str, int]:
    """What was said of three tasks, and how many of them were done; in a process without threads,
    as only such a one may be forked."""
    command = [sys.executable, "-c", TASKS.format(second)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return ended.stdout.strip(), ended.stderr.count("done")


def test_each_is_done_in_a_process_of_its_own_and_the_results_keep_their_order() -> None:
    assert carried_out("done") == ("3 True 3", 3)


@pytest.mark.parametrize(
    ("task", "told"),
    [
        ("refused", "RigError no such place"),
        ("full", "OSError [Errno 28] No space left on device"),
        ("dies", "RigError the process that draws a part of it died"),
    ],
)
def test_what_one_cannot_do_is_told_when_the_others_are_done(task: str, told: str) -> None:
    assert carried_out(task) == (told, 2)
