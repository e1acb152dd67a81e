"""Processed files: what was found, from what and how; the same bytes from the same file."""

from __future__ import annotations

import platform
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import recorded_run
import recorded_trials as trials

import rig
from rig.core.errors import ExitCode
from rig.detector.detector import DETECTOR_VERSION
from rig.detector.fir import StreamingFir
from rig.detector.low_pass import design_low_pass
from rig.detector.registered import ChosenDetector, chosen_detector
from rig.detector.settings import DetectorSettings
from rig.files.checksum import sha256_of
from rig.files.definitions import definition_path
from rig.files.describe import describe_processed
from rig.files.errors import RunFileError
from rig.files.hdf5.nexus import array_field
from rig.files.processed.reader import ProcessedFile, is_processed
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile
from rig.files.verify import verdict, verify
from rig.processing.detection import (
    DetectionFailure,
    DetectionJob,
    DetectionResult,
    detect_file,
    detect_trials,
)
from rig.processing.identity import CODE, detection_digest

DETECTOR = chosen_detector("paper-hp")
SETTINGS = DETECTOR.settings
assert isinstance(SETTINGS, DetectorSettings)
TRIALS = {"trial-001": trials.slipping(), "trial-002": trials.quiet(seed=2)}


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trials.write_trials(tmp_path_factory.mktemp("run") / "slide_r001.rigj", TRIALS)


@pytest.fixture(scope="module")
def found(run_file: Path) -> DetectionResult:
    return detected(run_file)


@pytest.fixture
def own_run(tmp_path: Path) -> Path:
    return trials.write_trials(tmp_path / "own_r001.rigj", TRIALS)


def detected(
    run_file: Path, folder: Path | None = None, detector: ChosenDetector = DETECTOR
) -> DetectionResult:
    answer = detect_file(DetectionJob(run_file, detector, folder))
    assert isinstance(answer, DetectionResult), answer
    return answer


def refused(run_file: Path, detector: ChosenDetector = DETECTOR) -> DetectionFailure:
    answer = detect_file(DetectionJob(run_file, detector))
    assert isinstance(answer, DetectionFailure), answer
    assert str(run_file) in answer.message
    assert not (run_file.parent / "processed").exists(), "nothing is left behind"
    return answer


# What was found


@pytest.mark.parametrize("name", ["rig", "impulse", "paper-hp"])
def test_a_trial_in_which_nothing_ever_touched_the_strips_is_not_judged(
    tmp_path: Path, name: str
) -> None:
    dead = {
        "trial-001": np.zeros((1500, 2)),
        "trial-002": np.full((1500, 2), 0.01),
        "trial-003": 1e-3 * trials.slipping(),
        "trial-004": trials.slipping(),
    }
    file = trials.write_trials(tmp_path / "dead_r001.rigj", dead)
    first, again = (detected(file, detector=chosen_detector(name)) for _ in range(2))
    assert (first.kept, first.without_touch) == (False, 3)
    assert (again.kept, again.without_touch) == (True, 3)
    assert again.events == first.events


def test_a_trial_with_an_inverted_strip_has_a_warning_where_it_is_detected_and_shown(
    tmp_path: Path,
) -> None:
    inverted = trials.slipping() * [1.0, -1.0]
    both = {"trial-001": trials.slipping(), "trial-002": inverted}
    file = trials.write_trials(tmp_path / "inverted_r001.rigj", both)
    wanted = "alarms in trial-002 are not to be trusted: the first touch drives v_1 and v_2 oppos"
    for _ in range(2):
        found = detected(file)
        assert [f"inverted_r001.h5: {wanted}" in line for line in found.warnings] == [True]
        assert found.unjudged_s == {}
    with ProcessedFile.open(found.file) as processed:
        (warning,) = describe_processed(processed)["warnings"]
    assert warning.startswith(wanted)


def test_a_press_that_nothing_follows_was_seen_and_judged(tmp_path: Path) -> None:
    pressed = trials.slipping()
    pressed[700:] = trials.quiet(800)
    file = trials.write_trials(tmp_path / "hold_r001.rigj", {"trial-001": pressed})
    for name in ("rig", "impulse", "paper-hp"):
        found = detected(file, detector=chosen_detector(name))
        assert (found.events["incipient slip"], found.without_touch) == (0, 0)


def test_the_slip_is_found_in_its_trial_and_none_in_the_quiet_one(found: DetectionResult) -> None:
    assert found.trials == 2
    assert found.events["incipient slip"] == 1
    assert found.first_slip is not None
    trial, time_s = found.first_slip
    assert trial == "trial-001"
    assert trials.SLIP_S <= time_s < trials.SLIP_S + 0.02
    with ProcessedFile.open(found.file) as processed:
        kinds = [(of, event.kind) for of, event in processed.events()]
    assert ("trial-001", "predictive") in kinds
    assert not [kind for of, kind in kinds if of == "trial-002"]


def test_the_file_says_from_what_and_how_it_was_made(
    found: DetectionResult, run_file: Path
) -> None:
    with ProcessedFile.open(found.file) as processed:
        assert processed.source.file_name == run_file.name
        assert processed.source.sha256 == sha256_of(run_file)
        assert processed.source.definition == "NXrig_slip_trial"
        assert processed.settings == SETTINGS
        assert processed.version == DETECTOR_VERSION
        entry = processed.entry
        assert entry["process"].attrs["NX_class"] == "NXprocess"
        assert entry["process/parameters/arm_mV"][()] == SETTINGS.arm_mV
        assert entry["process/parameters/arm_mV"].attrs["units"] == "mV"
        assert entry["process/parameters/low_pass/half_power_Hz"].attrs["units"] == "Hz"
        assert entry["events/features/impulse_mV"].attrs["units"] == "mV"
    assert found.file.parent == run_file.parent / "processed"
    assert found.file.name.startswith(f"slide_r001.paper-hp-{DETECTOR_VERSION}-")
    assert found.file.stat().st_mode & 0o777 == 0o444


def test_what_is_read_is_what_was_detected(found: DetectionResult, run_file: Path) -> None:
    with ProcessedFile.open(found.file) as processed, RunFile.open(run_file) as run:
        read, made = processed.trials(), detect_trials(run, DETECTOR)
    assert [trial.events for trial in read] == [trial.events for trial in made]
    assert all(mine.same(own) for mine, own in zip(read, made, strict=True))
    volts = TRIALS["trial-001"]
    np.testing.assert_array_equal(read[0].v_d, volts[:, 0] - volts[:, 1])
    taps = design_low_pass(SETTINGS.low_pass, trials.RATE_HZ).taps
    expected = StreamingFir(taps, 1).add(read[0].v_d[:, None])[:, 0]
    np.testing.assert_array_equal(read[0].predictive, expected)


def test_rows_that_were_lost_stay_lost(tmp_path: Path) -> None:
    lost = {"trial-001": trials.slipping()}
    run_file = trials.write_trials(tmp_path / "gap_r001.rigj", lost, missing=50)
    answer = detected(run_file)
    with ProcessedFile.open(answer.file) as processed:
        (trial,) = processed.trials()
        assert list(processed.findings()) == []
    assert trial.sample.tolist() == [*range(700), *range(750, 1500)]
    gap = [event for event in trial.events if "gap of 50" in event.reason]
    assert [(event.kind, event.time_s) for event in gap] == [
        ("cannot judge", 0.75), ("judges again", 0.75)
    ]  # fmt: skip
    assert answer.unjudged_s == {gap[0].reason: pytest.approx(0.05)}


# The same file from the same file


def test_the_same_run_gives_the_same_bytes_and_stays_as_it_was(
    found: DetectionResult, run_file: Path, tmp_path: Path
) -> None:
    before = run_file.stat()
    again = detected(run_file, tmp_path / "elsewhere")
    assert again.file.read_bytes() == found.file.read_bytes()
    assert verify(run_file) == []
    after = run_file.stat()
    assert (after.st_mtime_ns, after.st_mode) == (before.st_mtime_ns, before.st_mode)


def test_who_holds_on_to_a_field_does_not_change_the_bytes(
    found: DetectionResult, run_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A profiler looks at the frames of a cluster's worker and so keeps what they hold alive."""
    held = []

    def holding(*given: Any) -> Any:
        held.append(array_field(*given))
        return held[-1]

    monkeypatch.setattr("rig.files.processed.writer.array_field", holding)
    again = detected(run_file, tmp_path / "elsewhere")
    assert held
    assert again.file.read_bytes() == found.file.read_bytes()


def as_written(file: Path) -> tuple[int, int, int]:
    """What changes when a file is written, and does not when it is read."""
    state = file.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns


def test_a_network_of_one_s_own_is_shown_with_what_it_was_trained_on(
    run_file: Path, tmp_path: Path
) -> None:
    usual = chosen_detector("rig")
    assert isinstance(usual.settings, DetectorSettings)
    assert usual.settings.network is not None
    own = {"name": "own", "trained_on": "3 trials of run files"}
    network = usual.settings.network.model_copy(update=own)
    settings = usual.settings.model_copy(update={"network": network})
    made = detected(run_file, tmp_path, ChosenDetector("rig", settings))
    with ProcessedFile.open(made.file) as file:
        shown = describe_processed(file)["parameters"]["network"]
    assert shown == "own, trained on 3 trials of run files"


def test_a_result_that_exists_is_kept(own_run: Path) -> None:
    first = detected(own_run)
    before = as_written(first.file)
    again = detected(own_run)
    assert again.kept
    assert not first.kept
    assert (again.events, again.first_slip) == (first.events, first.first_slip)
    assert as_written(again.file) == before


def test_other_parameters_or_another_version_add_a_file(
    own_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = detected(own_run)
    higher = SETTINGS.model_copy(update={"fire_mV": 100.0})
    deaf = detected(own_run, detector=replace(DETECTOR, settings=higher))
    assert deaf.events["incipient slip"] == 0
    monkeypatch.setattr(DETECTOR.kind, "version", "next")
    later = detected(own_run)
    files = {path.name for path in first.file.parent.glob("*.h5")}
    assert files == {first.file.name, deaf.file.name, later.file.name}
    assert ".paper-hp-next-" in later.file.name


def test_a_result_without_its_checksum_or_damaged_is_written_again(own_run: Path) -> None:
    first = detected(own_run)
    content = first.file.read_bytes()
    beside = first.file.with_name(first.file.name + ".sha256")
    beside.unlink()
    again = detected(own_run)
    assert not again.kept
    assert "written again" in again.warnings[0]
    assert beside.exists()
    first.file.chmod(0o644)
    first.file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert not detected(own_run).kept
    assert first.file.read_bytes() == content


def test_the_result_of_a_run_that_went_on_is_written_again(tmp_path: Path) -> None:
    begun = {"trial-001": TRIALS["trial-001"]}
    run_file = trials.write_trials(tmp_path / "a_r001.rigj", begun, complete=False)
    assert detected(run_file).trials == 1
    (tmp_path / "a_r001.rigj").unlink()
    trials.write_trials(tmp_path / "a_r001.rigj", TRIALS)
    (early,) = (tmp_path / "processed").glob("*.h5")
    gone_on = "a_r001.h5 has changed since, or is another run of that name: `rig detect` judges it"
    assert gone_on in verify(early)[0]
    with ProcessedFile.open(early) as file:
        assert gone_on in describe_processed(file)["warnings"][0]
    later = detected(run_file)
    assert verify(early) == []
    assert (later.trials, later.kept) == (2, False)
    assert "the run file has changed since" in later.warnings[0]


def test_another_runs_result_is_not_overwritten(own_run: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / "own_r001.rigj"
    results = tmp_path / "results"
    first = detected(own_run, results)
    content = first.file.read_bytes()
    answer = detect_file(
        DetectionJob(trials.write_trials(other, TRIALS, run_uuid="another"), DETECTOR, results)
    )
    assert isinstance(answer, DetectionFailure)
    assert "another run of that name" in answer.message
    assert "--to" in (answer.hint or "")
    assert first.file.read_bytes() == content


# What is refused


def test_files_of_other_kinds_are_refused_by_name(own_run: Path, tmp_path: Path) -> None:
    sweep = compile_run(recorded_run.write_run(tmp_path / "sweep.rigj"))
    answer = refused(sweep)
    assert "a sweep, which records no strips" in answer.message
    assert answer.hint is not None
    assert "trials and imported recordings" in answer.hint
    assert answer.code is ExitCode.USAGE
    assert "a journal, not a run file" in refused(tmp_path / "sweep.rigj").message
    assert "no such file" in refused(tmp_path / "none.h5").message
    found = detected(own_run)
    assert is_processed(found.file)
    assert "a processed file, not a run" in refused(found.file).message


@pytest.mark.parametrize(
    ("given", "reported"),
    [
        ({"rate_Hz": 50.0}, "rate 50 Hz must be between"),
        ({"units": "mV"}, "v_1 and v_2 are in 'mV', not in V"),
    ],
)
def test_a_trial_that_no_detector_can_take_is_named(
    tmp_path: Path, given: dict[str, object], reported: str
) -> None:
    run_file = trials.write_trials(tmp_path / "a.rigj", TRIALS, **given)  # type: ignore[arg-type]
    assert f"trial trial-001: {reported}" in refused(run_file).message


def test_a_value_that_is_no_number_is_named(tmp_path: Path) -> None:
    volts = trials.quiet()
    volts[900, 1] = np.nan
    run_file = trials.write_trials(tmp_path / "a.rigj", {"trial-001": volts})
    assert "trial trial-001: v_2 is nan V at sample 900" in refused(run_file).message


def test_a_run_of_which_nothing_was_kept_is_refused(tmp_path: Path) -> None:
    run_file = trials.write_trials(tmp_path / "a.rigj", {})
    answer = refused(run_file)
    assert "no trial was recorded (complete, 0 of 0 points)" in answer.message
    assert answer.hint == "name another file"


def test_a_run_that_was_interrupted_before_its_first_trial_is_to_be_resumed(
    tmp_path: Path,
) -> None:
    run_file = trials.write_trials(tmp_path / "a.rigj", {}, complete=False)
    assert refused(run_file).hint == f"`rig resume {run_file}` continues the run"


def test_a_run_file_that_has_changed_is_refused_and_one_without_checksum_reported(
    own_run: Path,
) -> None:
    beside = own_run.with_name(own_run.name + ".sha256")
    text = beside.read_text()
    beside.unlink()
    assert (
        "the file cannot be checked for corruption"
        in detected(own_run, own_run.parent / "x").warnings[0]
    )
    beside.write_text("0" * 64 + text[64:])
    answer = refused(own_run)
    assert "not the one that was written" in answer.message
    assert answer.code is ExitCode.FOUND_WRONG


def test_a_computer_with_other_code_refuses(own_run: Path, tmp_path: Path) -> None:
    answer = detect_file(DetectionJob(own_run, DETECTOR, made_by="0" * 64, elsewhere=True))
    assert isinstance(answer, DetectionFailure)
    assert "differs from that of the command" in answer.message
    assert platform.node() in answer.message
    assert not (tmp_path / "processed").exists()
    digest = detection_digest(DETECTOR)
    answer = detect_file(DetectionJob(own_run, DETECTOR, made_by=digest, elsewhere=True))
    assert isinstance(answer, DetectionResult)
    assert answer.made_by == digest


def test_what_other_code_has_made_is_written_again(
    own_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("rig.processing.identity.CODE_DIGEST", "other")
        other = detected(own_run)
        assert detected(own_run).kept
    mine = detected(own_run)
    assert not mine.kept
    assert "other code has made it" in mine.warnings[0]
    assert mine.file == other.file
    assert detected(own_run).kept


@pytest.mark.thorough
def test_the_digest_covers_all_code_from_run_file_to_processed_file() -> None:
    script = (
        "import sys, rig.processing.detection as d\n"
        "from rig.detector.registered import chosen_detector\n"
        "d.prepare(chosen_detector('paper-hp'))"
        "\nprint(*(m.__file__ for n, m in sys.modules.items() if n.startswith('rig.')))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    root = Path(rig.__file__).parent
    loaded = {Path(file).relative_to(root) for file in done.stdout.split()}
    covered = {path.relative_to(root) for pattern in CODE for path in root.glob(pattern)}
    assert Path("detector/rig.json") in covered
    decides = ("detector", "files", "processing")
    others = {str(path) for path in loaded - covered if path.parts[0] in decides}
    assert others <= {
        "files/__init__.py", "files/checksum.py", "files/errors.py", "files/file_kind.py",
        "files/naming.py", "files/verify.py", "files/describe.py", "files/definitions/__init__.py",
        "processing/__init__.py", "processing/identity.py", "processing/parallel.py",
    }  # fmt: skip


FULL_DISK = """
import resource, sys
from pathlib import Path
from rig.detector.registered import ChosenDetector, chosen_detector
from rig.processing.detection import DetectionJob, detect_file
job = DetectionJob(Path(sys.argv[1]), chosen_detector("paper-hp"))
for size in range(0, int(sys.argv[2]), 9001):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    print(detect_file(job).message)
"""


@pytest.mark.thorough
def test_a_full_disk_leaves_nothing(own_run: Path, found: DetectionResult) -> None:
    """Wherever in the file the disk is full."""
    size = found.file.stat().st_size
    command = [sys.executable, "-c", FULL_DISK, str(own_run), str(size)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert len(lines) == -(-size // 9001)
    assert all("cannot be written: File too large" in line for line in lines)
    assert list((own_run.parent / "processed").iterdir()) == []


# Viewers, validators, verify


def validate(path: Path) -> list[tuple[int, int]]:
    from nexusformat.nexus.validate import lint_nxdl, validate_application, validate_file

    definition = definition_path("NXrig_processed")
    assert lint_nxdl(definition) == []
    return [validate_file(str(path)), validate_application(str(path), application=str(definition))]


@pytest.mark.thorough
def test_nexusformat_finds_nothing(found: DetectionResult, tmp_path: Path) -> None:
    assert validate(found.file) == [(0, 0), (0, 0)]
    silent = trials.write_trials(tmp_path / "a.rigj", {"trial-001": trials.quiet()})
    assert validate(detected(silent).file) == [(0, 0), (0, 0)]


def test_viewers_plot_the_first_trial_at_the_first_click(found: DetectionResult) -> None:
    import xarray
    from silx.io.nxdata import NXdata, get_default

    with h5py.File(found.file) as opened:
        default = get_default(opened)
        assert default.group.name == "/entry/data"
        assert default.title.startswith("SIMULATED trial-001")
        assert default.signal_name == "Predictive signal (V)"
        for trial in ("trial_001", "trial_002"):
            assert NXdata(opened[f"entry/trials/{trial}"]).is_valid
    with xarray.open_dataset(found.file, group="/entry/data", engine="h5netcdf") as data:
        assert data["predictive"].dims == ("time",)
        assert data["predictive"].attrs["units"] == "V"


def test_a_run_that_was_not_simulated_does_not_say_so(tmp_path: Path) -> None:
    instruments = [i | {"simulated": False} for i in recorded_run.header()["instruments"]]
    run_file = trials.write_trials(
        tmp_path / "a.rigj", TRIALS, simulated=False, instruments=instruments
    )
    real = detected(run_file)
    assert real.simulated is False
    assert verify(real.file) == []
    assert b"SIMULATED" not in real.file.read_bytes()


def test_verify_says_what_a_sound_file_holds(found: DetectionResult) -> None:
    assert str(verdict(found.file)) == (
        f"sound (paper-hp {DETECTOR_VERSION}, {sum(found.events.values())} events in 2 trials)"
    )


def test_one_that_was_half_copied_is_to_be_detected_again_not_recovered(own_run: Path) -> None:
    made = detected(own_run).file
    made.chmod(0o644)
    made.write_bytes(made.read_bytes()[:40_000])
    assert is_processed(made)
    (*_, said) = verify(made)
    assert "not a readable processed file: " in said
    with pytest.raises(RunFileError) as refusal:
        ProcessedFile.open(made)
    assert refusal.value.hint == "`rig detect` writes it again from the run file"


def test_one_in_place_of_a_run_file_is_refused_with_the_run_file_s_name(own_run: Path) -> None:
    made = detected(own_run).file
    with pytest.raises(RunFileError, match="a processed file, not a run file") as refusal:
        RunFile.open(made)
    assert refusal.value.hint == "name the run file that it was made from, own_r001.h5"


def test_parameters_of_another_version_of_this_program_are_shown_as_they_stand(
    own_run: Path,
) -> None:
    made = detected(own_run).file
    made.chmod(0o644)
    with h5py.File(made, "r+") as file:
        note = file["entry/process/settings/data"]
        former = note.asstr()[()].replace('"fire_mV":', '"former_mV":3.5,"fire_mV":')
        note[()] = former
    with ProcessedFile.open(made) as opened:
        shown = describe_processed(opened)
    assert shown["parameters"]["former_mV"] == 3.5
    assert shown["trials"].keys() == TRIALS.keys()


def test_a_layout_of_another_version_is_named_instead_of_a_damage(own_run: Path) -> None:
    made = detected(own_run).file
    made.chmod(0o644)
    with h5py.File(made, "r+") as file:
        file["entry/definition"].attrs["version"] = "2"
    with pytest.raises(RunFileError, match="of layout 2, and this program reads layout 1") as found:
        ProcessedFile.open(made)
    assert "install the version of tactile-rig that has written it" in str(found.value.hint)


def without_mark(entry: h5py.Group) -> None:
    entry["title"][()] = "Slips detected"


def at_another_time(entry: h5py.Group) -> None:
    entry["events/time"][0] += 0.5


def by_other_parameters(entry: h5py.Group) -> None:
    entry["process/settings/data"].attrs["fingerprint"] = "0" * 64


def without_features(entry: h5py.Group) -> None:
    del entry["events/features"]


def of_another_run(entry: h5py.Group) -> None:
    entry["source/file_name"][()] = "other_r002.h5"


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (without_mark, "title does not say SIMULATED"),
        (at_another_time, "an event's time is not its row's"),
        (by_other_parameters, "fingerprint is not theirs"),
        (without_features, "features is missing"),
        (of_another_run, "its name is not that of its run"),
    ],
)
def test_verify_finds_what_was_changed(own_run: Path, change: object, reported: str) -> None:
    file = detected(own_run).file
    file.chmod(0o644)
    with h5py.File(file, "a") as opened:
        change(opened["entry"])  # type: ignore[operator]
    findings = verify(file)
    assert any("not the one that was written" in finding for finding in findings)
    assert any(reported in finding for finding in findings), findings
