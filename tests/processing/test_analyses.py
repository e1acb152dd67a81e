"""Analyses of other packages: what is shown and kept, and what a broken one costs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import recorded_trials as trials
from packages import install, on_path

from rig.files.runfile.reader import RunFile
from rig.processing.analyses import analyse

MODULE = """
import numpy as np

def values(run):
    return {"points": len(run.point_ids()), "largest_N": np.float32(2.5), "unknown_mm": np.nan,
            "each_V": np.arange(2.0), "judged": "good"}

def fails(run):
    raise RuntimeError("no such column")

def number(run):
    return 3

def strange(run):
    return {"run": run}
"""


@pytest.fixture
def file(rig: Any, tmp_path: Path) -> Path:
    """A run file of the procedure lab-trial, and a package with analyses for it."""
    entries = "[rig.analyses]\n" + "\n".join(
        (
            "lab-trial = lab_values:values",
            "lab-trial.broken = lab_values:fails",
            "lab-trial.number = lab_values:number",
            "lab-trial.strange = lab_values:strange",
            "lab-trial.missing = lab_values:missing",
            "lab-trial.folder = no_such_folder:values",
            "slip-trail = lab_values:values",
            "sweep = lab_values:fails",
        )
    )
    on_path(rig, install(tmp_path / "site", "lab-values", entries, {"lab_values.py": MODULE}))
    (rig.folder / "results").mkdir()
    recorded = {"trial-1": trials.slipping()}
    journal = rig.folder / "results" / "one.rigj"
    return trials.write_trials(journal, recorded, complete=True, procedure="lab-trial")


def test_the_values_of_an_analysis_are_shown_and_kept_and_broken_ones_cost_a_line(
    rig: Any, file: Path
) -> None:
    done = rig.run("analyse", str(file))
    assert done.code == 0, done.stderr
    assert "lab-trial (lab-values 1.0):" in done.stdout
    assert "  largest_N: 2.5" in done.stdout
    kept = json.loads((file.parent / "processed" / "one.analyses.json").read_text())
    assert list(kept["analyses"]) == ["lab-trial"]
    found = kept["analyses"]["lab-trial"]
    assert found["values"] == {
        "points": 1,
        "largest_N": 2.5,
        "unknown_mm": None,
        "each_V": [0.0, 1.0],
        "judged": "good",
    }
    assert found["units"] == {"largest_N": "N", "unknown_mm": "mm", "each_V": "V"}
    (recorded,) = (line.split()[0] for line in Path(f"{file}.sha256").read_text().splitlines())
    assert kept["source"]["sha256"] == recorded
    for words in (
        "the analysis lab-trial.broken (lab_values:fails) of lab-values failed: "
        "lab_values.py line 9: RuntimeError: no",
        "lab-trial.number (lab_values:number) of lab-values failed: TypeError: it returned int",
        "of lab-values failed: TypeError: run is a RunFile, neither a number nor a text",
        "lab-trial.missing (lab_values:missing) of lab-values failed: AttributeError",
        "lab-trial.folder (no_such_folder:values) of lab-values failed: ModuleNotFoundError",
        "the analysis slip-trail (lab_values:values) of lab-values belongs to no installed "
        "procedure; did you mean slip-trial?",
    ):
        assert words in done.stderr
    shown = rig.run("show", "--no-figures", str(file))
    assert shown.code == 0, shown.stderr
    assert "  judged: good" in shown.stdout


def test_a_file_without_an_analysis_is_reported(rig: Any, tmp_path: Path) -> None:
    journal = rig.folder / "one.rigj"
    file = trials.write_trials(journal, {"trial-1": trials.slipping()}, complete=True)
    refused = rig.run("analyse", str(file))
    assert refused.code == 2
    assert "nothing was computed for" in refused.errors[0]


def test_a_file_that_cannot_be_used_leaves_those_behind_it(rig: Any, file: Path) -> None:
    (rig.folder / "half.h5").write_bytes(file.read_bytes()[:20_000])
    done = rig.run("analyse", "half.h5", str(file))
    assert "half.h5: not a readable run file" in done.errors[0]
    assert "  largest_N: 2.5" in done.stdout
    assert done.code == 5


def test_a_file_whose_analysis_fails_is_reported_as_that(rig: Any, tmp_path: Path) -> None:
    entries = "[rig.analyses]\nlab-trial = lab_fails:fails"
    module = "def fails(run):\n    raise KeyError('fit')\n"
    on_path(rig, install(tmp_path / "site", "lab-fails", entries, {"lab_fails.py": module}))
    recorded = {"trial-1": trials.slipping()}
    journal = rig.folder / "one.rigj"
    file = trials.write_trials(journal, recorded, complete=True, procedure="lab-trial")
    refused = rig.run("analyse", "--debug", str(file))
    assert refused.code == 2
    assert "of lab-fails failed: lab_fails.py line 2: KeyError: 'fit'\n" in refused.stderr
    assert "Traceback" in refused.stderr
    assert "its analysis failed (see above); correct the package" in refused.errors[0]
    assert "install" not in refused.errors[0]


def test_an_analysis_that_never_returns_is_interrupted(
    file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    module = "import time\ndef never(run):\n    time.sleep(1e6)\n"
    entries = "[rig.analyses]\nlab-trial.never = lab_never:never"
    site = install(tmp_path / "never", "lab-never", entries, {"lab_never.py": module})
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setattr("rig.processing.analyses.LONGEST_S", 1.0)
    with RunFile.open(file) as run:
        (warning,) = (one for one in analyse(run).warnings if "lab-never" in one)
    assert warning == (
        "the analysis lab-trial.never (lab_never:never) of lab-never failed: lab_never.py line 3: "
        "it took longer than 1 s"
    )


def test_an_analysis_may_print_and_close_its_file_and_even_stdout(
    file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    module = (
        "import os\ndef closes(run):\n    print('look')\n    os.write(1, b'as C does\\n')\n"
        "    os.close(1)\n    with run:\n        return {'points': 1}\n"
    )
    entries = "[rig.analyses]\nlab-trial.closes = lab_closes:closes"
    site = install(tmp_path / "closes", "lab-closes", entries, {"lab_closes.py": module})
    monkeypatch.syspath_prepend(str(site))
    with RunFile.open(file) as run:
        (found,) = (one for one in analyse(run).found if one.package == "lab-closes")
        assert run.point_ids() == ["trial-1"], "it is still open for who comes next"
    assert found.values == {"points": 1}
    os.write(1, b"the answer\n")
    out, err = capfd.readouterr()
    assert out == "the answer\n"
    assert set(err.splitlines()) == {"look", "as C does"}


def test_a_signal_during_an_analysis_ends_the_command_and_is_no_fault_of_the_package(
    rig: Any, tmp_path: Path
) -> None:
    module = "import signal\ndef stopped(run):\n    signal.raise_signal(signal.SIGTERM)\n"
    entries = "[rig.analyses]\nlab-trial = lab_stopped:stopped"
    on_path(rig, install(tmp_path / "site", "lab-stopped", entries, {"lab_stopped.py": module}))
    journal = rig.folder / "one.rigj"
    recorded = {"trial-1": trials.slipping()}
    file = trials.write_trials(journal, recorded, complete=True, procedure="lab-trial")
    ended = rig.run("analyse", str(file))
    assert ended.code == 143, ended.stderr
    assert "failed" not in ended.stderr
    assert not list(rig.folder.rglob("*.analyses.json"))
