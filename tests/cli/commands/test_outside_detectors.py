"""Detectors of other packages run by the same commands; a broken one disables only itself."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import recorded_trials as trials
from packages import install, on_path, plate_bench

from rig.detector.detector import DETECTOR_VERSION
from rig.files.journal.detections import from_text
from rig.files.processed.reader import ProcessedFile
from rig.files.runfile.reader import RunFile

LAB = "[rig.detectors]\nlab-level = lab.level:Level\n"
LEVEL = '''"""A level detector."""
import numpy as np
from pydantic import Field

from rig.core.settings import Settings
from rig.detector.contract import Detector
from rig.detector.events import SlipEvent


class LevelSettings(Settings):
    level_mV: float = Field(20.0, gt=0)
    """A slip is reported where v_d first passes this level."""


class Level(Detector):
    """Reports a slip where v_d first passes a level."""

    Settings = LevelSettings
    version = "3"

    def reset(self):
        self.fired = False

    def judge(self, volts):
        above = 1e3 * np.abs(volts[:, 0] - volts[:, 1]) > self.settings.level_mV
        if self.fired or not above.any():
            return []
        self.fired = True
        return [self.event("incipient slip", above.argmax(), 0.75)]
'''
MODULES = {"lab/__init__.py": "", "lab/level.py": LEVEL}


def installed(rig: Any, source: str = LEVEL, entries: str = LAB) -> None:
    modules = {**MODULES, "lab/level.py": source}
    on_path(rig, install(rig.folder / "site", "lab-level", entries, modules))


def recorded(rig: Any, rate_Hz: float = 1000.0) -> Path:
    made = {"trial-001": trials.slipping(), "trial-002": trials.quiet(seed=2)}
    return trials.write_trials(rig.folder / "a_r001.rigj", made, rate_Hz=rate_Hz)


@pytest.mark.thorough
def test_it_judges_files_and_the_file_says_whose_it_was(rig: Any) -> None:
    installed(rig)
    file = recorded(rig)
    (rig.folder / "low.toml").write_text("level_mV = 5.0\n")
    done = rig.run("detect", "--detector", "lab-level", "--settings", "low.toml", file.name)
    assert done.code == 0, done.stderr
    assert "2 trials: 1 alarm of incipient slip (first at " in done.stdout
    (made,) = (file.parent / "processed").glob("a_r001.lab-level-3-*.h5")
    del rig.env["PYTHONPATH"]  # years later, without the package
    with ProcessedFile.open(made) as processed:
        assert processed.detector.name == "lab-level"
        assert (processed.detector.package, processed.detector.package_version) == (
            "lab-level", "1.0",
        )  # fmt: skip
        assert processed.detector.settings.model_dump() == {"level_mV": 5.0}
        assert len(processed.events()) == 1
        assert list(processed.findings()) == []
    verified = rig.run("verify", str(made))
    assert verified.code == 0, verified.stderr
    assert "sound (lab-level 3, 1 event in 2 trials)" in verified.stdout
    shown = rig.run("show", "--all", str(made))
    assert "lab-level 1.0" in shown.stdout
    assert "level_mV" in shown.stdout


@pytest.mark.thorough
def test_it_runs_in_several_processes_and_its_new_code_is_a_new_result(rig: Any) -> None:
    installed(rig)
    file = recorded(rig)
    other = trials.write_trials(rig.folder / "b_r001.rigj", {"trial-001": trials.slipping()})
    line = ("detect", "--detector", "lab-level", "--jobs", "2", file.name, other.name)
    assert rig.run(*line).code == 0
    again = rig.run(*line)
    assert again.stdout.count("Saved before") == 2
    (rig.folder / "site/lab/level.py").write_text(LEVEL.replace("argmax()", "argmax() + 1"))
    newer = rig.run(*line)
    assert newer.code == 0, newer.stderr
    assert newer.stderr.count("other code has made it") == 2


def test_the_list_names_it_with_its_package(rig: Any) -> None:
    installed(rig)
    shown = rig.run("detectors")
    assert shown.code == 0, shown.stderr
    lines = shown.stdout.splitlines()
    own = ["impulse", "paper-hp", "paper-literal", "rig", "rig-grip"]
    assert [line.split()[0] for line in lines] == [*own, "lab-level"]
    assert re.search(r"lab-level +3 +lab-level 1\.0 +Reports a slip where v_d first", lines[-1])
    said = json.loads(rig.run("detectors", "--json").stdout)
    assert said["detectors"][-1]["settings"] == {"level_mV": 20.0}


BROKEN = {
    "it cannot be imported": ("import acme_sdk\n", "install acme_sdk, which the package lab-level"),
    "it ends the program": ("raise SystemExit(0)\n", "cannot be imported: .*SystemExit"),
    "a class of another kind": ("class Level: pass\n", "is not a class that derives from"),
    "without judge": (LEVEL.replace("def judge", "def find"), "lacks judge"),
    "judge misspelt": (LEVEL.replace("def judge", "def judges"), "did you mean 'judge'"),
    "a hook misspelt": (
        f"{LEVEL}\n    def cutoff(self, now):\n        pass\n",
        "has 'cutoff', which is not a method of a detector; did you mean 'cut_off'",
    ),
    "without a version": (LEVEL.replace('version = "3"', 'version = "3/1"'), "lacks a version"),
    "settings of its own kind": (
        LEVEL.replace("Settings = LevelSettings", "Settings = dict"),
        "has Settings that are not a subclass",
    ),
    "settings without defaults": (
        LEVEL.replace("Field(20.0, gt=0)", "Field(gt=0)"),
        "has Settings without usable defaults: level_mV: missing; fix the package",
    ),
    "rates that do not ascend": (
        LEVEL.replace('version = "3"', 'version = "3"\n    slowest_Hz = 2000.0'),
        "that do not ascend",
    ),
}


@pytest.mark.thorough
def test_each_broken_one_is_named_and_disables_only_itself(rig: Any) -> None:
    for number, (source, _) in enumerate(BROKEN.values()):
        entries = f"[rig.detectors]\nlab-{number} = lab{number}.level:Level\n"
        modules = {f"lab{number}/__init__.py": "", f"lab{number}/level.py": source}
        install(rig.folder / "site", f"lab-level-{number}", entries, modules)
    on_path(rig, rig.folder / "site")
    listed = rig.run("detectors")
    assert listed.code == 0
    names = {line.split()[0] for line in listed.stdout.splitlines()}
    assert {"impulse", "paper-hp", "paper-literal", "rig"} <= names
    assert not {f"lab-{number}" for number in range(len(BROKEN))} & names
    warnings = [line for line in listed.stderr.splitlines() if "of the package lab-level-" in line]
    assert all(line.startswith("warning:") for line in warnings)
    assert len(warnings) == len(BROKEN)
    for number, (_, expected) in enumerate(BROKEN.values()):
        (warning,) = (one for one in warnings if f"of the package lab-level-{number} " in one)
        assert re.search(expected, warning), warning
    file = recorded(rig)
    refused = rig.run("detect", "--detector", "lab-0", file.name)
    assert refused.code == 2
    (error,) = refused.errors
    assert "of the package lab-level-0 " in error
    assert re.search(BROKEN["it cannot be imported"][1], error), error
    assert rig.run("detect", file.name).code == 0


def test_a_broken_one_is_found_before_a_trial_connects_to_anything(rig: Any) -> None:
    installed(rig, BROKEN["without judge"][0])
    (rig.folder / "bench.toml").write_text(
        plate_bench('driver = "me-gsv8"\nport = "socket://127.0.0.1:9"\n')
    )
    refused = rig.run("slip-trial", "--detector", "lab-level", "--no-figures")
    assert refused.code == 2, refused.stderr
    (error,) = refused.errors
    assert "of the package lab-level" in error
    assert "lacks judge" in error


NONSENSE = {
    "an event of the future": ("above.argmax()", "len(volts) + 3", "but rows .* were judged"),
    "an event of the past": ("above.argmax()", "-1", "an event lies in the row"),
    "no list": ("return [self.event(", "return (self.event(", "TypeError: .SlipEvent"),
    "no event": (
        'return [self.event("incipient slip", above.argmax(), 0.75)]',
        "return [1]",
        "returned int where an event",
    ),
    "an unknown kind": ('"incipient slip"', '"SLIP!"', "kind 'SLIP!': it must be one of"),
    "a confidence of 7": ("0.75", "7.0", "confidence 7.0: it must be from 0 to 1"),
    "no number as confidence": ("0.75", "float('nan')", "confidence nan"),
    "a feature without a number": (
        "0.75)", "0.75, '', {'x': float('inf')})", "feature 'x' is not a finite number",
    ),
    "a time of its own": (
        "return [self.event(",
        "return [SlipEvent('roll', self.rows, 9.0, 0.5), self.event(",
        "an event whose time 9.0 s is not that of its row [0-9]+",
    ),
    "too many events": ("0.75)]", "0.75)] * 1000000", "returned 1000000 events for"),
    "it raises": ("above.argmax()", "1 // 0", "py line 29: ZeroDiv"),
    "it ends the program": ("above.argmax()", "exit(0)", "py line 29: SystemExit"),
    "it changes the rows": ("above.argmax()", "volts.fill(0) or 0", ""),
}  # fmt: skip


def nonsensical(nonsense: str) -> str:
    """The source of a level detector that returns nonsense of this kind."""
    old, new, _ = NONSENSE[nonsense]
    source = LEVEL.replace(old, new)
    if nonsense == "no list":
        source = source.replace("0.75)]", "0.75))")
    assert source != LEVEL
    return source


def test_nonsense_is_refused_and_leaves_nothing(rig: Any) -> None:
    installed(rig, nonsensical("an event of the future"))
    file = recorded(rig)
    done = rig.run("detect", "--detector", "lab-level", "--json", file.name)
    assert len(done.stdout.splitlines()) == 1
    assert done.code == 1, done.stderr
    (error,) = done.errors
    assert "detector 'lab-level' of the package lab-level" in error
    assert re.search(NONSENSE["an event of the future"][2], error), error
    assert not (file.parent / "processed").exists()


DETECT_WITH_EACH = """
import json, sys
from pathlib import Path
from rig.detector.registered import chosen_detector
from rig.processing.detection import DetectionJob, DetectionResult, detect_file
stated = []
for name in sys.argv[2:]:
    found = detect_file(DetectionJob(Path(sys.argv[1]), chosen_detector(name), Path(name)))
    stated.append("" if isinstance(found, DetectionResult) else found.message)
print(json.dumps(stated))
"""


@pytest.mark.thorough
def test_every_kind_of_nonsense_is_refused_and_leaves_nothing(rig: Any) -> None:
    names = [f"lab-{number}" for number in range(len(NONSENSE))]
    for name, nonsense in zip(names, NONSENSE, strict=True):
        module = name.replace("-", "_")
        entries = f"[rig.detectors]\n{name} = {module}:Level\n"
        source = {f"{module}.py": nonsensical(nonsense)}
        install(rig.folder / "site", name, entries, source)
    on_path(rig, rig.folder / "site")
    done = subprocess.run(
        [sys.executable, "-c", DETECT_WITH_EACH, str(recorded(rig)), *names],
        cwd=rig.folder, env=rig.env, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name, stated, (_, _, expected) in zip(
        names, json.loads(done.stdout), NONSENSE.values(), strict=True
    ):
        if not expected:
            with ProcessedFile.open(next((rig.folder / name).glob("*.h5"))) as processed:
                assert abs(processed.trials()[0].v_d).max() > 0.01
            continue
        assert f"detector '{name}' of the package {name}" in stated
        assert re.search(expected, stated), stated
        assert not (rig.folder / name).exists()


@pytest.mark.thorough
def test_what_it_prints_does_not_reach_the_command_s_data(rig: Any) -> None:
    written = 'import os; os.write(1, b"at once\\n")\n'
    says = 'print("hello"); import os; os.write(1, b"below\\n"); above ='
    installed(rig, 'print("loading")\n' + written + LEVEL.replace("above =", says))
    done = rig.run("detect", "--detector", "lab-level", "--json", recorded(rig).name)
    assert done.code == 0, done.stderr
    assert json.loads(done.stdout)["summary"]["files"] == 1
    assert "hello" in done.stderr
    assert {"loading", "at once", "below"} <= set(done.stderr.splitlines())


@pytest.mark.thorough
def test_one_that_ends_its_process_is_named(rig: Any) -> None:
    installed(rig, LEVEL.replace("above =", "import os; self.rows > 100 and os._exit(3); above ="))
    file = recorded(rig)
    other = trials.write_trials(rig.folder / "b_r001.rigj", {"trial-001": trials.slipping()})
    done = rig.run("detect", "--detector", "lab-level", "--jobs", "2", file.name, other.name)
    assert done.code == 1, done.stderr
    for line in done.errors:
        assert "died while detector 'lab-level' of the package lab-level judged" in line


def test_one_that_ends_its_process_at_the_first_row_is_named(rig: Any) -> None:
    """The command tried it on a row first and ended without a word, with the code 3 that is one of
    an instrument."""
    installed(rig, LEVEL.replace("above =", "import os; os._exit(3); above ="))
    done = rig.run("detect", "--detector", "lab-level", recorded(rig).name)
    assert done.code == 1, done.stderr
    assert "died while detector 'lab-level' of the package lab-level judged" in done.errors[-1]


def test_one_that_ends_its_process_does_not_end_the_command_as_if_all_were_done(rig: Any) -> None:
    installed(rig, LEVEL.replace("above =", "import os; self.rows > 100 and os._exit(0); above ="))
    done = rig.run("detect", "--detector", "lab-level", recorded(rig).name)
    assert done.code == 1, done.stderr
    assert "died while detector 'lab-level' of the package lab-level judged" in done.errors[-1]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", "ended its process (SIGSEGV)"),
        pytest.param("os._exit(0)", "ended its process (exit code 0)", marks=pytest.mark.thorough),
        pytest.param("1 // 0", "ZeroDivisionError", marks=pytest.mark.thorough),
    ],
)
def test_one_that_fails_in_a_score_is_named_and_the_others_are_scored(
    rig: Any, fault: str, words: str
) -> None:
    installed(
        rig, LEVEL.replace("above =", f"import os, signal; self.rows > 100 and {fault}; above =")
    )
    file = recorded(rig)
    rows = [f"{file.name},{point},tap,0.5" for point in ("trial-001", "trial-002")]
    (rig.folder / "list.csv").write_text("\n".join(["file,point,label,motion_s", *rows, ""]))
    scored = ("score", "--files", "list.csv", "--no-roc", "--json", "--detector")
    done = rig.run(*scored, "lab-level", "--detector", "paper-hp", "--out", "both")
    assert done.code == 5, done.stderr
    document = json.loads(done.stdout)
    assert [one["name"] for one in document["detectors"]] == ["paper-hp"]
    assert words in document["failed_detectors"]["lab-level"]
    assert "lab-level" not in {row["detector"] for row in document["results"]}
    assert {row["of"] for row in document["results"] if row["quantity"] == "tap_alarms"} == {2}
    assert "error: lab-level is not in the tables: at a_r001.h5 trial-001, " in done.errors[-1]
    assert "detector 'lab-level' of the package lab-level" in done.errors[-1]
    assert words in done.errors[-1]
    done = rig.run(*scored, "lab-level", "--out", "alone")
    assert done.code == 1, done.stderr
    assert words in done.errors[-1]
    assert not (rig.folder / "alone").exists()


def living_in(group: int) -> list[int]:
    """The processes of this group that have not ended."""
    living = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, of_group = entry.read_text().rpartition(")")[2].split()[:3]
            if int(of_group) == group and state != "Z":
                living.append(int(entry.parent.name))
    return living


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_score_in_which_one_hangs_in_one_of_several_processes_ends_with_all_of_them(
    number: signal.Signals, code: int, rig: Any
) -> None:
    hangs = "volts.any() and (open('hangs', 'w').close(), [0 for _ in iter(int, 1)]); above ="
    installed(rig, LEVEL.replace("above =", hangs))
    (rig.folder / "population.json").write_text(
        json.dumps({"ridge": 2, "skin": {"ridges": 3, "elements_per_ridge": 3}, "held_s": 0.05})
    )
    begun = rig.start(
        "score", "--detector", "lab-level", "--population", "population.json", "--kinds", "slide",
        "--seeds", "1000000:1000002", "--no-roc", "--jobs", "2", "--out", "out",
    )  # fmt: skip
    give_up_s = time.monotonic() + 120
    while not (rig.folder / "hangs").exists():
        assert time.monotonic() < give_up_s, "the detector has not judged a trial"
        time.sleep(0.05)
    begun.send(number)
    assert begun.process.wait(120) == code
    while left := living_in(begun.process.pid):
        assert time.monotonic() < give_up_s + 120, left
        time.sleep(0.05)


def test_a_name_that_two_packages_register_disables_that_name_only(rig: Any) -> None:
    installed(rig)
    on_path(rig, install(rig.folder / "other", "lab-other", LAB))
    listed = rig.run("detectors")
    assert listed.code == 0, listed.stderr
    assert "paper-hp (default)" in listed.stdout
    assert "'lab-level' is registered by the packages" in listed.stderr
    file = recorded(rig)
    done = rig.run("detect", file.name)
    assert done.code == 0, done.stderr
    refused = rig.run("detect", "--detector", "lab-level", file.name)
    assert refused.code == 2
    assert "uninstall all but one of them" in refused.errors[-1]


@pytest.mark.thorough
def test_another_package_s_detector_of_our_name_does_not_replace_ours(rig: Any) -> None:
    installed(rig, entries="[rig.detectors]\npaper-hp = lab.level:Level\n")
    done = rig.run("detect", recorded(rig).name)
    assert done.code == 0, done.stderr
    assert f".paper-hp-{DETECTOR_VERSION}-" in done.stdout


@pytest.mark.thorough
def test_one_that_hangs_is_dropped_on_the_simulated_bench_and_the_trial_continues(rig: Any) -> None:
    hangs = "while self.rows > 500:\n            pass\n        above ="
    installed(rig, LEVEL.replace("above =", hangs))
    done = rig.run(
        "slip-trial", "--json", "--no-figures", "--detector", "lab-level",
        "--distance", "0.4mm", "--rest", "100ms", "--force-error-peak", "100",
    )  # fmt: skip
    assert done.code in (0, 5), done.stderr
    assert re.search(r"of the package \S+ fell behind by \d+ ms: no longer used", done.stderr)
    assert done.object["outcome"] == "complete"


@pytest.mark.thorough
def test_a_run_whose_grip_needs_one_that_has_ended_presses_nothing_more(rig: Any) -> None:
    """Every further trial would be pressed, and repeated, in vain."""
    ends = "import os; self.rows > 500 and os._exit(3); above ="
    installed(rig, LEVEL.replace("above =", ends))
    done = rig.run(
        "slip-trial", "--json", "--no-figures", "--detector", "lab-level", "--regrip", "-n", "3",
        "--distance", "0.4mm", "--rest", "100ms", "--force-error-peak", "100",
    )  # fmt: skip
    assert done.code == 1, done.stderr
    assert "detector lab-level was dropped (see the warning about it)" in done.stderr
    assert "Bench is safe" in done.stderr
    with RunFile.open(rig.folder / done.object["file"]) as run:
        (reading,) = run.readings()
    assert "was dropped, so the grip got no alarms" in str(reading["invalid"])


@pytest.mark.thorough
def test_it_runs_beside_a_trial_and_the_grip_answers_it(rig: Any) -> None:
    installed(rig)
    done = rig.run(
        "slip-trial", "--json", "--no-figures", "--detector", "lab-level", "--regrip",
        "--distance", "0.4mm", "--rest", "100ms", "--force-error-peak", "100",
    )  # fmt: skip
    assert done.code in (0, 5), done.stderr
    assert "incipient slip at " in done.stderr
    with RunFile.open(rig.folder / done.object["file"]) as run:
        (reading,) = run.readings()
    (live,) = from_text(reading["detections"])
    assert (reading["detector"], reading["squeezes"]) == ("lab-level", 1.0)
    judged = rig.run("detect", "--detector", "lab-level", done.object["file"])
    assert f"first at {live.time_s:.3f} s" in judged.stdout or f"{live.time_s:.3f}" in judged.stdout
