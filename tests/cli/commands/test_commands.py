"""Commands about files and benches: one line for what is wrong, its exit code, nothing else."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from pathlib import Path
from typing import Any

import h5py
import pytest
import typer
from benches import declare_soft_contact

from rig.cli.commands import show
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

SHORT = ("--frequencies", "200,1000", "--no-figures", "--json")


@pytest.fixture(scope="module")
def run_file(rig_of_the_module) -> Path:
    """A complete run file, made once."""
    rig = rig_of_the_module
    done = rig.sweep("--frequencies", "200")
    assert done.code == 0, done.stderr
    return rig.only("*.h5")


CODES = {"show": 8, "verify": 8, "recover": 8, "resume": 8}


@pytest.mark.parametrize("command", CODES)
@pytest.mark.thorough
def test_a_file_that_was_cut_off_is_reported_in_one_line(
    rig: Any, run_file: Path, command: str
) -> None:
    content = run_file.read_bytes()
    (rig.folder / "given.h5").write_bytes(content[: len(content) // 2])
    ended = rig.run(command, "given.h5")

    assert ended.code == CODES[command], ended.stderr
    assert len(ended.errors) == 1
    assert ended.stderr.splitlines() == ended.errors, "one line, and no traceback"
    assert "given" in ended.errors[0] + ended.stdout
    if command != "verify":
        assert ended.stdout == ""


@pytest.mark.parametrize("command", ["recover", "resume"])
def test_a_text_file_is_no_journal(rig: Any, command: str) -> None:
    (rig.folder / "given.rigj").write_text("hello\n")
    ended = rig.run(command, "given.rigj")

    assert ended.code == 8, "as of show, verify and detect"
    (error,) = ended.errors
    assert "given.rigj" in error
    assert "not a journal" in error


@pytest.mark.thorough
def test_a_sound_file_is_shown_and_verified(rig: Any, run_file: Path) -> None:
    for path in run_file.parent.iterdir():
        shutil.copy(path, rig.folder)
    shown = rig.run("show", run_file.name)
    assert shown.code == 0, shown.stderr
    assert "sweep" in shown.stdout
    assert "SIMULATED" in shown.stdout or "simulated" in shown.stdout
    assert "load_N 1" not in shown.stdout
    everything = rig.run("show", run_file.name, "--all")
    assert "  load_N: 1\n" in everything.stdout
    data = json.loads(rig.run("show", run_file.name, "--json").stdout)
    assert data["settings"]["load_N"] == 1.0
    assert data["results"]
    verified = rig.run("verify", run_file.name)
    assert verified.code == 0
    assert verified.stdout == f"{run_file.name}: sound (complete, 1 of 1 point)\n"


def of_another_program(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["spectrum"] = [1.0, 2.0]


def not_hdf5(path: Path) -> None:
    path.write_text("hello\n")


def nothing(path: Path) -> None:
    path.touch()


@pytest.mark.parametrize("command", CODES)
@pytest.mark.parametrize(
    ("make", "reported"),
    [
        (Path.mkdir, "a folder"),
        (nothing, "an empty file"),
        (not_hdf5, "not a journal and not a run file"),
        (of_another_program, "an HDF5 file, but not a run file"),
    ],
)
@pytest.mark.thorough
def test_every_command_says_what_kind_of_file_it_was_given(
    rig: Any, command: str, make: Any, reported: str
) -> None:
    make(rig.folder / "given.h5")
    ended = rig.run(command, "given.h5")
    is_found_wrong = command == "verify" or make is not Path.mkdir
    assert ended.code == (CODES[command] if is_found_wrong else 2)
    assert reported in ended.stdout + ended.stderr
    assert ended.stderr.splitlines() == ended.errors, "one line, and no traceback"
    for word in ("complete", "closed", "Error", "synchronously"):
        assert word not in ended.stdout + ended.stderr


@pytest.mark.parametrize("command", ["show", "detect", "analyse", "recover", "resume"])
def test_a_mistyped_name_is_a_usage_error_in_the_same_words(rig: Any, command: str) -> None:
    ended = rig.run(command, "missing.h5")
    assert (ended.code, ended.errors) == (2, ["error: missing.h5: no such file"])
    ended = rig.run(command, "")
    assert (ended.code, ended.errors) == (2, ["error: .: a folder, not a file"])


@pytest.mark.thorough
def test_one_file_that_cannot_be_shown_does_not_hide_the_others(rig: Any, run_file: Path) -> None:
    (rig.folder / "a.h5.sha256").write_text("0" * 64 + "  a.h5\n")
    for name in ("b.h5", "c.h5"):
        shutil.copy(run_file, rig.folder / name)
    ended = rig.run("show", "a.h5.sha256", "b.h5", "missing.h5", "c.h5")
    assert ended.code == 8
    assert ended.errors == [
        "error: a.h5.sha256: a checksum, not the file itself; name a.h5",
        "error: missing.h5: no such file",
    ]
    shown = [line for line in ended.stdout.splitlines() if line.startswith("file: ")]
    assert shown == ["file: b.h5", "file: c.h5"]


def test_a_file_that_the_computer_refuses_does_not_hide_the_others(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def shown(path: Path, *_: object) -> tuple[bool, str]:
        if path.name == "locked":
            raise PermissionError(13, "Permission denied", str(path))
        print(path)
        return True, ""

    monkeypatch.setattr(show, "_show_file", shown)
    with pytest.raises(typer.Exit) as ended:
        show.show([Path("locked"), Path("b.h5")])
    assert ended.value.exit_code == 2
    said = capsys.readouterr()
    assert said.out == "b.h5\n"
    assert said.err == "error: locked: Permission denied; give another name or place\n"


def test_an_import_of_a_missing_file_says_so_in_the_same_words(rig: Any) -> None:
    ended = rig.run("import", "missing.csv", "--channels", "v_1=1,v_2=2")
    assert (ended.code, ended.errors) == (2, ["error: missing.csv: no such file"])


@pytest.mark.thorough
def test_a_file_without_its_checksum_is_not_called_damaged(rig: Any, run_file: Path) -> None:
    shutil.copy(run_file, rig.folder / "alone.h5")
    verified = rig.run("verify", "alone.h5")
    assert verified.code == 8
    assert (
        "the file cannot be checked for corruption; alone.h5.sha256 is missing" in verified.stdout
    )
    assert "copy it along" in verified.stdout
    assert verified.errors == ["error: 1 of 1 file failed verification"]
    shown = rig.run("show", "--no-figures", "alone.h5")
    assert shown.code == 0
    assert "warning: alone.h5: the file cannot be checked for corruption" in shown.stderr


@pytest.mark.thorough
def test_show_draws_into_the_named_folder_and_works_without_figures(
    rig: Any, run_file: Path
) -> None:
    for path in run_file.parent.iterdir():
        shutil.copy(path, rig.folder)
    elsewhere = rig.run("show", run_file.name, "--figures-to", "figures", "--pdf")
    assert elsewhere.code == 0, elsewhere.stderr
    drawn = {path.suffix for path in (rig.folder / "figures").iterdir()}
    assert drawn == {".png", ".svg", ".pdf"}
    assert not list(rig.folder.glob("*.png"))

    refused = rig.run("show", run_file.name, "--figures-to", "/proc/figures")
    assert refused.code == 5, "it was asked for figures"
    assert "status: complete" in refused.stdout
    (line,) = refused.stderr.splitlines()
    assert "no figure was drawn: /proc/figures cannot be written" in line
    assert "--figures-to" in line


def test_verify_tells_every_file_and_counts_the_wrong_ones(rig: Any, run_file: Path) -> None:
    for path in run_file.parent.iterdir():
        shutil.copy(path, rig.folder)
    (rig.folder / "bad.h5").write_text("hello\n")
    ended = rig.run("verify", "bad.h5", run_file.name)

    assert ended.code == 8
    assert ended.stdout.splitlines()[-1] == f"{run_file.name}: sound (complete, 1 of 1 point)"
    assert ended.errors == ["error: 1 of 2 files failed verification"]


@pytest.mark.usefixtures("usual_ways")
@pytest.mark.thorough
def test_a_dry_run_writes_nothing_and_tells_the_true_duration(rig: Any) -> None:
    rehearsed = rig.run("sweep", *SHORT, "--dry-run")
    assert rehearsed.code == 0, rehearsed.stderr
    assert list(rig.folder.iterdir()) == [], "nothing was written"
    reported = rehearsed.object
    assert reported["dry_run"] is True
    assert reported["file"] is None
    assert reported["points_done"] == 2
    assert "nothing was saved" in rehearsed.stderr

    taken = rig.run("sweep", *SHORT)
    assert taken.object["duration_s"] == reported["duration_s"]
    assert reported["duration_s"] > 5, "it homes, approaches and presses the film first"
    for ended in (rehearsed, taken):
        (expected_s,) = re.findall(r"2 points, about ([\d.]+) s of bench time", ended.stderr)
        assert float(expected_s) == pytest.approx(reported["duration_s"], rel=0.25)


@pytest.mark.thorough
def test_a_dry_run_under_a_bench_file_keeps_that_benchs_limits(rig: Any) -> None:
    """The bench itself is not there, and a rehearsal does not miss it."""
    (rig.folder / "bench.toml").write_text(
        'name = "real"\n[fixture]\nmounted = "film-clamp"\n'
        "contact_from_mm = 12.0\ncontact_to_mm = 13.0\n"
        "[film]\n[load_cell]\nsensitivity_V_N = 0.1\n"
        '[generator]\ndriver = "keysight-33500b"\nmax_amplitude_V = 0.5\n'
        'resource = "TCPIP::127.0.0.1::1::SOCKET"\n'
        '[daq]\ndriver = "keysight-u2300a"\nresource = "TCPIP::127.0.0.1::hislip0,1::INSTR"\n'
        "channels = { load_cell = 101, film = 102 }\n"
    )
    allowed = rig.run("sweep", *SHORT, "--load", "0.4N", "--dry-run")
    assert allowed.code == 0, allowed.stderr
    refused = rig.run("sweep", *SHORT, "--load", "1N", "--dry-run")
    assert refused.code == 4
    assert re.search(r"0\.\d+ V is outside 0\.001 to 0\.5 V", refused.errors[0])


@pytest.mark.thorough
def test_a_bench_in_real_time_is_driven_made_safe_and_ended(rig: Any) -> None:
    log = ("--world-log", str(rig.world_log))
    simulator = rig.start("simulate", "--write", "sim.toml", "--seed", "5", *log)
    assert "SIMULATED" in simulator.wait_for(r"drive it with --bench sim\.toml")
    declare_soft_contact(rig.folder / "sim.toml")

    done = rig.run("sweep", *SHORT, "--bench", "sim.toml")
    assert done.code == 0, done.stderr
    assert done.object["simulated"] is True
    assert done.object["points_done"] == 2
    assert "Finished: " in done.stderr
    file = rig.folder / done.object["file"]
    assert verify(file) == []
    with RunFile.open(file) as run:
        assert run.header.simulated
        assert run.header.title.startswith("SIMULATED")
    assert rig.outputs() == [True, False]

    refused = rig.run("sweep", *SHORT, "--bench", "sim.toml", *log)
    assert refused.code == 2
    assert "--world-log belongs to a simulated bench that this command starts" in refused.errors[0]
    refused = rig.run("sweep", *SHORT, "--bench", "sim.toml", "--stages", "az", *log)
    assert "--stages and --world-log belong to a simulated bench" in refused.errors[0]

    safe = rig.run("make-safe", "--bench", "sim.toml")
    assert safe.code == 0
    assert safe.stderr == "simulated: generator, daq, stage_z, force_sensor made safe\n"

    simulator.send(signal.SIGQUIT)  # as SIGINT, which ends it in most other tests
    ended = simulator.finish()
    assert ended.code == 0
    assert "the simulated bench has ended" in ended.stderr

    gone = rig.run("make-safe", "--bench", "sim.toml")
    assert gone.code == 7
    *reasons, last = gone.errors
    for words in ("error: generator: OUTP1 0", "error: daq: STOP", "error: stage_z: "):
        assert [line for line in reasons if line.startswith(words)], words
    assert last.startswith("error: NOT SAFE: ")
    for words in ("generator", "daq", "stage_z", "Switch the bench off by hand and find out why"):
        assert words in last


def test_make_safe_clears_the_mark_that_kept_runs_from_starting_if_no_run_lives(rig: Any) -> None:
    simulator = rig.start("simulate", "--write", "sim.toml")
    simulator.wait_for("drive it")
    rig.mark_unsafe(rig.folder / "sim.toml", {"daq": "silent"})

    refused = rig.run("sweep", *SHORT, "--bench", "sim.toml")
    assert refused.code == 7
    assert re.search("left unsafe at 20.*: daq: silent", refused.errors[0])
    safe = rig.run("make-safe", "--bench", "sim.toml")
    assert safe.code == 0
    assert "daq: silent" in safe.stderr.splitlines()[0], "it says first what is known"
    assert rig.marks() == []
    again = rig.run("sweep", *SHORT, "--bench", "sim.toml", "--load", "1000N")
    assert again.code == 4, "it starts, and meets the next thing that is wrong"

    rig.mark_running(rig.folder / "sim.toml")
    at_work = rig.run("make-safe", "--bench", "sim.toml")
    assert at_work.code == 7
    assert f"(process {os.getpid()}) still uses the bench and may move it" in at_work.errors[-1]
    assert {mark["state"] for mark in rig.marks()} == {"running"}, "it is the run's to remove"
    simulator.send(signal.SIGTERM)
    assert simulator.finish().code == 0


def test_a_make_safe_that_fails_keeps_runs_from_starting(rig: Any) -> None:
    simulator = rig.start("simulate", "--write", "sim.toml")
    simulator.wait_for("drive it")
    path = rig.folder / "sim.toml"
    text = path.read_text()
    cut_off = re.sub(r"::\d+::SOCKET", "::1::SOCKET", text)
    assert cut_off != text
    path.write_text(cut_off)
    assert rig.run("make-safe", "--bench", "sim.toml").code == 7

    path.write_text(text)  # the generator's cable is plugged in again
    refused = rig.run("sweep", *SHORT, "--bench", "sim.toml")
    assert refused.code == 7
    assert re.search("left unsafe at 20.*: generator: ", refused.errors[0])
    assert rig.run("make-safe", "--bench", "sim.toml").code == 0
    assert rig.marks() == []
    simulator.send(signal.SIGTERM)
    assert simulator.finish().code == 0


def test_a_run_on_a_simulated_bench_that_has_ended_says_what_to_do(rig: Any) -> None:
    simulator = rig.start("simulate", "--write", "my sim.toml")
    simulator.wait_for("drive it")
    simulator.send(signal.SIGTERM)
    assert simulator.finish().code == 0

    refused = rig.run("sweep", *SHORT, "--bench", "my sim.toml")
    assert refused.code == 3
    (error,) = refused.errors
    assert "force_sensor of the simulated bench of my sim.toml cannot be connected (gen" in error
    assert "with rig simulate --fixture film-clamp --write 'my sim.toml' and the other" in error
    assert "this replaces the file" in error


def test_make_safe_on_a_file_without_instruments_says_that_nothing_was_there(rig: Any) -> None:
    (rig.folder / "empty.toml").write_text('name = "b"\n[fixture]\nmounted = "plate"\n')
    nothing = rig.run("make-safe", "--bench", "empty.toml")
    assert nothing.code == 2
    assert "empty.toml names no instruments: nothing was made safe" in nothing.errors[0]


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("make-safe", "--bench", "none.toml"), "none.toml"),
        (("sweep", "--bench", "none.toml"), "none.toml"),
        (("sweep", "--world", "none.toml"), "none.toml"),
        (("sweep", "--fault", "none.toml"), "none.toml"),
        (("simulate", "--world", "none.toml"), "none.toml"),
    ],
)
@pytest.mark.thorough
def test_a_file_that_is_not_there_is_a_usage_error(
    rig: Any, arguments: tuple[str, ...], reported: str
) -> None:
    ended = rig.run(*arguments)
    assert ended.code == 2, ended.stderr
    (error,) = ended.errors
    assert reported in error
    assert "Traceback" not in ended.stderr
