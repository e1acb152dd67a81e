"""Reading a recording from elsewhere in a test."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import foreign_files as files
import numpy as np
import pytest

from rig.files.errors import ForeignFileError
from rig.files.imported.import_file import read_foreign
from rig.files.imported.series import ChannelMap, Recording, recording_of
from rig.files.journal.values import Program

BY_NUMBER = {"time": "1", "v_1": "2", "v_2": "3"}
PROGRAM = Program(name="tactile-rig", version="0.0.1")


def read(
    content: bytes | str,
    folder: Path,
    columns: dict[str, str] | None = None,
    scale: dict[str, float] | None = None,
    rate_Hz: float | None = None,
    **options: Any,
) -> Recording:
    """The recording in a file of that content."""
    path = folder / "given.dat"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    channels = ChannelMap(columns or BY_NUMBER, scale or {}, rate_Hz)
    return recording_of(read_foreign(path, **options).source, channels, path.name)


@contextmanager
def refused(reason: str) -> Iterator[None]:
    """A file is refused, with such words in message or remedy."""
    with pytest.raises(ForeignFileError) as found:
        yield
    assert re.search(reason, found.value.one_line()), found.value.one_line()


def assert_as_written(recording: Recording, written: dict[str, np.ndarray]) -> None:
    for channel in ("v_1", "v_2"):
        np.testing.assert_array_equal(recording.raw[channel], written[channel], strict=True)
    assert recording.rate_Hz == files.RATE_Hz
