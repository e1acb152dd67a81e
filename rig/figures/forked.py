"""Work side by side in processes forked from this one, which has imported and read all they need.

Only for a process without threads of its own, as the one that draws beside a command is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rig.core.errors import RigError

T = TypeVar("T")


def side_by_side(tasks: Sequence[Callable[[], T]]) -> list[T]:
    """What the tasks give, in their order: the first is done here, each other in a process of its
    own. Raises what one raised, RigError where its process died, once all have ended."""
    from multiprocessing import get_context

    context = get_context("fork")
    others = []
    for task in tasks[1:]:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_carry_out, args=(task, sender))
        process.start()
        sender.close()
        others.append((process, receiver))
    outcomes = [_outcome(tasks[0])]
    for process, receiver in others:
        try:
            outcomes.append(receiver.recv())
        except EOFError:
            outcomes.append((None, RigError("the process that draws a part of it died")))
        process.join()
    for _, error in outcomes:
        if error is not None:
            raise error
    return [result for result, _ in outcomes]


def _outcome(task: Callable[[], Any]) -> tuple[Any, Exception | None]:
    try:
        return task(), None
    except Exception as error:  # noqa: BLE001 - whoever asked gets it
        return None, error


def _carry_out(task: Callable[[], Any], sender: Any) -> None:
    result, error = _outcome(task)
    if isinstance(error, RigError):  # its further fields do not survive the way
        error = RigError(error.message, error.hint)
    sender.send((result, error))
