"""What can go wrong with a recording, as RigErrors that name the file and the place."""

from __future__ import annotations

from pathlib import Path

from rig.errors import ExitCode, FoundWrongError, RigError


class JournalError(RigError):
    """A journal that cannot be used: names the file, the byte offset and the reason."""

    code = ExitCode.USAGE

    def __init__(
        self, path: Path | str, offset: int | None, reason: str, hint: str | None = None
    ) -> None:
        place = f"{path}" if offset is None else f"{path}: byte {offset}"
        super().__init__(f"{place}: {reason}", hint)
        self.path = Path(path)
        self.offset = offset
        self.reason = reason


class RecordingError(RigError):
    """The run can no longer be written down: names the file, the cause and the remedy."""

    def __init__(self, path: Path | str, cause: str, hint: str | None = None) -> None:
        super().__init__(f"{path}: {cause}", hint)
        self.path = Path(path)


class RunFileError(FoundWrongError):
    """A file that is no sound run file."""

    def __init__(self, path: Path | str, reason: str, hint: str | None = None) -> None:
        super().__init__(f"{path}: {reason}", hint)
        self.path = Path(path)
        self.reason = reason
