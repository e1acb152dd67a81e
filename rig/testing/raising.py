"""Expecting an error, without pytest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

E = TypeVar("E", bound=BaseException)


class Caught(Generic[E]):
    """The error that was raised, once it has been."""

    error: E


@contextmanager
def raising(kind: type[E]) -> Iterator[Caught[E]]:
    """Fail unless the block raises `kind`, which the value that it gives then holds as `error`."""
    caught: Caught[E] = Caught()
    try:
        yield caught
    except kind as error:
        caught.error = error
        return
    raise AssertionError(f"no {kind.__name__} was raised")
