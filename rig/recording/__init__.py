"""Recording: the journal of a run as it happens, and the run file that is compiled from it."""

from rig.recording.errors import JournalError, RecordingError, RunFileError
from rig.recording.header import End, Event, Instrument, Program, RunHeader, Stream, StreamState
from rig.recording.journal import JournalWriter, read_journal
from rig.recording.layout import Column, Layout, Plot
from rig.recording.naming import journal_path, next_run_path
from rig.recording.recorder import Recorder

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
    "journal_path",
    "next_run_path",
    "read_journal",
]
