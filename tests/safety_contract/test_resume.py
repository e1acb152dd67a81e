"""An interrupted sweep goes on where it was interrupted, and gives what it would have given."""

from __future__ import annotations

import re
import signal

import numpy as np
import pytest
from recorded_run import end

from rig.core.settings import fingerprint
from rig.files.journal.reader import read_journal
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

SETTLING = ("--settling", "0.3s")
"""So that a run takes seconds and is interrupted in the middle on a busy machine too."""
FORTY_POINTS = ("--frequencies", ",".join(f"{300 * 1.07**k:.6g}" for k in range(40)), *SETTLING)
"""No round numbers: what remains of mains and ringing would be alike at all of them."""


def interrupted_at(line, running):
    """Press Ctrl-C at a line of a sweep under way; its end."""
    running.wait_for(line)
    running.send(signal.SIGINT)
    return running.finish()


@pytest.mark.thorough
def test_a_resumed_sweep_equals_an_uninterrupted_one(rig):
    whole = rig.sweep(*FORTY_POINTS)
    assert whole.code == 0, whole.stderr
    stopped = interrupted_at(r"^8/40 ", rig.start_sweep(*FORTY_POINTS))
    resumed_from = stopped.object["points_done"]
    resumed = rig.run("resume", stopped.object["journal"], "--no-figures", "--json")

    assert resumed.code == 0, resumed.stderr
    assert resumed.object["points_done"] == 40
    finished = f"Finished: 40 of 40 points, {resumed_from} of them earlier, in "
    assert finished in resumed.stderr
    assert " of bench time since the resume (simulated)." in resumed.stderr
    assert not list(rig.results.rglob("*.rigj")), "a complete run needs its journal no more"
    with (
        RunFile.open(rig.folder / whole.object["file"]) as expected,
        RunFile.open(rig.folder / resumed.object["file"]) as got,
    ):
        assert got.point_ids() == expected.point_ids()
        assert len(set(got.point_ids())) == 40
        assert got.outcome.attempt == 2
        difference = (got.column("gain") - expected.column("gain"))[resumed_from:]
        errors = np.hypot(got.column("gain_error"), expected.column("gain_error"))[resumed_from:]
        # The World remembers the generator's phase, so the same noise meets another phase: values
        # taken after the interruption agree within their errors, those before it to the bit. Of
        # opposite phases the noise adds up instead of adding its squares: up to sqrt(2) times what
        # two independent values would differ by, and where it was stopped decides which phase.
        assert np.abs(difference / errors).max() < 4.2 * np.sqrt(2)
        assert np.sqrt(np.mean((difference / errors) ** 2)) < 1.25 * np.sqrt(2)
        kept_before = slice(0, resumed_from)
        assert (got.column("gain")[kept_before] == expected.column("gain")[kept_before]).all()


@pytest.mark.thorough
def test_a_run_of_an_earlier_version_is_refused_for_what_has_changed_since(rig):
    """Its bench file, which the journal holds, need not be one that would be accepted now."""
    stopped = interrupted_at(r"^3/40 ", rig.start_sweep(*FORTY_POINTS))
    assert stopped.code == 130, stopped.stderr
    header = read_journal(rig.folder / stopped.object["journal"]).header
    was = header.bench_toml
    before, stage, after = was.partition("[stage_z]")
    then = before + stage + re.sub(r"(?m)^timeout_s = .*$", "timeout_s = 3.5", after, count=1)
    assert then != was
    earlier = rig.folder / "earlier.rigj"
    changed = {"bench_toml": then, "fingerprint": fingerprint("sweep", {}, 0, then)}
    with JournalWriter.create(earlier, header.model_copy(update=changed)) as journal:
        journal.end(end("stopped", 0))
    refused = rig.run("resume", str(earlier), "--no-figures")

    assert refused.code == 2, refused.stderr
    (error,) = refused.errors
    assert "changed since the run began" in error
    assert "[stage_z] timeout_s of the bench file (3.5 then, " in error
    assert "start a new run" in error

    instruments = tuple(
        one.model_copy(update={"serial_number": "MY1"}) if one.name == "daq" else one
        for one in header.instruments
    )
    parts = {"instruments": instruments, "procedure_version": "0.9"}
    swapped = rig.folder / "swapped.rigj"
    with JournalWriter.create(swapped, header.model_copy(update=parts)) as journal:
        journal.end(end("stopped", 0))
    refused = rig.run("resume", str(swapped), "--no-figures", "--allow-expired")
    assert refused.code == 2, refused.stderr
    (error,) = refused.errors
    assert re.search(
        r"changed since the run began: .*; daq \(\S+ MY1 then, \S+ SIM\S* now\)", error
    )
    assert "version of the procedure's package (0.9 then, none now)" in error


GRID = ("--lowest", "200", "--fine-per-decade", "20", "--highest", "12000", *SETTLING)
"""A grid of its own, with two drops that a second plan looks at."""


@pytest.mark.thorough
def test_a_sweep_interrupted_in_its_second_plan_continues_there(rig):
    running = rig.start_sweep(*GRID)
    second = running.wait_for(r"^sweep: \d+ further points \(\d+ done\), about ")
    to_take, grid = map(int, re.findall(r"(\d+) further points \((\d+) done", second)[0])
    stopped = interrupted_at(rf"^{grid + 3}/{grid + to_take} ", running)
    assert stopped.code == 130, stopped.stderr
    with RunFile.open(rig.folder / stopped.object["file"]) as run:
        before = dict(zip(run.point_ids(), run.column("gain"), strict=True))
    assert grid + 3 <= len(before) < grid + to_take
    resumed = rig.run("resume", stopped.object["journal"], "--no-figures", "--json")

    assert resumed.code == 0, resumed.stderr
    assert resumed.object["points_done"] == resumed.object["points_planned"] == grid + to_take
    file = rig.folder / resumed.object["file"]
    assert verify(file) == []
    with RunFile.open(file) as run:
        after = dict(zip(run.point_ids(), run.column("gain"), strict=True))
        assert len(run.point_ids()) == len(after) == grid + to_take
    assert {point: after[point] for point in before} == before
    taken = re.findall(r"^\d+/\d+ (\S+)$", stopped.stderr + resumed.stderr, re.MULTILINE)
    assert sorted(taken) == sorted(after), "every point exactly once, those of both plans"


@pytest.mark.thorough
def test_a_complete_run_is_not_resumed(rig):
    done = rig.sweep("--frequencies", "20")
    again = rig.run("resume", done.object["file"])

    assert again.code == 2
    assert "complete" in again.errors[0]


@pytest.mark.thorough
def test_a_journal_that_was_edited_is_not_resumed(rig):
    stopped = interrupted_at(r"^5/40 ", rig.start_sweep(*FORTY_POINTS))
    journal = rig.folder / stopped.object["journal"]
    content = journal.read_bytes()
    # The header's checksum protects it: an edited journal is refused, not resumed.
    edited = content.replace(b'"load_N":1.0', b'"load_N":2.0', 1)
    assert edited != content
    journal.write_bytes(edited)
    again = rig.run("resume", str(journal))

    assert again.code == 2
    assert "journal" in again.errors[0] or "rigj" in again.errors[0]


@pytest.mark.thorough
def test_a_simulated_run_is_resumed_on_a_simulated_bench_whatever_lies_beside(rig):
    stopped = interrupted_at(
        r"^1/6 ", rig.start_sweep("--frequencies", "300,400,500,600,700,800", *SETTLING)
    )
    assert stopped.code == 130, stopped.stderr
    (rig.folder / "bench.toml").write_text("[no bench file at all")
    resumed = rig.run("resume", stopped.object["journal"], "--no-figures", "--json")
    assert resumed.code == 0, resumed.stderr
    assert resumed.object["points_done"] == 6


@pytest.mark.thorough
def test_a_run_whose_bench_is_gone_has_lost_nothing(rig):
    """What an earlier attempt has recorded is reported, though nothing answers."""
    with rig.served() as path:
        asked = ("--frequencies", "300,400,500", *SETTLING, "--json", "--no-figures")
        running = rig.start("sweep", *asked, "--bench", str(path))
        running.wait_for(r"^1/3 ")
        running.send(signal.SIGINT)
        stopped = running.finish()
    kept = stopped.object["points_done"]
    assert kept > 0, stopped.stderr
    again = rig.run("resume", stopped.object["journal"], "--no-figures", "--json")

    assert again.code == 3, again.stderr
    assert f"Failed: {kept} of 3 points" in again.stderr
    assert again.object["points_done"] == kept
    assert verify(rig.folder / stopped.object["journal"]) == []


@pytest.mark.thorough
def test_a_resume_in_another_folder_says_where_the_bench_file_is_missed(rig):
    """It is named as it was given, which may be relative to the folder where the run began; `rig
    resume` has no other way to name it."""
    with rig.served():
        asked = ("--frequencies", "300,400,500", *SETTLING, "--json", "--no-figures")
        running = rig.start("sweep", *asked, "--bench", "bench.toml")
        running.wait_for(r"^1/3 ")
        running.send(signal.SIGINT)
        stopped = running.finish()
    (rig.folder / "bench.toml").rename(rig.folder / "elsewhere.toml")
    again = rig.run("resume", stopped.object["journal"])
    assert again.code == 2
    (error,) = again.errors
    assert f"the bench file of this run, bench.toml, does not exist in {rig.folder}" in error
    assert "give the command in the folder in which the run began" in error
    assert "--bench" not in error
