"""docs/files.md: its examples run as they stand, and its tables name what the program writes."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
from pathlib import Path

import h5py
import pytest
import recorded_run as run
import recorded_skin

from rig.files.journal.format import MAGIC, MAX_PAYLOAD, RecordKind
from rig.files.journal.layout import RESERVED_GROUPS
from rig.files.runfile.compile import compile_run
from rig.files.verify import REQUIRED

TEXT = (Path(__file__).parents[2] / "docs" / "files.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
NAME = "2026-11-21T22-00-00_sweep_r017.h5"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the run file that the document's examples open."""
    compile_run(run.write_run(tmp_path / "run.rigj"), tmp_path / NAME)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def printed(example: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(example, "docs/files.md", "exec"), {})
    return out.getvalue()


def test_the_h5py_example_reads_readings_and_samples(folder: Path) -> None:
    shown = printed(EXAMPLES[0])
    assert shown.startswith("SIMULATED Sweep of strip A is complete\n")
    assert "-19.9" in shown
    assert " dB\n" in shown
    first = run.samples(3)[:3, 0] * run.state()["scale"][0]  # point 3 was recorded first
    assert shown.endswith(f"{first} V at 4000.0 Hz\n")


def test_the_xarray_example_finds_a_gain_by_its_frequency(folder: Path) -> None:
    gain, unit = printed(EXAMPLES[1]).split()
    assert float(gain) == run.reading(3)["gain_dB"]
    assert unit == "dB"


def test_the_xarray_example_of_a_trial_finds_friction_and_volts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = recorded_skin.write_skin(tmp_path / "run.rigj")
    file.rename(tmp_path / "2026-11-21T22-00-00_slip-trial_r018.h5")
    monkeypatch.chdir(tmp_path)
    found, volts = printed(EXAMPLES[2]).splitlines()
    frames, friction, stored = re.findall(r"[\d.]+", found)
    assert found == f"{frames} frames, friction {friction}, stored {stored}"
    assert 165 < int(frames) < 185  # of 500: from 0.05 mm after 1.25 times the way to the peak on
    assert float(stored) == pytest.approx(recorded_skin.reading(0)["kinetic_friction"], abs=5e-4)
    assert float(friction) == pytest.approx(float(stored), rel=0.005)
    counts = recorded_skin.samples("strips", 0)[1000:2001, 0]
    assert volts == f"('time',) 1001 V {counts.std() * recorded_skin.COUNTS_V:.4f}"


def test_the_checksum_is_checked_by_hand_as_described(folder: Path) -> None:
    (command,) = re.findall(r"^    (sha256sum .*)$", TEXT, re.MULTILINE)
    assert subprocess.run(command.split(), capture_output=True).returncode == 0
    content = bytearray((folder / NAME).read_bytes())
    content[len(content) // 2] ^= 1
    (folder / NAME).unlink()
    (folder / NAME).write_bytes(content)
    assert subprocess.run(command.split(), capture_output=True).returncode == 1


def test_the_journal_is_read_by_what_the_document_says_alone(tmp_path: Path) -> None:
    import json
    import struct
    import zlib

    content = run.write_run(tmp_path / "a.rigj").read_bytes()
    assert content[:8] == b"RIGJ0001"
    at, found = 8, []
    while at < len(content):
        length, checksum = struct.unpack_from("<II", content, at)
        payload = content[at + 8 : at + 8 + length]
        assert zlib.crc32(payload) == checksum
        found.append(payload[0])
        if payload[0] == 2:
            _, stream, first_index, _ = struct.unpack_from("<BHQd", payload)
            assert stream == 0
            assert (length - 19) % 4 == 0
            assert first_index in (0, 250)
        else:
            json.loads(payload[1:])
        at += 8 + length
    assert found[0] == 1
    assert found[-1] == 7
    assert found.count(5) == len(run.POINTS)


def test_the_tables_of_the_document_are_complete() -> None:
    rows = dict(re.findall(r"^\| (\d) \| ([A-Z_]+) \|", TEXT, re.MULTILINE))
    assert rows == {str(int(kind)): kind.name for kind in RecordKind}
    assert MAGIC.decode() in TEXT
    assert f"{MAX_PAYLOAD:_}".replace("_", " ") in TEXT
    tree = TEXT[TEXT.index("## The run file") : TEXT.index("## The processed file")]
    missing = {
        name for name in {*RESERVED_GROUPS, *REQUIRED} if not re.search(rf"\b{name}\b", tree)
    }
    assert missing == set()


def test_what_a_file_holds_is_in_the_document(folder: Path) -> None:
    tree = TEXT[TEXT.index("## The run file") : TEXT.index("## The processed file")]
    with h5py.File(NAME) as file:
        names = {*file["entry"], *file["entry/outcome"], *file["entry/events"]}
        assert {
            name for name in names - {"coherence"} if not re.search(rf"\b{name}\b", tree)
        } == set()
