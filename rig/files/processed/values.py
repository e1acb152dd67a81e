"""The values of a processed file, and the name under which it is stored; no file is opened here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ConfigDict

from rig.core.settings import Settings, fingerprint
from rig.detector.events import SlipEvent
from rig.files.naming import RUN_SUFFIX

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DEFINITION, LAYOUT_VERSION = "NXrig_processed", "1"
FOLDER = "processed"
"""Name of the folder of the results, in the folder of their run."""
FINGERPRINT_LENGTH = 12
"""Characters of the parameters' fingerprint in a file's name."""


@dataclass(frozen=True)
class ProcessedSource:
    """The run file that was processed, as it describes itself; times are ISO 8601."""

    file_name: str
    sha256: str
    definition: str
    title: str
    """Title of the run, with its mark."""
    run_uuid: str
    start_time: str | None
    end_time: str | None
    simulated: bool | None
    """None if it is not known."""
    mark: str
    """First word of every title: SIMULATED, IMPORTED or nothing."""


@dataclass(frozen=True)
class DetectedTrial:
    """The results of a detector for one trial, with the signals that they came from."""

    id: str
    rate_Hz: float
    sample: NDArray[np.int64]
    """(n,), the rows that were recorded, counted from the first; gaps are missing rows."""
    v_d: NDArray[np.float64]
    """v_1 - v_2 in V, (n,)."""
    predictive: NDArray[np.float64]
    """v_d behind the detector's low-pass, in V, (n,)."""
    events: tuple[SlipEvent, ...]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Time in s since the trial's first row, shape (n,)."""
        return self.sample / self.rate_Hz

    def same(self, other: DetectedTrial) -> bool:
        """Return whether both are equal bit for bit."""
        return (
            (self.id, self.rate_Hz, self.events) == (other.id, other.rate_Hz, other.events)
            and self.sample.tobytes() == other.sample.tobytes()
            and self.v_d.tobytes() == other.v_d.tobytes()
            and self.predictive.tobytes() == other.predictive.tobytes()
        )


class UnknownSettings(Settings):
    """Parameters of another package's detector, as the file states them: values by name. They can
    be read where that package is not installed."""

    model_config = ConfigDict(extra="allow")


@dataclass(frozen=True)
class StatedDetector:
    """The detector of a processed file, as the file states it."""

    name: str
    """Name under which it is registered."""
    version: str
    """Version that the detector stated when it processed the run file."""
    package: str
    """Package that it came from; empty in files from before packages could
    bring detectors."""
    package_version: str
    settings: Settings
    """Parameters of the detector."""


def processed_path(run_file: Path, detector: StatedDetector, folder: Path | None = None) -> Path:
    """Return where the result belongs: in `folder`, or in ``processed`` beside the run file.

    ``<run>.<detector>-<version>-<hash of the parameters>.h5``
    """
    folder = run_file.parent / FOLDER if folder is None else folder
    shown = fingerprint(detector.settings)[:FINGERPRINT_LENGTH]
    name = f"{run_file.stem}.{detector.name}-{detector.version}-{shown}{RUN_SUFFIX}"
    return folder / name
