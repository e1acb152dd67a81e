"""Recording: the journal of a run as it happens, and the run file that is compiled from it.

Names are imported when they are first used: a command that only shows its help pays for none.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rig.files.errors import JournalError, RecordingError, RunFileError
    from rig.files.journal.layout import Column, Layout, Plot, Trace
    from rig.files.journal.recorder import Recorder
    from rig.files.journal.values import (
        End,
        Event,
        Instrument,
        Program,
        RunHeader,
        Stream,
        StreamState,
    )
    from rig.files.journal.writer import JournalWriter, read_journal
    from rig.files.naming import journal_path, next_run_path

__all__ = [
    "Column",
    "End",
    "Event",
    "Instrument",
    "JournalError",
    "JournalWriter",
    "Layout",
    "Plot",
    "Program",
    "Recorder",
    "RecordingError",
    "RunFileError",
    "RunHeader",
    "Stream",
    "StreamState",
    "Trace",
    "journal_path",
    "next_run_path",
    "read_journal",
]

_MODULES = ("errors", "header", "journal", "layout", "naming", "recorder")


def __getattr__(name: str) -> Any:
    if name in __all__:
        for module in _MODULES:
            found = vars(import_module(f"{__name__}.{module}")).get(name)
            if found is not None:
                return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
