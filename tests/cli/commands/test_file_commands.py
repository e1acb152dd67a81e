"""Commands on the files of an interrupted or damaged run, through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import recorded_run as run

from rig.files.journal.values import RunHeader
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run
from rig.files.verify import safe_verdict, verdict


def test_a_verdict_calls_points_what_the_procedure_of_the_run_calls_them(tmp_path: Path) -> None:
    with JournalWriter.create(tmp_path / "run.rigj", run.header()) as writer:
        run.take_point(writer, 0)
        writer.end(run.end("stopped", 1))

    def noun_of(header: RunHeader) -> tuple[str, str]:
        return {"sweep": ("trial", "trials")}[header.procedure]

    assert str(verdict(tmp_path / "run.rigj")) == "sound (stopped, 1 of 5 points)"
    assert str(verdict(tmp_path / "run.rigj", noun_of)) == "sound (stopped, 1 of 5 trials)"
    file = compile_run(tmp_path / "run.rigj")
    assert str(safe_verdict(file, noun_of)) == "sound (stopped, 1 of 5 trials)"


@pytest.mark.thorough
def test_an_interrupted_run_is_shown_and_verified_from_both_of_its_files(rig: Any) -> None:
    with JournalWriter.create(rig.folder / "run.rigj", run.header(notes="first try")) as writer:
        for number in (0, 1):
            run.take_point(writer, number)
        writer.end(run.end("stopped", 2))
    journal = rig.run("verify", "run.rigj")
    assert journal.code == 0
    assert journal.stdout == "run.rigj: sound (stopped, 2 of 5 points)\n"
    assert rig.run("recover", "run.rigj").code == 0
    file = rig.run("verify", "run.h5")
    assert file.stdout == "run.h5: sound (stopped, 2 of 5 points)\n"
    for name in ("run.rigj", "run.h5"):
        shown = rig.run("show", "--no-figures", name)
        assert shown.code == 0, shown.stderr
        for line in (
            "start: 2026-11-21 22:00:00+01:00, took 7.2 s of bench time",
            "status: stopped (operator), 2 of 5 points",
            "user: A. Person (email a@example.org)",
            "sample: strip A (thickness_um 28.0)",
            "notes: first try",
            "bench: bench.toml",
            "resume with: rig resume run.rigj",
        ):
            assert line in shown.stdout.splitlines(), (name, shown.stdout)
        everything = rig.run("show", "--all", name).stdout.splitlines()
        for line in ("status: stopped", "reason: operator", "points_done: 2", "duration_s: 7.25"):
            assert line in everything

    (rig.folder / "run.rigj").unlink()
    for command in ("resume", "recover"):
        ended = rig.run(command, "run.h5")
        assert ended.code == 2
        assert "run.rigj is not beside it" in ended.errors[0]
        assert "stopped, 2 of 5 points" in ended.errors[0]


def test_a_damaged_journal_is_reported_by_verify_and_refused_before_any_bench(rig: Any) -> None:
    path = run.write_run(rig.folder / "run.rigj")
    content = bytearray(path.read_bytes())
    content[9000] ^= 1
    path.write_bytes(content)
    verified = rig.run("verify", "run.rigj")
    assert verified.code == 8
    assert "damaged, with sound records behind that: bad record at byte" in verified.stdout

    ended = rig.run("resume", "run.rigj", "--world-log", str(rig.world_log))
    assert ended.code == 2
    (error,) = ended.errors
    assert error.count("byte") == 1
    assert ended.stderr.splitlines() == [error], "no bench was started"
    assert not rig.world_log.exists()


def test_many_warnings_leave_the_rest_of_a_run_on_the_screen(rig: Any) -> None:
    with JournalWriter.create(rig.folder / "run.rigj", run.header()) as writer:
        run.take_point(writer, 0)
        reported = [f"1 record at {n} Hz taken again" for n in range(1, 36)]
        writer.end(run.end("stopped", 1, warnings=reported))
    short = rig.run("show", "run.rigj")
    assert 3 <= (named := short.stdout.count("taken again")) <= 12
    assert f"... and {35 - named} more; --all shows them" in short.stdout
    assert len(short.stdout.splitlines()) <= 23
    assert rig.run("show", "--all", "run.rigj").stdout.count("taken again") == 35
    assert rig.run("show", "--json", "run.rigj").stdout.count("taken again") == 35


def test_every_file_of_a_show_as_json_has_its_object_also_one_that_cannot_be_read(rig: Any) -> None:
    with JournalWriter.create(rig.folder / "run.rigj", run.header()) as writer:
        writer.end(run.end("stopped", 0))
    alone = rig.run("show", "--json", "absent.h5")
    assert alone.code == 2
    assert json.loads(alone.stdout)["errors"] == ["absent.h5: no such file"]

    several = rig.run("show", "--json", "run.rigj", "absent.h5", "run.rigj")
    assert several.code == 2
    objects = [json.loads(line) for line in several.stdout.splitlines()]
    assert [one["file"] for one in objects] == ["run.rigj", "absent.h5", "run.rigj"]
    assert (objects[1]["outcome"], objects[1]["exit"]) == ("failed", 2)
    assert objects[1]["errors"] == ["absent.h5: no such file"]

    overlay = rig.run("show", "--json", "--overlay", "run.rigj")
    assert overlay.code == 2
    assert "name two or more" in json.loads(overlay.stdout)["errors"][0]

    twice = rig.run("show", "--overlay", "run.rigj", "./run.rigj")
    assert twice.code == 2
    assert "run.rigj is named twice, and --overlay shows how runs differ" in twice.stderr
