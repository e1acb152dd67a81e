"""Checks that a block raises an error, without pytest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

E = TypeVar("E", bound=BaseException)


class Caught(Generic[E]):
    """The error that was raised, once it has been."""

    error: E


@contextmanager
def raising(kind: type[E], what: str) -> Iterator[Caught[E]]:
    """Fail unless the block raises `kind`, which the value that it gives then holds as `error`;
    `what` says in the message what was done."""
    caught: Caught[E] = Caught()
    try:
        yield caught
    except kind as error:
        caught.error = error
        return
    raise AssertionError(f"{what}: no {kind.__name__} was raised")
