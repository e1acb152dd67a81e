"""Detecting slips in run files: one file in, one processed file out.

`detect_file` is a plain function of plain values, which a pool of processes or a cluster can call;
what goes wrong with a file is in its answer, since not every error survives the way between
processes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.text import in_shell
from rig.detector.blocks import BlockFeed
from rig.detector.events import EVENT_KINDS, SlipEvent, inverted_warning, unjudged_s
from rig.detector.notices import NOTICE_COLUMNS, notices_in
from rig.detector.registered import ChosenDetector
from rig.files.checksum import checksum_findings, sha256_of
from rig.files.errors import RunFileError
from rig.files.file_kind import require_hdf5
from rig.files.journal.strips import STRIPS, stream_of_strips
from rig.files.naming import checksum_path
from rig.files.processed.reader import ProcessedFile, is_processed
from rig.files.processed.values import (
    DetectedTrial,
    ProcessedSource,
    StatedDetector,
    processed_path,
)
from rig.files.processed.writer import write_processed
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify_in_child
from rig.processing.identity import detection_digest
from rig.processing.parallel import worker_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rig.files.journal.values import RunHeader
    from rig.files.runfile.reader import Waveform


@dataclass(frozen=True)
class DetectionJob:
    """A run file to be processed: everything that `detect_file` needs, as plain values."""

    run_file: Path
    detector: ChosenDetector
    folder: Path | None = None
    """Folder for the result; None is ``processed`` beside the run file."""
    made_by: str = ""
    """`detection_digest` that the job needs: another computer may have other code. Empty: whatever
    this one has."""
    elsewhere: bool = False
    """True if a worker of a cluster does the job; failures then name it."""


@dataclass(frozen=True)
class DetectionFailure:
    """The reason why a file was not processed: the parts of a RigError, which can be pickled."""

    message: str
    hint: str | None
    code: ExitCode

    def error(self) -> RigError:
        """Return the failure as a RigError, to be raised or reported."""
        return RigError(self.message, self.hint, self.code)


@dataclass(frozen=True)
class DetectionResult:
    """The result of a detector for one run file."""

    file: Path
    """The processed file."""
    kept: bool
    """True if the processed file existed before and was left as it was."""
    simulated: bool | None
    trials: int
    events: dict[str, int]
    """Number of events by kind."""
    first_slip: tuple[str, float] | None
    """The first incipient slip: its trial, and when in it, s."""
    unjudged_s: dict[str, float] = field(default_factory=dict)
    """Time in s that the detector could not judge, in all trials together, by its reason."""
    warnings: tuple[str, ...] = field(default=())
    without_touch: int = 0
    """Number of trials in which nothing was found and the strips showed no touch at all: whether
    they worked is not known. The processed file does not state it."""
    made_by: str = ""
    """`detection_digest` of what did it. Empty from a program that does not know of it."""


def prepare(detector: ChosenDetector) -> None:
    """Import and compile the detector now, so that processes forked afterwards need not. One of
    another package judges in these only, as it may end its process."""
    import h5py  # noqa: F401
    import numpy as np

    if detector.is_own:
        detector.make(detector.kind.design_rate_Hz).add(np.zeros((1, 2)))


def detect_file(job: DetectionJob) -> DetectionResult | DetectionFailure:
    """Process one run file, unless a sound result for the same bytes exists. Returns failures as
    values; raises nothing that belongs to the file.
    """
    try:
        return _detect(job)
    except RigError as error:
        where = f" (on {worker_name()})" if job.elsewhere else ""
        return DetectionFailure(error.message + where, error.hint, error.code)


def detect_trials(run: RunFile, detector: ChosenDetector) -> list[DetectedTrial]:
    """Return what the detector finds in every kept trial of a run, in the order of the trials.

    Raises ConfigurationError where the run has no strips, or a trial cannot be judged.
    """
    stream = _stream_of_strips(run)
    pieces: dict[str | None, list[Waveform]] = {}
    for waveform in run.waveforms(stream=stream):
        pieces.setdefault(waveform.point, []).append(waveform)
    if not pieces:
        complete = run.outcome.status == "complete"
        raise ConfigurationError(
            f"{run.path}: no trial was recorded ({run.outcome.extent()})",
            "name another file"
            if complete
            else f"`rig resume {in_shell(run.path)}` continues the run",
        )
    trials = []
    readings = _readings_with_notices(run)
    for point in run.point_ids():
        if point in pieces:
            try:
                trials.append(
                    _detect_trial(point, pieces[point], readings.get(point, {}), detector)
                )
            except ValueError as error:
                raise ConfigurationError(f"{run.path}: trial {point}: {error}") from error
    return trials


def _readings_with_notices(run: RunFile) -> dict[str, dict[str, Any]]:
    """Return the reading of each kept trial; none for a file that does not state what its
    bench knew."""
    if not set(NOTICE_COLUMNS) & set(run.columns()):
        return {}
    return dict(zip(run.point_ids(), run.readings(), strict=True))


def _detect(job: DetectionJob) -> DetectionResult:
    run_file, detector = job.run_file, job.detector
    made_by = detection_digest(detector)
    if job.made_by not in ("", made_by):
        raise other_code(run_file)
    warnings = _refuse_damaged(run_file)
    if is_processed(run_file):
        raise ConfigurationError(
            f"{run_file}: a processed file, not a run", "name the run file that it was made from"
        )
    stated = _stated(detector)
    target = processed_path(run_file, stated, job.folder)
    with RunFile.open(run_file) as run:
        source = _source(run, sha256_of(run_file))
        trials, kept = _already_there(target, source, made_by, warnings), True
        if trials is None:
            trials, kept = detect_trials(run, detector), False
        without_touch = _without_touch(run, trials, detector)
    if not kept:
        write_processed(target, source, stated, made_by, trials)
    found = _found(target, kept, source, made_by, trials, warnings)
    return replace(found, without_touch=without_touch)


def _stated(detector: ChosenDetector) -> StatedDetector:
    """Return what a processed file states of its detector."""
    return StatedDetector(
        name=detector.name,
        version=detector.version,
        package=detector.package,
        package_version=detector.package_version,
        settings=detector.settings,
    )


def other_code(run_file: Path) -> ConfigurationError:
    """Return the error of a computer that would find other slips than the one that asks it."""
    return ConfigurationError(
        f"{run_file}: this computer's detector, network or file code differs from that of the "
        "command",
        "install the same tactile-rig on all of them, and restart the workers",
    )


def _refuse_damaged(run_file: Path) -> list[str]:
    """Raise RunFileError if the file is not the one that was written; return a warning if that is
    not known."""
    require_hdf5(run_file)
    doubts = list(checksum_findings(run_file))
    if doubts and checksum_path(run_file).exists():
        raise RunFileError(run_file, "; ".join(doubts), "`rig verify` says more")
    if doubts:
        verify_in_child(run_file)  # HDF5 may crash or hang on it; a child process takes that
    return [f"{run_file.name}: {doubt}" for doubt in doubts]


def _already_there(
    target: Path, source: ProcessedSource, made_by: str, warnings: list[str]
) -> list[DetectedTrial] | None:
    """Return the result that exists, if it is sound, of just this run file and made by this code;
    None if it has to be written (again). Raises RunFileError where it is another run's."""
    if not target.exists():
        return None
    if doubts := list(checksum_findings(target)):
        warnings.append(f"{target.name}: written again: {'; '.join(doubts)}")
        return None
    with ProcessedFile.open(target) as there:
        if there.source.run_uuid != source.run_uuid:
            raise RunFileError(
                target,
                f"is the result of another run of that name ({there.source.title})",
                "move it away, or name another folder with --to",
            )
        if there.source.sha256 != source.sha256:
            warnings.append(f"{target.name}: written again: the run file has changed since")
            return None
        if there.made_by != made_by:
            warnings.append(f"{target.name}: written again: other code has made it")
            return None
        return there.trials()


def _found(
    target: Path,
    kept: bool,
    source: ProcessedSource,
    made_by: str,
    trials: list[DetectedTrial],
    warnings: list[str],
) -> DetectionResult:
    events = [(trial.id, event) for trial in trials for event in trial.events]
    counts = Counter(event.kind for _, event in events)
    slips = ((trial, event.time_s) for trial, event in events if event.kind == "incipient slip")
    if inverted := inverted_warning({trial.id: trial.events for trial in trials}):
        warnings = [*warnings, f"{source.file_name}: {inverted}"]
    return DetectionResult(
        file=target,
        kept=kept,
        simulated=source.simulated,
        trials=len(trials),
        events={kind: counts[kind] for kind in EVENT_KINDS},
        first_slip=next(slips, None),
        unjudged_s=_unjudged_by_reason(trials),
        warnings=tuple(warnings),
        made_by=made_by,
    )


def _without_touch(run: RunFile, trials: list[DetectedTrial], chosen: ChosenDetector) -> int:
    """Return in how many trials nothing was found and no touch was seen. Those in which nothing was
    found are judged again for it."""
    silent = {trial.id for trial in trials if not {one.kind for one in trial.events} - {"rejected"}}
    if not silent or not chosen.is_own:
        return 0
    pieces: dict[str | None, list[Waveform]] = {}
    for waveform in run.waveforms(stream=_stream_of_strips(run)):
        if waveform.point in silent:
            pieces.setdefault(waveform.point, []).append(waveform)
    number = 0
    for of_trial in pieces.values():
        rate_Hz = of_trial[0].rate_Hz
        assert rate_Hz is not None, "the trial was judged"
        detector = chosen.make(rate_Hz)
        for piece, volts in _rows_of(of_trial):
            detector.add(volts, first_sample=piece.first_index - of_trial[0].first_index)
        number += detector.touch_seen is False
    return number


def _unjudged_by_reason(trials: list[DetectedTrial]) -> dict[str, float]:
    by_reason: dict[str, float] = {}
    for trial in trials:
        cannot = [event for event in trial.events if event.kind == "cannot judge"]
        record_s = (int(trial.sample[-1]) + 1) / trial.rate_Hz
        # Every interval begins with one such event, except a gap within one, which extends it.
        for begin_s, end_s in unjudged_s(trial.events, record_s):
            reason = next(event.reason for event in cannot if begin_s <= event.time_s <= end_s)
            by_reason[reason] = by_reason.get(reason, 0.0) + end_s - begin_s
    return by_reason


def _source(run: RunFile, sha256: str) -> ProcessedSource:
    header: RunHeader = run.header
    return ProcessedSource(
        file_name=run.path.name,
        sha256=sha256,
        definition=header.layout.definition,
        title=header.marked(header.title),
        run_uuid=header.run_uuid,
        start_time=header.start_time,
        end_time=run.end_time,
        simulated=header.simulated,
        mark=header.mark,
    )


def _stream_of_strips(run: RunFile) -> str:
    stream = stream_of_strips(run.header.layout)
    if stream is None:
        raise ConfigurationError(
            f"{run.path}: a {run.header.procedure}, which records no strips v_1 and v_2",
            "slips are found in runs with the strips' signals: trials and imported recordings",
        )
    return stream


def _detect_trial(
    point: str, pieces: list[Waveform], reading: dict[str, Any], chosen: ChosenDetector
) -> DetectedTrial:
    """Return the result for one trial, with what its reading says that the bench knew. Raises
    ValueError if the detector cannot process it, or if its pieces are of different kinds."""
    import numpy as np

    rate_Hz = pieces[0].rate_Hz
    if rate_Hz is None:
        raise ValueError("the file gives no sampling rate of v_1 and v_2")
    detector = BlockFeed(chosen, rate_Hz, notices_in(reading))
    events: list[SlipEvent] = []
    rows, differences, predictive = [], [], []
    for piece, volts in _rows_of(pieces):
        first = piece.first_index - pieces[0].first_index
        events += detector.add(volts, first_sample=first)
        v_d = volts[:, 0] - volts[:, 1]
        rows.append(np.arange(first, first + len(v_d), dtype=np.int64))
        differences.append(v_d)
        predictive.append(detector.detector.predictive(v_d))
    events += detector.finish()
    return DetectedTrial(
        id=point,
        rate_Hz=rate_Hz,
        sample=np.concatenate(rows),
        v_d=np.concatenate(differences),
        predictive=np.concatenate(predictive),
        events=tuple(events),
    )


def _rows_of(pieces: list[Waveform]) -> Iterator[tuple[Waveform, NDArray[np.float64]]]:
    """Yield each piece with its volts, (n, 2)."""
    import numpy as np

    for piece in pieces:
        if piece.units != "V":
            raise ValueError(f"v_1 and v_2 are in {piece.units!r}, not in V")
        if piece.rate_Hz != pieces[0].rate_Hz:
            raise ValueError(
                f"the rate changes from {pieces[0].rate_Hz} Hz to {piece.rate_Hz} Hz within it"
            )
        yield piece, np.column_stack([piece.values(name) for name in STRIPS])
